"""Sensors and coat surfaces for the tests of the optics: small, synthetic, each showing one thing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from raytac.gel.surface import GelSurface, PadGrid, make_grid
from raytac.specs.sensor import CameraSpec, LedSpec, LightsSpec, SensorSpec, Vec3
from tests.conftest import make_sensor_spec

RESOLUTION = (80, 60)
SETTINGS = ("resolution", "outputs", "device", "seed")
"""Arguments of ``OpticsConfig.build``; the other options of these tests are fields of a configuration."""
PITCH = 0.25e-3
"""Spacing of the pad's nodes [m]."""
SMALL = (2e-5, 2e-5)
"""Edges of an LED that is a point for every purpose here [m]."""


def built(config: Any, spec: SensorSpec, **options: Any) -> Any:
    """The mode of a class of configurations, on the CPU and small unless said otherwise; ``options`` are its fields or ``SETTINGS``."""
    assert set(options) <= {*SETTINGS, *(field.name for field in fields(config))}
    settings = {"resolution": RESOLUTION, "device": "cpu"} | {k: v for k, v in options.items() if k in SETTINGS}
    return config(**{k: v for k, v in options.items() if k not in SETTINGS}).build(spec, **settings)


def led(
    name: str,
    position: Vec3,
    aim: Vec3 = (0.0, 0.0, 0.0),
    *,
    size: tuple[float, float] = SMALL,
    lobe: float = 1.0,
    power: Vec3 = (1.0, 1.0, 1.0),
    layer: str | None = None,
) -> LedSpec:
    """An LED at ``position`` [m] whose axis points at ``aim`` [m]."""
    axis = np.subtract(aim, position) / np.linalg.norm(np.subtract(aim, position))
    return LedSpec(name, layer or name, position, tuple(axis.tolist()), size, lobe, power)


def sensor(
    leds: Sequence[LedSpec],
    *,
    albedo: Vec3 = (0.5, 0.5, 0.5),
    specular: float = 0.0,
    roughness: float = 0.4,
    walls: float = 0.0,
    dome: tuple[float, float] = (math.inf, math.inf),
    camera: CameraSpec | None = None,
) -> SensorSpec:
    """A sensor in the size class of a GelSight Mini with these LEDs; by default flat, Lambertian and in a black case."""
    spec = make_sensor_spec()
    return replace(
        spec,
        gelpad=replace(spec.gelpad, dome_radius=dome),
        coat=replace(spec.coat, reflectance=albedo, specular=specular, roughness=roughness),
        case=replace(spec.case, reflectance=walls),
        camera=camera or spec.camera,
        lights=LightsSpec(tuple(leds)),
    )


def lit_from_three_sides(*, scale: float = 3e-5) -> tuple[LedSpec, ...]:
    """Four LEDs in three layers about the pad, each with some of every channel."""
    size = (2e-3, 1e-3)
    return (
        led("red", (0, -11.2e-3, -9e-3), (0, 2e-3, 0), size=size, lobe=1.5, power=(scale, 0.1 * scale, 0), layer="red"),
        led("green_a", (13.2e-3, -5e-3, -8e-3), size=size, lobe=2.0, power=(0, scale, 0.2 * scale), layer="green"),
        led("green_b", (13.2e-3, 5e-3, -8e-3), size=size, lobe=2.0, power=(0, 0.6 * scale, 0), layer="green"),
        led("blue", (-3e-3, 11.2e-3, -10e-3), size=size, power=(0.1 * scale, 0, scale), layer="blue"),
    )


def like_a_mini() -> SensorSpec:
    """Three colours, a dome, a slightly glossy coat and grey walls: as the shipped sensor, but that its coat is matt."""
    spec = sensor(lit_from_three_sides(), albedo=(0.55, 0.5, 0.45), specular=0.05, walls=0.1, dome=(0.21, 0.135))
    return replace(spec, response=replace(spec.response, exposure=12.0))


def grid_of(spec: SensorSpec, pitch: float = PITCH) -> PadGrid:
    return make_grid(spec.gelpad, pitch)


def surface(grid: PadGrid, *heights: np.ndarray, contact: np.ndarray | None = None) -> GelSurface:
    """One environment for each height (Ny, Nx) [m]; ``contact`` (Ny, Nx) holds for all of them."""
    height = np.stack([np.broadcast_to(h, grid.shape) for h in heights]).astype(np.float32)
    touched = np.zeros(height.shape, bool) if contact is None else np.broadcast_to(contact, height.shape)
    return GelSurface(grid, height, touched, np.zeros((len(heights), 2)))


def at_rest(grid: PadGrid) -> GelSurface:
    return surface(grid, grid.rest)


def ball(
    grid: PadGrid, *, depth: float = 0.8e-3, radius: float = 4e-3, centre: tuple[float, float] = (1.5e-3, -1e-3)
) -> tuple[np.ndarray, np.ndarray]:
    """(height, contact) of a ball ``depth`` [m] deep below the pad's centre plane, with a Gaussian surround."""
    r2 = (grid.x[None, :] - centre[0]) ** 2 + (grid.y[:, None] - centre[1]) ** 2
    under = radius - depth - np.sqrt(np.maximum(radius**2 - r2, 0))
    under = np.where(r2 < radius**2, under, np.inf)
    free = grid.rest - 0.55 * depth * np.exp(-r2 / (2 * 2.6e-3**2))
    return np.minimum(free, under), under <= free


def relief(grid: PadGrid) -> np.ndarray:
    """Height like a coin's: a disc with soft flanks, waves of 0.12 mm and 2.5 mm period on it."""
    x, y = grid.x[None, :], grid.y[:, None]
    disc = 1 / (1 + np.exp((np.hypot(x, y) - 6e-3) / 0.25e-3))
    waves = np.cos(2 * np.pi * x / 2.5e-3) * np.cos(2 * np.pi * y / 2.5e-3)
    return grid.rest - disc * (0.45e-3 + 0.06e-3 * waves)


def plateau(grid: PadGrid, height: float, edge: float) -> np.ndarray:
    """A plateau ``height`` [m] towards the camera for x <= ``edge`` [m], with a wall one cell wide."""
    return np.where(grid.x[None, :] <= edge + 1e-9, -height, 0.0) + np.zeros(grid.shape)
