"""Fits of LED strips: light against closed forms and the ray tracer's, known strips recovered wherever they lie."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from raytac.calibrate.direct_fit import DirectFit, FitSettings, FitState
from raytac.calibrate.direct_light import led_light, led_slopes
from raytac.calibrate.imprint import RIGID_PAD, PixelGeometry
from raytac.calibrate.light_parameters import HEIGHT, LENGTH, LightParameters, with_parameters
from raytac.calibrate.model_fits import images_of, raytrace_mode
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.ray_fit import extra_light, fit_lights, refine_circles, solve_direct
from raytac.calibrate.start import leds_at_walls
from raytac.gel.surface import make_grid
from raytac.optics import RayTraced
from raytac.specs import LightsSpec, SensorSpec, load_sensor, with_lights
from raytac.specs.sensor_check import validate_sensor
from tests.calibrate.test_light_fit import RADIUS, circles, direct, traced
from tests.optics.test_strip import PANEL, STRIP, line_irradiance, rectangle_irradiance

DIRECT = RayTraced(shadows=False, bounce=False)
SETTINGS = FitSettings(fixed=("gamma", "tone", "stray", "slope", "mix", "distance", "distortion"), samples=(150, 100), prior=1.0)


def strips(z: float, length: float = 18.0, height: float = 1.0, virtual: bool = False) -> SensorSpec:
    """A Mini with a Lambertian coat and a strip a side at the height ``z``, sizes in mm."""
    mini = load_sensor("gelsight_mini")
    response = dataclasses.replace(mini.response.unshaded, gamma=1.4, black_level=(0.0, 0.0, 0.0), vignetting=(0.0, 0.0, 0.0))
    plain = dataclasses.replace(mini, response=response, coat=dataclasses.replace(mini.coat, specular=0.0))
    size = (length / 1e3, height / 1e3)
    leds = (
        dataclasses.replace(
            led,
            position=(*(0.95 * c for c in led.position[:2]), z / 1e3),
            size=size,
            virtual=virtual,
            power=tuple(3 * p for p in led.power),
        )
        for led in leds_at_walls(plain, "1,1,1").leds
    )
    return with_lights(plain, LightsSpec(tuple(leds)))


def rows(sensor: SensorSpec) -> LightParameters:
    return LightParameters.of(sensor, np.full((8, 8, 3), 100.0))


def blank(at: np.ndarray) -> Photographs:
    return Photographs(np.full((240, 320, 3), 100.0), np.full((len(at), 240, 320, 3), 100.0), at, np.full(len(at), RADIUS))


@pytest.mark.parametrize(
    ("lamp", "formula"), [(STRIP, line_irradiance), (PANEL, rectangle_irradiance)], ids=["line", "rectangle"]
)
def test_light_of_a_strip_is_its_closed_form(lamp, formula) -> None:
    """Within the error of three points, and no point in its middle would do."""
    x, y = np.meshgrid(np.linspace(-8e-3, 8e-3, 9), np.linspace(-6e-3, 6e-3, 7))
    p = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    flat = PixelGeometry(p, np.tile([[0.0], [0.0], [-1.0]], p.shape[1]))
    plain = with_lights(strips(-6.0), LightsSpec((dataclasses.replace(lamp, layer="red"),)))
    parameters = rows(plain)
    found = led_light(flat, parameters.leds[0], parameters.points[0], 1.0)
    expected = formula(lamp, p.T)
    np.testing.assert_allclose(found, expected, rtol=0.01)
    np.testing.assert_array_equal(led_slopes(flat, parameters.leds[0], parameters.points[0], 1.0).light, found)
    small = dataclasses.replace(lamp, size=(1e-4, 1e-4))
    middle = rows(with_lights(plain, LightsSpec((dataclasses.replace(small, layer="red"),))))
    assert np.abs(led_light(flat, middle.leds[0], middle.points[0], 1.0) / expected - 1).max() > 0.1


@pytest.mark.parametrize("size", [(18.0, 1.0), (18.0, 4.0), (4.0, 6.0), (1.0, 0.5)])
def test_direct_light_is_the_ray_tracers(size: tuple[float, float]) -> None:
    """Without shadows and inter-reflection nothing is left to add: the same sum at the same points."""
    sensor, at = strips(-8.0, *size), circles(3)
    state = FitState(rows(sensor), RIGID_PAD.copy(), at)
    problem = DirectFit(sensor, blank(at), state, FitSettings(samples=(200, 200)))
    plain = problem.light(state)
    extra = extra_light(problem, state, make_grid(sensor.gelpad, 0.06e-3), "cpu", DIRECT)
    assert not extra.by_led
    for one, other in zip(extra.light.parts, plain.parts, strict=True):
        assert np.abs(one).mean() < 0.01 * other.mean()


@pytest.mark.parametrize(
    ("z", "virtual"),
    [
        (-2.2, True),
        pytest.param(-3.5, True, marks=pytest.mark.slow),
        pytest.param(-5.7, False, marks=pytest.mark.slow),
        pytest.param(-9.0, False, marks=pytest.mark.slow),
        (-18.0, False),
    ],
)
def test_strips_anywhere_between_coat_and_board_are_recovered(z: float, virtual: bool) -> None:
    """From 1.5 mm away and 3 mm shorter or longer: heights to 0.4 mm, lengths to 1 mm, images to a quarter of a level."""
    true_sensor = strips(z, virtual=virtual)
    validate_sensor(true_sensor)
    shots, true = direct(true_sensor, circles(6))
    offset = np.random.default_rng(8).normal(size=true.p.leds.shape) * [1.5, 1.5, 0, 0.1, 0.1, 0.3, 0, 3.0]
    offset[:, 2] = -1.5
    start = FitState(dataclasses.replace(true.p, leds=true.p.leds + offset), true.slopes, true.circles)
    problem = DirectFit(true_sensor, shots, start, SETTINGS, factor=4)
    start = problem.inside_bounds(start)
    problem, found = solve_direct(problem, start, 100)
    before, after = (np.abs(problem.residuals(state)[0]).mean() for state in (start, found))
    assert problem.points == true.p.smooth_points
    off = np.abs(found.p.leds - true.p.leds)
    assert after < 0.25 < before, f"image error {before:.2f} to {after:.2f} levels"
    assert off[:, 2].max() < 0.4 and off[:, :2].max() < 0.6 and off[:, LENGTH].max() < 1.0, off
    validate_sensor(dataclasses.replace(true_sensor, lights=found.p.lights(true_sensor)))


@pytest.mark.parametrize(
    ("shadows", "rounds"), [(False, 3), pytest.param(True, 6, marks=pytest.mark.slow)], ids=["plain", "shadows"]
)
def test_the_ray_tracers_strips_are_explained(shadows: bool, rounds: int) -> None:
    """From strips so low that they take one point across where the true ones take two: their sizes, and held-out presses.

    Images of the true lights are off by rounding alone.
    """
    sensor = strips(-7.5, height=3.6)
    validate_sensor(sensor)
    sensor = dataclasses.replace(sensor, optics=dataclasses.replace(sensor.optics, shadows=shadows))
    shots = traced(sensor, circles(8))
    train, test = shots.take(np.arange(6)), shots.take(np.arange(6, 8))
    offset = np.random.default_rng(4).normal(size=rows(sensor).leds.shape) * [1, 1, 0.3, 0.05, 0.05, 0.3, 0, 2.0]
    offset[:, HEIGHT] = -1.5
    p = rows(sensor)
    start = with_parameters(sensor, dataclasses.replace(p, leds=p.leds + offset), shots.background)
    assert {points.across for points in rows(start).points} == {1} and {points.across for points in p.points} == {2}
    fitted = fit_lights(start, train, settings=dataclasses.replace(SETTINGS, prior=30.0), starts=1, rounds=rounds, device="cpu")
    validate_sensor(fitted.sensor)
    at = refine_circles(fitted.sensor, test, fitted.state, device="cpu")

    def error(lit: SensorSpec, at: np.ndarray, slopes: np.ndarray) -> float:
        mode = raytrace_mode(lit, np.rint(shots.background.clip(0, 255)), "cpu", RayTraced())
        return float(np.abs(images_of(mode, lit, test, at, slopes) - test.presses)[test.distance(sensor) < 1].mean())

    floor, own = error(sensor, test.circles, RIGID_PAD), error(fitted.sensor, at, fitted.state.slopes)
    off = fitted.state.p.leds - p.leds
    print(floor, own, off.round(2), fitted.costs)
    assert own < floor + 0.2 and np.abs(off[:, [HEIGHT, LENGTH]]).max() < 0.8


def test_what_lies_at_a_bound_that_moves_follows() -> None:
    """Strips that touch their ceiling and are too high: small damped steps go downhill, although the ceiling moves their middles."""
    shots, true = direct(strips(-5.9, height=1.0), circles(5))
    leds = true.p.leds.copy()
    leds[:, 2], leds[:, HEIGHT] = -5.2, 3.0
    start = FitState(dataclasses.replace(true.p, leds=leds), true.slopes, true.circles)
    problem = DirectFit(strips(-7.5, height=3.0), shots, start, SETTINGS, factor=4)
    state = problem.inside_bounds(start)
    assert (state.p.leds[:, 2] < -6.4).all(), "the ceiling holds their upper edges"
    cost = problem.cost(state, problem.residuals(state))
    trial = problem.step(state)
    for damping in (1e4, 1e6):
        new = trial(damping)
        assert problem.cost(new, problem.residuals(new)) < cost
    small = trial(1e4)
    lower = small.p.leds[:, HEIGHT] < state.p.leds[:, HEIGHT]
    assert lower.any() and (small.p.leds[lower, 2] > state.p.leds[lower, 2]).all(), "a lower strip may lie higher"
