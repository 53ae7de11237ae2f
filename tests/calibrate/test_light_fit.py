"""The fit of lights: derivatives against finite differences, circles found again, starts that a sensor accepts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from raytac.calibrate.light_fit import LightFit
from raytac.calibrate.light_parameters import LightParameters, leds_at_walls
from raytac.calibrate.photographs import Photographs, encode, press_balls
from raytac.errors import InputError
from raytac.gel.pad import make_grid
from raytac.gel.surface import GelSurface
from raytac.optics.raytrace import RayTracer
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor_check import validate_sensor

CIRCLES = np.array([[110.0, 90.0, 31.0], [220.0, 150.0, 29.0]])
BLACK = (0.01, 0.03, 0.02)


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    """The Mini with stray light and another gamma."""
    mini = load_sensor("gelsight_mini")
    return dataclasses.replace(mini, response=dataclasses.replace(mini.response, gamma=1.8, black_level=BLACK))


@pytest.fixture(scope="module")
def pressed(sensor: SensorSpec) -> Callable[[np.ndarray], GelSurface]:
    """The ball at circles (N, 3)."""
    grid = make_grid(sensor.gelpad, 0.3e-3)
    return lambda circles: press_balls(sensor, grid, Photographs(np.empty(0), np.empty(0), circles, 3.155e-3), 1.2)


@pytest.fixture(scope="module")
def shots(sensor: SensorSpec, pressed: Callable[[np.ndarray], GelSurface]) -> Photographs:
    """What the sensor sees, in levels that are not rounded, 80 × 60."""
    tracer = RayTracer(sensor, resolution=(80, 60), outputs=("layers",), device="cpu")
    linear = np.sum(list(tracer.render_layers(pressed(CIRCLES)).values()), axis=0) * tracer.response.scale
    levels = encode(linear + np.array(BLACK), sensor.response.gamma)
    return Photographs(levels[0], levels[1:], CIRCLES, 3.155e-3)


@pytest.fixture(scope="module")
def problem(sensor: SensorSpec, shots: Photographs, pressed: Callable[[np.ndarray], GelSurface]) -> LightFit:
    p = LightParameters.of(sensor, shots.background)
    return LightFit(sensor, shots, pressed, p, 0.7, "cpu")


def test_the_sensor_explains_its_own_images(sensor: SensorSpec, shots: Photographs, problem: LightFit) -> None:
    p = LightParameters.of(sensor, shots.background)
    images = problem.residuals(p, problem.light(p))[: -len(problem.penalty(p))]
    assert len(images) > 10_000 and np.abs(images).max() < 0.05


def test_derivatives_agree_with_finite_differences(sensor: SensorSpec, shots: Photographs, problem: LightFit) -> None:
    rng = np.random.default_rng(0)
    p = LightParameters.of(sensor, shots.background)
    x = p.flat() * 1.02  # away from the optimum, so that no residual is zero
    p = p.at(x)
    light = problem.light(p)
    jac, here = problem.jacobian(p, light).astype(float), problem.residuals(p, light)
    count = len(p.leds)
    blocks = {
        "position [mm]": (np.array([6 * k + c for k in range(count) for c in range(3)]), 0.1),
        "axis [rad]": (np.array([6 * k + c for k in range(count) for c in (3, 4)]), 0.02),
        "lobe": (6 * np.arange(count) + 5, 0.05),
        "power": (6 * count + 3 * np.arange(count), 1e-7),
        "shares of other channels": (np.array([6 * count + 3 * k + c for k in range(count) for c in (1, 2)]), 1e-3),
        "response": (9 * count + np.arange(6), 1e-3),
    }
    assert sum(len(columns) for columns, _ in blocks.values()) == len(x)
    for name, (columns, step) in blocks.items():
        direction = np.zeros_like(x)
        direction[columns] = step * rng.choice([-1.0, 1.0], len(columns))
        ends = []
        for sign in (1, -1):
            moved = p.at(x + 0.5 * sign * direction)
            ends.append(problem.residuals(moved, problem.light(moved)))
        difference, predicted = ends[0] - ends[1], jac @ direction
        images = slice(0, len(here) - len(problem.penalty(p)))  # the penalty has a kink
        size = np.linalg.norm(difference[images])
        assert size > 1e-2, f"{name}: the image must change"
        off = np.linalg.norm(difference[images] - predicted[images]) / size
        assert off < 0.1, f"{name}: the Jacobian misses {off:.1%} of the change"


def test_circles_are_found_again(sensor: SensorSpec, shots: Photographs, problem: LightFit) -> None:
    labels = CIRCLES + np.array([[0.7, -0.5, 0.4], [-0.6, 0.6, -0.5]])
    problem.circles = labels.copy()
    problem.surface = problem.press_balls(labels)
    p = LightParameters.of(sensor, shots.background)
    for _ in range(3):
        problem.refine_circles(p, labels)
    off = np.abs(problem.circles - CIRCLES)
    assert off.max() < 0.25 < np.abs(labels - CIRCLES).max(), f"off by {off} px"


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
