"""Parameters of a fit of lights: LEDs and their bounds, glow, response, view, ties.

An LED has place, aim, lobe, height, length and power. A press says something only about the light that reaches it, so LEDs far from all
presses are poorly known. Ties carry over from those nearby: LEDs of one side are of one kind, and stand mirrored about the middle of
their wall.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytac.calibrate.camera_view import ROUNDED, camera_with_view, view_of, with_view
from raytac.calibrate.photographs import decode
from raytac.errors import InputError
from raytac.optics.trace.quadrature import EdgePoints, quadrature
from raytac.specs import LedSpec, LightsSpec, SensorSpec
from raytac.specs.sensor_check import camera_edges, view_edges
from raytac.specs.tone import STRAIGHT, ToneCurve

CHANNELS = ("red", "green", "blue")
DARKEST = 0.85
"""Most of the darkest background pixel's light that may be stray."""
CEILING = -5.1
"""Highest z [mm] of an LED: below gel and a plate of 1 mm, so that a slab stays possible."""
VIRTUAL_CEILING = -0.6
"""Highest z [mm] of a virtual source over the coat at rest (a guess)."""
HEIGHT = 6
"""Column of a row of ``LightParameters.leds`` that has the height of the emitting face."""
HEIGHTS = 0.1, 6.0
"""Range of a fitted height [mm]: from an LED to a light guide as high as a wall (a guess)."""
LENGTH = 7
"""Column that has the emitting face's length, along ``LedSpec.edges[0]``."""
SHORTEST = 0.1
"""Least of a fitted length [mm]; the most is what the case takes."""
GAP = 0.02
"""Distance [mm] that an LED's corners keep from the case and the gel."""
MOST_MIXED = -0.5
"""Least number of a fitted colour matrix off its diagonal (a guess); the most is 0.
Both are for light in full scales. Light of several channels from one LED is in its powers."""
MOST_BENT = np.array([0.4, 0.1, 0.4])
"""Most of the size of a fitted tone curve's coefficients: with them every curve rises."""
OFF_DIAGONAL = ~np.eye(3, dtype=bool)
REFERENCE_DISTANCE = 10e-3
"""Distance [m] at which a power of 1 gives a coat facing the LED full scale."""


@dataclass(frozen=True)
class LightParameters:
    """Parameters of lights and camera, as arrays."""

    template: LightsSpec
    """The light file that names and layers come from."""
    leds: np.ndarray
    """(L, 8): x, y, z [mm], azimuth, elevation [rad], lobe, height and length of the face [mm]."""
    power: np.ndarray
    """(L, 3) [full scales]: diffuse light of a coat at ``REFERENCE_DISTANCE`` facing the LED."""
    glow: np.ndarray
    """(3,): even irradiance from the case over that of the LED, by layer of ``CHANNELS``."""
    response: np.ndarray
    """(6,): gamma, stray light of each channel, a₁ and a₂ of the vignette 1 + a₁r² + a₂r⁴.
    Stray light is over that of the channel's darkest background pixel."""
    mix: np.ndarray
    """(6,): the colour matrix off its diagonal, row by row, for light in full scales."""
    tone: np.ndarray
    """(3,): coefficients of the tone curve."""
    view: np.ndarray
    """(2,): distance [mm] and distortion of ``camera_view``."""

    @classmethod
    def of(cls, sensor: SensorSpec, background: np.ndarray) -> LightParameters:
        """Parameters of a sensor with this image at rest [levels].

        InputError for other layers, and a tone curve of more coefficients than a fit has.
        """
        leds, power = [], []
        for led in sensor.lights.leds:
            if led.layer not in CHANNELS:
                rule = "must be a camera channel, the LED's colour"
                raise InputError("led.layer", value=led.layer, rule=rule, choices=CHANNELS)
            x, y, z = led.axis
            aim = np.arctan2(y, x), np.arcsin(np.clip(z, -1, 1))
            leds.append([*(1e3 * c for c in led.position), *aim, led.lobe, 1e3 * led.size[1], 1e3 * led.size[0]])
            power.append(np.array(led.power) * full_scale(sensor))
        response = sensor.response
        if len(response.tone) > len(MOST_BENT):
            raise InputError(
                "response.tone", value=response.tone, rule=f"must have at most {len(MOST_BENT)} coefficients in a fit"
            )
        tone = np.array([*response.tone, *np.zeros(len(MOST_BENT) - len(response.tone))])
        stray = np.clip(np.array(response.black_level) / darkest(background, response.gamma, response.curve), 0, DARKEST)
        glow = [max((led.glow for led in sensor.lights.leds if led.layer == c), default=0.0) * _GLOW for c in CHANNELS]
        a1, a2, _ = response.vignetting
        at_response, mix = np.array([response.gamma, *stray, a1, a2]), np.array(response.colour_mix) * _mixed_balance(sensor)
        return cls(sensor.lights, np.array(leds), np.array(power), np.array(glow), at_response, mix, tone, view_of(sensor))

    @property
    def mixing(self) -> np.ndarray:
        """The colour matrix for light in full scales, (3, 3)."""
        whole = np.eye(3)
        whole[OFF_DIAGONAL] = self.mix
        return whole

    @property
    def curve(self) -> ToneCurve:
        """The tone curve."""
        return ToneCurve(tuple(self.tone))

    @cached_property
    def layer(self) -> np.ndarray:
        """Index in ``CHANNELS`` of every LED's layer, (L,)."""
        return np.array([CHANNELS.index(led.layer) for led in self.template.leds])

    @cached_property
    def virtual(self) -> np.ndarray:
        """True for virtual sources, (L,)."""
        return np.array([led.virtual for led in self.template.leds])

    @property
    def points(self) -> tuple[EdgePoints, ...]:
        """Points that the ray tracer takes on every LED."""
        return tuple(quadrature(led) for led in self._placed())

    @property
    def smooth_points(self) -> tuple[EdgePoints, ...]:
        """The same, but two at least across every strip: light then depends on all heights.

        The ray tracer takes one across a thin strip, and steps to two where it seems 25 degrees high.
        """
        return tuple(dataclasses.replace(one, across=max(one.across, 2)) if one.along > 1 else one for one in self.points)

    def _placed(self) -> list[LedSpec]:
        """The LEDs with the powers of the template."""
        leds = []
        for led, row in zip(self.template.leds, self.leds, strict=True):
            flat, azimuth = np.cos(row[4]), row[3]
            leds.append(
                dataclasses.replace(
                    led,
                    position=(float(row[0] / 1e3), float(row[1] / 1e3), float(row[2] / 1e3)),
                    axis=(float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(row[4]))),
                    lobe=float(row[5]),
                    size=(float(row[LENGTH] / 1e3), float(row[HEIGHT] / 1e3)),
                )
            )
        return leds

    def lights(self, sensor: SensorSpec) -> LightsSpec:
        """The light file, for the coat and exposure of ``sensor``."""
        scale, glow = full_scale(sensor), self.glow[self.layer] / _GLOW
        lit = zip(self._placed(), self.power, glow, strict=True)
        return LightsSpec(tuple(dataclasses.replace(led, power=tuple(map(float, w / scale)), glow=float(g)) for led, w, g in lit))


_GLOW = np.pi * REFERENCE_DISTANCE**2
"""An even radiance G irradiates with π G, an LED of intensity I at distance d with I / d²."""


def full_scale(sensor: SensorSpec) -> np.ndarray:
    """Diffuse light [full scales] (3,) of an LED of 1 W/sr at ``REFERENCE_DISTANCE``."""
    coat, response = sensor.coat, sensor.response
    diffuse = (1 - coat.specular) * np.array(coat.reflectance) / np.pi
    return response.gain * np.array(response.white_balance) * diffuse / REFERENCE_DISTANCE**2


def _mixed_balance(sensor: SensorSpec) -> np.ndarray:
    """White balance of a channel over that of the channel it takes from, (6,) as ``colour_mix``."""
    balance = np.array(sensor.response.white_balance)
    return (balance[:, None] / balance)[OFF_DIAGONAL]


def least_mix(sensor: SensorSpec) -> np.ndarray:
    """Least ``LightParameters.mix`` of a fit, (6,): ``MOST_MIXED``, or −1 in the sensor's file."""
    return np.maximum(MOST_MIXED, -_mixed_balance(sensor))


def check_mix(sensor: SensorSpec, p: LightParameters) -> None:
    """InputError for a start whose colour matrix lies outside the bounds of a fit of it."""
    balance, least = _mixed_balance(sensor), least_mix(sensor)
    if (p.mix < least - ROUNDED).any() or (p.mix > ROUNDED).any():
        bounds = ", ".join(f"[{number:.4g}, 0]" for number in least / balance)
        rule = f'must be in {bounds} where a fit of it begins: fix "mix", or begin without a matrix'
        raise InputError("response.colour_mix", value=tuple(float(f"{m:.4g}") for m in p.mix / balance), rule=rule)


def check_tone(p: LightParameters) -> None:
    """InputError for a start whose tone curve lies outside the bounds of a fit of it."""
    if (np.abs(p.tone) > MOST_BENT + ROUNDED).any():
        bounds = ", ".join(f"±{most:g}" for most in MOST_BENT)
        rule = f'must be within {bounds} where a fit of it begins: fix "tone", or begin without a curve'
        raise InputError("response.tone", value=tuple(float(f"{t:.4g}") for t in p.tone), rule=rule)


def mean_power(p: LightParameters) -> float:
    """Mean over LEDs of their power in the channel that they light most [full scales]."""
    return max(float(p.power.max(1).mean()), 1e-6)


def with_parameters(sensor: SensorSpec, p: LightParameters, background: np.ndarray) -> SensorSpec:
    """The sensor with fitted lights and response, unchecked; ``background`` as of ``of``."""
    gamma, *stray, a1, a2 = map(float, p.response)
    black = np.array(stray) * darkest(background, gamma, p.curve)
    black_level = tuple(map(float, black))
    mix = tuple(map(float, p.mix / _mixed_balance(sensor)))
    vignetting = (a1, a2, 0.0)
    response = dataclasses.replace(
        sensor.response.unshaded,
        gamma=gamma,
        black_level=black_level,
        vignetting=vignetting,
        colour_mix=mix,
        tone=tuple(map(float, p.tone)) if p.tone.any() else (),
    )
    return dataclasses.replace(with_view(sensor, p.view), response=response, lights=p.lights(sensor))


def darkest(background: np.ndarray, gamma: float, curve: ToneCurve = STRAIGHT) -> np.ndarray:
    """Linear light of the darkest pixel of every channel, (3,)."""
    return np.maximum(decode(background.reshape(-1, 3).min(0), gamma, curve), 1e-6)


PLACE, AIM, LOBE, TALL, LONG, POWER = 1.0, 0.2, 1.0, 0.5, 0.5, 0.3
"""Standard deviations of LEDs about mirrored places [mm] and aims [rad], and about the
lobe, height and length [mm] and power (over the mean power) of the LED beside them."""

LEAST = 1.0
"""Least distance [mm] of a layer's LEDs from the pad's middle, to be on one side of it."""


@dataclass(frozen=True)
class Ties:
    """Beliefs, in standard deviations: ``matrix`` x is about ``offset``, (T, n) and (T,)."""

    matrix: np.ndarray
    offset: np.ndarray

    def off(self, x: np.ndarray) -> np.ndarray:
        """Standard deviations by which x (n,) is off, (T,)."""
        return self.matrix @ x - self.offset


def side_ties(p: LightParameters, size: int) -> Ties:
    """Ties of the LEDs of every layer, which stand on one side of the pad.

    They are mirrored about the line from the pad's middle to theirs. An LED is tied to that which lies nearest to its mirror image at
    the start, if that holds of both. ``size`` is the vector's length, whose first entries are ``p.leds`` and ``p.power``.
    """
    rows: list[np.ndarray] = []
    offsets: list[float] = []
    wide = p.leds.shape[1]

    def tie(sigma: float, offset: float, *terms: tuple[int, float]) -> None:
        row = np.zeros(size)
        for place, factor in terms:
            row[place] += factor / sigma
        rows.append(row)
        offsets.append(offset / sigma)

    for layer in range(len(CHANNELS)):
        own = [int(led) for led in np.flatnonzero(p.layer == layer)]
        if not own:
            continue
        middle = p.leds[own, :2].mean(0)
        if np.hypot(*middle) > LEAST:
            out = middle / np.hypot(*middle)
            across = np.array([-out[1], out[0]])
            mirrored = p.leds[own, :2] - 2 * np.outer(p.leds[own, :2] @ across, across)
            nearest = np.argmin(np.linalg.norm(mirrored[:, None] - p.leds[own, :2], axis=2), axis=1)
            for k in np.flatnonzero(nearest[nearest] == np.arange(len(own))):
                a, b = own[k], own[nearest[k]]
                if a > b:
                    continue
                tie(PLACE, 0.0, *((wide * led + axis, float(across[axis])) for led in (a, b) for axis in (0, 1)))
                # Mirrored, an azimuth A becomes 2 φ − A with φ that of ``out``, up to whole turns.
                turn, total = 2 * float(np.arctan2(out[1], out[0])), float(p.leds[a, 3] + p.leds[b, 3])
                tie(AIM, turn + 2 * np.pi * round((total - turn) / (2 * np.pi)), (wide * a + 3, 1), (wide * b + 3, 1))
                if a < b:
                    signs = ((a, 1), (b, -1))
                    tie(PLACE, 0.0, *((wide * led + axis, float(sign * out[axis])) for led, sign in signs for axis in (0, 1)))
                    tie(PLACE, 0.0, (wide * a + 2, 1), (wide * b + 2, -1))
                    tie(AIM, 0.0, (wide * a + 4, 1), (wide * b + 4, -1))
        for a, b in itertools.pairwise(own):
            tie(LOBE, 0.0, (wide * a + 5, 1), (wide * b + 5, -1))
            tie(TALL, 0.0, (wide * a + HEIGHT, 1), (wide * b + HEIGHT, -1))
            tie(LONG, 0.0, (wide * a + LENGTH, 1), (wide * b + LENGTH, -1))
            for power in range(p.leds.size, p.leds.size + 3):
                tie(POWER * mean_power(p), 0.0, (power + 3 * a, 1), (power + 3 * b, -1))
    return Ties(np.array(rows).reshape(len(rows), size), np.array(offsets))


def leds_inside(sensor: SensorSpec, p: LightParameters, *, lengths: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Rows of ``p.leds`` moved to what a sensor accepts, (L, 8).

    LEDs lie in the case and below gel and plate; virtual sources up to the coat, on that side of the view where they begin. Lengths and
    heights change where ``lengths`` and ``heights`` (L,) are true, and aims and lobes as far as they may.
    """
    leds = p.leds.copy()
    leds[:, 4], leds[:, 5] = np.clip(leds[:, 4], -1.4, 1.4), np.clip(leds[:, 5], 1.0, 15.0)
    leds[:, HEIGHT] = np.where(heights, np.clip(leds[:, HEIGHT], *HEIGHTS), leds[:, HEIGHT])
    u, v = _edges(leds)
    low, high = _beside_view(sensor, p)
    # What lies between a wall and the view is as wide for a virtual source as the case for an LED.
    width = np.where(p.virtual[:, None], high - low, 1e3 * np.array(sensor.case.size))
    tallest = ((width - 2 * GAP - SHORTEST * np.abs(u[:, :2])) / np.maximum(np.abs(v[:, :2]), 1e-6)).min(1)
    leds[:, HEIGHT] = np.where(heights & p.virtual, np.clip(leds[:, HEIGHT], None, tallest), leds[:, HEIGHT])
    room = width - 2 * GAP - leds[:, HEIGHT, None] * np.abs(v[:, :2])
    longest = np.maximum((room / np.maximum(np.abs(u[:, :2]), 1e-6)).min(1), SHORTEST)
    leds[:, LENGTH] = np.where(lengths, np.clip(leds[:, LENGTH], SHORTEST, longest), leds[:, LENGTH])
    reach = GAP + 0.5 * (leds[:, LENGTH, None] * np.abs(u) + leds[:, HEIGHT, None] * np.abs(v))
    leds[:, :2] = np.clip(leds[:, :2], reach[:, :2] + low, np.maximum(high - reach[:, :2], reach[:, :2] + low))
    pad, ceiling = sensor.gelpad, np.full(len(leds), CEILING)
    for k in np.flatnonzero(p.virtual):
        corner = np.minimum(1e-3 * (np.abs(leds[k, :2]) + reach[k, :2]), 0.5 * np.array(pad.size))
        ceiling[k] = VIRTUAL_CEILING - 1e3 * max(float(pad.sag(a * corner[0], b * corner[1])) for a in (-1, 1) for b in (-1, 1))
    floor = 1e3 * sensor.case.floor_z + reach[:, 2]
    leds[:, 2] = np.clip(leds[:, 2], floor, np.maximum(ceiling - reach[:, 2], floor))
    return leds


def _beside_view(sensor: SensorSpec, p: LightParameters) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x and y [mm] of what LEDs reach, (L, 2) each."""
    half = 5e2 * np.array(sensor.case.size)
    low, high = (np.tile(sign * half, (len(p.leds), 1)) for sign in (-1, 1))
    sides = _sides(sensor, p)
    if sides:
        edges = 1e3 * np.array(camera_edges(camera_with_view(sensor.camera, *map(float, p.view))))
        for k, (axis, end) in sides.items():
            (high, low)[end][k, axis] = edges[axis, end]
    return low, high


def _sides(sensor: SensorSpec, p: LightParameters) -> dict[int, tuple[int, int]]:
    """Side of the given view on which every virtual source begins, by its index.

    A side is its axis, 0 or 1, and 0 for its low end or 1 for its high one.
    """
    sides: dict[int, tuple[int, int]] = {}
    virtual = np.flatnonzero(p.virtual)
    if not len(virtual):
        return sides
    edges = view_edges(sensor)
    for k in map(int, virtual):
        place = p.template.leds[k].position
        beyond = {(axis, end): sign * (place[axis] - edges[axis][end]) for axis in (0, 1) for end, sign in enumerate((-1, 1))}
        sides[k] = max(beyond, key=lambda side: beyond[side])
    return sides


def room_beside_view(
    sensor: SensorSpec, p: LightParameters, *, lengths: np.ndarray, heights: np.ndarray
) -> tuple[float, float, float, float]:
    """Width [mm] that virtual sources need, turned anyhow, beside the view.

    At low x, high x, low y and high y; 0 for none. Sizes can shrink where ``lengths`` and ``heights`` (L,) are true.
    """
    length, height = np.where(lengths, SHORTEST, p.leds[:, LENGTH]), np.where(heights, HEIGHTS[0], p.leds[:, HEIGHT])
    room = [0.0] * 4
    for k, (axis, end) in _sides(sensor, p).items():
        room[2 * axis + end] = max(room[2 * axis + end], 2 * GAP + float(np.hypot(length[k], height[k])))
    return room[0], room[1], room[2], room[3]


def _edges(leds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of every LED's edges (``LedSpec.edges``), (L, 3) each."""
    (sin_a, cos_a), (sin_e, cos_e) = ((np.sin(leds[:, k]), np.cos(leds[:, k])) for k in (3, 4))
    u = np.stack([-sin_a, cos_a, np.zeros(len(leds))], axis=1)
    return u, np.stack([-sin_e * cos_a, -sin_e * sin_a, cos_e], axis=1)
