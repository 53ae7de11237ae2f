"""``Tracer``: LEDs, layers, camera response and flat field that all ray tracers share."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from dataclasses import replace

import numpy as np

from raytac.checks import check_seed, is_number
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.device_mode import DeviceMode
from raytac.optics.ink import checked_ink
from raytac.optics.response import SATURATED, Response, mid_grey_exposure, saturated_share
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.scene import UNIT
from raytac.specs.sensor import AUTO


def total(layers: dict[str, np.ndarray]) -> np.ndarray:
    """The linear image: the sum of its layers."""
    return np.asarray(np.sum(np.stack(list(layers.values())), axis=0, dtype=np.float32))


class Tracer(DeviceMode):
    """Base of the ray tracers of one sensor and resolution; ``seed``: paths and the case's fit."""

    config: RayTraced

    def _set_up(self) -> None:
        check_seed("seed", self.seed)
        sensor, config = self.sensor, self.config
        leds = sensor.lights.leds
        by_colour = config.layers == "colour"
        self.layer_names = sensor.lights.layers if by_colour else tuple(led.name for led in leds)
        self.groups = [self.layer_names.index(led.layer if by_colour else led.name) for led in leds]
        self._scene_lamps = [Lamp.from_spec(self.mi, led, UNIT) for led in leds]
        # Of a mode without images, nobody asks how bright they are.
        unlit = replace(sensor.response, exposure=1.0)
        spec = unlit if sensor.response.exposure == AUTO else sensor.response
        self.response = Response(spec, self.camera, monochrome=sensor.camera.monochrome)
        if config.flat_field is not None:
            self._check_image("flat_field", config.flat_field, floats=True)

    @property
    @abstractmethod
    def samples(self) -> int:
        """Rays or samples of a pixel."""

    @abstractmethod
    def _layers(self, heights: np.ndarray, ink: np.ndarray | None = None, **sampling: int | None) -> dict[str, np.ndarray]:
        """Linear radiance by layer, each (B, H, W, 3) float32."""

    @abstractmethod
    def _rest_image(self, rest: np.ndarray) -> np.ndarray:
        """8-bit image (H, W, 3) of ``rest`` (1, Ny, Nx), exact enough to count white pixels."""

    def _rest_light(self, rest: np.ndarray) -> np.ndarray:
        """Linear image (H, W, 3) of the surface at ``rest`` (1, Ny, Nx)."""
        return total(self._layers(rest))[0]

    @property
    def sampling(self) -> dict[str, int | float | str]:
        """``integrator``, ``spp`` and ``exposure`` for headers; no exposure while it is ``AUTO``."""
        exposure = self.sensor.response.exposure
        known = {"exposure": float(exposure)} if is_number(exposure) else {}
        return {"integrator": self.config.integrator, "spp": self.samples, **known}

    def prepare(self, grid: PadGrid) -> None:
        is_first = self._grid is None
        super().prepare(grid)
        if is_first and "rgb" in self.outputs and self.config.flat_field is None:
            self._warn_if_saturated(grid)

    def render_layers(self, surface: GelSurface, **sampling: int | None) -> dict[str, np.ndarray]:
        """Linear radiance by layer, each (B, H, W, 3) float32; whatever ``outputs`` say about rgb.

        ``sampling``: ``spp`` and ``seed`` of a sampled tracer, as of its ``render``.

        Raises ``InputError``: no output needs light; and as ``render``.
        """
        if not self._lit:
            rule = "layers need a tracer with an output of light"
            raise InputError("outputs", value=self.outputs, rule=rule, choices=("rgb", "layers"))
        heights, failed = self._checked(surface)
        layers = self._layers(heights, checked_ink(surface), **sampling)
        for image in layers.values():
            image[failed] = np.nan
        return layers

    def _set_flat_field(self, grid: PadGrid) -> None:
        """Make the image at rest that of the configuration, if it has one."""
        if self.config.flat_field is not None and self._lit:
            self.response.set_flat_field(self.config.flat_field, self._rest_light(grid.rest[None].astype(np.float32)))

    def _warn_if_saturated(self, grid: PadGrid) -> None:
        """Warn of an image at rest that is largely white, and name the mid-grey exposure."""
        rest = grid.rest[None].astype(np.float32)
        if (share := saturated_share(self._rest_image(rest))) <= SATURATED:
            return
        response, advice = self.sensor.response, "the light is too uneven for any exposure"
        try:
            grey = mid_grey_exposure(
                self.sensor, self.response.mixed(self._rest_light(rest)) * self.camera.cut(self.response.scale) / response.gain
            )
        except SpecError:
            grey = response.gain
        if abs(grey - response.gain) > 0.1 * grey:
            advice = f'exposure = {grey:g} makes it mid-grey on average, and exposure = "auto" finds that by itself'
        warnings.warn(
            f"sensor {self.sensor.name!r}: {100 * share:.0f} % of the pixels are at 255 at rest with "
            f"exposure = {response.gain:g}; {advice}",
            stacklevel=3,
        )
