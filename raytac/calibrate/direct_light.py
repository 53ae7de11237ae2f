"""Direct light of point LEDs on a Lambertian coat, with derivatives, in NumPy for fits.

It is the diffuse part of the ray tracer's own sum (``raytac.optics.trace.fast_tracer``) with one point an LED and no visibility:

    D = c^n · cos θ · d₀² / r²,  c = −w · a,  cos θ = w · n_p,  w = (l − p) / r,

for an LED at l with axis a and lobe n, a point p with normal n_p, and the distance d₀ at which power 1 is full scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.imprint import PixelGeometry
from raytac.optics.trace.led import lobe_gain, lobe_slopes

_BEHIND = 1e-3
"""Least cosine of an LED's lobe: its powers stay differentiable behind the LED."""
_SOFT = 1e-2
"""Cosine over which a coat that turns away from an LED goes dark."""


@dataclass(frozen=True)
class LedLight:
    """Light of one LED at M points, and its derivatives."""

    light: np.ndarray
    """D, (M,)."""
    by_led: np.ndarray
    """By the first six of a row of ``LightParameters.leds``, (6, M); a point has no height.
    Position [1/mm], azimuth and elevation [1/rad], lobe."""
    by_normal: np.ndarray
    """By the point's normal, (3, M). By the point itself it is minus that by the LED's position."""


def led_light(seen: PixelGeometry, led: np.ndarray, reference: float) -> LedLight:
    """``led``: row of ``LightParameters.leds``; ``reference`` [m]: d₀."""
    azimuth, elevation, lobe = led[3:6]
    (sa, ca), (se, ce) = ((np.sin(x), np.cos(x)) for x in (azimuth, elevation))
    axis, by_azimuth, by_elevation = np.array([[ce * ca, ce * sa, se], [-ce * sa, ce * ca, 0], [-se * ca, -se * sa, ce]])
    d = 1e-3 * led[:3, None] - seen.p
    inverse = 1 / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    w = d * inverse
    towards = -(axis @ w)
    c = np.maximum(towards, _BEHIND)
    by_cosine, by_lobe = lobe_slopes(towards, lobe, _BEHIND)
    cosine = w[0] * seen.n[0] + w[1] * seen.n[1] + w[2] * seen.n[2]
    root = np.sqrt(cosine * cosine + _SOFT**2)
    soft = 0.5 * (cosine + root)
    arriving = lobe_gain(np, towards, lobe, _BEHIND) * (reference * inverse) ** 2
    light = arriving * soft
    by_normal = arriving * (0.5 * (1 + cosine / root)) * w
    steep = by_cosine * light
    by_led = np.empty((6, len(light)))
    # ∂c/∂l = −(a + c w) / r, ∂cos/∂l = (n_p − cos w) / r, ∂r⁻²/∂l = −2 w r⁻³.
    turned = by_normal[0] * w[0] + by_normal[1] * w[1] + by_normal[2] * w[2]
    slope = arriving * (0.5 * (1 + cosine / root))
    for k in range(3):
        by_led[k] = -steep * (axis[k] + c * w[k]) + slope * seen.n[k] - (turned * cosine + 2 * light) * w[k]
    by_led[:3] *= 1e-3 * inverse
    by_led[3], by_led[4], by_led[5] = -steep * (by_azimuth @ w), -steep * (by_elevation @ w), light * by_lobe
    return LedLight(light, by_led, by_normal)


def case_light(seen: PixelGeometry) -> np.ndarray:
    """Irradiance (M,) of a case of radiance 1 / π: its share of the hemisphere, (1 − n_z) / 2."""
    return 0.5 * (1 - seen.n[2])


@dataclass(frozen=True)
class Light:
    """Light of every LED at power 1, (L, M, 3): of presses, of their pixels at rest, over rest."""

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
    """Slope of every LED's light by a column of its row; other columns change nothing."""

    def of(self, leds: np.ndarray) -> Light:
        """The light of LEDs (L, 7)."""
        light = self.light
        for k, slope in self.by_led.items():
            light = light.plus(slope, (leds[:, k] - self.at[:, k])[:, None, None])
        return light
