"""Shadows of imprints in NumPy: against the ray tracer, and in fits of lights that cast them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from raytac.calibrate.cast_shadow import shadow_light, shadow_slopes, solve_shadowed
from raytac.calibrate.direct_fit import DirectFit, FitSettings, FitState
from raytac.calibrate.direct_light import ExtraLight
from raytac.calibrate.imprint import RIGID_PAD
from raytac.calibrate.light_parameters import HEIGHT, LENGTH, LightParameters
from raytac.calibrate.photographs import Photographs, encode
from raytac.calibrate.ray_fit import defect, solve_direct
from raytac.calibrate.start import leds_at_walls
from raytac.gel.surface import make_grid
from raytac.optics import RayTraced
from raytac.specs import SensorSpec, load_sensor, with_lights
from tests.calibrate.test_light_fit import RADIUS, circles


def lit(name: str, size: tuple[float, float], z: float) -> SensorSpec:
    """A sensor with an LED of this length and height at three walls, ``z`` high; all in mm."""
    sensor = load_sensor(name)
    response = dataclasses.replace(sensor.response.unshaded, gamma=1.4, black_level=(0.0,) * 3, vignetting=(0.0,) * 3)
    sensor = dataclasses.replace(sensor, response=response, coat=dataclasses.replace(sensor.coat, specular=0.0))
    leds = (
        dataclasses.replace(
            led, position=(0.8 * led.position[0], 0.8 * led.position[1], 1e-3 * z), size=(1e-3 * size[0], 1e-3 * size[1])
        )
        for led in leds_at_walls(sensor, "1,1,1").leds
    )
    return with_lights(sensor, dataclasses.replace(sensor.lights, leds=tuple(leds)))


def problem_of(sensor: SensorSpec, count: int, radius: float, samples: int, factor: int = 2) -> tuple[DirectFit, FitState]:
    """A fit to grey presses whose circles have this radius [px of 320]."""
    width, height = sensor.camera.resolution
    at = circles(count)
    at[:, 2] = radius
    at *= width / 320
    grey = np.full((height, width, 3), 100.0)
    shots = Photographs(grey, np.repeat(grey[None], count, axis=0), at, np.full(count, RADIUS))
    state = FitState(LightParameters.of(sensor, grey), RIGID_PAD.copy(), at)
    return DirectFit(sensor, shots, state, FitSettings(samples=(samples, samples)), factor=factor), state


@pytest.mark.parametrize(
    ("name", "size", "z", "tolerance"),
    [
        ("gelsight_mini", (1.0, 2.0), -6.0, 0.05),
        ("gelsight_mini", (14.0, 3.0), -7.0, 0.2),
        ("gelsight_dome", (2.0, 2.0), -6.0, 0.05),
    ],
)
def test_shadows_are_the_ray_tracers(name: str, size: tuple[float, float], z: float, tolerance: float) -> None:
    """The light that shadows take, LED by LED, at the pixels of three deep presses."""
    sensor = lit(name, size, z)
    problem, state = problem_of(sensor, 3, 40.0, 400)
    grid = make_grid(sensor.gelpad, 0.06e-3)
    off, on = (defect(problem, state, grid, "cpu", RayTraced(bounce=False, shadows=cast)).pressed for cast in (False, True))
    true, own = on - off, shadow_light(problem, state).pressed
    taken = np.abs(true).mean((1, 2))
    assert (taken > 1e-4).all() and (own <= 0).all()
    assert (np.abs(own - true).mean((1, 2)) < tolerance * taken).all(), np.abs(own - true).mean((1, 2)) / taken


def test_a_higher_light_has_a_wider_penumbra() -> None:
    shares = []
    for height in (0.2, 4.0):
        problem, state = problem_of(lit("gelsight_mini", (1.0, height), -6.0), 3, 40.0, 400)
        light = problem.light(state).pressed[..., 0]
        shares.append(1 + shadow_light(problem, state).pressed[..., 0] / np.maximum(light, 1e-9))
    partly = [float(((share > 0.05) & (share < 0.95)).mean()) for share in shares]
    assert partly[1] > 3 * partly[0] > 0, partly


def test_slopes_follow_leds_to_first_order() -> None:
    """By places and sizes: more than half of the shadows' change."""
    problem, state = problem_of(lit("gelsight_mini", (10.0, 2.0), -6.0), 3, 40.0, 400)
    slopes = shadow_slopes(problem, state)
    assert sorted(slopes) == [0, 1, 2, HEIGHT, LENGTH]
    for column, step in ((0, 0.3), (1, -0.3), (2, 0.3), (HEIGHT, 0.4), (LENGTH, 0.8)):
        leds = state.p.leds.copy()
        leds[:, column] += step
        moved = dataclasses.replace(state, p=dataclasses.replace(state.p, leds=leds))
        change = shadow_light(problem, moved).pressed - shadow_light(problem, state).pressed
        missed = np.abs(change - step * slopes[column].pressed).mean()
        assert missed < 0.5 * np.abs(change).mean(), (column, missed / np.abs(change).mean())


def test_lights_that_cast_shadows_are_found_by_them() -> None:
    """Photographs with shadows, from 1.5 mm too deep: heights to 0.3 mm, where direct light alone ends far off."""
    sensor = lit("gelsight_mini", (2.0, 2.0), -6.5)
    every, true = problem_of(sensor, 6, 38.0, 10**6, factor=4)
    every = every.with_extra(ExtraLight(shadow_light(every, true), true.p.leds.copy(), {}))
    pressed, flat, _ = every.total(true.p, every.light(true))
    small, presses = (np.full((*shape, 60, 80, 3), 100.0) for shape in ((), (6,)))
    small[every.row, every.column] = encode(flat, 1.4)
    presses[every.press, every.row, every.column] = encode(pressed, 1.4)
    shots = dataclasses.replace(
        every.shots, background=small.repeat(4, 0).repeat(4, 1), presses=presses.repeat(4, 1).repeat(4, 2)
    )
    leds = true.p.leds + np.array([0.5, -0.5, -1.5, 0.1, -0.1, 0.0, 0.0, 0.0])
    settings = FitSettings(
        fixed=("gamma", "stray", "vignette", "mix", "tone", "distance", "distortion", "glow", "slope"),
        rest_weight=0.0,
        reach=2.0,
        prior=1.0,
    )
    start = FitState(dataclasses.replace(true.p, leds=leds), true.slopes, true.circles)
    problem = DirectFit(sensor, shots, start, settings, factor=4)
    _, alone = solve_direct(problem, start, 10)
    found = solve_shadowed(problem, alone)
    off = [np.abs(one.p.leds[:, 2] - true.p.leds[:, 2]).max() for one in (alone, found)]
    errors = []
    for state in (alone, found):
        own = problem.with_points(state.p.smooth_points)
        own = own.with_extra(ExtraLight(shadow_light(own, state), state.p.leds.copy(), {}))
        errors.append(float(np.abs(own.residuals(state)[0]).mean()))
    assert off[1] < 0.3 < off[0] and errors[1] < 0.5 * errors[0], (off, errors)
