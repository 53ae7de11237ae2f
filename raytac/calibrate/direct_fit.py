"""Joint fit of lights, response, imprint and circles to photographs, by direct light.

Residuals are those of the presses with the real background B as flat field, and of the image at rest,

    I = encode((decode(B) − b) · L(pressed) / L(rest) + b),

with gamma and tone curve in ``encode``, solved by Levenberg and Marquardt's method with a prior on every parameter. What direct light lacks
(shadows, inter-reflection, a specular coat) can be given as ``extra`` light of every LED, with its slopes by the LED's place and size
(``ray_fit``).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from raytac.calibrate.camera_view import ViewBounds, check_view, with_view
from raytac.calibrate.direct_light import ExtraLight, LedLight, Light, case_light, led_light, led_slopes
from raytac.calibrate.imprint import PixelGeometry, circles_on_pad, on_plane, pixel_geometry, rest_geometry
from raytac.calibrate.light_parameters import (
    DARKEST,
    HEIGHT,
    LENGTH,
    MOST_BENT,
    OFF_DIAGONAL,
    REFERENCE_DISTANCE,
    LightParameters,
    check_mix,
    check_tone,
    darkest,
    least_mix,
    leds_inside,
    mean_power,
    room_beside_view,
    side_ties,
)
from raytac.calibrate.photographs import Photographs, decode, encode, level_slope
from raytac.optics.trace.quadrature import EdgePoints
from raytac.specs import SensorSpec

SIGMA = {
    "place": 4.0,
    "aim": 0.6,
    "lobe": 2.0,
    "height": 1.0,
    "length": 4.0,
    "power": 2.0,
    "glow": 0.5,
    "gamma": 0.5,
    "stray": 0.5,
    "vignette": 0.5,
    "mix": 0.1,
    "tone": 0.2,
    "distance": 0.3,
    "distortion": 0.03,
    "slope": 0.15,
}
"""Standard deviation of a parameter about its start [mm, rad, 1].

That of powers is over the mean power of the start, that of the camera's distance over its start."""
CIRCLE_SIGMA = np.array([1.0, 1.0, 1.5]) / 320
"""Standard deviation of a circle's x, y and radius about its label, over the image's width."""
BORDER_SIGMA = 4.0
"""That of a circle which leaves the image, over that of the others: labels are worse there."""
CIRCLE_PRIOR = 300.0
"""Squared residual [levels²] that a circle's deviation of one sigma is worth."""
HOLD, HOLD_FACTOR = 1000.0, 8.0
"""First stiffness [levels²/σ²] of LEDs to the best state, and its factor.

Rounds that make the cost worse raise it by the factor, others lower it (Levenberg and Marquardt's rule, between rounds)."""
ACTIVE = 6
"""Most times that a step is solved for with more parameters at their bounds."""
STEP = 1e-5
"""Step of the derivatives by response and imprint."""
VIEW_STEPS = np.array([1e-2, 1e-5])
"""Steps of the derivatives by the camera's distance [mm] and distortion."""
REST_FACTOR = 8
"""The image at rest is fitted as means of so many pixels squared."""
LEAST_SHARE = 0.1
"""Least share of a channel's light at rest that a colour matrix leaves it (a guess).

It may make light negative where no press was, and no gain of a sensor makes that bright. So fits are pushed back below this share."""
LACK = 3000.0
"""Residual [levels] of light that is a channel's mean below that."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit."""

    reach: float = 2.4
    """Pixels up to this many radii from a circle's centre count."""
    ring_weight: float = 1.5
    """Weight of a residual outside the labelled circle."""
    rest_weight: float = 0.3
    """Weight of the whole image at rest over that of the presses."""
    huber: float = 6.0
    """Residual [levels] from which on it counts linearly."""
    samples: tuple[int, int] = (150, 90)
    """Pixels of every press that count, drawn at random inside the labelled circle and outside."""
    circles: bool = True
    """True fits the circles too."""
    fixed: tuple[str, ...] = ()
    """Blocks of parameters that stay: names of ``SIGMA``."""
    prior: float = 30.0
    """Squared residual [levels²] that is worth one sigma of a parameter's deviation."""
    ties: float = 0.0
    """The same of a deviation from ``side_ties``: LEDs of a side alike and mirrored."""


@dataclass(frozen=True)
class FitState:
    """State of a fit: lights, response, s at the imprint's inner knots, circles (N, 3) [px]."""

    p: LightParameters
    slopes: np.ndarray
    circles: np.ndarray


@dataclass(frozen=True)
class _Seen:
    """Sensor with a view, and its geometry whatever is pressed."""

    sensor: SensorSpec
    places: tuple[np.ndarray, np.ndarray]
    """Places on z = 0 that pixels of presses see."""
    flat: PixelGeometry
    """Coat at rest in these pixels."""
    rest: PixelGeometry
    """Coat over the image at rest."""


class DirectFit:
    """Least-squares problem on the pixels near the circles of ``shots``, the circles' prior."""

    def __init__(
        self,
        sensor: SensorSpec,
        shots: Photographs,
        start: FitState,
        settings: FitSettings,
        *,
        factor: int = 2,
        extra: ExtraLight | None = None,
        seed: int = 0,
    ) -> None:
        """``factor``² pixels are averaged to one; ``start`` is the prior of lights and imprint.

        Raises InputError: a colour matrix, tone curve or distortion that is fitted and does not begin inside its bounds.
        """
        if "mix" not in settings.fixed:
            check_mix(sensor, start.p)
        if "tone" not in settings.fixed:
            check_tone(start.p)
        if "distortion" not in settings.fixed:
            check_view(sensor, start.p.view)
        self.sensor, self.shots, self.start, self.settings = sensor, shots, start, settings
        small, coarse = shots.shrunk(factor), shots.shrunk(REST_FACTOR)
        height, width = small.background.shape[:2]
        rho = small.distance(sensor)
        self.press, self.row, self.column = _draw(rho, settings, seed)
        self.inside = rho[self.press, self.row, self.column] < 1
        self.u, self.v = factor * (self.column + 0.5), factor * (self.row + 0.5)
        self.real = small.presses[self.press, self.row, self.column].astype(float)
        self.behind = small.background[self.row, self.column].astype(float)
        rest_v, rest_u = REST_FACTOR * (np.mgrid[: coarse.background.shape[0], : coarse.background.shape[1]] + 0.5)
        self.rest_u, self.rest_v = rest_u.ravel(), rest_v.ravel()
        self.rest_real = coarse.background.reshape(-1, 3).astype(float)
        self.share = np.where(self.inside, 1.0, settings.ring_weight)[:, None]
        self.lack_share = np.sqrt(len(self.press) / len(self.rest_u))
        self.rest_share = settings.rest_weight * self.lack_share
        native, (cx, cy) = sensor.camera.resolution, sensor.camera.principal_point
        self.r2 = (((self.rest_u - cx) ** 2 + (self.rest_v - cy) ** 2) / (native[0] ** 2 + native[1] ** 2) * 4)[:, None]
        self.darkest = shots.background.reshape(-1, 3).min(0)[None]
        coat = sensor.coat
        diffuse = (1 - coat.specular) * np.array(coat.reflectance)
        self.even_gain = (diffuse + coat.specular) / diffuse
        self.extra, self.shape = extra, (height, width)
        self.points = start.p.smooth_points
        wider = np.where(shots.fully_visible, 1.0, BORDER_SIGMA)[:, None]
        self.circle_sigma = CIRCLE_SIGMA * native[0] * wider
        self.ties = side_ties(start.p, len(self.flat(start)))
        self.anchor, self.hold = self.flat(start), 0.0
        self.views = ViewBounds(sensor, start.p.view)
        self.sigma = self._sigma()
        """Standard deviation of every parameter about its start, (n,)."""
        # A view's pixels are asked for by every derivative at it, and its circles by all but their own.
        self._seen, self._on_pad = lru_cache(8)(self._seen), lru_cache(8)(self._on_pad)

    def with_points(self, points: tuple[EdgePoints, ...]) -> DirectFit:
        """The same problem with ``points`` on its LEDs.

        They stay as LEDs move, so that images are smooth in every parameter.
        """
        other = copy.copy(self)
        other.points = points
        return other

    def with_fixed(self, *names: str) -> DirectFit:
        """The same problem with further blocks of parameters that stay."""
        other = copy.copy(self)
        other.settings = dataclasses.replace(self.settings, fixed=(*self.settings.fixed, *names))
        return other

    def with_extra(self, extra: ExtraLight) -> DirectFit:
        """The same problem with light beyond the direct light."""
        other = copy.copy(self)
        other.extra = extra
        return other

    def near(self, state: FitState, hold: float) -> DirectFit:
        """The same problem with LEDs held near those of ``state``.

        A deviation of one sigma there costs ``hold`` [levels²]: extra light is known to first order about that state alone.
        """
        other = copy.copy(self)
        other.anchor, other.hold = self.flat(state), hold
        return other

    def _held(self) -> np.ndarray:
        """Stiffness of every parameter to the anchor, (n,): that of LEDs' rows."""
        stiff = np.zeros(len(self.anchor))
        stiff[: self.start.p.leds.size] = self.hold
        return stiff / self.sigma**2

    def _seen(self, view: tuple[float, ...]) -> _Seen:
        own = with_view(self.sensor, np.array(view))
        places, rest = on_plane(own.camera, self.u, self.v), on_plane(own.camera, self.rest_u, self.rest_v)
        return _Seen(own, places, rest_geometry(own, places), rest_geometry(own, rest))

    def _on_pad(self, view: tuple[float, ...], circles: bytes) -> np.ndarray:
        return circles_on_pad(self._seen(view).sensor, np.frombuffer(circles).reshape(-1, 3), self.shots.radius)

    def geometry(self, state: FitState) -> PixelGeometry:
        """Points and normals that the pixels of presses see."""
        view = tuple(map(float, state.p.view))
        seen, on_pad = self._seen(view), self._on_pad(view, state.circles.astype(float).tobytes())
        return pixel_geometry(seen.sensor, seen.places, self.press, on_pad, self.shots.radius, state.slopes)

    def geometries(self, state: FitState) -> tuple[PixelGeometry, PixelGeometry, PixelGeometry]:
        """Points and normals in pixels of presses, the same at rest, and over the image at rest."""
        seen = self._seen(tuple(map(float, state.p.view)))
        return self.geometry(state), seen.flat, seen.rest

    def light(self, state: FitState) -> Light:
        """Direct light of every LED at power 1."""
        p = state.p
        return Light(*(self._led_layers(p, g, [led_light(g, *led) for led in self._leds(p)]) for g in self.geometries(state)))

    def _leds(self, p: LightParameters) -> list[tuple[np.ndarray, EdgePoints, float]]:
        """Of every LED what its light depends on beside the geometry."""
        return [(led, points, REFERENCE_DISTANCE) for led, points in zip(p.leds, self.points, strict=True)]

    def _led_layers(self, p: LightParameters, seen: PixelGeometry, leds: list[np.ndarray]) -> np.ndarray:
        """(L, M, 3): direct light of every LED, (M,) each, and the even glow that goes with it."""
        even = case_light(seen)[:, None] * self.even_gain
        return np.stack([light[:, None] + p.glow[k] * even for light, k in zip(leds, p.layer, strict=True)])

    def total(self, p: LightParameters, light: Light) -> list[np.ndarray]:
        """Linear light (M, 3) in the pixels of presses, in the same at rest, over the image at rest."""
        return _summed(p, self._with_extra(p, light))

    def _with_extra(self, p: LightParameters, light: Light) -> Light:
        return light if self.extra is None else light.plus(self.extra.of(p.leds))

    def images(self, p: LightParameters, total: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Levels of the presses' pixels (M, 3) and of the image at rest (K, 3)."""
        pressed, rest, _ = self._linear(p, total)
        return encode(pressed, p.response[0], p.curve), encode(rest, p.response[0], p.curve)

    def _linear(self, p: LightParameters, total: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Light [full scales] that is encoded: pressed (M, 3), at rest (K, 3); stray light (3,)."""
        gamma, *stray = p.response[:4]
        black = np.array(stray) * darkest(self.darkest, gamma, p.curve)
        pressed, flat, rest = total
        linear = (decode(self.behind, gamma, p.curve) - black) * pressed / flat + black
        return linear, rest * self._vignette(p) + black, black

    def _vignette(self, p: LightParameters) -> np.ndarray:
        """The vignette over the image at rest, (K, 1)."""
        a1, a2 = p.response[4:]
        return 1 + self.r2 * (a1 + a2 * self.r2)

    def lack(self, p: LightParameters, total: list[np.ndarray]) -> np.ndarray:
        """Light at rest that is below the least share, over its channel's mean, (K, 3) [levels]."""
        unmixed = total[2] @ np.linalg.inv(p.mixing).T
        return LACK * np.minimum(total[2] - LEAST_SHARE * unmixed, 0) / np.maximum(unmixed.mean(0), _LEAST)

    def blocks(self, p: LightParameters) -> list[tuple[str, int]]:
        """Name (of ``SIGMA``) of every parameter of the vector's blocks, and how many follow."""
        per_led = [("place", 3), ("aim", 2), ("lobe", 1), ("height", 1), ("length", 1)] * len(p.leds)
        rest = [("glow", 3), ("gamma", 1), ("stray", 3), ("vignette", 2), ("mix", 6), ("tone", len(MOST_BENT))]
        view = [("distance", 1), ("distortion", 1)]
        return [*per_led, ("power", p.power.size), *rest, *view, ("slope", len(self.start.slopes))]

    def _sigma(self) -> np.ndarray:
        p = self.start.p
        unit = {"power": mean_power(p), "distance": p.view[0]}
        return np.concatenate([np.full(n, SIGMA[name] * unit.get(name, 1.0)) for name, n in self.blocks(p)])

    def free(self, p: LightParameters) -> np.ndarray:
        """True for parameters that are fitted, and that images depend on, (n,)."""
        free = np.concatenate([np.full(n, name not in self.settings.fixed) for name, n in self.blocks(p)])
        for column, seen in zip((LENGTH, HEIGHT), self.sees_sizes(), strict=True):
            free[column : p.leds.size : p.leds.shape[1]] &= seen
        return free

    def sees_sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """True for LEDs on whose length and on whose height images depend, (L,) each.

        An edge has an extent for direct light if it has more than one point, and for extra light if that has its slope.
        """
        by_led = () if self.extra is None else self.extra.by_led
        counts = np.array([points.by_edge for points in self.points])
        length, height = ((counts[:, k] > 1) | (column in by_led) for k, column in enumerate((LENGTH, HEIGHT)))
        return length, height

    def flat(self, state: FitState) -> np.ndarray:
        p = state.p
        return np.concatenate([p.leds.ravel(), p.power.ravel(), p.glow, p.response, p.mix, p.tone, p.view, state.slopes])

    def at(self, x: np.ndarray, circles: np.ndarray) -> FitState:
        p = self.start.p
        cuts = np.cumsum([p.leds.size, p.power.size, 3, 6, 6, len(MOST_BENT), 2])
        leds, power, glow, response, mix, tone, view, slopes = np.split(x, cuts)
        leds, power = leds.reshape(p.leds.shape), power.reshape(-1, 3)
        changed = LightParameters(p.template, leds, power, glow, response, mix, tone, view)
        return FitState(changed, slopes, circles)

    def inside_bounds(self, state: FitState) -> FitState:
        """Every parameter moved to what a sensor accepts (``leds_inside``).

        LEDs are moved as a whole, virtual ones beside the view; of the other blocks, those that are fixed stay.
        """
        p, response = state.p, state.p.response.copy()

        def bounded(name: str, values: np.ndarray, least: float | np.ndarray, most: float | np.ndarray | None) -> np.ndarray:
            return values if name in self.settings.fixed else np.clip(values, least, most)

        length, height = self.sees_sizes()
        room = room_beside_view(self.sensor, p, lengths=length, heights=height)
        p = dataclasses.replace(p, view=self.views.inside(p.view, self.settings.fixed, room))
        leds = leds_inside(self.sensor, p, lengths=length, heights=height)
        response[:1], response[1:4] = bounded("gamma", response[:1], 1.0, 2.4), bounded("stray", response[1:4], 0, DARKEST)
        response[4:5] = bounded("vignette", response[4:5], -2.0, 0.5)
        response[5:] = bounded("vignette", response[5:], max(-0.3, -0.75 - response[4]), 1.5)
        power, glow = bounded("power", p.power, 0, None), bounded("glow", p.glow, 0, None)
        mix, tone = bounded("mix", p.mix, least_mix(self.sensor), 0), bounded("tone", p.tone, -MOST_BENT, MOST_BENT)
        changed = LightParameters(p.template, leds, power, glow, response, mix, tone, p.view)
        circles = state.circles.copy()
        circles[:, 2] = np.clip(circles[:, 2], 3, None)
        return FitState(changed, state.slopes, circles)

    def residuals(self, state: FitState) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [levels], not weighted: of pressed pixels (M, 3), and (2, K, 3) at rest.

        Those at rest are of the image and of its ``lack``.
        """
        return self._residuals(state.p, self.total(state.p, self.light(state)))

    def _residuals(self, p: LightParameters, total: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        image, rest = self.images(p, total)
        return image - self.real, np.stack([rest - self.rest_real, self.lack(p, total)])

    def weights(self, off: np.ndarray, limit: float) -> np.ndarray:
        """Huber's weights of residuals: 1 up to ``limit``, then falling."""
        return np.minimum(1.0, limit / np.maximum(np.abs(off), 1e-9))

    def cost(self, state: FitState, off: tuple[np.ndarray, np.ndarray]) -> float:
        h = self.settings.huber
        robust = [np.where(np.abs(r) <= h, r * r, h * (2 * np.abs(r) - h)) for r in (off[0], off[1][0])]
        x = (self.flat(state) - self.flat(self.start)) / self.sigma
        c, tied = (state.circles - self.shots.circles) / self.circle_sigma, self.ties.off(self.flat(state))
        images = (robust[0] * self.share**2).sum() + (robust[1] * self.rest_share**2).sum()
        images += ((off[1][1] * self.lack_share) ** 2).sum()
        away = self.flat(state) - self.anchor
        priors = (
            self.settings.prior * (x @ x)
            + self._held() @ away**2
            + self.settings.ties * (tied @ tied)
            + CIRCLE_PRIOR * (c * c).sum()
        )
        return float(images + priors)

    def jacobian(self, state: FitState) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Jacobians of ``residuals`` (3M, G) and (6K, G), of presses by circles (3M, 3); residuals."""
        p, geometries = state.p, self.geometries(state)
        leds = [[led_slopes(g, *led) for led in self._leds(p)] for g in geometries]
        layers = (self._led_layers(p, g, [led.light for led in part]) for g, part in zip(geometries, leds, strict=True))
        whole = self._with_extra(p, Light(*layers))
        total = _summed(p, whole)
        off, rest_off = self._residuals(p, total)
        gains = self._gains(p, total)
        (count, wide), slopes = p.leds.shape, len(state.slopes)
        first = p.leds.size + p.power.size
        mixing, unmixed = p.mixing.T, [_powered(p, part) for part in whole.parts]
        last = first + 17 + len(p.tone)
        jac = np.zeros((last + slopes, off.size), np.float32)
        rest_jac = np.zeros((len(jac), rest_off.size), np.float32)

        lack = rest_off[1]
        mean = np.maximum((total[2] @ np.linalg.inv(p.mixing).T).mean(0), _LEAST)

        def column(k: int, *parts: np.ndarray, mixing: np.ndarray = mixing, of_matrix: bool = False) -> None:
            pressed, flat, still = (part @ mixing for part in parts)
            jac[k] = (gains[0] * pressed - gains[1] * flat).ravel()
            unmixed = np.zeros_like(still) if of_matrix else np.broadcast_to(parts[2], still.shape)
            lacking = (LACK * (lack < 0) * (still - LEAST_SHARE * unmixed) - lack * unmixed.mean(0)) / mean
            rest_jac[k] = np.stack([gains[2] * still, lacking]).ravel()

        none, by_led = (np.zeros((1, 3)),) * 3, {} if self.extra is None else self.extra.by_led
        for led in range(count):
            for k in range(wide):
                of_extra = [part[led] for part in by_led[k].parts] if k in by_led else none
                own = [part[led].by_led[k][:, None] for part in leds]
                column(wide * led + k, *((a + b) * p.power[led] for a, b in zip(own, of_extra, strict=True)))
        for led in range(count):
            for c in range(3):
                column(p.leds.size + 3 * led + c, *(part[led] * np.eye(3)[c] for part in whole.parts))
        for k in range(3):
            power = p.power[p.layer == k].sum(0) * self.even_gain
            column(first + k, *(case_light(g)[:, None] * power for g in geometries))
        for begin, name in ((first + 3, "response"), (first + 15, "tone")):
            values = getattr(p, name)
            for k, step in enumerate(STEP * np.eye(len(values)), begin):
                changed = dataclasses.replace(p, **{name: values + step})
                other, other_rest = self._residuals(changed, total)
                jac[k], rest_jac[k] = ((other - off) / STEP).ravel(), ((other_rest - rest_off) / STEP).ravel()
        for k, (row, other) in enumerate(np.argwhere(OFF_DIAGONAL)):
            column(first + 9 + k, *unmixed, mixing=np.outer(np.eye(3)[other], np.eye(3)[row]), of_matrix=True)
        by_geometry = [self._by_geometry(p, part) for part in leds]

        def change(part: int, new: PixelGeometry) -> np.ndarray:
            (by_point, by_normal), old = by_geometry[part], geometries[part]
            return np.einsum("kmc,km->mc", by_point, new.p - old.p) + np.einsum("kmc,km->mc", by_normal, new.n - old.n)

        def moved(slopes: np.ndarray, circles: np.ndarray, step: float) -> np.ndarray:
            new = self.geometry(FitState(p, slopes, circles))
            return (gains[0] * (change(0, new) @ mixing) / step).ravel()

        for k, step in enumerate(VIEW_STEPS * np.eye(2)):
            new = self.geometries(dataclasses.replace(state, p=dataclasses.replace(p, view=p.view + step)))
            column(last - 2 + k, *(change(part, g) / step[k] for part, g in enumerate(new)))

        for k in range(slopes):
            jac[last + k] = moved(state.slopes + STEP * np.eye(slopes)[k], state.circles, STEP)
        circles = np.zeros((off.size, 3), np.float32)
        if self.settings.circles:
            for k in range(3):
                circles[:, k] = moved(state.slopes, state.circles + 1e-3 * np.eye(3)[k], 1e-3)
        return jac.T, rest_jac.T, circles, (off, rest_off)

    def _by_geometry(self, p: LightParameters, leds: list[LedLight]) -> tuple[np.ndarray, np.ndarray]:
        """Slopes (3, M, 3) of the linear light of M pixels by their point [1/m] and normal."""
        by_point, by_normal = np.zeros((2, 3, len(leds[0].light), 3))
        for led, power, layer in zip(leds, p.power, p.layer, strict=True):
            by_point -= 1e3 * led.by_led[:3, :, None] * power
            by_normal += led.by_normal[:, :, None] * power
            by_normal[2] -= 0.5 * p.glow[layer] * self.even_gain * power
        return by_point, by_normal

    def _gains(self, p: LightParameters, total: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slopes of levels by light pressed, by light at rest (negated), and of the rest image."""
        linear, rest, black = self._linear(p, total)
        slope, still = (level_slope(light, p.response[0], p.curve) for light in (linear, rest))
        lit = slope * (linear - black)
        return lit / total[0], lit / total[1], still * self._vignette(p)

    def step(self, state: FitState) -> Callable[[float], FitState]:
        """The normal equations at ``state``; the result gives the trial state of any damping."""
        settings, count = self.settings, len(self.shots.circles)
        jac, rest_jac, circles, (off, rest_off) = self.jacobian(state)
        w = (self.weights(off, settings.huber) * self.share**2).ravel().astype(np.float32)
        seen = self.weights(rest_off[0], settings.huber) * self.rest_share**2
        rest_w = np.stack([seen, np.full_like(seen, self.lack_share**2)]).ravel().astype(np.float32)
        free = self.free(state.p)
        x, x0, sigma = self.flat(state), self.flat(self.start), self.sigma
        size = len(x)
        n = size + 3 * count
        normal, slope = np.zeros((n, n)), np.zeros(n)
        normal[:size, :size] = (jac.T * w) @ jac + (rest_jac.T * rest_w) @ rest_jac
        held = self._held()
        normal[:size, :size] += np.diag(settings.prior / sigma**2 + held) + settings.ties * self.ties.matrix.T @ self.ties.matrix
        slope[:size] = (jac.T * w) @ off.ravel() + (rest_jac.T * rest_w) @ rest_off.ravel()
        slope[:size] += (
            settings.prior * (x - x0) / sigma**2
            + held * (x - self.anchor)
            + settings.ties * self.ties.matrix.T @ self.ties.off(x)
        )
        own = np.repeat(self.press, 3)
        first = np.searchsorted(own, np.arange(count + 1))
        for k in range(count):
            a, b = slice(first[k], first[k + 1]), slice(size + 3 * k, size + 3 * k + 3)
            weighted = circles[a].T * w[a]
            normal[b, b] = weighted @ circles[a] + np.diag(CIRCLE_PRIOR / self.circle_sigma[k] ** 2)
            normal[b, :size] = weighted @ jac[a]
            normal[:size, b] = normal[b, :size].T
            slope[b] = (
                weighted @ off.ravel()[a] + CIRCLE_PRIOR * (state.circles[k] - self.shots.circles[k]) / self.circle_sigma[k] ** 2
            )
        pushed = self.at(x - 1e-9 * np.sign(slope[:size]), state.circles)
        stuck = np.abs(self.flat(self.inside_bounds(pushed)) - self.flat(pushed)) > 1e-12
        movable = np.concatenate([free & ~stuck, np.full(3 * count, settings.circles)])
        follows = np.eye(n)
        follows[:size, :size] = self._following(x, slope[:size], free & stuck, free & ~stuck)
        normal, slope = follows.T @ normal @ follows, follows.T @ slope

        def trial(damping: float) -> FitState:
            damped = normal + np.diag(damping * np.diag(normal))
            change, move = np.zeros(n), movable.copy()
            # What would leave its bounds is put there, and the others are solved for once more: a cut step alone is no step downhill.
            for _ in range(ACTIVE):
                fixed = damped[np.ix_(move, ~move)] @ change[~move]
                change[move] = np.linalg.solve(damped[np.ix_(move, move)], -slope[move] - fixed)
                moved = (follows @ change)[:size]
                proposed = self.at(x + moved, state.circles + change[size:].reshape(-1, 3))
                allowed = self.inside_bounds(proposed)
                over = move[:size] & (np.abs(self.flat(allowed) - self.flat(proposed)) > 1e-12)
                if not over.any():
                    break
                change[:size][over] = (self.flat(allowed) - x)[over]
                move[:size] &= ~over
            change = follows @ change
            return self.inside_bounds(self.at(x + change[:size], state.circles + change[size:].reshape(-1, 3)))

        return trial

    def _following(self, x: np.ndarray, slope: np.ndarray, stuck: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Motion (n, n) of all parameters by each that is ``free``.

        All move by their own change, and those ``stuck`` at a bound with it: what an LED reaches depends on its size and aim, and with that
        the places where its middle may lie; those of virtual sources depend on the view too. No LED depends on another, so that all move
        at once in one column of ``LightParameters.leds`` after the other.
        """
        motion, circles = np.eye(len(x)), self.start.circles
        if not stuck.any():
            return motion
        beyond = x - 1e3 * STEP * np.sign(slope) * stuck
        after, (count, wide) = len(x) - len(self.start.slopes), self.start.p.leds.shape

        def moved(chosen: np.ndarray) -> np.ndarray:
            """Motion of all parameters by those that are ``chosen``, (n,)."""
            ends = [self.flat(self.inside_bounds(self.at(beyond + sign * STEP * chosen, circles))) for sign in (1, -1)]
            return (ends[0] - ends[1]) / (2 * STEP)

        for column in range(wide):
            chosen = free & (np.arange(len(x)) % wide == column) & (np.arange(len(x)) < count * wide)
            by_column = moved(chosen) if chosen.any() else chosen
            for k in np.flatnonzero(chosen):
                own = slice(k - column, k - column + wide)
                motion[own, k] = np.where(stuck[own], by_column[own], motion[own, k])
        for k in after - 2 + np.flatnonzero(free[after - 2 : after]):
            motion[stuck, k] = moved(np.arange(len(x)) == k)[stuck]
        return motion

    def solve(self, state: FitState, iterations: int, tick: Callable[[FitState, float], None] | None = None) -> FitState:
        """Levenberg and Marquardt's method from ``state``; ``tick(state, cost)`` at accepted steps."""
        damping, state, slow = 1e-2, self.inside_bounds(state), 0
        cost = self.cost(state, self.residuals(state))
        for _ in range(iterations):
            trial = self.step(state)
            while True:
                new = trial(damping)
                after = self.cost(new, self.residuals(new))
                if after < cost or damping > 1e7:
                    break
                damping *= 4
            if not after < cost:
                break
            slow = slow + 1 if cost - after < 1e-4 * cost else 0
            state, cost, damping = new, after, max(damping / 5, 1e-7)
            if tick is not None:
                tick(state, cost)
            if slow == 4:
                break
        return state


_LEAST = 1e-6
"""Least light [full scales] of presses that is divided by."""


def _draw(rho: np.ndarray, settings: FitSettings, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Press, row and column of the pixels that count; ``rho`` (N, H, W): distances over radii."""
    rng, results = np.random.default_rng(seed), []
    for k, one in enumerate(rho):
        for low, high, count in zip((0.0, 1.0), (1.0, settings.reach), settings.samples, strict=True):
            row, column = np.nonzero((one >= low) & (one < high))
            chosen = np.sort(rng.permutation(len(row))[:count])
            results.append(np.stack([np.full(len(chosen), k), row[chosen], column[chosen]]))
    press, row, column = np.concatenate(results, axis=1)
    return press, row, column


def _summed(p: LightParameters, light: Light) -> list[np.ndarray]:
    """All LEDs at their powers, mixed by the colour matrix, (M, 3) of each part of ``light``.

    Of presses it is > 0. At rest it may be negative, and counts as a ``lack`` then.
    """
    pressed, flat, rest = (_powered(p, part) @ p.mixing.T for part in light.parts)
    return [np.maximum(pressed, _LEAST), np.maximum(flat, _LEAST), rest]


def _powered(p: LightParameters, part: np.ndarray) -> np.ndarray:
    """All LEDs at their powers, (M, 3) of a part of light (L, M, 3)."""
    return np.einsum("lmc,lc->mc", part, p.power)
