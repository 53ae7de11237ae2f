"""Optical modes of one sensor, each built once: light of the case and kernels take seconds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.optics.trace.config import RayTraced
from raytac.report.image_error import regions
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode, OpticsConfig
    from raytac.optics.trace.tracer import Tracer


@dataclass(frozen=True)
class Tracers:
    """Makes and keeps optical modes on one device."""

    spec: SensorSpec
    device: str
    seed: int
    built: dict[str, Any] = field(default_factory=dict)

    def get(self, size: tuple[int, int], config: RayTraced | None = None, outputs: tuple[str, ...] = ("rgb",)) -> Tracer:
        """Ray tracer of images of ``size`` (width, height) [px]; path tracers have one layer."""
        return self.mode(size, RayTraced() if config is None else config, outputs)  # type: ignore[return-value]

    def mode(self, size: tuple[int, int], config: OpticsConfig[OpticalMode], outputs: tuple[str, ...] = ("rgb",)) -> OpticalMode:
        """The same of any optical mode."""
        key = repr((size, config, outputs))
        if key not in self.built:
            spec = self.spec
            if isinstance(config, RayTraced) and config.sampled:
                leds = tuple(replace(led, layer="all") for led in spec.lights.leds)
                spec = replace(spec, lights=replace(spec.lights, leds=leds))
            self.built[key] = config.build(spec, resolution=size, outputs=outputs, device=self.device, seed=self.seed)
        return self.built[key]

    def contact(self, size: tuple[int, int], surface: GelSurface) -> np.ndarray:
        """Contact of environment 0 as the camera sees it, (H, W) bool."""
        seen = self.get(size, outputs=("depth",)).render(surface).contact
        assert seen is not None
        return seen[0]

    def regions(self, size: tuple[int, int], surface: GelSurface) -> dict[str, np.ndarray]:
        """Masks of ``raytac.report.image_error.regions`` for environment 0."""
        return regions(self.contact(size, surface), self.spec.camera.pitch_at(size))


def path_trace(tracer: Tracer, surface: GelSurface, spp: int, seed: int) -> np.ndarray:
    """Linear radiance (H, W, 3) of environment 0 by path tracing, BVH rebuild included."""
    return tracer.render_layers(surface, spp=spp, seed=seed)["all"][0]
