"""Direct light of extended LEDs on a Lambertian coat, with derivatives, in NumPy for fits.

It is the diffuse part of the ray tracer's own sum (``raytac.optics.trace.fast_tracer``) with the same points on an LED's rectangle, and
no visibility:

    D = Σ_k w_k ρ_k L(l_k),  L(l) = c^n · cos θ · d₀² / r²,  c = −w · a,  cos θ = w · n_p,  w = (l − p) / r,

for points l_k of an LED with axis a and lobe n, a point p with normal n_p, and the distance d₀ at which power 1 is full scale. Points of
the longer edge lie at Gauss's places over the angle that it spans, seen from p (``raytac.optics.trace.led.Sight``): with F the foot's place
before the edge's middle, R the distance of its line and h half its length,

    x_k = R tan φ_k − F,  φ_k = (1 − g_k) φ₀ + g_k φ₁,  tan φ₀,₁ = (F ∓ h) / R,  ρ_k = (φ₁ − φ₀) R / (2 h cos² φ_k).

Derivatives are those of this sum, with all that the points move by.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytac.calibrate.imprint import PixelGeometry
from raytac.optics.trace.led import lobe_gain, lobe_slopes
from raytac.optics.trace.quadrature import EdgePoints, gauss

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
    """By a row of ``LightParameters.leds``, (8, M).
    Position [1/mm], azimuth and elevation [1/rad], lobe, height and length [1/mm]. An edge with one point has no extent."""
    by_normal: np.ndarray
    """By the point's normal, (3, M). By the point itself it is minus that by the LED's position."""


@dataclass(frozen=True)
class _Frame:
    """Axis and edges of an LED, unit vectors (3,); slopes by azimuth and elevation, (2, 3)."""

    axis: np.ndarray
    axis_slopes: np.ndarray
    edges: tuple[np.ndarray, np.ndarray]
    edge_slopes: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, azimuth: float, elevation: float) -> _Frame:
        """The frame of ``LedSpec.edges``: u = z × a and v = a × u."""
        (sa, ca), (se, ce) = ((np.sin(x), np.cos(x)) for x in (azimuth, elevation))
        axis, u, v = np.array([[ce * ca, ce * sa, se], [-sa, ca, 0], [-se * ca, -se * sa, ce]])
        none = np.zeros(3)
        return cls(axis, np.array([ce * u, v]), (u, v), (np.array([[-ca, -sa, 0], none]), np.array([-se * u, -axis])))


@dataclass(frozen=True)
class _PointSlopes:
    """Slopes of a point's light by its place, the aim's two angles, the lobe and the normal."""

    by_place: np.ndarray
    by_aim: np.ndarray
    by_lobe: np.ndarray
    by_normal: np.ndarray


class _PointLight:
    """Light of a point of an LED at ``d`` (3, M) [m] from the points ``seen``."""

    def __init__(self, seen: PixelGeometry, d: np.ndarray, frame: _Frame, lobe: float, reference: float) -> None:
        self.seen, self.frame, self.lobe = seen, frame, lobe
        self.inverse = 1 / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        self.w = w = d * self.inverse
        self.towards = -(frame.axis @ w)
        self.cosine = w[0] * seen.n[0] + w[1] * seen.n[1] + w[2] * seen.n[2]
        self.root = np.sqrt(self.cosine * self.cosine + _SOFT**2)
        self.arriving = lobe_gain(np, self.towards, lobe, _BEHIND) * (reference * self.inverse) ** 2
        self.light = self.arriving * (0.5 * (self.cosine + self.root))

    def slopes(self) -> _PointSlopes:
        c, cosine, light, w = np.maximum(self.towards, _BEHIND), self.cosine, self.light, self.w
        by_cosine, by_lobe = lobe_slopes(self.towards, self.lobe, _BEHIND)
        slope = self.arriving * (0.5 * (1 + cosine / self.root))
        steep = by_cosine * light
        # ∂c/∂l = −(a + c w) / r, ∂cos/∂l = (n_p − cos w) / r, ∂r⁻²/∂l = −2 w r⁻³.
        along = steep * c + slope * cosine + 2 * light
        by_place = self.inverse * (slope * self.seen.n - steep * self.frame.axis[:, None] - along * w)
        by_aim = -steep * (self.frame.axis_slopes @ w)
        return _PointSlopes(by_place, by_aim, light * by_lobe, slope * w)


@dataclass(frozen=True)
class _Place:
    """Place x [m] on the longer edge and its density."""

    x: np.ndarray
    density: np.ndarray
    share: float
    tangent: np.ndarray


class _Edge:
    """Longer edge of an LED, seen from M points: foot F, distance R (M,), half length h [m]."""

    def __init__(self, foot: np.ndarray, distance: np.ndarray, half: float, count: int) -> None:
        self.foot, self.distance, self.half, self.count = foot, distance, half, count
        self.ends = [foot + sign * half for sign in (-1, 1)]

    @cached_property
    def span(self) -> np.ndarray:
        """Angle that the edge spans, (M,)."""
        low, high = self._angles
        return high - low

    @cached_property
    def _angles(self) -> list[np.ndarray]:
        return [np.arctan2(end, self.distance) for end in self.ends]

    def places(self) -> list[_Place]:
        """Places of the edge's points; one is its middle."""
        if self.count == 1:
            none = np.zeros_like(self.foot)
            return [_Place(none, none + 1, 0.5, none)]
        places = []
        for share, weight in gauss(self.count):
            tangent = np.tan(self._angles[0] + share * self.span)
            density = weight * 0.5 * self.span * self.distance * (1 + tangent * tangent) / self.half
            places.append(_Place(self.distance * tangent - self.foot, density, share, tangent))
        return places

    @cached_property
    def _end_slopes(self) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Slopes of the first end's angle and of the span by F, R and h."""
        slopes = []
        for sign, end in zip((-1, 1), self.ends, strict=True):
            square = self.distance**2 + end**2
            slopes.append((self.distance / square, -end / square, sign * self.distance / square))
        return slopes[0], tuple(b - a for a, b in zip(*slopes, strict=True))

    def slopes(self, place: _Place) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Slopes of x and of the density's logarithm by F, R and h, three (M,) each."""
        if self.count == 1:
            none = np.zeros_like(self.foot)
            return (none,) * 3, (none,) * 3
        first, span_slopes = self._end_slopes
        turned = [a + place.share * s for a, s in zip(first, span_slopes, strict=True)]
        tangent = place.tangent
        secant = 1 + tangent * tangent
        own_x = (-1.0, tangent, 0.0)
        own_log = (0.0, 1 / self.distance, -1 / self.half)
        return (
            tuple(self.distance * secant * t + o for t, o in zip(turned, own_x, strict=True)),
            tuple(s / self.span + 2 * tangent * t + o for s, t, o in zip(span_slopes, turned, own_log, strict=True)),
        )


class _Face:
    """Emitting face of an LED, a row of ``LightParameters.leds``, seen from M points."""

    def __init__(self, seen: PixelGeometry, led: np.ndarray, points: EdgePoints, reference: float) -> None:
        self.seen, self.lobe, self.reference, self.across = seen, led[5], reference, points.across
        self.frame = _Frame.of(*led[3:5])
        self.long, self.short = (1, 0) if points.upright else (0, 1)
        halves = 0.5e-3 * led[7], 0.5e-3 * led[6]
        self.e, self.f, self.other = self.frame.edges[self.long], self.frame.edges[self.short], halves[self.short]
        self.q = 1e-3 * led[:3, None] - seen.p
        foot = self.e @ self.q
        distance = np.sqrt(np.maximum(np.einsum("km,km->m", self.q, self.q) - foot * foot, 1e-12))
        self.edge = _Edge(foot, distance, halves[self.long], points.along)

    def points(self) -> Iterator[tuple[_Place, float, float, _PointLight]]:
        """Of every point: places on the longer edge and, in [−1, 1], the other; weight; light."""
        for place in self.edge.places():
            for share, weight in gauss(self.across):
                y = 2 * share - 1
                d = self.q + self.e[:, None] * place.x + (self.f * (y * self.other))[:, None]
                yield place, y, weight, _PointLight(self.seen, d, self.frame, self.lobe, self.reference)


def led_light(seen: PixelGeometry, led: np.ndarray, points: EdgePoints, reference: float) -> np.ndarray:
    """D, (M,); ``led``: row of ``LightParameters.leds``; ``reference`` [m]: d₀."""
    light = np.zeros(len(seen.p[0]))
    for place, _, weight, one in _Face(seen, led, points, reference).points():
        light += weight * place.density * one.light
    return light


def led_slopes(seen: PixelGeometry, led: np.ndarray, points: EdgePoints, reference: float) -> LedLight:
    """``led_light`` with its slopes, for several times the work."""
    face = _Face(seen, led, points, reference)
    e, q, edge, long, short = face.e, face.q, face.edge, face.long, face.short
    light, by_lobe, by_other, by_foot, by_distance, by_half = np.zeros((6, len(seen.p[0])))
    by_place, by_e, by_f = np.zeros((3, *q.shape))
    by_normal = np.zeros(q.shape)
    by_aim = np.zeros((2, len(light)))
    for place, y, weight, one in face.points():
        slopes, density = one.slopes(), weight * place.density
        x_slopes, log_slopes = edge.slopes(place)
        along = e @ slopes.by_place
        light += density * one.light
        by_place += density * slopes.by_place
        by_aim += density * slopes.by_aim
        by_lobe += density * slopes.by_lobe
        by_normal += density * slopes.by_normal
        by_e += density * place.x * slopes.by_place
        by_f += density * (y * face.other) * slopes.by_place
        by_other += density * y * (face.f @ slopes.by_place)
        by_foot += density * (along * x_slopes[0] + one.light * log_slopes[0])
        by_distance += density * (along * x_slopes[1] + one.light * log_slopes[1])
        by_half += density * (along * x_slopes[2] + one.light * log_slopes[2])
    # F = e · q and R² = q² − F².
    by_line = by_distance / edge.distance
    rise = by_foot - by_line * edge.foot
    by_led = np.empty((8, len(light)))
    by_led[:3] = 1e-3 * (by_place + rise * e[:, None] + by_line * q)
    for k in (0, 1):
        turned_e, turned_f = face.frame.edge_slopes[long][k], face.frame.edge_slopes[short][k]
        by_led[3 + k] = by_aim[k] + turned_e @ by_e + turned_f @ by_f + rise * (turned_e @ q)
    by_led[5] = by_lobe
    by_led[7 - long], by_led[7 - short] = 0.5e-3 * by_half, 0.5e-3 * by_other
    return LedLight(light, by_led, by_normal)


@dataclass(frozen=True)
class LightFrom:
    """Light of a place on an LED's longer edge, and the edges that go with it."""

    light: np.ndarray
    """(M,), with the density of the place."""
    d: np.ndarray
    """From the points to the place [m], (3, M)."""
    halves: np.ndarray
    """Its part of half the longer edge, and half the shorter one [m], (2, 3, M)."""


def light_by_place(seen: PixelGeometry, led: np.ndarray, count: int, reference: float) -> list[LightFrom]:
    """Light of ``count`` places on the longer edge of ``led``, amid the shorter one."""
    frame, halves = _Frame.of(*led[3:5]), (0.5e-3 * led[7], 0.5e-3 * led[6])
    long = int(halves[1] * np.hypot(*frame.edges[1][:2]) > halves[0] * np.hypot(*frame.edges[0][:2]))
    (e, f), (half, other) = (frame.edges[long], frame.edges[1 - long]), (halves[long], halves[1 - long])
    q = 1e-3 * led[:3, None] - seen.p
    foot = e @ q
    distance = np.sqrt(np.maximum(np.einsum("km,km->m", q, q) - foot * foot, 1e-12))
    result = []
    for place in _Edge(foot, distance, half, count).places():
        d = q + e[:, None] * place.x
        own = np.stack([half * e[:, None] * place.density, np.repeat(other * f[:, None], len(foot), axis=1)])
        result.append(LightFrom(place.density * _PointLight(seen, d, frame, led[5], reference).light, d, own))
    return result


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
    """(L, 8), rows as those of ``LightParameters.leds``."""
    by_led: Mapping[int, Light]
    """Slope of every LED's light by a column of its row; other columns change nothing."""

    def of(self, leds: np.ndarray) -> Light:
        """The light of LEDs (L, 8)."""
        light = self.light
        for k, slope in self.by_led.items():
            light = light.plus(slope, (leds[:, k] - self.at[:, k])[:, None, None])
        return light
