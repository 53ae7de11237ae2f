"""The door that every optical mode shares: a GelSurface goes in, images come out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from raytac.gel.surface import GelSurface

__all__ = ["INTEGRATORS", "OPTICAL_OUTPUTS", "OpticalMode", "OpticsImages"]

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
