"""Optical modes that shade a height image: the camera's view of the coat as one height a pixel, and a colour from its slopes.

The Taxim table and Phong's model know nothing of rays, so one front step serves both: each pixel's ray is intersected with the
height field by two Newton steps, and slopes follow by central differences between neighbouring pixels, as published. Everything is
Dr.Jit code on device arrays, one thread a pixel of every environment, recorded once for each batch size and replayed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from raytac.device import total_memory
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.base import OpticsImages
from raytac.optics.camera import Pinhole
from raytac.optics.ink import checked_ink, darkened, ink_at
from raytac.optics.refraction import Slab
from raytac.optics.runtime import ROUNDING, check_batch, largest_batch, load_mitsuba, no_collection
from raytac.optics.surface_check import check_same_grid, check_shapes, check_view, device_envs, safe_heights
from raytac.optics.trace.fast_tracer import RayTracer
from raytac.optics.trace.height_field import CoatLayout
from raytac.specs.sensor import SensorSpec

__all__ = ["HEIGHT_MODE_OUTPUTS", "ImageHeights", "ImageMode", "see_heights"]

HEIGHT_MODE_OUTPUTS = ("rgb", "normals", "depth")
"""Optical outputs of these modes: they know colours, not the light of each LED."""


@dataclass(frozen=True)
class ImageHeights:
    """What the pixels of B images see, as device arrays of B·H·W; lengths in image pixels (of the pitch along x)."""

    height: Any
    """−z of the coat [px]: grows towards the camera."""
    moved: Any
    """Displacement from rest [px]: rest − z."""
    contact: Any
    """1 where the object touches, else 0 (UInt8); None if nobody asked."""
    envs: int
    resolution: tuple[int, int]
    """(width, height) [px]."""
    aspect: float = 1.0
    """Pitch along x over pitch along y."""
    ink: Any = None
    """Share of marker dots; None without dots."""

    def pixel(self, mi: Any) -> tuple[Any, Any, Any, Any]:
        """(index, index in the image, column, row) of every pixel of the batch."""
        width, height = self.resolution
        i = dr.arange(mi.UInt32, self.envs * width * height)
        p = i % (width * height)
        return i, p, p % width, p // width

    def slopes(self, mi: Any, of: Any) -> tuple[Any, Any, list[Any]]:
        """(s_x, s_y, the four neighbours' values) by central differences of ``of``; the rim repeats the pixels next to it (upstream)."""
        width, height = self.resolution
        i, _, column, row = self.pixel(mi)
        first = i - row * width - column
        inner = first + dr.clip(row, 1, height - 2) * width + dr.clip(column, 1, width - 2)
        near = [dr.gather(mi.Float, of, k) for k in (inner + 1, inner - 1, inner + width, inner - width)]
        return 0.5 * (near[0] - near[1]), 0.5 * self.aspect * (near[2] - near[3]), near


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
    width, height = camera.resolution
    envs = dr.width(heights) // (g.nx * g.ny)
    i = dr.arange(mi.UInt32, envs * width * height)
    env, p = i // (width * height), i % (width * height)
    origin, (tx, ty) = camera.ray(mi.Float(p % width) + 0.5, mi.Float(p // width) + 0.5)
    ox, oy, oz = origin

    def cell(z: Any) -> tuple[Any, Any, Any]:
        fx = dr.clip((ox + (z - oz) * tx - g.x0) / g.dx, 0, g.nx - 1.001)
        fy = dr.clip((oy + (z - oz) * ty - g.y0) / g.dy, 0, g.ny - 1.001)
        ix, iy = mi.UInt32(fx), mi.UInt32(fy)
        return iy * g.nx + ix, fx - mi.Float(ix), fy - mi.Float(iy)

    def corners(of: Any, k: Any) -> list[Any]:
        return [dr.gather(mi.Float, of, k + offset) for offset in (0, 1, g.nx, g.nx + 1)]

    first = env * (g.nx * g.ny)
    z = mi.Float(0)
    for _ in range(2):
        k, wx, wy = cell(z)
        a, b, c, d = corners(heights, first + k)
        top, bottom = dr.lerp(a, b, wx), dr.lerp(c, d, wx)
        along = dr.lerp(b - a, d - c, wy) / g.dx * tx + (bottom - top) / g.dy * ty
        z += (dr.lerp(top, bottom, wy) - z) / dr.maximum(1 - along, 0.5)
    k, wx, wy = cell(z)
    now, before = corners(heights, first + k), corners(rest, k)

    def blend(v: list[Any]) -> Any:
        return dr.lerp(dr.lerp(v[0], v[1], wx), dr.lerp(v[2], v[3], wx), wy) * (1 / pitch[0])

    # Differences first, so that a coat at rest has moved by exactly nothing.
    moved = blend([r - n for r, n in zip(before, now, strict=True)])
    touched = None
    if contact is not None:
        nearest = k + dr.select(wx > 0.5, 1, 0) + dr.select(wy > 0.5, g.nx, 0)
        touched = dr.gather(mi.UInt8, contact, first + nearest)
    dots = None if ink is None else ink_at(mi, g, ink, env, ox + (z - oz) * tx, oy + (z - oz) * ty)
    return ImageHeights(-blend(now), moved, touched, envs, (width, height), pitch[0] / pitch[1], dots)


class ImageMode(ABC):
    """Base of the modes that shade height images; fulfils ``raytac.optics.base.OpticalMode``.

    A mode gives ``_inputs`` (every device array that a frame reads, for the recording), ``_levels`` and ``_floats_per_pixel``.
    """

    label: str
    needs_contact = False
    """Whether a frame reads where the object touches."""

    def __init__(self, sensor: SensorSpec, *, resolution: tuple[int, int] | None, outputs: tuple[str, ...], device: str) -> None:
        for name in outputs:
            if name not in HEIGHT_MODE_OUTPUTS:
                rule = f"must be an output of optics={self.label.partition('-')[0]!r}; only the ray tracer has layers"
                raise InputError("outputs", value=name, rule=rule, choices=HEIGHT_MODE_OUTPUTS)
        if resolution is not None and (len(resolution) != 2 or min(resolution) < 3):
            raise InputError("resolution", value=resolution, rule="must be (width, height), each >= 3 pixels")
        self.mi, self.device = load_mitsuba(device)
        self.sensor, self.outputs = sensor, tuple(outputs)
        slab = Slab.from_spec(sensor)
        self.camera = Pinhole.from_spec(sensor.camera, resolution, slab)
        self.pitch = sensor.camera.pitch_at(self.camera.resolution)
        """Size of an image pixel on the plane z = 0 along x and y [m]."""
        self._memory = total_memory(self.device)
        self._grid: PadGrid | None = None
        self._frozen: dict[tuple[str, int], Any] = {}
        self._geometry: RayTracer | None = None

    # ---------------------------------------------------------------- what a mode gives

    @abstractmethod
    def _build(self, grid: PadGrid) -> Any:
        """Device arrays that a frame reads besides the surface, a frozen dataclass; called once, for the first grid."""

    @abstractmethod
    def _levels(self, seen: ImageHeights, inputs: Any) -> tuple[list[Any], Any]:
        """Three channels of B·H·W levels, neither rounded nor clipped, and flags (B·H·W, or one unused value)."""

    @abstractmethod
    def _floats_per_pixel(self) -> float:
        """Device memory that ``_levels`` holds at its peak, in floats a pixel."""

    # ---------------------------------------------------------------- memory

    def memory_per_env(self, grid: PadGrid) -> int:
        """Most device memory that an environment of a batch on ``grid`` takes [byte]: nodes, height images, those on the way, the last."""
        width, height = self.camera.resolution
        nodes = grid.rest.size * (9 if self.needs_contact else 8)  # height, ink and contact
        # Heights, displacement and ink, what the mode holds; contact and flags; three channels and their bytes.
        return ROUNDING * (nodes + round(width * height * (4 * (3 + self._floats_per_pixel()) + 2 + 15)))

    def largest_batch(self, grid: PadGrid) -> int:
        """Largest number of environments that one call may render on ``grid``."""
        width, height = self.camera.resolution
        return largest_batch(self._memory, self.memory_per_env(grid), 4 * max(width * height, grid.rest.size))

    def _check_batch(self, envs: int, grid: PadGrid) -> None:
        each = self.memory_per_env(grid)
        check_batch(envs, self.largest_batch(grid), per_env=each, memory=self._memory, device=self.device)

    # ---------------------------------------------------------------- images

    def prepare(self, grid: PadGrid) -> None:
        """Build what depends on the pad's grid; done at the first frame and kept.

        Raises:
            InputError: the camera sees beyond the pad, or a second grid.
        """
        if self._grid is not None:
            check_same_grid(grid, self._grid)
            return
        check_view(self.camera, grid)
        self.layout = CoatLayout.from_grid(grid)
        self._rest = self.mi.Float(grid.rest.astype(np.float32).ravel())  # a copy: see ``recording``
        self._inputs = self._build(grid)
        self._grid = grid

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface``; see ``OpticsImages`` for the shapes.

        An environment whose heights are not finite fails alone: its ``rgb`` is 0, its other images are NaN, its contact is False.

        Raises:
            InputError: a surface whose arrays do not have the shape of its grid, an empty batch, one too large, or a second grid.
        """
        images = OpticsImages()
        if {"normals", "depth"} & set(self.outputs):
            images = self._ray_cast(surface)
        if "rgb" not in self.outputs:
            return images
        heights, contact, failed = self._upload(surface)
        width, height = self.camera.resolution
        rgb, flags = self.render_device(heights, contact, self._upload_ink(surface))
        image = np.array(rgb).reshape(surface.batch, height, width, 3)
        image[failed] = 0
        return replace(images, rgb=image, uncovered=self._uncovered(np.array(flags), failed))

    def render_levels(self, surface: GelSurface) -> np.ndarray:
        """The image before rounding and clipping [levels, 0-255], shape (B, H, W, 3), float32; NaN where an environment failed."""
        heights, contact, failed = self._upload(surface)
        channels, _ = self._inked_levels(self._see(heights, contact, self._rest, self._upload_ink(surface)), self._inputs)
        width, height = self.camera.resolution
        image = np.stack([np.array(c) for c in channels], axis=-1).reshape(surface.batch, height, width, 3)
        image[failed] = np.nan
        return image

    def image_heights(self, surface: GelSurface) -> tuple[np.ndarray, np.ndarray]:
        """(−z, rest − z) of the coat through every pixel's centre [image pixels], each (B, H, W) float32."""
        heights, contact, failed = self._upload(surface)
        seen = self._see(heights, contact, self._rest, None)
        width, height = self.camera.resolution
        found = [np.array(v).reshape(surface.batch, height, width) for v in (seen.height, seen.moved)]
        for image in found:
            image[failed] = np.nan
        return found[0], found[1]

    def render_device(self, heights: Any, contact: Any = None, ink: Any = None) -> tuple[Any, Any]:
        """On device arrays: heights (B·Ny·Nx) [m], contact (B·Ny·Nx, UInt8, or None) and ink (B·Ny·Nx, or None) to (image, flags).

        The image is B·H·W·3, UInt8. Heights must be finite, which is not checked here.
        Nothing leaves the device. Dr.Jit records the kernels at the first call of a batch size and
        replays them afterwards.

        Raises:
            InputError: nothing was rendered or prepared before, heights of no whole number of grids, contact or ink of another width, or
                a batch too large.
        """
        if self._grid is None:
            raise InputError("heights", value=type(heights).__name__, rule="call prepare(grid) first: it tells the grid")
        others = ({"contact": contact} if self.needs_contact else {}) | ({} if ink is None else {"ink": ink})
        envs = device_envs(self.layout.nx * self.layout.ny, heights, **others)
        self._check_batch(envs, self._grid)
        key = "frame" if ink is None else "frame-ink", envs
        if key not in self._frozen:
            self._frozen[key] = dr.freeze(self._frame)
        touched = contact if self.needs_contact else self.mi.UInt8(0)
        with no_collection():
            return self._frozen[key](heights, touched, self._rest, self._inputs, ink)

    def _frame(self, heights: Any, contact: Any, rest: Any, inputs: Any, ink: Any) -> tuple[Any, Any]:
        mi = self.mi
        channels, flags = self._inked_levels(self._see(heights, contact, rest, ink), inputs)
        levels = dr.ravel(mi.Color3f([dr.clip(c + 0.5, 0, 255) for c in channels]))
        dr.eval(levels, flags)  # in one kernel: flags that are left over would find all bins again
        return mi.UInt8(levels), flags

    def _inked_levels(self, seen: ImageHeights, inputs: Any) -> tuple[list[Any], Any]:
        """``_levels`` with the dots of the markers, if there are some."""
        channels, flags = self._levels(seen, inputs)
        return (channels if seen.ink is None else darkened(self.sensor, channels, seen.ink)), flags

    def _see(self, heights: Any, contact: Any, rest: Any, ink: Any) -> ImageHeights:
        touched = contact if self.needs_contact else None
        seen = see_heights(self.mi, self.layout, self.camera, self.pitch, rest, heights, touched, ink)
        dr.eval(seen.height, seen.moved, seen.contact, seen.ink)
        return seen

    def _upload_ink(self, surface: GelSurface) -> Any:
        ink = checked_ink(surface)
        return None if ink is None else self.mi.Float(ink.ravel())

    def _upload(self, surface: GelSurface) -> tuple[Any, Any, np.ndarray]:
        check_shapes(surface)
        self.prepare(surface.grid)
        self._check_batch(surface.batch, surface.grid)
        heights, failed = safe_heights(surface)
        contact = None
        if self.needs_contact:
            touched = surface.contact & ~failed[:, None, None] if failed.any() else surface.contact
            contact = self.mi.UInt8(np.ascontiguousarray(touched).view(np.uint8).ravel())
        return self.mi.Float(heights.ravel()), contact, failed

    def _uncovered(self, flags: np.ndarray, failed: np.ndarray) -> np.ndarray | None:
        """Share of the contact pixels with an uncovered bin, from the flags of ``_levels``; a mode without coverage has none."""
        return None

    def _ray_cast(self, surface: GelSurface) -> OpticsImages:
        """Normals, positions, depth and contact are those of the ray tracer: geometry has no cheaper truth."""
        if self._geometry is None:
            outputs = tuple(name for name in self.outputs if name != "rgb")
            self._geometry = RayTracer(self.sensor, resolution=self.camera.resolution, outputs=outputs, device=self.device)
        return self._geometry.render(surface)
