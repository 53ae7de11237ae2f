"""FOTS: markers pushed apart by the indentation, dragged by shear and turned by twist; for pads whose height is all that is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.contacts import ContactCells, Contacts, ContactSamples
from raytac.specs.marker_motion import MarkerMotionSpec
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.markers.fots_kernel import FotsConstants

__all__ = ["FotsMarkers", "fots_constants", "marker_motion_of"]


def marker_motion_of(sensor: SensorSpec) -> MarkerMotionSpec:
    """The sensor's fitted marker motion.

    Raises:
        InputError: nobody calibrated it.
    """
    if sensor.marker_motion is None:
        rule = (
            "has no marker motion: `raytac calibrate markers --sensor NAME` fits one and writes marker_motion.toml, "
            "which the sensor's file names as marker_motion"
        )
        raise InputError("sensor", value=sensor.name, rule=rule)
    return sensor.marker_motion


def fots_constants(motion: MarkerMotionSpec) -> FotsConstants:
    """What the kernel needs of a marker motion."""
    from raytac.markers.fots_kernel import FotsConstants

    return FotsConstants(
        motion.dilate_gain,
        motion.dilate_lambda,
        motion.shear_lambda,
        motion.shear_max,
        motion.twist_lambda,
        motion.twist_max,
        motion.punch,
    )


class FotsMarkers:
    """The model ``fots``; formulas and sources in ``raytac.markers.fots_kernel``, constants from the sensor's marker motion."""

    name = "fots"
    needs_contacts = True

    def __init__(self, sensor: SensorSpec, grid: PadGrid, *, device: str = "auto") -> None:
        """Raises ``InputError`` if the sensor has no marker motion, ``BackendError`` if Dr.Jit cannot run on ``device``."""
        from raytac.markers.fots_kernel import FotsKernel

        motion = marker_motion_of(sensor)
        cells = ContactCells.over(grid)
        self._rest: np.ndarray | None = None
        self._xy: np.ndarray | None = None
        self._kernel = FotsKernel(cells.x, cells.y, device=device)
        self.device = self._kernel.device
        self.constants = fots_constants(motion)

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert samples is not None and contacts is not None
        if self._xy is None or rest is not self._rest:
            self._rest, self._xy = rest, rest[..., :2]  # one view for every frame: the kernel knows it again
        return self._kernel.displacement(self._xy, samples.depth, samples.boxes, contacts.table, self.constants)
