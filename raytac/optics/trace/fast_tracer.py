"""``FastTracer``: quadrature over the LEDs, smooth inter-reflection; nothing is random.

For each pixel one camera ray meets the coat, and for each LED the rendering equation's direct term is summed over a few
points on its rectangle (Kajiya 1986, eq. 1 restricted to one bounce; area form of Shirley, Wang and Zimmerman 1996):

    L_o(p) = Σ_led V_led · Σ_k w_k · f(p, ω_k, ω_o) · I(θ_k) · cos θ_p / r_k²

with the LED's intensity I(θ) = power · cosⁿ θ, the coat's reflectance f and the share V of the LED that p sees (``ShadowGrid``).
Everything runs in Dr.Jit, batched over environments: one thread a pixel, one code for LLVM and CUDA.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import GelSurface, PadGrid, grid_pitch, make_grid
from raytac.optics.base import casts_shadows
from raytac.optics.device_mode import DeviceFrame, Float, FrameInputs, UInt8
from raytac.optics.geometry import CoatField, CoatLayout, PixelSample, concave_cover, see
from raytac.optics.ink import ink_at, inked_albedo
from raytac.optics.response import mid_grey_exposure
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.direct import direct_light
from raytac.optics.trace.interreflection import BounceField, CaseLight
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.occluders import Occluders
from raytac.optics.trace.quadrature import quadrature
from raytac.optics.trace.shadow import ShadowGrid
from raytac.optics.trace.tracer import Tracer, total
from raytac.specs.sensor import AUTO, LedSpec, SensorSpec


@dataclass(frozen=True)
class FastArrays:
    """Device arrays of a frame."""

    lamps: list[Lamp]
    bounce: BounceField | None
    """Grid of indirect light; None without inter-reflection."""
    shadow: ShadowGrid | None
    """Grid of the LEDs' visible shares; None without cast shadows."""
    occluders: Occluders | None
    """Bounds on what casts them."""
    scale: list[Float]
    """The response's gain by channel."""


class FastTracer(Tracer):
    """The integrator ``fast``: no noise; B surfaces at a time, on the device if asked."""

    @property
    def samples(self) -> int:
        return self.config.rays**2

    @property
    def shadows(self) -> bool:
        """True if shadows are cast."""
        return casts_shadows(self.sensor, self.config.shadows)

    @property
    def _crops(self) -> bool:
        return self.config.flat_field is None  # which is taken of the whole image

    def _build(self, grid: PadGrid) -> FastArrays:
        mi, bounce = self.mi, None
        lamps = [Lamp.from_spec(mi, led) for led in self.sensor.lights.leds]
        if self._lit and self.config.bounce:
            case = CaseLight.of(mi, self.sensor, grid, self._scene_lamps, self.groups, self.seed)
            bounce = BounceField.build(mi, self.layout, case, self.camera, self.sensor.gelpad.thickness, self._lit_channels)
        shadow = self._shadow_grid(self.layout) if self._lit and self.shadows else None
        occluders = None if shadow is None else shadow.occluders(mi, self.layout, concave_cover(grid), lamps, self.slab)
        self._arrays = FastArrays(lamps, bounce, shadow, occluders, [])
        self._set_flat_field(grid)
        return replace(self._arrays, scale=self.response.device_scale(mi, self.camera))

    def _shadow_grid(self, layout: CoatLayout) -> ShadowGrid:
        thickness, leds = self.sensor.gelpad.thickness, self.sensor.lights.leds
        return ShadowGrid.build(layout, self.camera, thickness, leds, self.config.led_points)

    @property
    def _lit_channels(self) -> list[int]:
        """Channels of all layers that an LED gives light to."""
        leds = zip(self.sensor.lights.leds, self.groups, strict=True)
        return sorted({3 * group + c for led, group in leds for c in range(3) if led.power[c] > 0.0})

    def _bytes_per_env(self, grid: PadGrid) -> int:
        width, height = self.camera.size
        layout, channels = CoatLayout.from_grid(grid), 3 * len(self.layer_names)
        # A pixel's levels before and after they are interleaved, and in bytes; a channel each.
        pixel = 27 * ("rgb" in self.outputs) + 4 * channels * ("layers" in self.outputs)
        indirect = 0  # fields on grids of their own
        if self.config.bounce:
            indirect = BounceField.memory_per_env(layout, self.camera, self.sensor.gelpad.thickness, self._lit_channels)
        if self.shadows:
            indirect += self._shadow_grid(layout).memory_per_env(layout)
        field = 8 * grid.rest.size + CoatField.memory_per_env(layout)  # height and ink
        return self._lit * (field + indirect + width * height * pixel)

    def _other_images(self, frame: DeviceFrame, failed: np.ndarray) -> dict[str, Any]:
        return {"layers": self._to_numpy_layers(frame.layers, len(failed))} if "layers" in self.outputs else {}

    def _layers(self, heights: np.ndarray, ink: np.ndarray | None = None) -> dict[str, np.ndarray]:
        inputs = FrameInputs(self._rest, self._arrays, None if ink is None else self._upload(ink))
        return self._to_numpy_layers(self._linear(self._upload(heights), inputs), len(heights))

    def _rest_image(self, rest: np.ndarray) -> np.ndarray:
        return np.array(self.render_device(self._upload(rest)).rgb).reshape(-1, 3)

    def _to_numpy_layers(self, channels: list[Float], envs: int) -> dict[str, np.ndarray]:
        stack = np.stack([np.array(c) for c in channels], axis=-1).reshape(*self._shape(envs), len(self.layer_names), 3)
        return {name: np.ascontiguousarray(stack[..., g, :]) for g, name in enumerate(self.layer_names)}

    def _frame(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> tuple[UInt8, list[Float], UInt8]:
        mi, channels = self.mi, self._linear(heights, inputs, by_layer="layers" in self.outputs)
        linear = [sum(channels[c::3], mi.Float(0)) for c in range(3)]
        rgb = self.response.encode(mi, linear, inputs.own.scale) if "rgb" in self.outputs else mi.UInt8(0)
        return rgb, channels if "layers" in self.outputs else [], mi.UInt8(0)

    def _linear(self, heights: Float, inputs: FrameInputs, by_layer: bool = True) -> list[Float]:
        """Radiance of every channel (3·G), each B·H·W, averaged over the rays of a pixel.

        Indirect light is that of its layer, or else all in the first: sums over layers are the same, for less work.
        """
        mi, layout = self.mi, self.layout
        envs = dr.width(heights) // (layout.nx * layout.ny)
        field = CoatField(mi, layout, inputs.rest, heights)
        bounce, shadow, occluders = inputs.own.bounce, inputs.own.shadow, inputs.own.occluders
        shares = None if shadow is None else shadow.shares(mi, field, occluders, inputs.own.lamps, envs, self.slab)
        radiosity = partial(self._radiosity, shares, inputs)
        grids = None if bounce is None else bounce.gather_light(mi, field, radiosity, envs, by_layer)
        sums: list[Any] = []
        for a in range(self.config.rays):
            for b in range(self.config.rays):
                seen = see(mi, field, self.camera, envs, ((a + 0.5) / self.config.rays, (b + 0.5) / self.config.rays))
                channels = self._shade(seen, shares, grids, inputs, by_layer)
                sums = [t + c for t, c in zip(sums, channels, strict=True)] if sums else channels
        return [t / self.config.rays**2 for t in sums]

    def _shade(
        self, seen: PixelSample, shares: list[Any] | None, grids: list[Any] | None, inputs: FrameInputs, by_layer: bool
    ) -> list[Any]:
        mi, coat = self.mi, self.sensor.coat
        diffuse_albedo = [(1 - coat.specular) * r for r in self._albedo(seen, inputs)]
        out = [mi.Float(0) for _ in range(3 * len(self.layer_names))]
        for lamp, spec, group, share in self._sources(inputs, shares, seen):
            diffuse, specular = direct_light(mi, coat, seen, lamp, quadrature(spec, self.config.led_points), slab=self.slab)
            for c in range(3):
                out[3 * group + c] += share * lamp.power[c] * (diffuse * (diffuse_albedo[c] / dr.pi) + specular * coat.specular)
        if grids is not None and inputs.own.bounce is not None:
            for k, e in inputs.own.bounce.irradiance(mi, grids, seen, by_layer):
                out[k] += e * ((diffuse_albedo[k % 3] + coat.specular) / dr.pi)
        return out if seen.exit is None else [o * seen.exit for o in out]

    def _sources(
        self, inputs: FrameInputs, shares: list[Any] | None, seen: PixelSample
    ) -> Iterator[tuple[Lamp, LedSpec, int, Any]]:
        """Lamp, LED, layer and visible share at ``seen`` of every LED."""
        leds, shadow = self.sensor.lights.leds, inputs.own.shadow
        visible = [1.0] * len(leds) if shadow is None else shadow.at(self.mi, shares, seen)
        return zip(inputs.own.lamps, leds, self.groups, visible, strict=True)

    def _albedo(self, seen: PixelSample, inputs: FrameInputs) -> list[Any]:
        """Diffuse albedo of the coat or its dots at the seen points, a channel each."""
        if inputs.ink is None:
            return list(self.sensor.coat.reflectance)
        return inked_albedo(self.sensor, ink_at(self.mi, self.layout, inputs.ink, seen.env, seen.p.x, seen.p.y))

    def _radiosity(self, shares: list[Any] | None, inputs: FrameInputs, seen: PixelSample) -> list[Any]:
        """Direct radiosity B of the coat at a sample, by channel, for its own inter-reflection."""
        mi, coat, albedo = self.mi, self.sensor.coat, self._albedo(seen, inputs)
        out = [mi.Float(0) for _ in range(3 * len(self.layer_names))]
        for lamp, spec, group, share in self._sources(inputs, shares, seen):
            diffuse, _ = direct_light(mi, coat, seen, lamp, quadrature(spec), specular=False, slab=self.slab)
            for c in range(3):
                out[3 * group + c] += share * lamp.power[c] * diffuse * ((1 - coat.specular) * albedo[c] + coat.specular)
        return out


def with_exposure(sensor: SensorSpec, device: str = "auto") -> SensorSpec:
    """``sensor`` with the ``mid_grey_exposure`` of its image at rest in place of ``AUTO``.

    That image has the sensor's own resolution and one ray a pixel, whatever else is rendered, so that every mode finds the same number.
    Raises SpecError: no exposure makes that image mid-grey; BackendError: Mitsuba cannot run on ``device``.
    """
    if sensor.response.exposure != AUTO:
        return sensor
    plain = replace(sensor, response=replace(sensor.response, exposure=1.0))
    tracer = FastTracer(plain, RayTraced(), outputs=("layers",), device=device)
    rest = GelSurface.at_rest(make_grid(sensor.gelpad, grid_pitch(sensor.camera.pitch_at(sensor.camera.resolution))))
    light = tracer.response.mixed(total(tracer.render_layers(rest))[0])
    exposure = mid_grey_exposure(sensor, light * tracer.response.scale)
    return replace(sensor, response=replace(sensor.response, exposure=exposure))
