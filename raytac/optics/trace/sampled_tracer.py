"""``SampledTracer``: path tracing, ours or Mitsuba's, one environment at a time, with noise."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from raytac.checks import check_seed, check_whole
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.base import OpticsImages, casts_shadows
from raytac.optics.device_mode import Float, UInt8
from raytac.optics.ink import checked_ink
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.denoise import make_denoiser
from raytac.optics.trace.fast_tracer import FastTracer, with_exposure
from raytac.optics.trace.reference import ReferenceIntegrator, StockPathIntegrator
from raytac.optics.trace.scene import SensorScene
from raytac.optics.trace.tracer import Tracer, total
from raytac.specs.sensor import SensorSpec

_GLANCE = 16
"""Samples a pixel that show how bright an image is."""


def image_seed(seed: int, env: int) -> int:
    """Seed of environment ``env``: ``seed`` for the first, unrelated streams for the others."""
    return (seed + env * 0x9E3779B1) & 0xFFFFFFFF


class SampledTracer(Tracer):
    """The integrators ``reference`` and ``path``."""

    def _set_up(self) -> None:
        super()._set_up()
        self.scene: SensorScene | None = None
        self._denoiser = make_denoiser(self.mi, self.device, self.camera.resolution) if self.config.denoise else None

    @property
    def samples(self) -> int:
        return self.config.spp or 256

    def render(self, surface: GelSurface, *, spp: int | None = None, seed: int | None = None) -> OpticsImages:
        """As ``DeviceMode.render``, with ``spp`` samples a pixel and ``seed``; None is as built."""
        heights, failed = self._checked(surface)
        images: dict[str, Any] = {}
        if self._lit:
            layers = self._layers(heights, checked_ink(surface), spp=spp, seed=seed)
            images = {"layers": layers} if "layers" in self.outputs else {}
            if "rgb" in self.outputs:
                images["rgb"] = self.response.encode_numpy(total(layers))
        seen = {"normals", "depth"} & set(self.outputs)
        points = self._recorded(self._seen, self._upload(heights), None, None) if seen else None
        return self._images(surface, failed, images, points)

    def start(self, surface: GelSurface) -> Callable[[], OpticsImages]:
        """As ``DeviceMode.start``, but the images are there at once, summed up on the host."""
        images = self.render(surface)
        return lambda: images

    def render_device(self, heights: Float, contact: UInt8 | None = None, ink: Float | None = None) -> NoReturn:
        """Refuse: what is summed up over samples is an image on the host.

        Raises:
            InputError: always.
        """
        rule = "must be taxim, phong or raytrace with the integrator fast to stay on the device"
        raise InputError("optics", value=self.label, rule=rule)

    def _build(self, grid: PadGrid) -> None:
        # Only what the outputs need: normals and depth take camera rays on the height field alone.
        if self._lit:
            self.scene = SensorScene(self.mi, self.sensor, grid, glass=self.config.integrator == "path")
            self._integrator = self._make_integrator(self.config.progress)
            self._set_flat_field(grid)

    def _make_integrator(self, progress: bool) -> ReferenceIntegrator | StockPathIntegrator:
        assert self.scene is not None
        kind = StockPathIntegrator if self.config.integrator == "path" else ReferenceIntegrator
        return kind(self.scene, self.camera, max_depth=self.config.max_depth, progress=progress)

    def _layers(
        self, heights: np.ndarray, ink: np.ndarray | None = None, spp: int | None = None, seed: int | None = None
    ) -> dict[str, np.ndarray]:
        spp = self.samples if spp is None else check_whole("spp", spp)
        seed = self.seed if seed is None else check_seed("seed", seed)
        assert self.scene is not None
        images = []
        for b, height in enumerate(heights):
            self.scene.set_surface(height, None if ink is None else ink[b])
            images.append(self._integrator.render(self._scene_lamps, self.groups, spp, image_seed(seed, b)))
        stack = np.stack(images, axis=1)
        if self._denoiser is not None:
            stack = np.stack([[self._denoiser(image) for image in layer] for layer in stack])
        return dict(zip(self.layer_names, stack, strict=True))

    def _rest_light(self, rest: np.ndarray) -> np.ndarray:
        if self.config.flat_field is not None:
            return super()._rest_light(rest)
        assert self.scene is not None
        # A few samples are enough to see how bright it is.
        self.scene.set_surface(rest[0], None)
        return self._make_integrator(False).render(self._scene_lamps, self.groups, _GLANCE, self.seed).sum(axis=0)

    def _rest_image(self, rest: np.ndarray) -> np.ndarray:
        return self.response.encode_numpy(self._rest_light(rest))


def ray_tracer(
    sensor: SensorSpec, config: RayTraced, *, outputs: tuple[str, ...] = ("rgb",), device: str = "auto", **settings: Any
) -> Tracer:
    """The tracer of a configuration, for a sensor whose ``AUTO`` exposure becomes a number."""
    if config.sampled and not casts_shadows(sensor, config.shadows):
        name = config.integrator
        text = f"optics.shadows = false of sensor {sensor.name!r} is for 'fast': {name!r} casts shadows as light does"
        warnings.warn(text, stacklevel=3)
    if {"rgb", "layers"} & set(outputs):
        sensor = with_exposure(sensor, device)
    return (SampledTracer if config.sampled else FastTracer)(sensor, config, outputs=outputs, device=device, **settings)
