"""Shadows that ball imprints cast, at the few pixels of a fit, in NumPy.

The visible share of an LED is the ray tracer's (``raytac.optics.trace.shadow``): the mean over directions to the points of the longer edge,
weighted by their light, of the part of the shorter edge above the horizon,

    V = Σ_k g_k S_k / Σ_k g_k,  S = clip(1/2 + c / 2 τ, 0, 1),  c = min_s (h(s) − r(s)) / s,

with the coat's height h and the ray's r at the distance s along the ray, and τ the tangent of half the elevation that the LED spans. The
coat is the imprint's own profile. The resting gel is concave and casts no shadow, so that only the path over the imprint is looked at.

A fit has some hundred pixels a press, where the ray tracer renders whole images. So slopes by places and sizes of LEDs are cheap.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from raytac.calibrate.camera_view import with_view
from raytac.calibrate.direct_fit import HOLD, HOLD_FACTOR, DirectFit, FitState
from raytac.calibrate.direct_light import ExtraLight, Light, led_light, light_by_place
from raytac.calibrate.imprint import PixelGeometry, PressedCoat
from raytac.calibrate.light_parameters import HEIGHT, HEIGHTS, LENGTH, REFERENCE_DISTANCE, SHORTEST
from raytac.optics.trace.shadow import EXTENDED, angle

REACH = 2.4
"""Contact radii within which an imprint casts shadows; it is nearly flat beyond."""
STEPS = 32
"""Places along a ray's path over the imprint where clearance is computed."""
NEAREST = 0.03e-3
"""Distance [m] from which a ray may be blocked: closer, the normal tells what is lit."""
DIRECTION = np.deg2rad(20.0)
"""Angle of the longer edge that a direction covers."""
LEAST_TANGENT = 1e-4
"""Least τ, as the ray tracer's."""
CHANGES = {0: 0.4, 1: 0.4, 2: 0.4, HEIGHT: 0.5, LENGTH: 1.0}
"""Steps [mm] of slopes by an LED's place and size; shadows' soft edges are as wide."""
LEAST = {HEIGHT: HEIGHTS[0], LENGTH: SHORTEST}
"""Least size [mm] that a slope is computed at."""
ROUNDS, SOLVED = 16, 3
"""Most times that shadows are computed again, and solver steps with each."""
SOFTER = 4.0
"""Factor by which a round that makes the cost less lowers the stiffness."""
ENOUGH = 1e-3
"""Part of the cost below which a gain ends the fit."""


def visible_share(seen: PixelGeometry, coat: PressedCoat, led: np.ndarray) -> np.ndarray:
    """Visible share (M,) of an LED, a row of ``LightParameters.leds``, at the points ``seen``."""
    span = 2 * np.arctan2(0.5 * max(led[LENGTH], led[HEIGHT]), np.linalg.norm(led[:3]))
    count = max(1, int(np.ceil(span / DIRECTION)))
    lit, whole = np.zeros((2, len(seen.p[0])))
    for place in light_by_place(seen, led, count, REFERENCE_DISTANCE):
        share = _above_horizon(seen.p, coat, place.d, place.halves)
        lit += place.light * share
        whole += place.light
    return np.where(whole > 0, lit / np.where(whole > 0, whole, 1), 1.0)


def _above_horizon(p: np.ndarray, coat: PressedCoat, d: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """S at points ``p`` (3, M) for light at ``p + d`` with half edges ``halves`` (2, 3, M)."""
    reach = np.maximum(np.hypot(d[0], d[1]), 1e-9)
    ux, uy = d[0] / reach, d[1] / reach
    ahead, square = coat.from_axis(p, ux, uy)
    limit = REACH * coat.radius
    chord = np.sqrt(np.maximum(limit**2 - square, 0))
    first, last = np.maximum(ahead - chord, NEAREST), np.minimum(ahead + chord, reach)
    crosses = np.flatnonzero((square < limit**2) & (last > first))
    s = first[crosses, None] + (last - first)[crosses, None] * (np.arange(STEPS) + 0.5) / STEPS
    x, y = (p[k, crosses, None] + s * u[crosses, None] for k, u in enumerate((ux, uy)))
    ray = p[2, crosses, None] + s * (d[2] / reach)[crosses, None]
    clearance = ((coat.height(x, y, crosses) - ray) / s).min(1)
    # Extent across the ray in the vertical plane, at the LED, and the elevation that it spans.
    length = np.sqrt(reach**2 + d[2] ** 2)
    up = np.stack([-d[2] * ux, -d[2] * uy, reach]) / length
    half = np.abs(np.einsum("ekm,km->em", halves, up)).sum(0)
    tangent = np.maximum(half * length / reach**2, LEAST_TANGENT)[crosses]
    share = np.ones(len(reach))
    share[crosses] = np.clip(0.5 + 0.5 * clearance / tangent, 0, 1)
    return share


def shadow_light(problem: DirectFit, state: FitState) -> Light:
    """Direct light that imprints keep from the pixels of presses, negative."""
    sensor, seen, lights = with_view(problem.sensor, state.p.view), problem.geometry(state), []
    coat = PressedCoat.of(sensor, problem.press, state.circles, problem.shots.radius, state.slopes)
    for led, points in zip(state.p.leds, problem.points, strict=True):
        lights.append((visible_share(seen, coat, led) - 1) * led_light(seen, led, points, REFERENCE_DISTANCE))
    pressed = np.repeat(np.array(lights)[..., None], 3, axis=2)
    flat, rest = (np.zeros((len(lights), count, 3)) for count in (len(problem.press), len(problem.rest_u)))
    return Light(pressed, flat, rest)


def shadow_slopes(problem: DirectFit, state: FitState) -> dict[int, Light]:
    """Slopes of ``shadow_light`` by places and sizes of LEDs, by central differences.

    Slopes by lengths where an LED is extended."""
    slopes, extended = {}, any(angle(led) > EXTENDED for led in state.p.lights(problem.sensor).leds)
    for k, step in CHANGES.items():
        if k == LENGTH and not extended:
            continue
        ends = [state.p.leds.copy(), state.p.leds.copy()]
        for leds, offset in zip(ends, (-step, step), strict=True):
            leds[:, k] += offset
            if k in LEAST:
                leds[:, k] = np.maximum(leds[:, k], LEAST[k])  # a size below 0 is that above
        apart = (ends[1][:, k] - ends[0][:, k])[:, None, None]
        states = [dataclasses.replace(state, p=dataclasses.replace(state.p, leds=leds)) for leds in ends]
        below, above = (shadow_light(problem, moved) for moved in states)
        slopes[k] = Light(*((b - a) / apart for a, b in zip(below.parts, above.parts, strict=True)))
    return slopes


def solve_shadowed(problem: DirectFit, state: FitState, tick: Callable[[FitState, float], None] | None = None) -> FitState:
    """Fit of direct light with cast shadows, from ``state``.

    Edges of shadows are linear in an LED's place for short steps alone. So shadows are computed again after every few steps, LEDs are
    stiff to the best state, and the more so after steps that were too long (Levenberg and Marquardt's rule, as between rounds of the ray
    tracer). Light of ``problem`` beyond the direct light is not looked at.
    """
    best, hold = None, HOLD
    for _ in range(ROUNDS + 1):
        own = problem.with_points(state.p.smooth_points)
        own = own.with_extra(ExtraLight(shadow_light(own, state), state.p.leds.copy(), shadow_slopes(own, state)))
        cost = own.cost(state, own.residuals(state))
        if best is None or cost < best[0]:
            slow = best is not None and best[0] - cost < ENOUGH * cost
            best, hold = (cost, own, state), hold / SOFTER
            if tick is not None:
                tick(state, cost)
            if slow:
                break
        else:
            hold *= HOLD_FACTOR
        _, own, state = best
        state = own.near(state, hold).solve(state, SOLVED)
    assert best is not None
    return best[2]
