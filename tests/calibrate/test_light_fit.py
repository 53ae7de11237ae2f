"""The fit of lights: derivatives against finite differences, known lights found again, starts, and input that cannot be fitted."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from raytac.calibrate.direct_fit import SIGMA, DirectFit, FitSettings, FitState
from raytac.calibrate.direct_light import ExtraLight, Light
from raytac.calibrate.imprint import RIGID_PAD, press_surface
from raytac.calibrate.light_parameters import HEIGHT, LENGTH, MOST_BENT, LightParameters, side_ties, with_parameters
from raytac.calibrate.photographs import Photographs, encode
from raytac.calibrate.prior_choice import choose_strength
from raytac.calibrate.ray_fit import extra_light, fit_lights, refine_circles
from raytac.calibrate.start import leds_at_walls, leds_split
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics import RayTraced
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.tone import LEAST_SLOPE, ToneCurve

RADIUS = 3.155e-3
MIX = np.array([-0.04, -0.06, -0.02, -0.05, -0.03, -0.04])
"""A colour matrix off its diagonal, for a white balance of 1."""
TONE = np.array([0.2, -0.05, 0.3])
"""A tone curve."""
NOISE = 1.5
"""Noise of a synthetic pixel [levels]."""


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    """A Mini with three LEDs at walls, a Lambertian coat, even glow, stray light and gamma 1.4."""
    mini = load_sensor("gelsight_mini")
    response = dataclasses.replace(mini.response, gamma=1.4, black_level=(0.01, 0.02, 0.02), vignetting=(-0.3, 0.0, 0.0))
    lights = leds_at_walls(mini, "1,1,1")
    lights = dataclasses.replace(lights, leds=tuple(dataclasses.replace(led, glow=60.0) for led in lights.leds))
    coat = dataclasses.replace(mini.coat, specular=0.0)
    return with_lights(dataclasses.replace(mini, response=response, coat=coat), lights)


def circles(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(60, 260, count), rng.uniform(55, 185, count), rng.uniform(26, 34, count)])


def traced(sensor: SensorSpec, at: np.ndarray, noise: float = 0.0) -> Photographs:
    """Photographs by the ray tracer, full size."""
    tracer = RayTraced().build(sensor, outputs=("layers",), device="cpu")
    grid = make_grid(sensor.gelpad, 0.12e-3)

    def levels(surface: GelSurface) -> np.ndarray:
        linear = np.sum(list(tracer.render_layers(surface).values()), axis=0) * tracer.response.scale
        return encode(linear + np.array(sensor.response.black_level), sensor.response.gamma)

    images = levels(press_surface(sensor, grid, at, np.full(len(at), RADIUS), RIGID_PAD))
    images = images + noise * np.random.default_rng(0).normal(size=images.shape)
    return Photographs(levels(GelSurface.at_rest(grid))[0], images, at, np.full(len(at), RADIUS))


def direct(
    sensor: SensorSpec,
    at: np.ndarray,
    mix: np.ndarray | None = None,
    tone: np.ndarray | None = None,
    view: np.ndarray | None = None,
) -> tuple[Photographs, FitState]:
    """Photographs by direct light alone, even over squares of 4 px, and the state that made them: no stray light, no vignette."""
    blank = Photographs(np.full((240, 320, 3), 100.0), np.full((len(at), 240, 320, 3), 100.0), at, np.full(len(at), RADIUS))
    p = LightParameters.of(sensor, blank.background)
    mix = np.zeros(6) if mix is None else mix
    tone = np.zeros(3) if tone is None else tone
    view = p.view if view is None else view
    p = dataclasses.replace(p, response=np.array([1.4, 0.0, 0.0, 0.0, 0.0, 0.0]), mix=mix, tone=tone, view=view)
    state = FitState(p, RIGID_PAD.copy(), at)
    every = DirectFit(sensor, blank, state, FitSettings(reach=99.0, samples=(10**6, 10**6)), factor=4)
    pressed, flat, _ = every.total(state.p, every.light(state))
    small, presses = np.empty((60, 80, 3)), np.empty((len(at), 60, 80, 3))
    small[every.row, every.column] = encode(flat, 1.4, p.curve)
    presses[every.press, every.row, every.column] = encode(pressed, 1.4, p.curve)
    background, images = small.repeat(4, 0).repeat(4, 1), presses.repeat(4, 1).repeat(4, 2)
    return dataclasses.replace(blank, background=background, presses=images), state


@pytest.fixture(scope="module")
def known(sensor: SensorSpec) -> tuple[Photographs, FitState]:
    return direct(sensor, circles(6))


SIZES = {"points": [(2e-3, 1e-3)] * 3, "strips": [(22e-3, 4e-3), (18e-3, 4e-3), (4e-3, 6e-3)]}
"""Lengths and heights [m] of three LEDs; a strip that stands has its longer edge upright."""


def with_sizes(sensor: SensorSpec, sizes: list[tuple[float, float]]) -> SensorSpec:
    """LEDs of these lengths and heights; those that stand look up, so that the camera sees their height."""
    leds = (
        dataclasses.replace(led, size=size, axis=(*(0.6 * c / np.hypot(*led.axis[:2]) for c in led.axis[:2]), -0.8))
        for led, size in zip(sensor.lights.leds, sizes, strict=True)
    )
    return dataclasses.replace(sensor, lights=dataclasses.replace(sensor.lights, leds=tuple(leds)))


LEAST_CHANGE = {"distance": 0.05}
"""Least change of the images [levels] by a unit of a parameter where that is not 0.1: the distance, about 28, is in mm."""


@pytest.mark.parametrize("kind", SIZES)
def test_derivatives_agree_with_finite_differences(sensor: SensorSpec, kind: str) -> None:
    shots, state = direct(with_sizes(sensor, SIZES[kind]), circles(6))
    p = dataclasses.replace(state.p, response=np.array([1.4, 0.3, 0.4, 0.5, -0.3, 0.05]), mix=MIX, tone=TONE)
    state = dataclasses.replace(state, p=p)
    problem = DirectFit(sensor, shots, state, FitSettings(samples=(40, 40)), factor=4)
    plain, rng = problem.light(state), np.random.default_rng(4)

    def some() -> Light:
        """Up to a tenth of the direct light."""
        return Light(*(0.1 * part.mean() * rng.uniform(size=part.shape) for part in plain.parts))

    extra = ExtraLight(some(), p.leds + 0.1, {k: some() for k in ((0, 1, 2, HEIGHT, LENGTH) if kind == "points" else (0, 1, 2))})
    problem = DirectFit(sensor, shots, state, FitSettings(samples=(40, 40)), factor=4, extra=extra)
    expected_points = [(1, 1, False)] * 3 if kind == "points" else [(3, 2, False), (3, 2, False), (2, 2, True)]
    assert [dataclasses.astuple(points) for points in problem.points] == expected_points
    jac, rest_jac, by_circle, _ = problem.jacobian(state)
    x, first = problem.flat(state), 0
    for name, count in problem.blocks(p):
        for k in range(first, first + count):
            ends = [problem.residuals(problem.at(x + s * 1e-4 * np.eye(len(x))[k], state.circles)) for s in (1, -1)]
            image, rest = ((a - b).ravel() / 2e-4 for a, b in zip(*ends, strict=True))
            expected, found = np.concatenate([image, rest]), np.concatenate([jac[:, k], rest_jac[:, k]])
            assert np.linalg.norm(expected) > LEAST_CHANGE.get(name, 0.1), f"{name}: the images must change"
            np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max(), err_msg=name)
        first += count
    assert first == len(x)
    for k in range(3):
        ends = [
            problem.residuals(dataclasses.replace(state, circles=state.circles + s * 1e-3 * np.eye(3)[k]))[0] for s in (1, -1)
        ]
        expected = (ends[0] - ends[1]).ravel() / 2e-3
        assert np.linalg.norm(expected) > 1
        np.testing.assert_allclose(by_circle[:, k], expected, atol=5e-3 * np.abs(expected).max())


def test_known_lights_are_found_again(sensor: SensorSpec, known: tuple[Photographs, FitState]) -> None:
    """From LEDs moved by 2 mm and labels by a third of a pixel: LEDs to 0.3 mm, circles to half that,
    as their labels hold them back, and images to a quarter of a level."""
    shots, true = known
    rng = np.random.default_rng(1)
    moved = dataclasses.replace(true.p, leds=true.p.leds + rng.normal(size=true.p.leds.shape) * [2, 2, 1, 0.1, 0.1, 0.4, 0, 0])
    labels = true.circles + rng.normal(size=(6, 3)) * 0.3
    settings = FitSettings(fixed=("gamma", "stray", "slope"), samples=(150, 100))
    start = FitState(moved, true.slopes, labels)
    problem = DirectFit(sensor, dataclasses.replace(shots, circles=labels), start, settings, factor=4)
    start = problem.inside_bounds(start)
    before = np.abs(problem.residuals(start)[0]).mean()
    found = problem.solve(start, 80)
    after = np.abs(problem.residuals(found)[0]).mean()
    assert after < 0.25 < 1 < before, f"image error {before:.2f} to {after:.2f} levels"
    assert (
        np.abs(found.p.leds[:, :3] - true.p.leds[:, :3]).max() < 0.3 < 1 < np.abs(start.p.leds[:, :3] - true.p.leds[:, :3]).max()
    )
    assert np.abs(found.circles - true.circles).mean() < 0.5 * np.abs(labels - true.circles).mean()


def test_a_known_colour_matrix_is_found_again(sensor: SensorSpec) -> None:
    """From LEDs moved by 1 mm and an unmixed camera: the matrix to 0.01, and images to a quarter of a level."""
    shots, true = direct(sensor, circles(6), MIX)
    moved = true.p.leds + np.random.default_rng(1).normal(size=true.p.leds.shape) * [1, 1, 1, 0.1, 0.1, 0.4, 0, 0]
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, leds=moved, mix=np.zeros(6)))
    settings = FitSettings(fixed=("gamma", "stray", "slope"), samples=(150, 100))
    problem = DirectFit(sensor, shots, start, settings, factor=4)
    found = problem.solve(start, 80)
    assert np.abs(problem.residuals(found)[0]).mean() < 0.25 < 1 < np.abs(problem.residuals(start)[0]).mean()
    np.testing.assert_allclose(found.p.mix, MIX, atol=0.01)
    held = problem.with_fixed("mix").solve(start, 80)
    assert not held.p.mix.any()
    errors = [np.abs(problem.residuals(state)[0]).mean() for state in (found, held)]
    assert errors[1] > 5 * errors[0], "powers of LEDs, which are positive, cannot stand for it"


def test_a_known_camera_is_found_again(sensor: SensorSpec) -> None:
    """From the shipped distance and no distortion: both, and images that no other camera explains as well."""
    shots, true = direct(sensor, circles(12), view=np.array([36.0, -0.03]))
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, view=np.array([28.0, 0.0])))
    problem = DirectFit(sensor, shots, start, FitSettings(fixed=("gamma", "tone", "mix", "stray"), samples=(150, 100)), factor=4)
    found, held = problem.solve(start, 60), problem.with_fixed("distance", "distortion").solve(start, 60)
    assert (np.abs(found.p.view - true.p.view) < [1.5, 0.004]).all(), found.p.view
    np.testing.assert_array_equal(held.p.view, start.p.view)
    errors = [float(np.abs(problem.residuals(state)[0]).mean()) for state in (found, held)]
    assert errors[0] < 0.25 and errors[1] > 1.5 * errors[0], errors
    written = with_parameters(sensor, found.p, shots.background).camera
    assert written.position[2] == pytest.approx(-1e-3 * found.p.view[0]) and written.distortion[0] < 0


def test_derivatives_of_what_light_at_rest_lacks_agree_with_finite_differences(sensor: SensorSpec) -> None:
    """With a matrix that makes light negative; not where one end of a difference lacks something and the other not."""
    shots, true = direct(sensor, circles(4))
    p = dataclasses.replace(true.p, response=np.array([1.4, 0.3, 0.4, 0.5, -0.3, 0.05]), mix=np.full(6, -0.45), tone=TONE)
    state = dataclasses.replace(true, p=p)
    problem = DirectFit(sensor, shots, state, FitSettings(samples=(10, 10)), factor=4)
    lack, x = problem.residuals(state)[1][1], problem.flat(state)
    found = problem.jacobian(state)[1].reshape(2, *lack.shape, len(x))[1]
    assert 0.01 < (lack < 0).mean() < 0.99 and np.abs(found).max() > 1
    for k in range(len(x)):
        ends = [problem.residuals(problem.at(x + s * 1e-5 * np.eye(len(x))[k], state.circles))[1][1] for s in (1, -1)]
        same = (ends[0] < 0) == (ends[1] < 0)
        assert same.mean() > 0.99
        expected = (ends[0] - ends[1])[same] / 2e-5
        np.testing.assert_allclose(found[..., k][same], expected, atol=2e-3 * np.abs(found).max())


def test_a_fit_leaves_no_light_at_rest_negative(sensor: SensorSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Presses in the middle alone say nothing of the light elsewhere, which a matrix makes negative."""
    at = np.array([[150.0, 115.0, 28.0], [170.0, 125.0, 30.0], [160.0, 120.0, 31.0], [165.0, 118.0, 33.0]])
    shots, true = direct(sensor, at)
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, mix=np.full(6, -0.35)))
    settings = FitSettings(fixed=("gamma", "tone", "stray", "slope", "mix"), samples=(100, 50), rest_weight=0.01)
    problem = DirectFit(sensor, shots, start, settings, factor=4)

    def least(state: FitState) -> float:
        return float(problem.total(state.p, problem.light(state))[2].min())

    assert least(start) < 0
    assert least(problem.solve(start, 40)) > 0
    monkeypatch.setattr("raytac.calibrate.direct_fit.LACK", 0.0)
    assert least(problem.solve(start, 40)) < 0, "the image at rest alone must not hold it"


def test_the_ray_tracer_mixes_and_bends_colours_as_the_fit_does(sensor: SensorSpec) -> None:
    """Its images of a sensor with matrix, tone curve and white balance: direct light with these explains them, without one not."""
    leds = tuple(dataclasses.replace(led, glow=0.0) for led in sensor.lights.leds)
    balanced = dataclasses.replace(sensor.response, black_level=(0.0, 0.0, 0.0), white_balance=(1.2, 0.8, 1.0))
    response = dataclasses.replace(balanced, colour_mix=tuple(MIX), tone=tuple(TONE))
    mixed = with_lights(dataclasses.replace(sensor, response=response), dataclasses.replace(sensor.lights, leds=leds))
    at, grid = circles(2), make_grid(sensor.gelpad, 0.12e-3)
    tracer = RayTraced(bounce=False, shadows=False).build(mixed, device="cpu")
    pressed = tracer.render(press_surface(sensor, grid, at, np.full(2, RADIUS), RIGID_PAD)).rgb
    rest = tracer.render(GelSurface.at_rest(grid)).rgb
    assert pressed is not None and rest is not None
    shots = Photographs(rest[0].astype(float), pressed.astype(float), at, np.full(2, RADIUS))
    state, errors = FitState(LightParameters.of(mixed, shots.background), RIGID_PAD.copy(), at), []
    for changed in ({}, {"mix": np.zeros(6)}, {"tone": np.zeros(3)}):
        own = dataclasses.replace(state, p=dataclasses.replace(state.p, **changed))
        problem = DirectFit(mixed, shots, own, FitSettings(samples=(400, 200)), factor=2)
        errors.append(float(np.abs(problem.residuals(own)[0][problem.inside]).mean()))
    assert errors[0] < 0.5 and min(errors[1:]) > 3 * errors[0], errors


def test_a_known_tone_curve_is_found_again(sensor: SensorSpec) -> None:
    """From LEDs moved by 1 mm and a straight curve: the curve to 0.02 of full scale where the images have levels."""
    shots, true = direct(sensor, circles(6), tone=TONE)
    moved = true.p.leds + np.random.default_rng(1).normal(size=true.p.leds.shape) * [1, 1, 1, 0.1, 0.1, 0.4, 0, 0]
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, leds=moved, tone=np.zeros(3)))
    settings = FitSettings(fixed=("gamma", "stray", "slope", "mix"), samples=(150, 100))
    problem = DirectFit(sensor, shots, start, settings, factor=4)
    found, held = problem.solve(start, 80), problem.with_fixed("tone").solve(start, 80)
    assert not held.p.tone.any()
    errors = [float(np.abs(problem.residuals(state)[0]).mean()) for state in (found, held)]
    assert errors[0] < 0.25 and errors[1] > 2 * errors[0], errors
    seen = np.quantile(shots.presses, [0.01, 0.99])
    low, high = true.p.curve.straight(seen / 255)
    u = np.linspace(low, high, 20)
    # A gain of all light is that of all powers: curves are compared at the same middle.
    scale = np.exp(np.log(found.p.curve.straight(true.p.curve.bent(u)) / u).mean())
    np.testing.assert_allclose(found.p.curve.bent(scale * u), true.p.curve.bent(u), atol=0.02)


def test_fitted_tone_curves_rise_and_longer_ones_are_refused(sensor: SensorSpec) -> None:
    """At the corners of the bounds; a start beyond them is refused, and one of four coefficients."""
    for signs in itertools.product((-1, 0, 1), repeat=3):
        curve = ToneCurve(tuple(signs * MOST_BENT))
        assert curve.least_slope >= LEAST_SLOPE - 1e-9, curve
    shots, true = direct(sensor, circles(2))
    beyond = dataclasses.replace(true, p=dataclasses.replace(true.p, tone=np.array([0.5, 0.0, -0.7])))
    with pytest.raises(InputError, match=r"response\.tone = .*0\.5.*±0\.4, ±0\.1, ±0\.4.*fix \"tone\""):
        DirectFit(sensor, shots, beyond, FitSettings(samples=(60, 40)), factor=4)
    problem = DirectFit(sensor, shots, true, FitSettings(samples=(60, 40)), factor=4)
    np.testing.assert_array_equal(problem.inside_bounds(beyond).p.tone, [0.4, 0.0, -0.4])
    long = dataclasses.replace(sensor, response=dataclasses.replace(sensor.response, tone=(0.1, 0.0, 0.0, 0.1)))
    with pytest.raises(InputError, match=r"response\.tone.*at most 3"):
        LightParameters.of(long, shots.background)


@pytest.mark.slow
def test_five_starts_end_at_the_same_error(sensor: SensorSpec, known: tuple[Photographs, FitState]) -> None:
    shots, true = known
    rng, errors = np.random.default_rng(2), []
    for _ in range(5):
        moved = true.p.leds + rng.normal(size=true.p.leds.shape) * [1.5, 1.5, 1.0, 0.2, 0.2, 0.5, 0, 0]
        problem = DirectFit(sensor, shots, true, FitSettings(fixed=("gamma",), samples=(150, 100)), factor=4)
        start = problem.inside_bounds(dataclasses.replace(true, p=dataclasses.replace(true.p, leds=moved)))
        errors.append(float(np.abs(problem.residuals(problem.solve(start, 100))[0]).mean()))
    assert max(errors) < 0.1, errors


@pytest.mark.slow
def test_the_ray_tracers_own_photographs_are_explained(sensor: SensorSpec) -> None:
    """Noisy photographs by the ray tracer, LEDs moved: after the fit its images are off by no more than the noise, other presses too."""
    shots = traced(sensor, circles(10), NOISE)
    train, test = shots.take(np.arange(8)), shots.take(np.arange(8, 10))
    p = LightParameters.of(sensor, shots.background)
    moved = dataclasses.replace(
        p, leds=p.leds + np.random.default_rng(0).normal(size=p.leds.shape) * [1, 1, 0.3, 0.05, 0.05, 0.2, 0, 0]
    )
    start = with_parameters(sensor, moved, shots.background)
    fitted = fit_lights(start, train, settings=FitSettings(fixed=("gamma",)), starts=1, rounds=2, device="cpu")
    validate_sensor(fitted.sensor)
    at = refine_circles(fitted.sensor, test, fitted.state, device="cpu")
    assert np.abs(at - test.circles).max() < 0.5
    grid = make_grid(sensor.gelpad, 0.12e-3)
    tracer = RayTraced(flat_field=np.rint(shots.background.clip(0, 255)).astype(np.uint8)).build(fitted.sensor, device="cpu")
    image = tracer.render(press_surface(sensor, grid, at, test.radius, fitted.state.slopes)).rgb
    assert image is not None
    inside = test.distance(sensor) < 1
    error = np.abs(image - test.presses)[inside].mean()
    floor = NOISE * np.sqrt(2 / np.pi)
    assert error < 1.35 * floor, f"{error:.2f} levels where the noise is {floor:.2f}"


def test_the_round_of_least_cost_is_returned(
    sensor: SensorSpec, known: tuple[Photographs, FitState], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the ray tracer adds is made worse in every later round: the costs say so, and the fit is that of the first."""
    shots, true = known
    made: list[float] = []

    def worse(problem: DirectFit, state: FitState, *_: object, **__: object) -> ExtraLight:
        plain = problem.light(state)
        made.append(0.02 * len(made))
        return ExtraLight(Light(*(made[-1] * part.mean() + 0 * part for part in plain.parts)), state.p.leds, {})

    monkeypatch.setattr("raytac.calibrate.ray_fit.extra_light", worse)
    settings = FitSettings(fixed=("gamma", "stray", "slope"), samples=(100, 60))
    options = {"settings": settings, "start": true, "starts": 1, "device": "cpu", "tracing": RayTraced(shadows=False)}
    fitted = fit_lights(sensor, shots, rounds=2, **options)
    assert len(made) == len(fitted.costs) == 3 and np.argmin(fitted.costs) == 0, fitted.costs
    monkeypatch.undo()
    alone = fit_lights(sensor, shots, rounds=0, **options)
    np.testing.assert_array_equal(fitted.state.p.leds, alone.state.p.leds)


def test_too_few_presses_and_refraction_are_refused(sensor: SensorSpec, known: tuple[Photographs, FitState]) -> None:
    shots, _ = known
    with pytest.raises(InputError, match="at least 4"):
        fit_lights(sensor, shots.take(np.arange(3)), device="cpu")
    slab = dataclasses.replace(sensor, refraction=dataclasses.replace(sensor.refraction, model="slab"))
    with pytest.raises(InputError, match=r"refraction\.model"):
        fit_lights(slab, shots, device="cpu")
    strange = dataclasses.replace(sensor.lights.leds[0], layer="white")
    with pytest.raises(InputError, match="camera channel"):
        LightParameters.of(
            dataclasses.replace(sensor, lights=dataclasses.replace(sensor.lights, leds=(strange,))), shots.background
        )


def test_parameters_and_light_file_are_inverse(sensor: SensorSpec) -> None:
    background = np.full((8, 8, 3), 90.0)
    sensor = dataclasses.replace(sensor, response=dataclasses.replace(sensor.response, white_balance=(1.2, 0.8, 1.0)))
    p = dataclasses.replace(LightParameters.of(sensor, background), mix=MIX)
    again = LightParameters.of(with_parameters(sensor, p, background), background)
    for name in ("leds", "power", "glow", "response", "mix"):
        np.testing.assert_allclose(getattr(again, name), getattr(p, name), rtol=1e-6, atol=1e-9, err_msg=name)
    assert p.glow.min() > 0


def test_ties_hold_at_mirrored_leds_and_nowhere_else(sensor: SensorSpec) -> None:
    """LEDs at walls are alike and mirrored; one that moves, turns, narrows or brightens is told, its mirror image with it is not."""
    walls = with_lights(sensor, leds_at_walls(sensor, "5,3,4"))
    p = LightParameters.of(walls, np.full((8, 8, 3), 90.0))
    x = np.concatenate([p.leds.ravel(), p.power.ravel(), np.zeros(9)])
    ties = side_ties(p, len(x))
    np.testing.assert_allclose(ties.off(x), 0, atol=1e-9)
    last = {"red": 4, "green": 7, "blue": 11}
    for layer, first in (("red", 0), ("green", 5), ("blue", 8)):
        signs = (-1, 1, 1, -1, 1) if layer != "green" else (1, -1, 1, -1, 1)
        for k, sign in enumerate(signs):
            one, both = p.leds.copy(), p.leds.copy()
            one[first, k] += 0.3
            both[first, k] += 0.3
            both[last[layer], k] += 0.3 * sign
            moved = [np.concatenate([leds.ravel(), x[p.leds.size :]]) for leds in (one, both)]
            assert np.abs(ties.off(moved[0])).max() > 0.2
            np.testing.assert_allclose(ties.off(moved[1]), 0, atol=1e-9)
    for k in (8 * 2 + 5, 8 * 2 + 6, 8 * 2 + 7, p.leds.size + 3 * 9):
        assert np.abs(ties.off(x + 0.3 * np.eye(len(x))[k])).max() > 0.2


def test_a_split_led_is_a_row_of_the_same_light(sensor: SensorSpec) -> None:
    lights = leds_split(sensor, 3)
    assert len(lights.leds) == 9 and len({led.name for led in lights.leds}) == 9
    validate_sensor(with_lights(sensor, lights))
    for led, row in zip(sensor.lights.leds, (lights.leds[k : k + 3] for k in (0, 3, 6)), strict=True):
        np.testing.assert_allclose(np.sum([one.power for one in row], axis=0), led.power)
        np.testing.assert_allclose(np.mean([one.position for one in row], axis=0), led.position)
        step = np.subtract(row[1].position, row[0].position)
        np.testing.assert_allclose(np.abs(step @ np.array(led.edges[0])), row[0].size[0], err_msg="the row has no gaps")
        assert np.linalg.norm(step) * 3 == pytest.approx(1.5 * led.size[0])
    assert leds_split(sensor, 1) == sensor.lights
    for count in (0, 1.5, float("nan"), "2"):
        with pytest.raises(InputError, match=r"split = .*whole number >= 1"):
            leds_split(sensor, count)  # type: ignore[arg-type]


def test_extra_light_follows_leds_to_first_order(sensor: SensorSpec) -> None:
    """LEDs 2 mm high move by 0.4 mm either way or lose 0.5 mm of their height: slopes tell more than half of the shadows' change."""
    leds = tuple(dataclasses.replace(led, position=(*led.position[:2], -6e-3), size=(1e-3, 2e-3)) for led in sensor.lights.leds)
    low = with_lights(sensor, dataclasses.replace(sensor.lights, leds=leds))
    at = circles(3)
    at[:, 2] = 40
    blank = Photographs(np.full((240, 320, 3), 100.0), np.full((3, 240, 320, 3), 100.0), at, np.full(3, RADIUS))
    state = FitState(LightParameters.of(low, blank.background), RIGID_PAD.copy(), at)
    problem = DirectFit(low, blank, state, FitSettings(samples=(400, 400)), factor=2)
    grid, tracing = make_grid(low.gelpad, 0.12e-3), RayTraced(bounce=False)
    extra = extra_light(problem, state, grid, "cpu", tracing)
    assert sorted(extra.by_led) == [0, 1, 2, HEIGHT]
    for column, step in (*((k, sign * 0.4) for k in range(3) for sign in (1, -1)), (HEIGHT, -0.5)):
        moved_leds = state.p.leds.copy()
        moved_leds[:, column] += step
        moved = dataclasses.replace(state, p=dataclasses.replace(state.p, leds=moved_leds))
        true = extra_light(problem, moved, grid, "cpu", tracing, slopes=False).light.pressed
        held, followed = (np.abs(true - one.pressed).mean() for one in (extra.light, extra.of(moved_leds)))
        assert held > 5e-5, f"column {column}: shadows must change"
        assert followed < held / 2, f"column {column} by {step}: {followed / held:.2f} of the change is missed"
    none = extra_light(problem, state, grid, "cpu", RayTraced(bounce=False, shadows=False))
    assert not none.by_led, "without shadows the rest changes slowly"


def test_strong_ties_are_kept_and_weak_ones_are_not(sensor: SensorSpec) -> None:
    """Lights whose red LEDs have other powers, lobes and distances from the middle: a fit with strong ties makes them alike."""
    walls = with_lights(sensor, leds_at_walls(sensor, "2,1,1"))
    led = dataclasses.replace(walls.lights.leds[0], position=(-9e-3, -9.5e-3, -6e-3), lobe=4.0, power=(4e-5, 0.0, 0.0))
    uneven = with_lights(sensor, dataclasses.replace(walls.lights, leds=(led, *walls.lights.leds[1:])))
    shots, true = direct(uneven, circles(6))
    off = {}
    for ties in (0.0, 1e8):
        settings = FitSettings(fixed=("gamma", "stray", "slope"), samples=(60, 40), ties=ties)
        problem = DirectFit(uneven, shots, true, settings, factor=4)
        off[ties] = np.abs(problem.ties.off(problem.flat(problem.solve(true, 15)))).max()
    assert off[1e8] < 0.02 < 1 < off[0.0]


def test_a_start_at_the_walls_is_a_sensor(sensor: SensorSpec) -> None:
    lights = leds_at_walls(sensor, "3,1,4")
    assert [led.layer for led in lights.leds] == ["red"] * 3 + ["green"] + ["blue"] * 4
    validate_sensor(with_lights(sensor, lights))
    for led in lights.leds:
        np.testing.assert_allclose(np.linalg.norm(led.axis), 1)
        assert np.dot(led.axis[:2], led.position[:2]) < 0, "aims across the pad"
    for bad in ("3,2", "3,2,0", "a,b,c", "1,2,3,4"):
        with pytest.raises(InputError, match="three whole numbers"):
            leds_at_walls(sensor, bad)


def test_the_prior_that_serves_presses_elsewhere_best_is_chosen(sensor: SensorSpec) -> None:
    """Lights that begin 3 mm from where they are: a prior that nails them there serves worse, and the choice says so."""
    shots, true = direct(sensor, circles(8))
    moved = dataclasses.replace(true.p, leds=true.p.leds + np.array([3.0, 0, 0, 0, 0.3, 0, 0, 0]))
    start = with_parameters(sensor, moved, shots.background)
    settings = FitSettings(fixed=("gamma", "slope", "stray", "mix", "tone", "distance", "distortion"))
    found, errors = choose_strength(start, shots, settings, candidates={"tied-dark": {"prior": 1e7}, "free": {"prior": 30.0}})
    assert found == "free" and errors["free"] < 0.6 * errors["tied-dark"], "a clear difference beats custom"
    usual = {"tied-dark": {"prior": 30.0}, "free": {"prior": 60.0}}
    found, errors = choose_strength(start, shots, settings, candidates=usual, seed=2)
    assert errors["free"] < errors["tied-dark"], "the least error is the other's"
    assert found == "tied-dark", "by next to nothing: the usual one"
    with pytest.raises(InputError, match="at least 8"):
        choose_strength(start, shots.take(np.arange(7)), settings)


def test_a_fitted_colour_matrix_is_one_that_a_sensor_file_takes(sensor: SensorSpec) -> None:
    """Where red's gain is three times the others': numbers in full scales end where those of the file reach −1, and at −0.5 else."""
    balanced = dataclasses.replace(sensor, response=dataclasses.replace(sensor.response, white_balance=(3.0, 1.0, 1.0)))
    shots, true = direct(balanced, circles(2))
    problem = DirectFit(balanced, shots, true, FitSettings(samples=(60, 40)), factor=4)
    for mix, written in ((-0.4, (-0.4 / 3, -0.4 / 3, -1, -0.4, -1, -0.4)), (-0.9, (-0.5 / 3, -0.5 / 3, -1, -0.5, -1, -0.5))):
        beyond = dataclasses.replace(true, p=dataclasses.replace(true.p, mix=np.full(6, mix)))
        fitted = with_parameters(balanced, problem.inside_bounds(beyond).p, shots.background)
        assert fitted.response.colour_mix == pytest.approx(written)
        again = LightParameters.of(fitted, shots.background)
        np.testing.assert_allclose(again.mix, problem.inside_bounds(beyond).p.mix, rtol=1e-12)


def test_fixed_blocks_stay_and_a_start_outside_the_bounds_of_free_ones_is_refused(sensor: SensorSpec) -> None:
    """A camera whose own matrix adds channels: kept where "mix" is fixed, as circles are refined, and no start of a fit of it."""
    added = dataclasses.replace(sensor.response, colour_mix=(0.2, 0.0, 0.1, -0.7, 0.0, 0.3), white_balance=(1.2, 0.8, 1.0))
    own = dataclasses.replace(sensor, response=dataclasses.replace(added, gamma=2.6, vignetting=(0.7, 0.0, 0.0)))
    shots, true = direct(sensor, circles(2))
    state = dataclasses.replace(true, p=LightParameters.of(own, shots.background))
    response = {"gamma": slice(0, 1), "vignette": slice(4, 6)}
    for fixed in (("mix",), ("gamma", "mix"), ("mix", "vignette"), tuple(SIGMA)):
        kept = DirectFit(own, shots, state, FitSettings(fixed=fixed, samples=(60, 40)), factor=4).inside_bounds(state)
        np.testing.assert_array_equal(kept.p.mix, state.p.mix)
        for name in ("gamma", "vignette"):
            stays = np.array_equal(kept.p.response[response[name]], state.p.response[response[name]])
            assert stays == (name in fixed), (name, fixed)
    written = with_parameters(own, kept.p, shots.background).response
    assert written.colour_mix == pytest.approx(own.response.colour_mix) and written.gamma == 2.6
    with pytest.raises(InputError, match=r"response\.colour_mix = .*0\.2.*must be in \[-0\.3333, 0\].*fix \"mix\"") as said:
        DirectFit(own, shots, state, FitSettings(samples=(60, 40)), factor=4)
    assert "-0.7" in str(said.value)
    rounded = dataclasses.replace(true, p=dataclasses.replace(true.p, mix=np.array([-0.50001, 0, 0, 0, 0, 0])))
    problem = DirectFit(sensor, shots, rounded, FitSettings(samples=(60, 40)), factor=4)
    assert problem.inside_bounds(rounded).p.mix[0] == -0.5
