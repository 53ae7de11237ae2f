"""Light in the pixels of a fit, LED by LED, and what a fit of direct light is given beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

__all__ = ["ExtraLight", "Light"]


@dataclass(frozen=True)
class Light:
    """Light of every LED at power 1 by channel, each (L, M, 3): in the pixels of presses, in the same at rest, over the image at rest."""

    pressed: np.ndarray
    flat: np.ndarray
    rest: np.ndarray

    @property
    def parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All three, in that order."""
        return self.pressed, self.flat, self.rest

    def plus(self, other: Light, factor: np.ndarray | float = 1.0) -> Light:
        """The sum with ``factor`` times another; one factor for all, or one an LED (L, 1, 1)."""
        return Light(*(a + factor * b for a, b in zip(self.parts, other.parts, strict=True)))


@dataclass(frozen=True)
class ExtraLight:
    """Light beyond the direct light, to first order about the LEDs ``at``."""

    light: Light
    at: np.ndarray
    """(L, 7), rows as those of ``LightParameters.leds``."""
    by_led: Mapping[int, Light]
    """Slope of every LED's light by a column of its row; columns that are not named change nothing."""

    def of(self, leds: np.ndarray) -> Light:
        """The light of LEDs (L, 7)."""
        light = self.light
        for k, slope in self.by_led.items():
            light = light.plus(slope, (leds[:, k] - self.at[:, k])[:, None, None])
        return light
