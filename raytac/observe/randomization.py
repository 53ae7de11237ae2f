"""Seeded differences between nominally equal sensors, for each environment or for a world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from raytac.checks import is_number
from raytac.errors import InputError
from raytac.markers import MarkerPerturbation
from raytac.specs.sensor import ResponseSpec, SensorSpec
from raytac.specs.task import TaskScene

_ABSOLUTE = {"noise": np.inf, "pad_shift": 0.02, "pad_turn": 0.5}
"""Upper bounds of widths that are not relative to 1: a larger one is no mounting error."""


@dataclass(frozen=True)
class Randomization:
    """Half widths of uniform distributions, relative to 1 unless said otherwise; all 0 is none.

    *Each environment, at every reset*: the camera (``CameraDrift``) by ``exposure``, ``white_balance``, ``gamma``; the pattern of
    ``markers``; the mounting of the pad by ``pad_shift``, ``pad_turn``; and in environments with rigid pads (``TaskBatch``) bodies by
    ``body_mass``, ``body_friction``, gels by ``youngs_modulus``, ``friction``. *Each frame*: ``noise``, and noise and loss of ``markers``.
    *Once a world*, in the sensor that all its environments share (``randomised_sensor``): ``led_power``, ``led_colour``, ``reflectance``;
    with soft pads, or a sensor that is in no environment, gels too, and bodies (``randomised_bodies``). A table of ``taxim`` is baked for
    every such sensor, which the ray tracer does not need: vary seeds over processes.
    """

    led_power: float = 0.0
    """Power of each LED."""
    led_colour: float = 0.0
    """Power of each channel of each LED."""
    reflectance: float = 0.0
    """Reflectance of the coat in each channel."""
    youngs_modulus: float = 0.0
    """Young's modulus of the gel."""
    friction: float = 0.0
    """Friction coefficient of the gel, for bodies without one in the scene."""
    body_mass: float = 0.0
    """Mass of each free body."""
    body_friction: float = 0.0
    """Friction coefficient of each body that has one in the scene, against all it touches.

    For two bodies in contact MuJoCo uses the greater coefficient."""
    pad_shift: float = 0.0
    """Shift of each pad on its mount along each pad axis [m]; the arm's control ignores it."""
    pad_turn: float = 0.0
    """Rotation of each pad on its mount: each component of a rotation vector, pad frame [rad]."""
    exposure: float = 0.0
    """Gain of the camera, all channels, in linear light."""
    white_balance: float = 0.0
    """Gain of every channel, in linear light."""
    gamma: float = 0.0
    """Exponent that encodes linear light."""
    noise: float = 0.0
    """Standard deviation of every 8-bit value in every frame; not relative."""
    markers: MarkerPerturbation = field(default_factory=MarkerPerturbation)
    """Noise and losses of the tracker, shift and rotation of the pattern."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "markers":
                if not isinstance(value, MarkerPerturbation):
                    raise InputError("markers", value=value, rule="must be a MarkerPerturbation")
                continue
            absolute, bound = item.name in _ABSOLUTE, _ABSOLUTE.get(item.name, 1.0)
            rule = "must be 0 or more, and finite" if absolute else "must be in [0, 1): a half width relative to 1"
            if absolute and np.isfinite(bound):
                rule = f"must be in [0, {bound:g}) m or rad"
            if not (is_number(value) and 0.0 <= value < bound):
                raise InputError(item.name, value=value, rule=rule)

    @property
    def changes_images(self) -> bool:
        """True if images differ between environments of one world."""
        return any((self.exposure, self.white_balance, self.gamma, self.noise))

    @property
    def changes_bodies(self) -> bool:
        """True if bodies differ."""
        return any((self.body_mass, self.body_friction))

    @property
    def changes_gel(self) -> bool:
        """True if gels differ."""
        return any((self.youngs_modulus, self.friction))

    @property
    def changes_mounting(self) -> bool:
        """True if pads have mounting errors."""
        return any((self.pad_shift, self.pad_turn))

    @property
    def changes_sensor(self) -> bool:
        """True if the sensor differs between worlds."""
        return any((self.led_power, self.led_colour, self.reflectance, self.changes_gel))


def randomised_sensor(sensor: SensorSpec, randomization: Randomization, seed: int) -> SensorSpec:
    """Sensor drawn by a seed, the same if nothing of it varies; reflectances are at most 1."""
    r = randomization
    if not r.changes_sensor:
        return sensor
    rng = np.random.default_rng((seed, 0x5E45))

    def factor(width: float, count: int = 1) -> np.ndarray:
        return 1.0 + width * rng.uniform(-1.0, 1.0, count)

    # The order of the draws is part of what a seed means.
    powers = [np.asarray(led.power) * factor(r.led_power) * factor(r.led_colour, 3) for led in sensor.lights.leds]
    leds = tuple(replace(led, power=tuple(power.tolist())) for led, power in zip(sensor.lights.leds, powers, strict=True))
    reflectance = np.minimum(np.asarray(sensor.coat.reflectance) * factor(r.reflectance, 3), 1.0)
    gel = {name: float(getattr(sensor.gelpad, name) * factor(getattr(r, name))[0]) for name in ("youngs_modulus", "friction")}
    coat = replace(sensor.coat, reflectance=tuple(reflectance.tolist()))
    return replace(sensor, lights=replace(sensor.lights, leds=leds), coat=coat, gelpad=replace(sensor.gelpad, **gel))


def randomised_bodies(scene: TaskScene, randomization: Randomization, seed: int) -> TaskScene:
    """Scene with bodies drawn by a seed, equal in all environments; the same if none varies."""
    r = randomization
    if not r.changes_bodies:
        return scene
    rng = np.random.default_rng((seed, 0xB0D1))
    bodies = []
    for body in scene.bodies:
        mass, friction = 1.0 + np.array([r.body_mass, r.body_friction]) * rng.uniform(-1.0, 1.0, 2)
        if body.dynamics == "free":
            has_mass = body.mass is not None
            body = replace(body, mass=float(body.mass * mass)) if has_mass else replace(body, density=float(body.density * mass))
        coefficients = {name: getattr(body, name) for name in ("friction", "gel_friction")}
        body = replace(body, **{name: float(value * friction) for name, value in coefficients.items() if value is not None})
        bodies.append(body)
    return replace(scene, bodies=tuple(bodies))


def response_curves(draws: Any, randomization: Randomization, response: ResponseSpec) -> Any:
    """8-bit values of n cameras by the nominal one's, (n, 3, 256); NumPy or PyTorch.

    Args:
        draws: uniform random numbers (n, 5) in [−1, 1): exposure, white balance of three channels, exponent.
        response: that of the nominal camera; its exponent and tone curve count.
    """
    xp, r = array_namespace(draws), randomization
    gain = (1.0 + r.exposure * draws[:, :1]) * (1.0 + r.white_balance * draws[:, 1:4])
    exponent = response.gamma * (1.0 + r.gamma * draws[:, 4])
    level = xp.arange(256, dtype=draws.dtype, device=device(draws)) / 255.0
    light = gain[:, :, None] * response.curve.straight(level) ** response.gamma
    encoded = light ** (1.0 / exponent[:, None, None])
    # White and brighter stays so; the curve is for levels up to it.
    return 255.0 * xp.where(encoded < 1.0, response.curve.bent(encoded), encoded)


class CameraDrift:
    """Cameras of B environments, each with its own exposure, white balance, exponent and noise.

    u8 → 255 S((g · S⁻¹(u8 / 255)^γ)^(1 / γ')) with g the gains and S the tone curve; values above 255 saturate, as in a camera. Each
    environment has its own random stream, so that its draws do not depend on B.
    """

    def __init__(self, sensor: SensorSpec, randomization: Randomization, num_envs: int, seed: int) -> None:
        self._settings, self._response = randomization, sensor.response
        self._streams = [np.random.default_rng((seed + b, 0xCA3)) for b in range(num_envs)]
        self._curves = np.empty((num_envs, 3, 256), np.float32)
        self.reset(range(num_envs))

    def reseed(self, envs: Sequence[int], seeds: Sequence[int]) -> None:
        """Seed the random streams of environments."""
        for b, seed in zip(envs, seeds, strict=True):
            self._streams[b] = np.random.default_rng((seed, 0xCA3))

    def reset(self, envs: range | list[int]) -> None:
        """Draw the cameras of environments."""
        if len(envs):
            draws = np.stack([self._streams[b].uniform(-1.0, 1.0, 5) for b in envs])
            self._curves[list(envs)] = response_curves(draws, self._settings, self._response)

    def apply(self, images: np.ndarray, *, noise: bool = True, envs: Sequence[int] | None = None) -> np.ndarray:
        """8-bit images (n, H, W, 3) of these cameras; ``noise``: add the noise of a frame.

        ``envs``: environment of each image; None is all in order. Others draw no noise, and one that is named twice draws once.
        """
        chosen = list(range(len(self._streams))) if envs is None else list(envs)
        values = self._curves[np.asarray(chosen)[:, None, None, None], np.arange(3), images]
        if noise and self._settings.noise:
            shape = images.shape[1:]
            drawn = {b: self._streams[b].standard_normal(shape, np.float32) for b in dict.fromkeys(chosen)}
            values = values + self._settings.noise * np.stack([drawn[b] for b in chosen])
        return np.clip(values + 0.5, 0.0, 255.0).astype(np.uint8)
