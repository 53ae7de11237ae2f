"""Ray tracers of one sensor, each built once: a build fits the case's light and compiles kernels, which takes seconds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.report.image_error import regions
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.trace.fast_tracer import RayTracer

__all__ = ["Tracers", "path_trace"]


@dataclass(frozen=True)
class Tracers:
    """Makes and keeps ray tracers on one device."""

    spec: SensorSpec
    device: str
    seed: int
    built: dict[str, RayTracer] = field(default_factory=dict)

    def get(self, size: tuple[int, int], **options: Any) -> RayTracer:
        """Ray tracer for images of ``size`` (width, height) [px]; ``options`` as of ``RayTracer``.

        Sampled integrators light all LEDs in one pass of three channels, which is all that a plain image needs.
        """
        key = repr((size, sorted(options.items())))
        if key not in self.built:
            from raytac.optics.trace.fast_tracer import RayTracer

            spec = self.spec
            if options.get("integrator") in ("path", "reference"):
                leds = tuple(replace(led, layer="all") for led in spec.lights.leds)
                spec = replace(spec, lights=replace(spec.lights, leds=leds))
            self.built[key] = RayTracer(spec, resolution=size, device=self.device, seed=self.seed, **options)
        return self.built[key]

    def contact(self, size: tuple[int, int], surface: GelSurface) -> np.ndarray:
        """Contact of environment 0 as the camera sees it, (H, W) bool."""
        seen = self.get(size, outputs=("depth",)).render(surface).contact
        assert seen is not None
        return seen[0]

    def regions(self, size: tuple[int, int], surface: GelSurface) -> dict[str, np.ndarray]:
        """Masks of ``raytac.report.image_error.regions`` for environment 0."""
        return regions(self.contact(size, surface), self.spec.camera.pitch_at(size))


def path_trace(tracer: RayTracer, surface: GelSurface, spp: int, seed: int) -> np.ndarray:
    """Linear radiance (H, W, 3) of environment 0 from a sampled integrator of ``Tracers``, with vertex update and BVH rebuild."""
    tracer.spp, tracer.seed = spp, seed
    return tracer.render_layers(surface)["all"][0]
