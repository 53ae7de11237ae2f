"""``RayTracer``: the ray-traced optical mode. One sensor, one resolution, one scene; batches of surfaces in, images out."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from raytac.checks import check_known, check_names, check_seed, check_whole, is_whole
from raytac.device import total_memory
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, PadGrid, grid_pitch, make_grid
from raytac.optics.base import INTEGRATORS, OPTICAL_OUTPUTS, OpticsImages, chosen_shadows
from raytac.optics.camera import Pinhole
from raytac.optics.exposure import SATURATED, mid_grey_exposure, saturated_share
from raytac.optics.ink import checked_ink, ink_at, inked_albedo
from raytac.optics.refraction import Slab
from raytac.optics.response import Response
from raytac.optics.runtime import ROUNDING, check_batch, largest_batch, load_mitsuba, no_collection
from raytac.optics.surface_check import check_same_grid, check_shapes, check_view, device_envs, safe_heights
from raytac.optics.trace.denoise import make_denoiser
from raytac.optics.trace.direct import PixelSample, direct_light, see
from raytac.optics.trace.height_field import CoatField, CoatLayout
from raytac.optics.trace.interreflection import BounceField, CaseLight
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.reference import ReferenceIntegrator, StockPathIntegrator
from raytac.optics.trace.scene import UNIT, SensorScene
from raytac.specs.sensor import AUTO, SensorSpec

__all__ = ["RayTracer", "with_exposure"]


@dataclass(frozen=True)
class FastInputs:
    """Every device array that a recorded ``fast`` frame reads besides the heights; Dr.Jit wants them named as inputs."""

    rest: Any
    lamps: list[Lamp]
    bounce: BounceField | None
    scale: list[Any]
    ink: Any = None
    """Share of marker dots at the nodes, B·Ny·Nx; None without dots."""


def total(layers: dict[str, np.ndarray]) -> np.ndarray:
    """The linear image: the sum of its layers."""
    return np.asarray(np.sum(np.stack(list(layers.values())), axis=0, dtype=np.float32))


def image_seed(seed: int, env: int) -> int:
    """Seed of environment ``env``: ``seed`` itself for the first, unrelated streams for the others."""
    return (seed + env * 0x9E3779B1) & 0xFFFFFFFF


_GLANCE = 16
"""Samples a pixel that tell how bright an image is."""


def with_exposure(sensor: SensorSpec, device: str = "auto") -> SensorSpec:
    """``sensor`` with a number in place of an exposure of ``AUTO``: ``mid_grey_exposure`` of its image at rest by ``fast``.

    That image has the sensor's own resolution and one ray a pixel, whatever else is rendered, so that every mode finds the same number.

    Raises:
        SpecError: no exposure makes that image mid-grey.
        BackendError: Mitsuba cannot run on ``device``.
    """
    if sensor.response.exposure != AUTO:
        return sensor
    plain = replace(sensor, response=replace(sensor.response, exposure=1.0))
    tracer = RayTracer(plain, outputs=("layers",), device=device)
    rest = GelSurface.at_rest(make_grid(sensor.gelpad, grid_pitch(sensor.camera.pitch_at(sensor.camera.resolution))))
    exposure = mid_grey_exposure(sensor, total(tracer.render_layers(rest))[0] * tracer.response.scale)
    return replace(sensor, response=replace(sensor.response, exposure=exposure))


class RayTracer:
    """Ray tracing with Mitsuba 3 and Dr.Jit; fulfils ``raytac.optics.base.OpticalMode``."""

    def __init__(
        self,
        sensor: SensorSpec,
        *,
        integrator: str = "fast",
        resolution: tuple[int, int] | None = None,
        spp: int | None = None,
        outputs: tuple[str, ...] = ("rgb",),
        device: str = "auto",
        seed: int = 0,
        layers: str = "colour",
        bounce: bool = True,
        led_points: int = 1,
        shadows: bool | None = None,
        max_depth: int = -1,
        flat_field: np.ndarray | None = None,
        denoise: bool = False,
        progress: bool = False,
    ) -> None:
        """Build what does not depend on the surface's grid.

        Args:
            sensor: geometry, lights and camera.
            integrator: ``fast`` (deterministic), ``reference`` (unbiased path tracing of our own) or ``path`` (Mitsuba's, to compare).
            resolution: (width, height) [px]; None is the sensor's own.
            spp: samples a pixel. ``reference`` and ``path``: random samples, 256 if None. ``fast``: camera rays a pixel on a regular grid,
                a square number, 1 if None.
            outputs: any of ``rgb``, ``layers``, ``normals``, ``depth``.
            device: ``auto``, ``cpu`` or ``cuda``.
            seed: of the sampled integrator and of the fit of the case's light.
            layers: one layer per ``colour`` group of the light file or per ``led``.
            bounce: inter-reflection in ``fast``.
            led_points: ``fast`` integrates each LED with this number of points squared.
            shadows: cast shadows in ``fast``; None is as the sensor says. The sampled integrators always cast them.
            max_depth: sampled integrators: number of reflections, 1 is direct light only, −1 has no limit.
            flat_field: real image of the untouched sensor, (H, W, 3) uint8 at ``resolution``: the image is then
                flat_field × rendered / rendered at rest, in linear light.
            denoise: filter the layers of the sampled integrators (OptiX on CUDA, Open Image Denoise on the CPU).
            progress: show a progress bar for sampled images.

        Raises:
            InputError: a value out of its choices.
            SpecError: with ``refraction.model = "slab"``, a camera or LED that is not below the slab.
            BackendError: Mitsuba cannot run on ``device``.
        """
        check_known("integrator", integrator, INTEGRATORS)
        check_known("layers", layers, ("colour", "led"))
        outputs = check_names("outputs", outputs, OPTICAL_OUTPUTS)
        spp = None if spp is None else check_whole("spp", spp)
        led_points, seed = check_whole("led_points", led_points), check_seed("seed", seed)
        if not is_whole(max_depth) or max_depth < -1 or max_depth == 0:
            raise InputError("max_depth", value=max_depth, rule="must be a whole number >= 1, or -1 for no limit")
        if resolution is not None and (len(resolution) != 2 or min(resolution) < 1):
            raise InputError("resolution", value=resolution, rule="must be (width, height), each >= 1 pixel")
        self.rays = round(np.sqrt(spp or 1))
        if integrator == "fast" and self.rays**2 != (spp or 1):
            raise InputError(
                "spp", value=spp, rule="the fast integrator takes a square number of rays a pixel", choices=(1, 4, 9, 16)
            )
        if integrator == "fast" and denoise:
            raise InputError("denoise", value=denoise, rule="the fast integrator has no noise", choices=(False,))
        casts = chosen_shadows(sensor, shadows, integrator)
        if integrator != "fast" and not casts:
            text = f"optics.shadows = false of sensor {sensor.name!r} is for 'fast': {integrator!r} casts shadows as light does"
            warnings.warn(text, stacklevel=2)
        self.mi, self.device = load_mitsuba(device)
        if sensor.response.exposure == AUTO and {"rgb", "layers"} & set(outputs):
            sensor = with_exposure(sensor, self.device)
        self.sensor, self.integrator, self.outputs, self.seed = sensor, integrator, tuple(outputs), seed
        self.label = f"raytrace-{integrator}" + ("-denoised" if denoise else "")
        self.slab = Slab.from_spec(sensor)
        self.camera = Pinhole.from_spec(sensor.camera, resolution, self.slab)
        self.spp = spp or 256
        self.bounce, self.led_points, self.shadows = bounce, led_points, casts
        self.max_depth, self.progress = max_depth, progress
        self._denoiser = make_denoiser(self.mi, self.device, self.camera.resolution) if denoise else None
        leds = sensor.lights.leds
        self.layer_names = sensor.lights.layers if layers == "colour" else tuple(led.name for led in leds)
        self.groups = [self.layer_names.index(led.layer if layers == "colour" else led.name) for led in leds]
        self.lamps = [Lamp.from_spec(self.mi, led) for led in leds]
        self._scene_lamps = [Lamp.from_spec(self.mi, led, UNIT) for led in leds]
        # Of a mode without images, nobody asks how bright they are.
        unlit = replace(sensor.response, exposure=1.0)
        self.response = Response(unlit if sensor.response.exposure == AUTO else sensor.response, self.camera)
        self._flat_field = None if flat_field is None else self._check_flat_field(flat_field)
        self._memory = total_memory(self.device)
        self._grid: PadGrid | None = None

    def _check_flat_field(self, image: np.ndarray) -> np.ndarray:
        width, height = self.camera.resolution
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            rule = f"must be a uint8 image of shape ({height}, {width}, 3)"
            raise InputError("flat_field", value=f"{image.dtype} {image.shape}", rule=rule)
        return image

    # ---------------------------------------------------------------- per grid

    def _prepare(self, grid: PadGrid) -> None:
        """Build scene, layout and fields for a pad grid; done at the first frame and kept."""
        if self._grid is not None:
            check_same_grid(grid, self._grid)
            return
        check_view(self.camera, grid)
        mi = self.mi
        self.layout = CoatLayout.from_grid(grid)
        self._rest = mi.Float(grid.rest.astype(np.float32).ravel())  # a copy: see ``recording``
        # Only what the outputs need: normals and depth take camera rays on the height field alone.
        sampled = self.integrator != "fast"
        needs_scene = self._lit and (sampled or self.bounce)
        self.scene = SensorScene(mi, self.sensor, grid, glass=self.integrator == "path") if needs_scene else None
        self._bounce = None
        if not sampled and self.scene is not None:
            case = CaseLight.fit(self.scene, self._scene_lamps, self.groups, self.seed)
            self._bounce = BounceField.build(mi, self.layout, case)
        if sampled and self.scene is not None:
            kind = ReferenceIntegrator if self.integrator == "reference" else StockPathIntegrator
            self._sampled = kind(self.scene, self.camera, max_depth=self.max_depth, progress=self.progress)
        # One recording a batch size: a recording would replay at another size by scaling its launches, which is not what B means.
        self._frozen: dict[tuple[str, int], Any] = {}
        if self._flat_field is not None and self._lit:
            rest = grid.rest[None].astype(np.float32)
            self.response.set_flat_field(self._flat_field, total(self._layers(rest))[0])
        self._inputs = FastInputs(self._rest, self.lamps, self._bounce, self.response.device_scale(mi))
        self._grid = grid
        if "rgb" in self.outputs and self._flat_field is None:
            self._warn_if_saturated(grid)

    def _warn_if_saturated(self, grid: PadGrid) -> None:
        """Tell of an image at rest that is white over a large part, and of the exposure that would make it mid-grey."""
        heights = grid.rest[None].astype(np.float32)
        if self.integrator == "fast":
            rgb = np.array(self.render_device(self._upload(heights))["rgb"]).reshape(-1, 3)
        else:
            rgb = self.response.encode_numpy(self._glance(heights[0]))
        share = saturated_share(rgb)
        if share <= SATURATED:
            return
        response, advice = self.sensor.response, "the light is too uneven for any exposure"
        linear = total(self._layers(heights))[0] if self.integrator == "fast" else self._glance(heights[0])
        try:
            grey = mid_grey_exposure(self.sensor, linear * self.response.scale / response.gain)
        except SpecError:
            grey = response.gain
        if abs(grey - response.gain) > 0.1 * grey:
            advice = f'exposure = {grey:g} makes it mid-grey on average, and exposure = "auto" finds that by itself'
        warnings.warn(
            f"sensor {self.sensor.name!r}: {100 * share:.0f} % of the pixels are at 255 at rest with "
            f"exposure = {response.gain:g}; {advice}",
            stacklevel=2,
        )

    def _glance(self, height: np.ndarray) -> np.ndarray:
        """Linear image (H, W, 3) of one surface by a few samples a pixel of a sampled integrator: enough to tell how bright it is."""
        assert self.scene is not None
        self.scene.set_surface(height, None)
        images = type(self._sampled)(self.scene, self.camera, max_depth=self.max_depth, progress=False)
        return np.asarray(images.render(self._scene_lamps, self.groups, _GLANCE, self.seed).sum(axis=0))

    # ---------------------------------------------------------------- memory

    def memory_per_env(self, grid: PadGrid) -> int:
        """Most device memory that an environment of a ``fast`` batch on ``grid`` takes [byte]: the field at the nodes, the images."""
        width, height = self.camera.resolution
        layout, channels, asked = CoatLayout.from_grid(grid), 3 * len(self.layer_names), set(self.outputs)
        # A pixel's levels before and after they are interleaved, and in bytes; a channel each; where it looks.
        pixel = 27 * ("rgb" in asked) + 4 * channels * ("layers" in asked) + 24 * bool({"normals", "depth"} & asked)
        indirect = BounceField.memory_per_env(layout, channels) if self.bounce and self._lit else 0
        inputs = 8 * grid.rest.size  # height and ink
        return ROUNDING * (inputs + CoatField.memory_per_env(layout) + indirect + width * height * pixel)

    def largest_batch(self, grid: PadGrid) -> int:
        """Largest number of environments that one call of ``fast`` may render on ``grid``; sampled images take one at a time."""
        width, height = self.camera.resolution
        return largest_batch(self._memory, self.memory_per_env(grid), max(4 * grid.rest.size, 3 * width * height))

    def _check_batch(self, envs: int, grid: PadGrid) -> None:
        each = self.memory_per_env(grid)
        check_batch(envs, self.largest_batch(grid), per_env=each, memory=self._memory, device=self.device)

    # ---------------------------------------------------------------- images

    @property
    def _lit(self) -> bool:
        """Whether any output needs light."""
        return bool({"rgb", "layers"} & set(self.outputs))

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface``; see ``OpticsImages`` for the shapes.

        An environment whose heights are not finite fails alone: its ``rgb`` is 0, its other images are NaN, its contact is False.

        Raises:
            InputError: a surface whose arrays do not have the shape of its grid, an empty batch, or a second grid.
        """
        heights, failed = self._checked(surface)
        width, height = self.camera.resolution
        shape = (len(heights), height, width)
        rgb, layers = None, None
        if self._lit and self.integrator == "fast":
            device = self.render_device(self._upload(heights), self._upload_ink(surface))
            layers = self._to_numpy_layers(device["layers"], shape) if "layers" in self.outputs else None
            rgb = np.array(device["rgb"]).reshape(*shape, 3) if "rgb" in self.outputs else None
        elif self._lit:
            by_layer = self._layers(heights, checked_ink(surface))
            layers = by_layer if "layers" in self.outputs else None
            rgb = self.response.encode_numpy(total(by_layer)) if "rgb" in self.outputs else None
        images = {"rgb": rgb} if rgb is not None else {}
        if {"normals", "depth"} & set(self.outputs):
            images |= self._geometry(surface, heights, shape)
        if failed.any():
            for image in (*images.values(), *(layers or {}).values()):
                image[failed] = np.nan if image.dtype.kind == "f" else 0
        return OpticsImages(layers=layers, **images)

    def render_layers(self, surface: GelSurface) -> dict[str, np.ndarray]:
        """Linear radiance by layer, each (B, H, W, 3) float32, from any integrator; whatever ``outputs`` say about rgb."""
        if not self._lit:
            raise InputError(
                "outputs", value=self.outputs, rule="layers need a tracer with an output of light", choices=("rgb", "layers")
            )
        heights, failed = self._checked(surface)
        layers = self._layers(heights, checked_ink(surface))
        for image in layers.values():
            image[failed] = np.nan
        return layers

    def _checked(self, surface: GelSurface) -> tuple[np.ndarray, np.ndarray]:
        """Heights (B, Ny, Nx) float32 that are safe to trace, with failed environments at rest, and which those are (B,)."""
        check_shapes(surface)
        if self.integrator == "fast" or {"normals", "depth"} & set(self.outputs):
            self._check_batch(len(surface.height), surface.grid)
        self._prepare(surface.grid)
        return safe_heights(surface)

    def _layers(self, heights: np.ndarray, ink: np.ndarray | None = None) -> dict[str, np.ndarray]:
        width, height = self.camera.resolution
        if self.integrator == "fast":
            inputs = FastInputs(self._rest, self.lamps, self._bounce, [], None if ink is None else self._upload(ink))
            return self._to_numpy_layers(self._linear(self._upload(heights), inputs), (len(heights), height, width))
        assert self.scene is not None
        images = []
        for b, one in enumerate(heights):
            self.scene.set_surface(one, None if ink is None else ink[b])
            images.append(self._sampled.render(self._scene_lamps, self.groups, self.spp, image_seed(self.seed, b)))
        stack = np.stack(images, axis=1)
        if self._denoiser is not None:
            stack = np.stack([[self._denoiser(image) for image in layer] for layer in stack])
        return dict(zip(self.layer_names, stack, strict=True))

    def render_device(self, heights: Any, ink: Any = None) -> dict[str, Any]:
        """``fast`` on device arrays: heights (B·Ny·Nx) [m] to ``rgb`` (B·H·W·3, UInt8-valued) and ``layers`` (list of channels).

        ``ink`` (B·Ny·Nx): share of marker dots at each node, in [0, 1]. Heights must be finite, which is not checked here.
        Nothing leaves the device. Dr.Jit records the kernels at the first call of a batch size and replays them afterwards.

        Raises:
            InputError: another integrator, nothing was rendered before, heights of no whole number of grids, ink of another width, or a
                batch too large.
        """
        if self.integrator != "fast":
            raise InputError(
                "integrator", value=self.integrator, rule="device arrays need the fast integrator", choices=("fast",)
            )
        if self._grid is None:
            raise InputError("heights", value=type(heights).__name__, rule="render a GelSurface first: it tells the grid")
        others = {} if ink is None else {"ink": ink}
        envs = device_envs(self.layout.nx * self.layout.ny, heights, **others)
        self._check_batch(envs, self._grid)
        rgb, layers = self._recorded(self._fast_frame, heights, ink)
        return {"rgb": rgb, "layers": layers}

    def _recorded(self, function: Any, heights: Any, ink: Any = None) -> Any:
        """Call ``function(heights, inputs)``, recorded once for each number of environments and replayed afterwards."""
        key = function.__name__ + ("" if ink is None else "-ink"), dr.width(heights)
        if key not in self._frozen:
            self._frozen[key] = dr.freeze(function)
        with no_collection():
            return self._frozen[key](heights, self._inputs if ink is None else replace(self._inputs, ink=ink))

    def _fast_frame(self, heights: Any, inputs: FastInputs) -> tuple[Any, list[Any]]:
        channels = self._linear(heights, inputs)
        groups = range(len(channels) // 3)
        linear = [sum((channels[3 * g + c] for g in groups), self.mi.Float(0)) for c in range(3)]
        rgb = self.response.encode(self.mi, linear, inputs.scale) if "rgb" in self.outputs else self.mi.UInt8(0)
        return rgb, channels if "layers" in self.outputs else []

    def _linear(self, heights: Any, inputs: FastInputs) -> list[Any]:
        """Radiance of every channel (3·G), each B·H·W, averaged over the rays of a pixel."""
        mi, layout = self.mi, self.layout
        envs = dr.width(heights) // (layout.nx * layout.ny)
        field = CoatField(mi, layout, inputs.rest, heights)
        grids = inputs.bounce.gather_light(mi, field, self._radiosity(field, inputs), envs) if inputs.bounce else None
        sums: list[Any] = []
        for a in range(self.rays):
            for b in range(self.rays):
                seen = see(mi, field, self.camera, envs, ((a + 0.5) / self.rays, (b + 0.5) / self.rays))
                channels = self._shade(field, seen, grids, inputs)
                sums = [t + c for t, c in zip(sums, channels, strict=True)] if sums else channels
        return [t / self.rays**2 for t in sums]

    def _shade(self, field: CoatField, seen: PixelSample, grids: list[Any] | None, inputs: FastInputs) -> list[Any]:
        mi, coat = self.mi, self.sensor.coat
        diffuse_albedo = [(1 - coat.specular) * r for r in self._albedo(seen, inputs)]
        out = [mi.Float(0) for _ in range(3 * len(self.layer_names))]
        for lamp, group in zip(inputs.lamps, self.groups, strict=True):
            diffuse, specular = direct_light(mi, field, coat, seen, lamp, self.led_points, self.shadows, slab=self.slab)
            for c in range(3):
                out[3 * group + c] += lamp.power[c] * (diffuse * (diffuse_albedo[c] / dr.pi) + specular * coat.specular)
        if grids is not None and inputs.bounce is not None:
            for k, e in enumerate(inputs.bounce.irradiance(mi, grids, seen)):
                out[k] += e * ((diffuse_albedo[k % 3] + coat.specular) / dr.pi)
        return out if seen.exit is None else [o * seen.exit for o in out]

    def _albedo(self, seen: PixelSample, inputs: FastInputs) -> list[Any]:
        """Diffuse albedo of the coat or its dots at the seen points, a channel each."""
        if inputs.ink is None:
            return list(self.sensor.coat.reflectance)
        return inked_albedo(self.sensor, ink_at(self.mi, self.layout, inputs.ink, seen.env, seen.p.x, seen.p.y))

    def _radiosity(self, field: CoatField, inputs: FastInputs) -> Any:
        """Direct radiosity B of the coat at a sample, a channel each, for the coat's own inter-reflection."""
        mi, coat = self.mi, self.sensor.coat

        def radiosity(seen: PixelSample) -> list[Any]:
            albedo = self._albedo(seen, inputs)
            out = [mi.Float(0) for _ in range(3 * len(self.layer_names))]
            for lamp, group in zip(inputs.lamps, self.groups, strict=True):
                diffuse, _ = direct_light(mi, field, coat, seen, lamp, 1, self.shadows, specular=False, slab=self.slab)
                for c in range(3):
                    out[3 * group + c] += lamp.power[c] * diffuse * ((1 - coat.specular) * albedo[c] + coat.specular)
            return out

        return radiosity

    def _to_numpy_layers(self, channels: list[Any], shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
        stack = np.stack([np.array(c) for c in channels], axis=-1).reshape(*shape, len(self.layer_names), 3)
        return {name: np.ascontiguousarray(stack[..., g, :]) for g, name in enumerate(self.layer_names)}

    def _seen(self, heights: Any, inputs: FastInputs) -> tuple[Any, Any]:
        """Point and normal of the coat through every pixel's centre."""
        field = CoatField(self.mi, self.layout, inputs.rest, heights)
        seen = see(self.mi, field, self.camera, dr.width(heights) // (self.layout.nx * self.layout.ny))
        return seen.p, seen.n

    def _upload(self, heights: np.ndarray) -> Any:
        return self.mi.Float(heights.ravel())

    def _upload_ink(self, surface: GelSurface) -> Any:
        ink = checked_ink(surface)
        return None if ink is None else self._upload(ink)

    def _geometry(self, surface: GelSurface, heights: np.ndarray, shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
        """Normals, positions, camera depth and contact seen through the pixel centres; only what the outputs name."""
        seen_p, seen_n = self._recorded(self._seen, self._upload(heights))
        p = np.array(seen_p).T.reshape(*shape, 3)
        grid = surface.grid
        ix = np.clip(np.rint((p[..., 0] - grid.x[0]) / grid.pitch[0]).astype(int), 0, len(grid.x) - 1)
        iy = np.clip(np.rint((p[..., 1] - grid.y[0]) / grid.pitch[1]).astype(int), 0, len(grid.y) - 1)
        aov = {"contact": surface.contact[np.arange(shape[0])[:, None, None], iy, ix]}
        if "normals" in self.outputs:
            aov["normals"] = np.ascontiguousarray(np.array(seen_n).T.reshape(*shape, 3))
            aov["position"] = np.ascontiguousarray(p)
        if "depth" in self.outputs:
            aov["depth"] = (p[..., 2] - self.camera.position[2]).astype(np.float32)
        return aov
