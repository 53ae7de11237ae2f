"""Phong shading of the height image: the baseline that papers on tactile images compare with.

Gomes, Paoletti and Luo, Generation of GelSight tactile images for sim2real learning, RA-L 2021 (section III-C), as their released
simulator computes it. On the image B at rest, dimmed to k_a B, black is laid where the gel is pressed, and then each light's colour:

    out ← (1 − α) out + α colour,  α = k_d max(0, n · l) + k_s (R · v)⁵,  R = 2 (n · l) n − l,  v = (0, 0, 1)

with every step cut to [0, 255] and to whole levels, and a 3 × 3 blur at the end. n is (∂h/∂x, ∂h/∂y, 1) normalised, with h growing
towards the camera: the normal of their depth image, which leans the other way than that of the gel seen from the camera. Light vectors
l are not normalised. All this is kept. Their smoothing of the gel and its noise are left out: the physics gives the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.image.base import ImageHeights, ImageMode
from raytac.optics.trace.fast_tracer import RayTracer
from raytac.specs.sensor import SensorSpec, Vec3

__all__ = ["PHONG_LIGHTS", "PhongLight", "PhongMode"]

AMBIENT = 0.8
"""k_a."""
THICKNESS = 4e-3
"""Depth at which the pressed gel is black [m]: their elastomer's thickness."""
SPECULAR_EXPONENT = 5
_BLUR = (0.2960964, 0.4078072)
"""Outer and central tap of the last blur: a Gaussian of σ = 1 px on a row of three pixels, mirrored at its ends."""


@dataclass(frozen=True)
class PhongLight:
    """One light: direction to it (x right, y down, z to the camera, not normalised), colour R, G, B [levels], k_d and k_s."""

    direction: Vec3
    colour: Vec3
    diffuse: float
    specular: float


PHONG_LIGHTS: dict[str, tuple[PhongLight, ...]] = {
    "gelsight2014": (
        PhongLight((0.0, 1.0, 0.25), (255.0, 255.0, 255.0), 0.6, 0.5),
        PhongLight((-1.0, 0.0, 0.25), (115.0, 130.0, 255.0), 0.5, 0.3),
        PhongLight((0.0, -1.0, 0.25), (255.0, 82.0, 108.0), 0.6, 0.4),
        PhongLight((1.0, 0.0, 0.25), (153.0, 255.0, 120.0), 0.1, 0.1),
    ),
    "gelsight2017": (
        PhongLight((-1.0, 0.0, 0.25), (255.0, 82.0, 108.0), 0.6, 0.4),
        PhongLight((0.5, -0.866, 0.25), (153.0, 255.0, 120.0), 0.1, 0.4),
        PhongLight((0.5, 0.866, 0.25), (115.0, 130.0, 255.0), 0.1, 0.4),
    ),
    "gazebo": (
        PhongLight((0.0, 1.0, 0.25), (240.0, 240.0, 240.0), 0.5, 0.15),
        PhongLight((-1.0, 0.0, 0.25), (78.0, 139.0, 255.0), 0.5, 0.15),
        PhongLight((0.0, -1.0, 0.25), (255.0, 82.0, 108.0), 0.5, 0.15),
        PhongLight((1.0, 0.0, 0.25), (150.0, 240.0, 100.0), 0.5, 0.15),
    ),
}
"""Published sets by name: two sensors of the paper, and the lights of the robot simulation in the same release."""


@dataclass(frozen=True)
class PhongArrays:
    """Device arrays of a frame: the dimmed image at rest, three channels of H·W."""

    ambient: list[Any]


class PhongMode(ImageMode):
    """The optical mode ``phong``: one sensor, one set of lights, one resolution; batches of surfaces in, images out."""

    label = "phong"

    def __init__(
        self,
        sensor: SensorSpec,
        *,
        lights: str | tuple[PhongLight, ...] = "gelsight2017",
        background: np.ndarray | None = None,
        resolution: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("rgb",),
        device: str = "auto",
    ) -> None:
        """Check everything; kernels are compiled at the first image.

        Args:
            sensor: camera and pad.
            lights: a name of ``PHONG_LIGHTS``, or lights. The default is the set with three colours, as a GelSight Mini has them.
            background: image at rest, (H, W, 3) uint8 at ``resolution``; None is what the ray tracer makes of this sensor.
            resolution: (width, height) [px]; None is the sensor's own.
            outputs: any of ``rgb``, ``normals``, ``depth``.
            device: ``auto``, ``cpu`` or ``cuda``.

        Raises:
            InputError: a value out of its choices.
            BackendError: Dr.Jit cannot run on ``device``.
        """
        if isinstance(lights, str) and lights not in PHONG_LIGHTS:
            raise InputError("lights", value=lights, rule="must be a known set of lights", choices=PHONG_LIGHTS)
        if not isinstance(lights, (str, tuple, list)):
            raise InputError("lights", value=lights, rule="must be a name or PhongLights", choices=PHONG_LIGHTS)
        self.lights = PHONG_LIGHTS[lights] if isinstance(lights, str) else tuple(lights)
        for light in self.lights:
            if not isinstance(light, PhongLight):
                raise InputError("lights", value=light, rule="must be a name or PhongLights", choices=PHONG_LIGHTS)
            numbers = (*light.direction, *light.colour, light.diffuse, light.specular)
            if len(numbers) != 8 or not np.isfinite(numbers).all():
                raise InputError("lights", value=light, rule="must be finite, with three numbers in direction and colour")
        super().__init__(sensor, resolution=resolution, outputs=outputs, device=device)
        width, height = self.camera.resolution
        if background is not None:
            found = f"{background.dtype} {background.shape}" if isinstance(background, np.ndarray) else type(background).__name__
            if found != f"uint8 {(height, width, 3)}":
                raise InputError("background", value=found, rule=f"must be a uint8 array of shape {(height, width, 3)}")
        self._background = background

    def _build(self, grid: PadGrid) -> PhongArrays:
        image = self._background
        if image is None:
            tracer = RayTracer(self.sensor, resolution=self.camera.resolution, device=self.device)
            image = tracer.render(GelSurface.at_rest(grid)).rgb
            assert image is not None
        dimmed = AMBIENT * image.reshape(-1, 3).astype(np.float32)
        return PhongArrays([self.mi.Float(np.ascontiguousarray(dimmed[:, c])) for c in range(3)])

    def _levels(self, seen: ImageHeights, inputs: PhongArrays) -> tuple[list[Any], Any]:
        mi = self.mi
        sx, sy, _ = seen.slopes(mi, seen.height)
        _, p, _, _ = seen.pixel(mi)
        nz = dr.rsqrt(sx * sx + sy * sy + 1)
        nx, ny = sx * nz, sy * nz
        pressed = dr.clip(seen.moved * (self.pitch[0] / THICKNESS), 0, 1)
        out = [self._overlay(dr.gather(mi.Float, channel, p), pressed, 0.0) for channel in inputs.ambient]
        for light in self.lights:
            lx, ly, lz = light.direction
            dot = nx * lx + ny * ly + nz * lz
            mirrored = 2 * dot * nz - lz
            alpha = light.diffuse * dr.maximum(dot, 0) + light.specular * mirrored**SPECULAR_EXPONENT
            out = [self._overlay(channel, alpha, colour) for channel, colour in zip(out, light.colour, strict=True)]
        return self._blurred(seen, out), mi.UInt8(0)

    @staticmethod
    def _overlay(below: Any, alpha: Any, colour: float) -> Any:
        """``colour`` laid over with opacity ``alpha``, which may leave [0, 1]; cut to whole levels in [0, 255] (upstream)."""
        return dr.floor(dr.clip((1 - alpha) * below + alpha * colour, 0, 255))

    def _blurred(self, seen: ImageHeights, channels: list[Any]) -> list[Any]:
        """The 3 × 3 blur, mirrored at the border, and rounding to whole levels."""
        mi = self.mi
        width, height = seen.resolution
        i, _, column, row = seen.pixel(mi)
        left, right = dr.select(column > 0, i - 1, i + 1), dr.select(column < width - 1, i + 1, i - 1)
        up, down = dr.select(row > 0, i - width, i + width), dr.select(row < height - 1, i + width, i - width)
        side, middle = _BLUR
        blurred = mi.Vector4f(*channels, 0)
        for before, after in ((left, right), (up, down)):
            packed = dr.ravel(blurred)
            a, b, c = (dr.gather(mi.Vector4f, packed, at) for at in (before, i, after))
            blurred = side * (a + c) + middle * b
        return [dr.floor(c + 0.5) for c in (blurred.x, blurred.y, blurred.z)]

    def _floats_per_pixel(self) -> float:
        return 8  # the packed image, before and after the blur along x
