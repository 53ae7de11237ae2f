"""The door that every optical mode shares: a GelSurface goes in, images come out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.specs.sensor import SensorSpec

__all__ = ["INTEGRATORS", "OPTICAL_OUTPUTS", "OpticalMode", "OpticsImages", "chosen_shadows"]

INTEGRATORS = ("fast", "reference", "path")
"""Integrators of the ray tracer."""
OPTICAL_OUTPUTS = ("rgb", "layers", "normals", "depth")
"""Outputs that need an optical mode; without them no renderer is imported."""


@dataclass(frozen=True)
class OpticsImages:
    """Images of B sensors; fields as in ``TactileFrame``, None where not asked for."""

    rgb: np.ndarray | None = None
    layers: dict[str, np.ndarray] | None = None
    normals: np.ndarray | None = None
    position: np.ndarray | None = None
    depth: np.ndarray | None = None
    contact: np.ndarray | None = None
    uncovered: np.ndarray | None = None
    """Share of each image's contact pixels, (B,), whose table bin no calibration sample reached; None where that is unknown."""


class OpticalMode(Protocol):
    """One way to make images, built once for one sensor, resolution and set of outputs."""

    label: str
    """Mode label for headers and reports, e.g. ``raytrace-fast``."""
    device: str
    """``"cpu"`` or ``"cuda"``: where it runs."""

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface``."""
        ...


def chosen_shadows(sensor: SensorSpec, shadows: bool | None, integrator: str = "fast") -> bool:
    """Whether shadows are cast: as asked for, else as the sensor says.

    Raises:
        InputError: neither a truth value nor None, or False for an integrator that follows light as it goes.
    """
    if shadows is not None and not isinstance(shadows, bool):
        raise InputError("shadows", value=shadows, rule="must be True, False or None", choices=(True, False, None))
    if shadows is False and integrator != "fast":
        rule = f"is for the integrator 'fast': {integrator!r} follows light as it goes, shadows and all"
        raise InputError("shadows", value=shadows, rule=rule, choices=(True, None))
    return sensor.optics.shadows if shadows is None else shadows
