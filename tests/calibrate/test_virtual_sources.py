"""Virtual sources: where they may lie, known ones from the coat to the camera's board, rows, and rounds that are damped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate.direct_fit import DirectFit, FitSettings, FitState
from raytac.calibrate.direct_light import ExtraLight, Light
from raytac.calibrate.light_parameters import CEILING, VIRTUAL_CEILING, LightParameters, leds_inside
from raytac.calibrate.ray_fit import fit_lights, solve_direct
from raytac.calibrate.start import leds_at_walls, leds_in_rows
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics import RayTraced
from raytac.specs import LightsSpec, SensorSpec, load_sensor, with_lights
from raytac.specs.sensor_check import validate_sensor, view_edges
from raytac.specs.sensor_file import lights_text, load_lights
from tests.calibrate.test_light_fit import circles, direct

SETTINGS = FitSettings(fixed=("gamma", "tone", "stray", "slope", "distance", "distortion"), samples=(150, 100))


@pytest.fixture(scope="module")
def mini() -> SensorSpec:
    """A Mini with one virtual source a side."""
    sensor = load_sensor("gelsight_mini")
    response = dataclasses.replace(sensor.response.unshaded, gamma=1.4, black_level=(0.0, 0.0, 0.0), vignetting=(0.0, 0.0, 0.0))
    return with_lights(
        dataclasses.replace(sensor, response=response), leds_in_rows(leds_at_walls(sensor, "1,1,1"), None, virtual=True)
    )


def moved_to(sensor: SensorSpec, z: float, virtual: bool = True) -> SensorSpec:
    """All LEDs at the height z [mm], beside the view."""
    leds = (dataclasses.replace(led, position=(*led.position[:2], z / 1e3), virtual=virtual) for led in sensor.lights.leds)
    return dataclasses.replace(sensor, lights=LightsSpec(tuple(leds)))


def test_long_sources_are_cut_to_what_lies_between_wall_and_view(mini: SensorSpec) -> None:
    """However a source is turned and however large it grows, the sensor accepts what its bounds leave of it."""
    camera = dataclasses.replace(mini.camera, pixel_pitch=(6.8e-5, 6.8e-5))
    wide = moved_to(dataclasses.replace(mini, camera=camera), -4.0)
    p = LightParameters.of(wide, np.full((240, 320, 3), 100.0))
    rng = np.random.default_rng(5)
    for _ in range(50):
        leds = p.leds.copy()
        leds[:, 3:5] = rng.uniform([-np.pi, -1.4], [np.pi, 1.4], (3, 2))
        leds[:, 6:8] = rng.uniform([0.1, 0.1], [9.0, 30.0], (3, 2))
        every = np.ones(3, bool)
        own = dataclasses.replace(p, leds=leds)
        moved = dataclasses.replace(own, leds=leds_inside(wide, own, lengths=every, heights=every))
        validate_sensor(dataclasses.replace(wide, lights=moved.lights(wide)))


@pytest.mark.parametrize("z", [-1.5, *(pytest.param(z, marks=pytest.mark.slow) for z in (-3.0, -8.0)), -18.0])
def test_lights_anywhere_between_coat_and_board_are_found_again(mini: SensorSpec, z: float) -> None:
    """From 1.5 mm away: heights to 0.4 mm, images to a quarter of a level; those in the gel without a wall at its back."""
    true_sensor = moved_to(mini, z)
    validate_sensor(true_sensor)
    shots, true = direct(true_sensor, circles(6))
    rng = np.random.default_rng(8)
    offset = rng.normal(size=true.p.leds.shape) * [1.5, 1.5, 0, 0.1, 0.1, 0.3, 0, 0]
    offset[:, 2] = -1.5
    start = FitState(dataclasses.replace(true.p, leds=true.p.leds + offset), true.slopes, true.circles)
    problem = DirectFit(true_sensor, shots, start, dataclasses.replace(SETTINGS, prior=1.0), factor=4)
    start = problem.inside_bounds(start)
    problem, found = solve_direct(problem, start, 80)
    before, after = (np.abs(problem.residuals(state)[0]).mean() for state in (start, found))
    assert after < 0.25 < before, f"image error {before:.2f} to {after:.2f} levels"
    off = np.abs(found.p.leds[:, :3] - true.p.leds[:, :3])
    assert off[:, 2].max() < 0.4 and off.max() < 0.6, off
    validate_sensor(dataclasses.replace(true_sensor, lights=found.p.lights(true_sensor)))


def test_the_wall_of_a_real_led_does_not_hold_a_virtual_one(mini: SensorSpec) -> None:
    """Light from 1.5 mm below the coat: LEDs end at their ceiling and explain it worse."""
    shots, true = direct(moved_to(mini, -1.5), circles(6))
    errors = {}
    for virtual in (False, True):
        begin = moved_to(mini, -6.0, virtual)
        p = dataclasses.replace(true.p, template=begin.lights)
        leds = true.p.leds.copy()
        leds[:, 2] = -6.0
        start = FitState(dataclasses.replace(p, leds=leds), true.slopes, true.circles)
        problem = DirectFit(begin, shots, start, SETTINGS, factor=4)
        found = problem.solve(problem.inside_bounds(start), 60)
        errors[virtual] = float(np.abs(problem.residuals(found)[0]).mean())
        highest = found.p.leds[:, 2].max()
        assert highest <= CEILING if not virtual else CEILING < highest <= VIRTUAL_CEILING
    assert errors[True] < 0.5 * errors[False], errors


def test_bounds_keep_virtual_sources_a_sensor(mini: SensorSpec) -> None:
    """Wherever a step would put them."""
    shots, state = direct(moved_to(mini, -3.0), circles(4))
    problem = DirectFit(mini, shots, state, SETTINGS, factor=4)
    rng = np.random.default_rng(1)
    for _ in range(40):
        leds = state.p.leds + rng.normal(size=state.p.leds.shape) * [12, 12, 8, 2, 1, 0, 0, 0]
        kept = problem.inside_bounds(dataclasses.replace(state, p=dataclasses.replace(state.p, leds=leds)))
        validate_sensor(dataclasses.replace(mini, lights=kept.p.lights(mini)))


def test_a_sensor_takes_virtual_sources_beside_the_view_alone(mini: SensorSpec, tmp_path: Path) -> None:
    inside = moved_to(mini, -2.0)
    validate_sensor(inside)
    under = dataclasses.replace(inside.lights.leds[0], position=(0.0, -9e-3, -2e-3), virtual=False)
    with pytest.raises(SpecError, match="lies inside the gel"):
        validate_sensor(dataclasses.replace(mini, lights=LightsSpec((under,))))
    validate_sensor(dataclasses.replace(mini, lights=LightsSpec((dataclasses.replace(under, virtual=True),))))
    (low, high), _ = view_edges(mini)
    led = inside.lights.leds[0]
    seen = dataclasses.replace(inside, lights=LightsSpec((dataclasses.replace(led, position=(0.5 * (low + high), 0.0, -2e-3)),)))
    with pytest.raises(SpecError, match=r"must lie beside the camera.s view, x = -10\.14"):
        validate_sensor(seen)
    with pytest.raises(SpecError, match="above the gel"):
        validate_sensor(moved_to(mini, 0.5))
    slab = dataclasses.replace(moved_to(mini, -9.0), refraction=dataclasses.replace(mini.refraction, model="slab"))
    with pytest.raises(SpecError, match=r"refraction\.model must be 'none'"):
        validate_sensor(slab)
    file = tmp_path / "lights.toml"
    file.write_text(lights_text(inside.lights, "virtual"), "utf-8")
    assert all(led.virtual for led in load_lights(file).leds)
    assert "virtual" not in lights_text(load_sensor("gelsight_mini").lights, "")
    image = (
        RayTraced().build(inside, resolution=(64, 48), device="cpu").render(GelSurface.at_rest(make_grid(mini.gelpad, 0.3e-3)))
    )
    assert image.rgb is not None and image.rgb.max() > 0


def test_rows_share_the_power_and_heights_are_checked(mini: SensorSpec) -> None:
    rows = leds_in_rows(mini.lights, "-3.5,-9", virtual=True)
    assert len(rows.leds) == 6 and len({led.name for led in rows.leds}) == 6
    validate_sensor(with_lights(mini, rows))
    for k, led in enumerate(mini.lights.leds):
        pair = rows.leds[2 * k : 2 * k + 2]
        assert [one.position[2] for one in pair] == pytest.approx([-3.5e-3, -9e-3])
        np.testing.assert_allclose(np.sum([one.power for one in pair], axis=0), led.power)
    assert not any(led.virtual for led in leds_in_rows(mini.lights, None, virtual=False).leds)
    for bad in ("high", "-40", "-3,,4", ""):
        with pytest.raises(InputError, match="numbers in"):
            leds_in_rows(mini.lights, bad, virtual=True)


def test_a_round_that_is_worse_is_taken_back_and_the_next_is_shorter(mini: SensorSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Extra light that grows with the square of an LED's motion while its slope says otherwise, as shadows' edges do."""
    shots, true = direct(moved_to(mini, -6.0), circles(6))
    places: list[np.ndarray] = []

    def misleading(problem: DirectFit, state: FitState, *_: object, **__: object) -> ExtraLight:
        light = problem.light(state)
        places.append(state.p.leds.copy())
        away = state.p.leds[:, 0] - true.p.leds[:, 0]
        part = Light(*(0 * one + 0.4 * away[:, None, None] ** 2 * one.mean() for one in light.parts))
        slope = Light(*(0 * one - 0.5 * one.mean() * np.linspace(-1, 1, one.shape[1])[None, :, None] for one in light.parts))
        return ExtraLight(part, state.p.leds.copy(), {0: slope})

    monkeypatch.setattr("raytac.calibrate.ray_fit.extra_light", misleading)
    without = RayTraced(shadows=False)  # as the photographs are
    fitted = fit_lights(mini, shots, settings=SETTINGS, start=true, starts=1, rounds=4, device="cpu", tracing=without)
    costs, best = np.array(fitted.costs), int(np.argmin(fitted.costs))
    assert len(costs) == 5 and costs[1] > costs[0], "the first round is led astray"
    np.testing.assert_array_equal(fitted.state.p.leds, places[best])
    steps = [np.abs(places[k][:, :3] - places[0][:, :3]).max() for k in range(1, 5)]
    assert best == 0 or steps[best - 1] < steps[0]
    assert steps[1] < steps[0] and steps[2] < steps[1], f"steps from the best state must shrink: {steps}"


def test_held_problems_have_the_derivatives_of_their_cost(mini: SensorSpec) -> None:
    """One undamped step of a quadratic problem with strong anchors stays at them; without, it leaves."""
    shots, true = direct(moved_to(mini, -6.0), circles(5))
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, leds=true.p.leds + np.array([0.8, 0, 0, 0, 0, 0, 0, 0])))
    problem = DirectFit(mini, shots, start, SETTINGS, factor=4)
    free, held = (one.solve(start, 5) for one in (problem, problem.near(start, 1e9)))
    assert np.abs(free.p.leds - start.p.leds).max() > 0.3
    assert np.abs(held.p.leds - start.p.leds).max() < 1e-2
    off = problem.residuals(start)
    assert problem.near(start, 1e9).cost(start, off) == pytest.approx(problem.cost(start, off))
    assert problem.near(true, 100.0).cost(start, off) - problem.cost(start, off) == pytest.approx(
        100.0 * 3 * (0.8 / 4.0) ** 2, rel=1e-6
    )
