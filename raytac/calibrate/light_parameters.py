"""What a fit of lights varies: every LED's place, aim, lobe and power, and the camera's response; all as one vector with bounds."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.photographs import decode
from raytac.errors import InputError
from raytac.specs import LedSpec, LightsSpec, SensorSpec

__all__ = ["CEILING", "CHANNELS", "LightParameters", "channels", "darkest", "leds_at_walls"]

CHANNELS = ("red", "green", "blue")
SIDES = {"red": (0.0, -1.0), "green": (1.0, 0.0), "blue": (0.0, 1.0)}
"""Outward direction (x, y) of the wall that the LEDs of a layer stay at."""
SIDES = {"red": (0.0, -1.0), "green": (1.0, 0.0), "blue": (0.0, 1.0)}
"""Outward direction (x, y) of the wall that the LEDs of a layer stay at."""
DARKEST = 0.85
"""Most of the darkest background pixel's light that may be stray."""
CEILING = -5.1
"""Highest z [mm] of an LED: below gel and a support plate of 1 mm, so that ``refraction.model = "slab"`` stays possible."""


@dataclass(frozen=True)
class LightParameters:
    """``leds`` (L, 6): x, y, z [mm], azimuth, elevation [rad], lobe; ``power`` (L, 3): own channel [W/sr], the other two relative to it;
    ``response`` (6,): gamma, stray light of each channel over that of its darkest background pixel, a₁ and a₂ of the vignette
    1 + a₁r² + a₂r⁴. ``template``: the light file that names, layers and sizes come from."""

    template: LightsSpec
    leds: np.ndarray
    power: np.ndarray
    response: np.ndarray

    @classmethod
    def of(cls, sensor: SensorSpec, background: np.ndarray) -> LightParameters:
        """Those of a sensor, whose image at rest is ``background`` [levels].

        Raises:
            InputError: a layer that is no camera channel.
        """
        leds, power = [], []
        for led in sensor.lights.leds:
            if led.layer not in CHANNELS:
                raise InputError(
                    "led.layer", value=led.layer, rule="must be a camera channel, the LED's colour", choices=CHANNELS
                )
            x, y, z = led.axis
            leds.append([*(1e3 * c for c in led.position), np.arctan2(y, x), np.arcsin(z), led.lobe])
            own, *others = (led.power[c] for c in channels(led))
            power.append([own, *(other / max(own, 1e-12) for other in others)])
        response = sensor.response
        stray = np.array(response.black_level) / darkest(background, response.gamma)
        a1, a2, _ = response.vignetting
        return cls(sensor.lights, np.array(leds), np.array(power), np.array([response.gamma, *stray, a1, a2]))

    def flat(self) -> np.ndarray:
        return np.concatenate([self.leds.ravel(), self.power.ravel(), self.response])

    def at(self, x: np.ndarray) -> LightParameters:
        """The parameters of a vector as ``flat`` gives it."""
        cut = self.leds.size
        return LightParameters(self.template, x[:cut].reshape(-1, 6), x[cut:-6].reshape(-1, 3), x[-6:])

    def moved(self, leds: np.ndarray) -> LightParameters:
        return dataclasses.replace(self, leds=leds)

    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """Power by LED and channel (L, 3) [W/sr], and its slope by each of the LED's three parameters (L, 3, 3)."""
        power, slope = np.zeros((len(self.leds), 3)), np.zeros((len(self.leds), 3, 3))
        for k, (led, (main, a, b)) in enumerate(zip(self.template.leds, self.power, strict=True)):
            own, first, second = channels(led)
            power[k, [own, first, second]] = main, main * a, main * b
            slope[k, 0, [own, first, second]] = 1, a, b
            slope[k, 1, first] = slope[k, 2, second] = main
        return power, slope

    def lights(self, powers: np.ndarray | None = None) -> LightsSpec:
        """The light file, with these powers or other ones (L, 3)."""
        leds = []
        for led, row, w in zip(self.template.leds, self.leds, self.powers()[0] if powers is None else powers, strict=True):
            flat, azimuth = np.cos(row[4]), row[3]
            axis = (float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(row[4])))
            place, power = (row[0] / 1e3, row[1] / 1e3, row[2] / 1e3), (float(w[0]), float(w[1]), float(w[2]))
            leds.append(dataclasses.replace(led, position=tuple(map(float, place)), axis=axis, lobe=float(row[5]), power=power))
        return LightsSpec(tuple(leds))

    def bounds(self, sensor: SensorSpec) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest parameters: an LED stays at its wall and looks at most 75 degrees aside of straight across."""
        low, high = [], []
        half = 5e2 * np.array(sensor.case.size)
        for led, row in zip(self.template.leds, self.leds, strict=True):
            out = np.array(SIDES[led.layer])
            across = np.arctan2(-out[1], -out[0])
            across += 2 * np.pi * np.round((row[3] - across) / (2 * np.pi))
            low.append([*np.where(out > 0, 0.6 * half, 0.1 - half), -24.0, across - 1.31, -1.2, 1.0])
            high.append([*np.where(out < 0, -0.6 * half, half - 0.1), CEILING, across + 1.31, 1.0, 15.0])
        shares = np.tile([0.0, 0.0, 0.0], len(low)), np.tile([1.0, 0.5, 0.5], len(low))
        return (
            np.r_[np.ravel(low), shares[0], 1.0, np.zeros(3), -2.0, 0.0],
            np.r_[np.ravel(high), shares[1], 2.4, np.full(3, DARKEST), 0.0, 1.2],
        )


def darkest(background: np.ndarray, gamma: float) -> np.ndarray:
    """Linear light of the darkest pixel of every channel, (3,)."""
    return np.maximum(decode(background.reshape(-1, 3).min(0), gamma), 1e-6)


def leds_at_walls(sensor: SensorSpec, sides: str) -> LightsSpec:
    """A start for a fit: LEDs along the walls, near the gel's height, aimed across the pad and away from it.

    Raises:
        InputError: other than three whole numbers >= 1 joined by commas.
    """
    counts = sides.split(",")
    if len(counts) != 3 or not all(count.strip().isdecimal() and int(count) for count in counts):
        raise InputError("sides", value=sides, rule="must be three whole numbers >= 1 joined by commas, as in 3,2,3")
    half, leds = 0.5 * np.array(sensor.case.size), []
    for layer, count in zip(CHANNELS, map(int, counts), strict=True):
        out = np.array(SIDES[layer])
        own = np.eye(3)[CHANNELS.index(layer)]
        for k in range(count):
            along = 0.5 * (2 * k + 1 - count) / max(count, 2) * 2
            place = out * (half - 2.2e-3) + np.array([abs(out[1]), abs(out[0])]) * along * half * 0.8
            axis = np.array([*(-0.95 * out), -0.3])
            leds.append(
                LedSpec(
                    name=f"{layer}_{k + 1}",
                    layer=layer,
                    position=(float(place[0]), float(place[1]), -7.0e-3),
                    axis=tuple(map(float, axis / np.linalg.norm(axis))),  # type: ignore[arg-type]
                    size=(1.5e-3, 2.4e-3),
                    lobe=2.5,
                    power=tuple(map(float, 5e-5 / count * own)),  # type: ignore[arg-type]
                )
            )
    return LightsSpec(tuple(leds))


def channels(led: LedSpec) -> tuple[int, int, int]:
    """The LED's own channel, then the other two."""
    own = CHANNELS.index(led.layer)
    return own, *(c for c in range(3) if c != own)  # type: ignore[return-value]
