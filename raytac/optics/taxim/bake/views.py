"""The camera's view of calibration presses: their ray-traced images and slopes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import drjit as dr
import numpy as np

from raytac.gel.surface import GelSurface, PadGrid, grid_pitch, make_grid
from raytac.optics.device_mode import upload
from raytac.optics.image.base import see_heights
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.sampled_tracer import ray_tracer
from raytac.specs.sensor import SensorSpec

_BATCH = {"cpu": 8, "cuda": 32}


@dataclass(frozen=True)
class Views:
    """Images of a batch of presses and the geometry behind them; all NumPy, first axis B."""

    rgb: np.ndarray
    """(B, H, W, 3) uint8."""
    slope_x: np.ndarray
    """∂(rest − z)/∂x, (B, H, W) float32."""
    slope_y: np.ndarray
    moved: np.ndarray
    """rest − z [m], (B, H, W) float32."""
    contact: np.ndarray
    """(B, H, W) bool."""


class Calibration:
    """The ray tracer of one sensor set up for calibration presses."""

    def __init__(
        self,
        sensor: SensorSpec,
        *,
        device: str = "auto",
        resolution: tuple[int, int] | None = None,
        seed: int = 0,
        flat_field: np.ndarray | None = None,
    ) -> None:
        """``flat_field`` as of ``RayTraced``, the rest and errors as of its ``build``."""
        self.sensor = sensor
        self.tracer = ray_tracer(sensor, RayTraced(flat_field=flat_field), resolution=resolution, device=device, seed=seed)
        # Direct light alone, with and without cast shadows: their difference is shadow and nothing else.
        direct = (RayTraced(flat_field=flat_field, bounce=False, shadows=shadows) for shadows in (True, False))
        self._direct = [ray_tracer(self.tracer.sensor, one, resolution=resolution, device=device) for one in direct]
        self.pitch = sensor.camera.pitch_at(self.tracer.camera.resolution)
        """Size of an image pixel on the plane z = 0 along x and y [m]."""
        self.grid: PadGrid = make_grid(sensor.gelpad, grid_pitch(self.pitch))
        """Nodes of the presses, as fine as the image."""
        rest = GelSurface.at_rest(self.grid)
        rgb = self.tracer.render(rest).rgb
        assert rgb is not None
        self.rest_image: np.ndarray = rgb[0]
        """(H, W, 3) uint8."""
        self._rest = self.tracer.mi.Float(rest.height.ravel())

    def views(self, presses: Iterable[GelSurface]) -> Iterator[Views]:
        """Render ``presses`` on ``grid`` in batches, with slopes as the table mode sees them."""
        for surface in self._batches(presses):
            yield self._view(surface)

    def shadow_views(self, presses: Iterable[GelSurface]) -> Iterator[tuple[Views, np.ndarray]]:
        """As ``views``, with the change by shadows [levels], (B, H, W, 3) int16, negative in them."""
        for surface in self._batches(presses):
            with_shadows, without = (tracer.render(surface).rgb for tracer in self._direct)
            assert with_shadows is not None and without is not None
            yield self._view(surface), with_shadows.astype(np.int16) - without

    def _batches(self, presses: Iterable[GelSurface]) -> Iterator[GelSurface]:
        presses = iter(presses)
        while some := list(islice(presses, _BATCH[self.tracer.device])):
            height, contact, centre = (
                np.concatenate([getattr(s, a) for s in some]) for a in ("height", "contact", "contact_centre")
            )
            yield GelSurface(self.grid, height, contact, centre)

    def _view(self, surface: GelSurface) -> Views:
        tracer, mi = self.tracer, self.tracer.mi
        rgb = tracer.render(surface).rgb
        assert rgb is not None
        heights, contact = upload(mi, surface)
        seen = see_heights(mi, tracer.layout, tracer.camera, self.pitch, self._rest, heights, contact)
        dr.eval(seen.height, seen.displacement, seen.contact)
        slope_x, slope_y, _ = seen.slopes(mi, seen.displacement)
        dr.eval(slope_x, slope_y)
        x, y, moved, touched = (np.array(v).reshape(rgb.shape[:3]) for v in (slope_x, slope_y, seen.displacement, seen.contact))
        return Views(rgb, x, y, moved * np.float32(self.pitch[0]), touched.astype(bool))
