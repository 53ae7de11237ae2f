"""Configurations of the optical modes that come with raytac. Importing them loads no renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from raytac.checks import check_known, check_truth, check_whole, is_whole
from raytac.errors import InputError
from raytac.optics.base import OPTICAL_OUTPUTS, OpticsConfig, Variant
from raytac.specs.sensor import SensorSpec, Vec3

if TYPE_CHECKING:
    from raytac.optics.image.base import ImageMode
    from raytac.optics.image.mlp import MlpMode
    from raytac.optics.image.mlp_weights import MlpWeights
    from raytac.optics.image.phong import PhongMode
    from raytac.optics.taxim.table import PolyTable
    from raytac.optics.trace.tracer import Tracer

__all__ = ["INTEGRATORS", "PHONG_LIGHTS", "Mlp", "Phong", "PhongLight", "RayTraced", "Taxim"]

INTEGRATORS = ("fast", "reference", "path")
"""Integrators of the ray tracer."""


@dataclass(frozen=True)
class RayTraced(OpticsConfig["Tracer"]):
    """Ray tracing with Mitsuba 3 and Dr.Jit: the deterministic ``fast``, or path tracing."""

    integrator: Literal["fast", "reference", "path"] = "fast"
    """``fast`` (deterministic), ``reference`` (unbiased path tracing of our own) or ``path`` (Mitsuba's, to compare)."""
    spp: int | None = None
    """Samples a pixel. ``fast``: camera rays on a regular grid, a square number, 1 if None. Else: random samples, 256 if None."""
    shadows: bool | None = None
    """Cast shadows in ``fast``; None is as the sensor says. The sampled integrators always cast them."""
    layers: Literal["colour", "led"] = "colour"
    """One layer per ``colour`` group of the light file, or per ``led``."""
    bounce: bool = True
    """Inter-reflection in ``fast``."""
    led_points: int = 1
    """``fast`` integrates each LED with this number of points squared."""
    max_depth: int = -1
    """Sampled integrators: number of reflections; 1 is direct light only, −1 has no limit."""
    flat_field: np.ndarray | None = None
    """Real image of the untouched sensor, (H, W, 3) uint8: images are flat_field × rendered / rendered at rest, in linear light."""
    denoise: bool = False
    """Filter the layers of the sampled integrators (OptiX on CUDA, Open Image Denoise on the CPU)."""
    progress: bool = False
    """Show a progress bar for sampled images."""
    outputs: ClassVar[tuple[str, ...]] = OPTICAL_OUTPUTS

    def __post_init__(self) -> None:
        check_known("integrator", self.integrator, INTEGRATORS)
        check_known("layers", self.layers, ("colour", "led"))
        check_whole("spp", 1 if self.spp is None else self.spp)
        check_whole("led_points", self.led_points)
        _check_shadows(self.shadows)
        for name in ("bounce", "denoise", "progress"):
            check_truth(name, getattr(self, name))
        if not is_whole(self.max_depth) or self.max_depth < -1 or self.max_depth == 0:
            raise InputError("max_depth", value=self.max_depth, rule="must be a whole number >= 1, or -1 for no limit")
        if not self.sampled and self.rays**2 != (self.spp or 1):
            rule = "the fast integrator takes a square number of rays a pixel"
            raise InputError("spp", value=self.spp, rule=rule, choices=(1, 4, 9, 16))
        if not self.sampled and self.denoise:
            raise InputError("denoise", value=True, rule="the fast integrator has no noise", choices=(False,))
        if self.sampled and self.shadows is False:
            rule = f"is for the integrator 'fast': {self.integrator!r} follows light as it goes, shadows and all"
            raise InputError("shadows", value=False, rule=rule, choices=(True, None))

    @property
    def sampled(self) -> bool:
        return self.integrator != "fast"

    @property
    def unbiased(self) -> bool:
        return self.sampled and not self.denoise

    @property
    def rays(self) -> int:
        """Camera rays of ``fast`` along each side of a pixel."""
        return math.isqrt(self.spp or 1)

    @property
    def label(self) -> str:
        return f"raytrace-{self.integrator}" + ("-denoised" if self.denoise else "")

    def maker(self) -> Callable[..., Tracer]:
        from raytac.optics.trace.sampled_tracer import ray_tracer

        return ray_tracer

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return (
            Variant("fast", "raytac fast", "fast", cls()),
            Variant("fast_4_rays", "raytac fast, 4 rays a pixel", "4 rays", cls(spp=4), slow=True),
            Variant("reference", "raytac reference", "reference", cls("reference")),
            Variant("reference_denoised", "raytac reference, denoised", "denoised", cls("reference", denoise=True)),
            Variant("path", "Mitsuba path", "path", cls("path")),
        )


@dataclass(frozen=True)
class Taxim(OpticsConfig["ImageMode"]):
    """A Taxim table: colour by a polynomial for each slope, shadows from a table; baked from the ray tracer unless one is given."""

    calibration: str | Path | PolyTable | None = None
    """A table, a calibration folder, or None for the table baked from this sensor's own ray tracer, at first use unless it is kept from
    before. The sensor's lights matter only then. The table's image is laid over the whole image."""
    shadows: bool | None = None
    """Cast shadows; None is as the sensor says, where the table has them."""

    def __post_init__(self) -> None:
        _check_shadows(self.shadows)
        if not (self.calibration is None or isinstance(self.calibration, (str, Path)) or hasattr(self.calibration, "gradients")):
            rule = f"must be a PolyTable, a calibration folder or None, not {type(self.calibration).__name__}"
            raise InputError("calibration", value=self.calibration, rule=rule)

    def check(self, spec: SensorSpec) -> None:
        if isinstance(self.calibration, (str, Path)):
            from raytac.optics.taxim.folder import load_calibration

            load_calibration(self.calibration)

    def bake(self, spec: SensorSpec, device: str) -> None:
        if self.calibration is None:
            from raytac.optics.taxim.bake.bake import baked_table

            baked_table(spec, device=device)

    def maker(self) -> type[ImageMode]:
        from raytac.optics.taxim.mode import TaximMode

        return TaximMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return (
            Variant("taxim", "Taxim table", "table", cls(shadows=False), slow=True),
            Variant("taxim_shadow", "Taxim table with shadow", "+ shadow", cls(shadows=True), slow=True),
        )


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
class Phong(OpticsConfig["PhongMode"]):
    """Phong shading of the height image, the baseline of papers on tactile images."""

    lights: str | tuple[PhongLight, ...] = "gelsight2017"
    """A name of ``PHONG_LIGHTS``, or lights. The default is the set with three colours, as a GelSight Mini has them."""
    background: np.ndarray | None = None
    """Image at rest, (H, W, 3) uint8 at the mode's resolution; None is what the ray tracer makes of this sensor."""

    def __post_init__(self) -> None:
        if isinstance(self.lights, str) and self.lights not in PHONG_LIGHTS:
            raise InputError("lights", value=self.lights, rule="must be a known set of lights", choices=PHONG_LIGHTS)
        if not isinstance(self.lights, (str, tuple, list)):
            raise InputError("lights", value=self.lights, rule="must be a name or PhongLights", choices=PHONG_LIGHTS)
        for light in self.light_list:
            if not isinstance(light, PhongLight):
                raise InputError("lights", value=light, rule="must be a name or PhongLights", choices=PHONG_LIGHTS)
            numbers = (*light.direction, *light.colour, light.diffuse, light.specular)
            if len(numbers) != 8 or not np.isfinite(numbers).all():
                raise InputError("lights", value=light, rule="must be finite, with three numbers in direction and colour")

    @property
    def light_list(self) -> tuple[PhongLight, ...]:
        """The lights themselves."""
        return PHONG_LIGHTS[self.lights] if isinstance(self.lights, str) else tuple(self.lights)

    def maker(self) -> type[PhongMode]:
        from raytac.optics.image.phong import PhongMode

        return PhongMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        note = "lights and constants as published for another sensor, not fitted to this one"
        return (Variant("phong", "Phong", "Phong", cls(), note=note),)


@dataclass(frozen=True)
class Mlp(OpticsConfig["MlpMode"]):
    """A small network from slope and place to colour, fitted to presses of a real sensor; there is none by default."""

    weights: str | Path | MlpWeights | None = None
    """The network, its file, or the folder of ``raytac calibrate … --model mlp``."""

    def __post_init__(self) -> None:
        if self.weights is None:
            rule = "must name a network, as `raytac calibrate DATASET --model mlp` writes it: optics=Mlp(weights=…)"
            raise InputError("weights", value=None, rule=rule)

    def maker(self) -> type[MlpMode]:
        from raytac.optics.image.mlp import MlpMode

        return MlpMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return ()  # there is no network that every sensor could be compared with


def _check_shadows(shadows: bool | None) -> None:
    if shadows is not None and not isinstance(shadows, bool):
        raise InputError("shadows", value=shadows, rule="must be True, False or None", choices=(True, False, None))
