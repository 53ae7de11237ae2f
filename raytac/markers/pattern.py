"""Dots on the coat: positions at rest, which the camera must see, and printed ink."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from raytac.errors import InputError, SpecError
from raytac.gel.surface import PadGrid, rest_height
from raytac.optics.camera import Pinhole
from raytac.specs.sensor import MarkerSpec, SensorSpec


def marker_centres(spec: MarkerSpec) -> np.ndarray:
    """x, y of the dots at rest [m], pad frame, (M, 2); dot (j, i) is j · columns + i."""
    x = spec.offset[0] + (np.arange(spec.columns) - 0.5 * (spec.columns - 1)) * spec.pitch[0]
    y = spec.offset[1] + (np.arange(spec.rows) - 0.5 * (spec.rows - 1)) * spec.pitch[1]
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1).reshape(-1, 2)


def camera_of(sensor: SensorSpec, resolution: tuple[int, int] | None = None) -> Pinhole:
    """Camera of the sensor at ``resolution`` (width, height) [px]; None is the sensor's own."""
    if sensor.refraction.model == "none":
        return Pinhole.from_spec(sensor.camera, resolution)
    from raytac.optics.refraction import Slab

    return Pinhole.from_spec(sensor.camera, resolution, Slab.from_spec(sensor))


@dataclass(frozen=True)
class MarkerPattern:
    """Dots at rest, the same in B environments or shifted in each."""

    rest: np.ndarray
    """Positions on the surface at rest, pad frame [m], shape (1 or B, M, 3)."""
    pixel: np.ndarray
    """Projections of ``rest`` by ``camera`` [px], shape (1 or B, M, 2)."""
    camera: Pinhole
    radius: float
    """Radius of a dot [m]."""

    @classmethod
    def of(
        cls,
        sensor: SensorSpec,
        resolution: tuple[int, int] | None = None,
        *,
        shift: np.ndarray | None = None,
        turn: np.ndarray | None = None,
    ) -> MarkerPattern:
        """Place the sensor's dots, turned about the pad's centre, then shifted.

        Args:
            shift: (B, 2) [m].
            turn: (B,) [rad].

        Raises:
            InputError: the sensor has no markers, or a shift takes one off the pad or out of the view.
            SpecError: a marker at rest lies outside the camera's view; names the sensor's file.
        """
        spec, pad = sensor.markers, sensor.gelpad
        if spec.rows == 0:
            rule = "has no markers; give it a pattern ([markers] in its file), or take a sensor that has one, such as gelsight_mini_7x9"
            raise InputError("sensor", value=sensor.name, rule=rule)
        xy = marker_centres(spec)[None]
        if turn is not None:
            c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
            xy = np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)
        if shift is not None:
            xy = xy + np.asarray(shift, float)[:, None, :]
        if (np.abs(xy) > 0.5 * np.asarray(pad.size)).any():
            rule = "takes a marker off the pad (largest |x|, |y| in mm)"
            raise InputError("shift", value=1e3 * float(np.abs(xy).max()), rule=rule)
        rest = np.concatenate([xy, rest_height(pad, xy[..., 0], xy[..., 1])[..., None]], axis=-1)
        camera = camera_of(sensor, resolution)
        pixel = camera.project(rest)
        outside = ((pixel < 0) | (pixel > np.asarray(camera.resolution))).any(axis=-1)
        if outside.any():
            b, m = np.argwhere(outside)[0]
            row, column = divmod(int(m), spec.columns)
            at = tuple(round(float(v), 1) for v in pixel[b, m])
            width, height = camera.resolution
            rule = f"marker (row {row}, column {column}) lies outside the view: at pixel {at} of an image of {width} x {height}"
            if shift is not None or turn is not None:
                place = tuple(1e3 * float(v) for v in xy[b, m])
                raise InputError("shift", value=place, rule=rule + " (value: its position in mm)")
            raise SpecError(rule, file=sensor.source, key="markers.pitch_mm", value=[1e3 * p for p in spec.pitch])
        return cls(rest, pixel, camera, spec.radius)

    @property
    def count(self) -> int:
        """Number of dots M."""
        return self.rest.shape[1]

    def for_batch(self, batch: int) -> np.ndarray:
        """``rest`` of ``batch`` environments, (B, M, 3); InputError if shifted for another number."""
        if len(self.rest) not in (1, batch):
            raise InputError("batch", value=batch, rule=f"the pattern was placed for {len(self.rest)} environments")
        return np.broadcast_to(self.rest, (batch, *self.rest.shape[1:]))


def dot_ink(grid: PadGrid, centres: np.ndarray, radius: float) -> np.ndarray:
    """Coverage by round dots, shape (B, Ny, Nx), float32 in [0, 1].

    ``centres`` [m], (B, M, 2) or (B, M, 3), pad frame: present positions of the dots; ``radius`` [m]. A dot stays round: the strain inside
    it is neglected. Its edge is one grid spacing wide, so that images interpolate it without steps. Centres that are not finite print no
    dot.
    """
    return DotInk(grid, radius)(centres)


class DotInk:
    """``dot_ink`` of one grid and radius for frame after frame; memory and launch stay."""

    def __init__(self, grid: PadGrid, radius: float) -> None:
        self.grid, self._radius = grid, radius
        self._centres, self._ink = np.empty((0, 0, 2)), np.empty(0)
        self._print: Any = None

    def __call__(self, centres: np.ndarray) -> np.ndarray:
        """As of ``dot_ink``."""
        shape = *centres.shape[:2], 2
        if shape != self._centres.shape:
            self._make(shape)
        self._centres[:] = centres[..., :2]
        self._print()
        return self._ink.copy()

    def _make(self, shape: tuple[int, ...]) -> None:
        """Memory and launch for centres of a shape, whose number of pads seldom changes."""
        import warp as wp

        from raytac.markers.ink_kernels import DeviceInk
        from raytac.warp_runtime import Recorded

        dots = DeviceInk(self.grid, self._radius, num_envs=shape[0])
        centres = wp.zeros(shape[:2], dtype=wp.vec2d, device="cpu")
        self._print = Recorded(partial(dots, centres))
        self._centres, self._ink = centres.numpy(), dots.ink.numpy()
