"""Heights on the device to a learner's images: cut, averaged, compared with that at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.checks import check_methods
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.device_mode import Float, UInt8, upload
from raytac.optics.runtime import RENDERER, no_collection


@dataclass(frozen=True)
class ImageCut:
    """Crop of a rendered image, in pixels of the observed one."""

    size: tuple[int, int]
    """(width, height) of the observed image."""
    x: int
    """First column [px]."""
    y: int
    """First row [px]."""
    downscale: int
    """Rendered pixels along both sides of an observed one, which is their mean, rounded half up."""


class DeviceImage:
    """One optical mode whose images are cut on the device; one recording a batch size."""

    def __init__(self, mode: Any, grid: PadGrid, cut: ImageCut, *, difference: bool, ink: np.ndarray | None = None) -> None:
        """Render the pad at rest once, which prepares the mode for its grid.

        Args:
            mode: one that renders on the device, as ``DeviceMode`` does.
            difference: give (255 + image − image at rest) // 2 instead of the image.
            ink: share of marker dots at rest (1, Ny, Nx); None without.

        Raises InputError: a mode that has no images on the device, or a cut beyond the rendered image.
        """
        what = "a mode that renders on the device, such as taxim, phong or raytrace with the integrator fast"
        check_methods("optics", mode, ("prepare", "render_device"), ("mi", "camera", "outputs"), what)
        if "rgb" not in mode.outputs:
            raise InputError("outputs", value=mode.outputs, rule="must hold 'rgb'")
        self._mode, self._cut, self.mi = mode, cut, mode.mi
        left, top, wide, high = mode.camera.piece if hasattr(mode.camera, "piece") else (0, 0, *mode.camera.resolution)
        self._first = cut.x * cut.downscale - left, cut.y * cut.downscale - top
        self._rendered = wide, high
        (width, height), (right, bottom) = cut.size, mode.camera.resolution
        if (cut.x + width) * cut.downscale > right or (cut.y + height) * cut.downscale > bottom:
            raise InputError("cut", value=cut, rule=f"must lie within the rendered {right}x{bottom}")
        self._nodes = grid.rest.size
        self._is_whole = (width, height) == self._rendered
        self._frozen: dict[int, Any] = {}
        mode.prepare(grid)
        dots = None if ink is None else self.mi.Float(ink.ravel())
        image = mode.render_device(*self.upload(GelSurface.at_rest(grid)), dots).rgb
        self._rest = None
        if difference:
            rest = self._kept(image, 1, None)
            dr.eval(rest)
            self._rest = rest

    def upload(self, surface: GelSurface) -> tuple[Float, UInt8]:
        """Heights (B·Ny·Nx) and contact of a surface on the device; heights must be finite."""
        return upload(self.mi, surface)

    def __call__(self, heights: Float, contact: UInt8 | None = None, ink: Float | None = None) -> Any:
        """Images (B, height, width, 3), uint8, complete: a Dr.Jit tensor that DLPack hands on.

        Args:
            heights: [m], B·Ny·Nx of them on this device, finite, which is not checked: a Dr.Jit array, or a float32 PyTorch tensor.
            contact: where the object touches, as many bytes; only for modes that need it.
            ink: share of marker dots at the nodes, as many; None without.

        Raises InputError: no whole number of grids, or contact missing.
        """
        with RENDERER:
            mi = self.mi
            given = ((heights, mi.Float), (contact, mi.UInt8), (ink, mi.Float))
            heights, contact, ink = (self._array(values, kind) for values, kind in given)
            image = self._mode.render_device(heights, contact, ink).rgb
            envs = dr.width(heights) // self._nodes
            if not self._is_whole or self._rest is not None:
                if envs not in self._frozen:
                    self._frozen[envs] = dr.freeze(lambda image, rest: self._kept(image, envs, rest))
                with no_collection():
                    image = self._frozen[envs](image, self._rest)
            width, height = self._cut.size
            dr.eval(image)
            dr.sync_thread()  # another library's stream does not wait for this one's
            tensor: Any = dr.tensor_t(type(image))
            return tensor(image, (envs, height, width, 3))

    @staticmethod
    def _array(values: Any, kind: Any) -> Any:
        """A tensor of another library as an array on this device; copied only if it is elsewhere."""
        tensor: Any = dr.tensor_t(kind)
        return values if values is None or isinstance(values, kind) else tensor(values).array

    def _kept(self, image: Any, envs: int, rest: Any) -> Any:
        """Cut, mean and difference of images (B·H·W·3, UInt8)."""
        mi, (width, height), k = self.mi, self._cut.size, self._cut.downscale
        (columns, rows), (left, top) = self._rendered, self._first
        i = dr.arange(mi.UInt32, envs * width * height * 3)
        channel, pixel = i % 3, i // 3
        column, row, env = pixel % width, (pixel // width) % height, pixel // (width * height)
        first = ((env * rows + row * k + top) * columns + column * k + left) * 3 + channel
        total = mi.UInt32(k * k // 2)
        for dy in range(k):
            for dx in range(k):
                total += mi.UInt32(dr.gather(mi.UInt8, image, first + (dy * columns + dx) * 3))
        value = total // (k * k)
        if rest is None:
            return mi.UInt8(value)
        return mi.UInt8((255 + value - mi.UInt32(dr.gather(mi.UInt8, rest, i % (width * height * 3)))) // 2)
