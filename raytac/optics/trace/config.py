"""Configuration of the ray tracer. Importing it loads no renderer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Literal

import numpy as np

from raytac.checks import check_known, check_truth, check_whole, is_whole
from raytac.errors import InputError
from raytac.optics.base import OPTICAL_OUTPUTS, OpticsConfig, Variant, check_shadows

INTEGRATORS = ("fast", "reference", "path")
"""Integrators of the ray tracer."""


@dataclass(frozen=True)
class RayTraced(OpticsConfig[Any]):
    """Ray tracing with Mitsuba 3 and Dr.Jit: the deterministic ``fast``, or path tracing."""

    integrator: Literal["fast", "reference", "path"] = "fast"
    """``fast`` (deterministic), ``reference`` (our path tracing) or ``path`` (Mitsuba's)."""
    spp: int | None = None
    """Samples a pixel. ``fast``: a square number of rays, 1 if None; else random, 256 if None."""
    shadows: bool | None = None
    """Cast shadows in ``fast``; None is as the sensor says. Sampled integrators always do."""
    layers: Literal["colour", "led"] = "colour"
    """One layer per ``colour`` group of the light file, or per ``led``."""
    bounce: bool = True
    """Inter-reflection in ``fast``."""
    led_points: int = 1
    """``fast`` takes so many times the points along each edge of an LED that its angle asks for."""
    max_depth: int = -1
    """Sampled integrators: number of reflections; 1 is direct light only, −1 has no limit."""
    flat_field: np.ndarray | None = None
    """Real image at rest, (H, W, 3), uint8 or levels as floats, such as a mean of photographs.
    Images are it × rendered / rendered at rest, in linear light."""
    denoise: bool = False
    """Filter sampled layers (OptiX on CUDA, Open Image Denoise on the CPU)."""
    progress: bool = False
    """Show a progress bar for sampled images."""
    outputs: ClassVar[tuple[str, ...]] = OPTICAL_OUTPUTS

    def __post_init__(self) -> None:
        check_known("integrator", self.integrator, INTEGRATORS)
        check_known("layers", self.layers, ("colour", "led"))
        check_whole("spp", 1 if self.spp is None else self.spp)
        check_whole("led_points", self.led_points)
        check_shadows(self.shadows)
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

    def maker(self) -> Any:
        return import_module("raytac.optics.trace.sampled_tracer").ray_tracer

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return (
            Variant("fast", "raytac fast", "fast", cls()),
            Variant("fast_4_rays", "raytac fast, 4 rays a pixel", "4 rays", cls(spp=4), slow=True),
            Variant("reference", "raytac reference", "reference", cls("reference")),
            Variant("reference_denoised", "raytac reference, denoised", "denoised", cls("reference", denoise=True)),
            Variant("path", "Mitsuba path", "path", cls("path")),
        )
