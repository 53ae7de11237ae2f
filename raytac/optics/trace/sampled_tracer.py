"""``SampledTracer``: path tracing, ours or Mitsuba's, one environment at a time, with noise."""

from __future__ import annotations

import functools
import importlib
import subprocess
import sys
import warnings
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from raytac.checks import check_seed, check_whole
from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.base import OpticsImages, casts_shadows
from raytac.optics.device_mode import Float, UInt8
from raytac.optics.ink import checked_ink
from raytac.optics.trace.config import RayTraced
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
        """Refuse with ``InputError``: what is summed up over samples is an image on the host."""
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


_TRY_OPTIX = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
image = mi.OptixDenoiser(input_size=[32, 32])(mi.TensorXf(0.5, shape=(32, 32, 3)))
assert abs(float(mi.Float(image.array)[0]) - 0.5) < 0.05, "a grey image does not stay grey"
"""


def make_denoiser(mi: Any, device: str, resolution: tuple[int, int]) -> Callable[[np.ndarray], np.ndarray]:
    """Function that denoises a linear image of one ``resolution``; BackendError where none can."""
    if device == "cuda":
        if failure := _optix_failure():
            raise BackendError(
                f"OptiX's denoiser does not work here: {failure}; it needs the driver's file nvoptix.bin, which many containers lack. "
                "Mount it to /usr/share/nvidia, or render with denoise=False"
            )
        optix = mi.OptixDenoiser(input_size=list(resolution))
        return lambda image: np.array(optix(mi.TensorXf(image)))
    try:
        oidn = importlib.import_module("mitsuba_oidn")  # an extra: absent from the default install
    except ImportError as error:
        raise BackendError(
            "denoising on the CPU needs Open Image Denoise: `pip install raytac[denoise]`, or render with denoise=False"
        ) from error
    return lambda image: oidn.denoise(np.ascontiguousarray(image, dtype=np.float32), hdr=True)


@functools.cache
def _optix_failure() -> str:
    """Why OptiX's denoiser fails here, or nothing; in its own process, since Dr.Jit aborts."""
    try:
        done = subprocess.run([sys.executable, "-c", _TRY_OPTIX], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "it gave no answer within 120 s"
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    messages = [line for line in lines if "[DENOISER]" in line]
    return (messages or lines[-1:] or [f"it ended with code {done.returncode}"])[0]
