"""Phong shading of the height image, a baseline of papers on tactile images.

Gomes, Paoletti and Luo, Generation of GelSight tactile images for sim2real learning, RA-L 2021 (section III-C), as their released
simulator computes it. On the image B at rest, dimmed to k_a B, black is laid where the gel is pressed, and then each light's colour:

    out ← (1 − α) out + α colour,  α = k_d max(0, n · l) + k_s (R · v)⁵,  R = 2 (n · l) n − l,  v = (0, 0, 1)

with every step cut to [0, 255] and to whole levels, and a 3 × 3 blur at the end. n is (∂h/∂x, ∂h/∂y, 1) normalised, with h growing
towards the camera: the normal of their depth image, which leans the other way than that of the gel seen from the camera. Light vectors
l are not normalised. All this is kept. Their smoothing of the gel and its noise are left out: the physics gives the surface.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.device_mode import Float, UInt8
from raytac.optics.image.base import ImageHeights, ImageMode
from raytac.optics.image.config import Phong
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.sampled_tracer import ray_tracer

AMBIENT = 0.8
"""k_a."""
THICKNESS = 4e-3
"""Depth at which the pressed gel is black [m]: their elastomer's thickness."""
SPECULAR_EXPONENT = 5
_BLUR = (0.2960964, 0.4078072)
"""Outer and central tap of the last blur: σ = 1 px on three pixels, mirrored at the ends."""


class PhongMode(ImageMode):
    """The optical mode ``phong`` of one sensor, set of lights and resolution, for batches."""

    config: Phong

    def _set_up(self) -> None:
        super()._set_up()
        if self.config.background is not None:
            self._check_image("background", self.config.background)

    def _build(self, grid: PadGrid) -> list[Float]:
        """The dimmed image at rest, three channels of H·W."""
        image = self.config.background
        if image is None:
            tracer = ray_tracer(self.sensor, RayTraced(), resolution=self.camera.resolution, device=self.device)
            image = tracer.render(GelSurface.at_rest(grid)).rgb
            assert image is not None
        dimmed = AMBIENT * image.reshape(-1, 3).astype(np.float32)
        return [self.mi.Float(np.ascontiguousarray(dimmed[:, c])) for c in range(3)]

    def _levels(self, seen: ImageHeights, arrays: list[Float]) -> tuple[list[Float], UInt8]:
        mi = self.mi
        sx, sy, _ = seen.slopes(mi, seen.height)
        _, p, _, _ = seen.pixel(mi)
        nz = dr.rsqrt(sx * sx + sy * sy + 1)
        nx, ny = sx * nz, sy * nz
        pressed = dr.clip(seen.displacement * (self.pitch[0] / THICKNESS), 0, 1)
        out = [self._overlay(dr.gather(mi.Float, channel, p), pressed, 0.0) for channel in arrays]
        for light in self.config.light_list:
            lx, ly, lz = light.direction
            dot = nx * lx + ny * ly + nz * lz
            mirrored = 2 * dot * nz - lz
            alpha = light.diffuse * dr.maximum(dot, 0) + light.specular * mirrored**SPECULAR_EXPONENT
            out = [self._overlay(channel, alpha, colour) for channel, colour in zip(out, light.colour, strict=True)]
        return self._blurred(seen, out), mi.UInt8(0)

    @staticmethod
    def _overlay(below: Any, alpha: Any, colour: float) -> Any:
        """``colour`` laid over with opacity ``alpha`` of any value; whole levels in [0, 255]."""
        return dr.floor(dr.clip((1 - alpha) * below + alpha * colour, 0, 255))

    def _blurred(self, seen: ImageHeights, channels: list[Any]) -> list[Any]:
        """The 3 × 3 blur, mirrored at the border, and rounding to whole levels."""
        mi = self.mi
        width, height = seen.resolution
        i, _, column, row = seen.pixel(mi)
        x_minus, x_plus = dr.select(column > 0, i - 1, i + 1), dr.select(column < width - 1, i + 1, i - 1)
        y_minus, y_plus = dr.select(row > 0, i - width, i + width), dr.select(row < height - 1, i + width, i - width)
        side, middle = _BLUR
        blurred = mi.Vector4f(*channels, 0)
        for before, after in ((x_minus, x_plus), (y_minus, y_plus)):
            packed = dr.ravel(blurred)
            a, b, c = (dr.gather(mi.Vector4f, packed, at) for at in (before, i, after))
            blurred = side * (a + c) + middle * b
        return [dr.floor(c + 0.5) for c in (blurred.x, blurred.y, blurred.z)]

    def _floats_per_pixel(self) -> float:
        return 8  # the packed image, before and after the blur along x
