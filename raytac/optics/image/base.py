"""Optical modes that shade a height image: one height a pixel, and colour by its slopes.

The Taxim table and Phong's model know nothing of rays, so one front step serves both: each pixel's ray is intersected with the
height field by two Newton steps, and slopes follow by central differences between neighbouring pixels, as published. Everything is
Dr.Jit code on device arrays, one thread a pixel of every environment, recorded once for each batch size and replayed.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.camera import Pinhole
from raytac.optics.device_mode import DeviceMode, Float, FrameInputs, UInt8
from raytac.optics.geometry import CoatLayout, bilinear
from raytac.optics.ink import checked_ink, darkened, ink_at


@dataclass(frozen=True)
class ImageHeights:
    """Surface seen by the pixels of B images, as device arrays of B·H·W.

    Lengths are in image pixels (of the pitch along x). Of a crop there are the pixels around it too, whose heights its slopes need
    (``grown``); ``here`` picks its own.
    """

    height: Any
    """−z of the coat [px]: grows towards the camera."""
    displacement: Any
    """Displacement from rest [px]: rest − z."""
    contact: Any
    """1 where the object touches, else 0 (UInt8); None if not asked for."""
    envs: int
    resolution: tuple[int, int]
    """(width, height) of the whole image [px]."""
    aspect: float = 1.0
    """Pitch along x over pitch along y."""
    ink: Any = None
    """Share of marker dots; None without dots."""
    crop: tuple[int, int, int, int] | None = None
    """Piece that is rendered, (left, top, width, height) [px]; None is all."""

    def pixel(self, mi: Any) -> tuple[Any, Any, Any, Any]:
        """(index here, index in the whole image, column, row) of every pixel that is rendered."""
        first_x, first_y, width, height = self.crop or (0, 0, *self.resolution)
        i = dr.arange(mi.UInt32, self.envs * width * height)
        p = i % (width * height)
        column, row = p % width, p // width
        if self.crop is None:
            return i, p, column, row
        column, row = column + first_x, row + first_y
        left, top, wide, high = grown(self.crop, self.resolution)
        i = i // (width * height) * (wide * high) + (row - top) * wide + (column - left)
        return i, row * self.resolution[0] + column, column, row

    def here(self, mi: Any, values: Any) -> Any:
        """``values`` of these arrays at the pixels that are rendered."""
        if self.crop is None or values is None:
            return values
        return dr.gather(type(values), values, self.pixel(mi)[0])

    def slopes(self, mi: Any, of: Any) -> tuple[Any, Any, list[Any]]:
        """(s_x, s_y, four neighbours) by central differences; rims repeat the next pixel (upstream)."""
        width, height = self.resolution
        left, top, wide, _ = grown(self.crop, self.resolution)
        i, _, column, row = self.pixel(mi)
        first = i - (row - top) * wide - (column - left)
        inner = first + (dr.clip(row, 1, height - 2) - top) * wide + (dr.clip(column, 1, width - 2) - left)
        near = [dr.gather(mi.Float, of, k) for k in (inner + 1, inner - 1, inner + wide, inner - wide)]
        return 0.5 * (near[0] - near[1]), 0.5 * self.aspect * (near[2] - near[3]), near


def grown(crop: tuple[int, int, int, int] | None, resolution: tuple[int, int]) -> tuple[int, int, int, int]:
    """A crop with the pixels around it that slopes need, at least three; None: the whole image."""
    columns, rows = resolution
    left, top, width, height = crop or (0, 0, columns, rows)
    x0, y0 = max(min(left - 1, columns - 3), 0), max(min(top - 1, rows - 3), 0)
    x1, y1 = min(max(left + width + 1, 3), columns), min(max(top + height + 1, 3), rows)
    return x0, y0, x1 - x0, y1 - y0


def see_heights(
    mi: Any,
    layout: CoatLayout,
    camera: Pinhole,
    pitch: tuple[float, float],
    rest: Any,
    heights: Any,
    contact: Any,
    ink: Any = None,
) -> ImageHeights:
    """Heights that the pixels' central rays meet.

    ``rest`` (Ny·Nx) and ``heights`` (B·Ny·Nx) [m] are device Floats, ``contact`` (B·Ny·Nx) a UInt8 or None, ``ink`` (B·Ny·Nx) a Float or
    None, ``pitch`` the size of an image pixel on z = 0 [m].

    On a ray p(z) = o + (z − o_z) (t_x, t_y, 1) the coat Z(x, y) is met where Z(p(z)) = z. Newton's step is
    z ← z + (Z − z) / (1 − ∇Z · t), two of them from z = 0; where the coat is steeper than half the ray the step is that of slope 1/2.
    """
    g = layout
    wide = replace(camera, crop=grown(camera.crop, camera.resolution))
    width, height = wide.size
    envs = dr.width(heights) // (g.nx * g.ny)
    i = dr.arange(mi.UInt32, envs * width * height)
    env = i // (width * height)
    column, row = wide.pixel(i % (width * height))
    (ox, oy, oz), (tx, ty) = camera.ray(mi.Float(column) + 0.5, mi.Float(row) + 0.5)

    def cell(z: Any) -> tuple[Any, Any, Any]:
        return g.cell(mi, 0, ox + (z - oz) * tx, oy + (z - oz) * ty)

    first = env * (g.nx * g.ny)
    z = mi.Float(0)
    for _ in range(2):
        k, wx, wy = cell(z)
        a, b, c, d = g.corners(mi.Float, heights, first + k)
        top, bottom = dr.lerp(a, b, wx), dr.lerp(c, d, wx)
        along = dr.lerp(b - a, d - c, wy) / g.dx * tx + (bottom - top) / g.dy * ty
        z += (dr.lerp(top, bottom, wy) - z) / dr.maximum(1 - along, 0.5)
    k, wx, wy = cell(z)
    now, before = g.corners(mi.Float, heights, first + k), g.corners(mi.Float, rest, k)
    # Differences first, so that the displacement of a coat at rest is exactly 0.
    displacement = bilinear([r - n for r, n in zip(before, now, strict=True)], wx, wy) * (1 / pitch[0])
    height = -(bilinear(now, wx, wy) * (1 / pitch[0]))
    touched = None
    if contact is not None:
        nearest = k + dr.select(wx > 0.5, 1, 0) + dr.select(wy > 0.5, g.nx, 0)
        touched = dr.gather(mi.UInt8, contact, first + nearest)
    dots = None if ink is None else ink_at(mi, g, ink, env, ox + (z - oz) * tx, oy + (z - oz) * ty)
    return ImageHeights(height, displacement, touched, envs, camera.resolution, pitch[0] / pitch[1], dots, camera.crop)


def grey_levels(channels: list[Any]) -> list[Any]:
    """The mean of three channels in each: what a monochrome camera makes of a model of colours."""
    return [(channels[0] + channels[1] + channels[2]) / 3] * 3


class ImageMode(DeviceMode):
    """Base of the modes that shade height images, by ``_levels`` and ``_floats_per_pixel``."""

    _smallest_side = 3
    _longest_row = 4

    def _set_up(self) -> None:
        self.pitch = self.sensor.camera.pitch_at(self.camera.resolution)
        """Size of an image pixel on the plane z = 0 along x and y [m]."""

    @abstractmethod
    def _levels(self, seen: ImageHeights, arrays: Any) -> tuple[list[Float], UInt8]:
        """Three channels of B·H·W levels, not clipped, and flags (B·H·W, or one unused value)."""

    @abstractmethod
    def _floats_per_pixel(self) -> float:
        """Device memory that ``_levels`` holds at its peak, in floats a pixel."""

    def _bytes_per_env(self, grid: PadGrid) -> int:
        _, _, width, height = grown(self.camera.crop, self.camera.resolution)
        nodes = grid.rest.size * (9 if self.needs_contact else 8)  # height, ink and contact
        # Heights, displacement and ink, what the mode holds; contact and flags; three channels and their bytes.
        return self._lit * (nodes + round(width * height * (4 * (3 + self._floats_per_pixel()) + 2 + 15)))

    def _frame(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> tuple[UInt8, list[Float], UInt8]:
        mi = self.mi
        channels, flags = self._inked_levels(self._see(heights, contact, inputs), inputs)
        levels = dr.ravel(mi.Color3f([dr.clip(c + 0.5, 0, 255) for c in channels]))
        dr.eval(levels, flags)  # in one kernel: flags that are left over would find all bins again
        return mi.UInt8(levels), [], flags

    def _inked_levels(self, seen: ImageHeights, inputs: FrameInputs) -> tuple[list[Float], UInt8]:
        """``_levels`` with the dots of the markers, if there are some."""
        channels, flags = self._levels(seen, inputs.own)
        if seen.ink is not None:
            channels = darkened(self.sensor, channels, seen.here(self.mi, seen.ink))
        return (grey_levels(channels) if self.sensor.camera.monochrome else channels), flags

    def _see(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> ImageHeights:
        seen = see_heights(self.mi, self.layout, self.camera, self.pitch, inputs.rest, heights, contact, inputs.ink)
        dr.eval(seen.height, seen.displacement, seen.contact, seen.ink)
        return seen

    def _seen_now(self, surface: GelSurface, *, dotted: bool) -> tuple[ImageHeights, FrameInputs, np.ndarray]:
        """Surface seen by the pixels, without a recording; its inputs; mask of failed environments."""
        heights, failed = self._checked(surface)
        inputs = replace(self._inputs, ink=self._upload_ink(checked_ink(surface)) if dotted else None)
        return self._see(self._upload(heights), self._upload_contact(surface, failed), inputs), inputs, failed

    def render_levels(self, surface: GelSurface) -> np.ndarray:
        """The image before rounding [levels, 0-255], (B, H, W, 3) float32; NaN where it failed."""
        seen, inputs, failed = self._seen_now(surface, dotted=True)
        channels, _ = self._inked_levels(seen, inputs)
        image = np.stack([np.array(c) for c in channels], axis=-1).reshape(*self._shape(surface.batch), 3)
        image[failed] = np.nan
        return image

    def image_heights(self, surface: GelSurface) -> tuple[np.ndarray, np.ndarray]:
        """(−z, rest − z) of the coat at every pixel's centre [image pixels], (B, H, W) float32."""
        seen, _, failed = self._seen_now(surface, dotted=False)
        own = (np.array(seen.here(self.mi, v)) for v in (seen.height, seen.displacement))
        heights, displacements = (v.reshape(self._shape(surface.batch)) for v in own)
        heights[failed] = displacements[failed] = np.nan
        return heights, displacements
