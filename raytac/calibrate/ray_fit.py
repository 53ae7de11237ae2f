"""Lights fitted with the ray tracer as forward model, by defect correction.

The ray tracer's image is direct light plus what that leaves out: shadows, inter-reflection, a specular coat. The rest is small, so that a
few rounds suffice of: render with every LED in a layer of its own, take the ray tracer's light minus the direct light, and fit again with
it added (``direct_fit``): held but for its slopes by the places and sizes of LEDs, on which shadows depend. Direct light has the points
that the ray tracer takes on each LED at the round's beginning.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.camera_view import VIEW, tells_view, with_view
from raytac.calibrate.cast_shadow import shadow_slopes, solve_shadowed
from raytac.calibrate.direct_fit import HOLD, HOLD_FACTOR, REST_FACTOR, SIGMA, DirectFit, FitSettings, FitState
from raytac.calibrate.direct_light import ExtraLight, Light
from raytac.calibrate.imprint import RIGID_PAD, press_surface
from raytac.calibrate.light_parameters import LightParameters, with_parameters
from raytac.calibrate.photographs import Photographs, decode, shrunk
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, PadGrid, make_grid
from raytac.optics.base import casts_shadows
from raytac.optics.trace.config import RayTraced
from raytac.specs import SensorSpec
from raytac.specs.sensor_check import validate_sensor

GRID_PITCH = 0.12e-3
"""Spacing of the pad's nodes [m] while fitting."""
FACTOR = 2
"""Presses are fitted, and rendered, as means of so many pixels squared."""
FIRST, LATER = 100, 30
"""Most solver steps with direct light alone, and in each round with the ray tracer's."""
UNSHADED = 15
"""Those with direct light alone where shadows are cast: LEDs go astray without them."""
START_SPREAD = np.array([1.5, 1.5, 1.0, 0.2, 0.2, 0.5, 0.0, 0.0])
"""Standard deviation of the starts: mm, rad, lobe exponent, mm."""
FEWEST = 4
"""Fewest presses that a fit takes."""
ENVS = 16
"""Presses in one call of the ray tracer."""
_LOG = logging.getLogger("raytac")
_AT_BOUND = 1e-4
"""Part of the distance within which it counts as being at a bound."""


@dataclass(frozen=True)
class Fitted:
    """Result of a fit."""

    sensor: SensorSpec
    """The sensor with its new lights and response."""
    state: FitState
    costs: tuple[float, ...]
    """Cost with the ray tracer's light before the first round and after every one.
    The least is taken, and the round after a worse one begins there; without rounds that with direct light alone."""
    start_errors: tuple[float, ...]
    """Mean absolute residual [levels] in the contacts after direct light from every start."""


def brightened(problem: DirectFit, state: FitState) -> FitState:
    """The same with powers that give the image at rest its mean in every channel."""
    rest = problem.total(state.p, problem.light(state))[2].mean(0)
    gain = decode(problem.rest_real, state.p.response[0], state.p.curve).mean(0) / np.maximum(rest, 1e-9)
    return dataclasses.replace(state, p=dataclasses.replace(state.p, power=state.p.power * gain))


def first_state(sensor: SensorSpec, shots: Photographs, settings: FitSettings, seed: int) -> FitState:
    """Start of a fit: the sensor's lights, brightened; the rigid imprint at labelled circles."""
    begin = FitState(LightParameters.of(sensor, shots.background), RIGID_PAD.copy(), shots.circles.copy())
    return brightened(DirectFit(sensor, shots, begin, settings, factor=FACTOR, seed=seed), begin)


def defect(problem: DirectFit, state: FitState, grid: PadGrid, device: str, tracing: RayTraced) -> Light:
    """Light of LEDs at power 1 that the ray tracer adds to direct light, at the fit's pixels."""
    sensor, p = with_view(problem.sensor, state.p.view), state.p
    unit = dataclasses.replace(p, power=np.ones_like(p.power))
    lit = dataclasses.replace(sensor, lights=unit.lights(sensor))
    height, width = problem.shape
    by_led = dataclasses.replace(tracing, layers="led")
    tracer = by_led.build(lit, resolution=(width, height), outputs=("layers",), device=device)
    # A light file gives power by channel, and the coat's albedo with it: at power 1 a layer shows full scales.
    scale = sensor.response.gain * np.array(sensor.response.white_balance)

    def layers(surface: GelSurface) -> np.ndarray:
        return scale * np.stack(list(tracer.render_layers(surface).values())).astype(float)

    count, pressed = len(state.circles), np.empty((len(p.leds), len(problem.press), 3))
    for first in range(0, count, ENVS):
        own = np.arange(first, min(first + ENVS, count))
        surface = press_surface(sensor, grid, state.circles[own], problem.shots.radius[own], state.slopes)
        here = np.isin(problem.press, own)
        pressed[:, here] = layers(surface)[:, problem.press[here] - first, problem.row[here], problem.column[here]]
    still = layers(GelSurface.at_rest(grid))[:, 0]
    by = REST_FACTOR * height // problem.shots.background.shape[0]
    rest = shrunk(still, by).reshape(len(still), -1, 3)
    return Light(pressed, still[:, problem.row, problem.column], rest).plus(problem.light(state), -1.0)


def extra_light(
    problem: DirectFit, state: FitState, grid: PadGrid, device: str, tracing: RayTraced, *, slopes: bool = True
) -> ExtraLight:
    """The defect, and where shadows are cast and ``slopes`` is asked for, those of shadows.

    Inter-reflection changes slowly with the LEDs' places, and has none.
    """
    lights = shadow_slopes(problem, state) if slopes and casts_shadows(problem.sensor, tracing.shadows) else {}
    return ExtraLight(defect(problem, state, grid, device, tracing), state.p.leds.copy(), lights)


def fit_lights(
    sensor: SensorSpec,
    shots: Photographs,
    *,
    settings: FitSettings | None = None,
    start: FitState | None = None,
    rounds: int = 3,
    starts: int = 3,
    device: str = "auto",
    seed: int = 0,
    tracing: RayTraced | None = None,
    tick: Callable[[str, float], None] | None = None,
) -> Fitted:
    """Fit ``sensor``'s LEDs, glow, response, imprint and the circles of ``shots``.

    ``start``: where the fit begins; None is ``first_state``. ``rounds`` of defect correction follow the fit of direct light; 0 leaves it
    at that. Direct light is fitted from ``starts`` places, the given one and others about it, and the best goes on. ``seed`` chooses
    pixels and places. The view is held at the given one where presses lie near the optical axis (``tells_view``), or where its distance
    ends at a bound. ``tick`` is called with the stage and the cost after every step. Raises InputError: refraction, a camera with
    tilt or without colours, LEDs of no colour, a colour matrix, tone curve or distortion outside its bounds that is not fixed,
    fewer values than parameters, or an end that no sensor file may hold; BackendError: the ray tracer cannot run on ``device``.
    """
    settings = FitSettings() if settings is None else settings
    keeping_view = dataclasses.replace(settings, fixed=tuple(dict.fromkeys((*settings.fixed, *VIEW))))
    if settings != keeping_view and not tells_view(sensor, shots.circles):
        _LOG.info("these presses lie too near to the optical axis to tell the camera's view, which stays as given")
        settings = keeping_view
    if sensor.refraction.model != "none":
        raise InputError("refraction.model", value=sensor.refraction.model, rule="cannot be fitted", choices=("none",))
    if sensor.camera.lens.tilts or sensor.camera.monochrome:
        rule = "must have no tilt or monochrome camera: fits know a camera of three colours that looks along +z"
        raise InputError("sensor.camera", value=sensor.name, rule=rule)
    begin = start or first_state(sensor, shots, settings, seed)
    problem = DirectFit(sensor, shots, begin, settings, factor=FACTOR, seed=seed)
    unknown, known = len(problem.flat(begin)) + 3 * len(shots.circles), 3 * len(problem.press)
    if known < 10 * unknown or len(shots.circles) < FEWEST:
        rule = f"are too few for {unknown} parameters ({known} values): take at least {FEWEST}, and 10 values a parameter"
        raise InputError("presses", value=len(shots.circles), rule=rule)

    def report(stage: str) -> Callable[[FitState, float], None]:
        return lambda _, cost: tick(stage, cost) if tick is not None else None

    rng, results, errors = np.random.default_rng(seed), [], []
    shaded = casts_shadows(sensor, (tracing or RayTraced()).shadows)
    for k in range(starts):
        first = begin if k == 0 else brightened(problem, _perturbed(problem, begin, rng))
        own, here = solve_direct(
            problem, first, UNSHADED if shaded else FIRST, report(f"direct light, start {k + 1} of {starts}")
        )
        off = own.residuals(here)
        results.append((own.cost(here, off), here))
        errors.append(float(np.abs(off[0][problem.inside]).mean()))
    _, state = min(results, key=lambda pair: pair[0])

    def with_given_view() -> Fitted:
        _LOG.warning(
            "the camera's distance ended at its bound, %.4g mm (given: %.4g mm): these presses do not tell the view. "
            "It stays as given, and all else is fitted again",
            state.p.view[0],
            begin.p.view[0],
        )
        options = {"start": start, "rounds": rounds, "starts": starts, "device": device, "seed": seed, "tracing": tracing}
        return fit_lights(sensor, shots, settings=keeping_view, tick=tick, **options)

    if _is_at_bound(problem, state):
        return with_given_view()
    problem = problem.with_points(state.p.smooth_points)
    if shaded:
        state = solve_shadowed(problem, state, report("direct light with shadows"))
        problem = problem.with_points(state.p.smooth_points)
    grid, costs, hold = make_grid(sensor.gelpad, GRID_PITCH), [], 0.0
    if not rounds:
        costs.append(problem.cost(state, problem.residuals(state)))
    # A round's cost is known when its result has been rendered: the light that it was solved with is of first order only.
    best = problem, state
    for k in range(rounds + bool(rounds)):
        problem = problem.with_points(state.p.smooth_points)
        problem = problem.with_extra(extra_light(problem, state, grid, device, tracing or RayTraced(), slopes=k < rounds))
        costs.append(problem.cost(state, problem.residuals(state)))
        if costs[-1] <= min(costs):
            best, hold = (problem, state), hold / HOLD_FACTOR
        else:  # too long a step: from the best state again, its LEDs held nearer to where they are
            hold = max(HOLD, HOLD_FACTOR * hold)
        if k < rounds:
            held = best[0].near(best[1], hold)
            state = held.solve(best[1], LATER, report(f"all light, round {k + 1} of {rounds}"))
    _, state = best
    if _is_at_bound(problem, state):
        return with_given_view()
    fitted = with_parameters(sensor, state.p, shots.background)
    check_fitted(fitted)
    return Fitted(fitted, state, tuple(costs), tuple(errors))


def check_fitted(sensor: SensorSpec) -> None:
    """Raise InputError for a fitted sensor that could not be loaded again."""
    try:
        validate_sensor(sensor)
    except SpecError as error:
        rule = f"the fit ended in a sensor that no file may hold ({error}): begin with other lights, take a stronger prior, or fix it"
        raise InputError("sensor", value=sensor.name, rule=rule) from error


def _is_at_bound(problem: DirectFit, state: FitState) -> bool:
    """True if the camera's distance was fitted and lies at its bound."""
    fixed, distance = problem.settings.fixed, float(state.p.view[0])
    if "distance" in fixed:
        return False
    return any(abs(distance - bound) <= _AT_BOUND * bound for bound in problem.views.distances("distortion" in fixed))


def solve_direct(
    problem: DirectFit, state: FitState, steps: int, tick: Callable[[FitState, float], None] | None = None
) -> tuple[DirectFit, FitState]:
    """Fit of direct light from ``state``, and the problem with the points of where it ended.

    Sizes of LEDs stay at first: a long step makes an LED high, and keeps it from where it should lie. Then all parameters are fitted, with
    the points of where LEDs are by then.
    """
    state = problem.with_fixed("length", "height").solve(state, steps, tick)
    own = problem.with_points(state.p.smooth_points)
    if own.points != problem.points or any(seen.any() for seen in own.sees_sizes()):
        state = own.solve(state, steps, tick)
    return own.with_points(state.p.smooth_points), state


def _perturbed(problem: DirectFit, state: FitState, rng: np.random.Generator) -> FitState:
    """The same with every LED elsewhere: 1.5 mm, 0.2 rad, half a lobe's exponent (sigma)."""
    leds = state.p.leds + rng.normal(size=state.p.leds.shape) * START_SPREAD
    return problem.inside_bounds(dataclasses.replace(state, p=dataclasses.replace(state.p, leds=leds)))


def refine_circles(
    sensor: SensorSpec,
    shots: Photographs,
    state: FitState,
    *,
    rounds: int = 1,
    device: str = "auto",
    seed: int = 0,
    tracing: RayTraced | None = None,
) -> np.ndarray:
    """Circles (N, 3) [px] of presses that were not fitted, from labels and fitted lights."""
    all_fixed = FitSettings(fixed=tuple(SIGMA))
    own = FitState(state.p, state.slopes, shots.circles.copy())
    problem = DirectFit(sensor, shots, own, all_fixed, factor=FACTOR, seed=seed)
    own, grid = problem.solve(own, 8), make_grid(sensor.gelpad, GRID_PITCH)
    for _ in range(rounds):
        # The prior is the label, not where direct light put the circle: DirectFit takes it from the photographs.
        problem = problem.with_extra(extra_light(problem, own, grid, device, tracing or RayTraced(), slopes=False))
        own = problem.solve(own, 8)
    return own.circles
