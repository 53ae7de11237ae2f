"""Configurations of Phong's model and of the networks. Importing them loads no renderer."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.errors import InputError
from raytac.optics.base import OpticsConfig, Variant
from raytac.specs.sensor import Vec3

if TYPE_CHECKING:
    from raytac.optics.image.mlp_weights import MlpWeights
    from raytac.optics.image.unet_weights import UnetWeights


@dataclass(frozen=True)
class PhongLight:
    """A light: direction to it (image axes, not normalised), colour [levels], k_d and k_s."""

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
"""Published sets by name: two sensors of the paper, and its robot simulation's."""


@dataclass(frozen=True)
class Phong(OpticsConfig[Any]):
    """Phong shading of the height image, the baseline of papers on tactile images."""

    lights: str | tuple[PhongLight, ...] = "gelsight2017"
    """A name of ``PHONG_LIGHTS``, or lights; by default three colours, as a GelSight Mini has."""
    background: np.ndarray | None = None
    """Image at rest, (H, W, 3) uint8, of the mode's resolution; None is the ray tracer's."""

    def __post_init__(self) -> None:
        if isinstance(self.lights, str) and self.lights not in PHONG_LIGHTS:
            raise InputError("lights", value=self.lights, rule="must be a known set of lights", choices=PHONG_LIGHTS)
        for light in self.light_list if isinstance(self.lights, (str, tuple, list)) else [self.lights]:
            if not isinstance(light, PhongLight):
                raise InputError("lights", value=light, rule="must be a name or PhongLights", choices=PHONG_LIGHTS)
            numbers = (*light.direction, *light.colour, light.diffuse, light.specular)
            if len(numbers) != 8 or not np.isfinite(numbers).all():
                raise InputError("lights", value=light, rule="must be finite, with three numbers in direction and colour")

    @property
    def light_list(self) -> tuple[PhongLight, ...]:
        """The lights themselves."""
        return PHONG_LIGHTS[self.lights] if isinstance(self.lights, str) else tuple(self.lights)

    def maker(self) -> Any:
        return import_module("raytac.optics.image.phong").PhongMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        note = "lights and constants as published for another sensor, not fitted to this one"
        return (Variant("phong", "Phong", "Phong", cls(), note=note),)


@dataclass(frozen=True)
class Mlp(OpticsConfig[Any]):
    """A small network from slope and place to colour, fitted to a real sensor; no default."""

    weights: str | Path | MlpWeights | None = None
    """The network, its file, or the folder of ``raytac calibrate … --model mlp``."""

    def __post_init__(self) -> None:
        if self.weights is None:
            rule = "must name a network, as `raytac calibrate DATASET --model mlp` writes it: optics=Mlp(weights=…)"
            raise InputError("weights", rule=rule)

    def maker(self) -> Any:
        return import_module("raytac.optics.image.mlp").MlpMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return ()  # there is no network that every sensor could be compared with


@dataclass(frozen=True)
class Unet(OpticsConfig[Any]):
    """A small U-Net from the coat to the whole image, which may learn shadows; needs PyTorch."""

    weights: str | Path | UnetWeights | None = None
    """A network, its file, or the folder of ``experiments/train_unet.py``.

    None is the shipped network, which has the default Mini's look.
    """

    def maker(self) -> Any:
        return import_module("raytac.optics.image.unet").UnetMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        note = "fitted to ray-traced presses of other objects and of spheres, coins and pins elsewhere"
        return (Variant("unet", "learned U-Net", "U-Net", cls(), note=note),)
