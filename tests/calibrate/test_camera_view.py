"""The fitted view: whatever a step proposes or a fit ends with is a sensor that a file can hold, and a view that stays is untouched."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate.camera_view import ViewBounds, tells_view, view_of, with_view
from raytac.calibrate.direct_fit import DirectFit, FitSettings, FitState
from raytac.calibrate.imprint import RIGID_PAD
from raytac.calibrate.light_parameters import LightParameters, with_parameters
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.ray_fit import check_fitted, fit_lights
from raytac.calibrate.start import leds_at_walls, leds_in_rows
from raytac.errors import InputError
from raytac.optics import RayTraced
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor_check import view_edges
from raytac.specs.sensor_file import lights_text, sensor_files
from tests.calibrate.test_light_fit import circles, direct

SENSORS = ("gelsight_mini", "gelsight_mini_calibrated", "gelsight_dome", "gelsight_r15", "digit")
NO_ROOM = (0.0, 0.0, 0.0, 0.0)


def loaded(sensor: SensorSpec, folder: Path) -> SensorSpec:
    """The sensor written as ``raytac calibrate`` writes it, and read again."""
    folder.mkdir(exist_ok=True)
    for name, text in (sensor_files(sensor) | {"lights.toml": lights_text(sensor.lights, "of a test")}).items():
        (folder / name).write_text(text, "utf-8")
    return load_sensor(folder / "sensor.toml")


def problem_of(sensor: SensorSpec, fixed: tuple[str, ...] = ()) -> tuple[DirectFit, FitState]:
    """A fit of ``sensor`` to one grey press, and where it begins."""
    width, height = sensor.camera.resolution
    grey = np.full((height, width, 3), 100.0)
    shots = Photographs(grey, grey[None], np.array([[width / 2, height / 2, 30.0]]), np.full(1, 3e-3))
    state = FitState(LightParameters.of(sensor, grey), RIGID_PAD.copy(), shots.circles.copy())
    return DirectFit(sensor, shots, state, FitSettings(fixed=("mix", "tone", *fixed), samples=(20, 20)), factor=4), state


def test_a_sensor_with_its_own_view_is_itself_though_another_is_equal() -> None:
    first, second = load_sensor("gelsight_mini"), load_sensor("gelsight_mini")
    assert first.camera is not second.camera
    for sensor in (first, second, first):
        assert with_view(sensor, view_of(sensor)) is sensor


@pytest.mark.parametrize("fixed", [(), ("distance",), ("distortion",)])
@pytest.mark.parametrize("name", SENSORS)
def test_every_view_inside_the_bounds_is_a_sensor(name: str, fixed: tuple[str, ...], tmp_path: Path) -> None:
    sensor = load_sensor(name)
    problem, state = problem_of(sensor, fixed)
    rng, start = np.random.default_rng(2), state.p.view
    views = [start * [1, 0] + [0, k] for k in (-0.3, -0.1, -0.02, 0.02, 0.3)]
    views += [np.array([factor * start[0], k]) for factor in (0.1, 0.6, 2.5, 9.0) for k in (-0.2, 0.2)]
    for view in views:
        moved = np.where([block in fixed for block in ("distance", "distortion")], start, view)
        leds = state.p.leds + rng.normal(size=state.p.leds.shape) * [3, 3, 3, 0.3, 0.3, 0.5, 0, 0]
        kept = problem.inside_bounds(dataclasses.replace(state, p=dataclasses.replace(state.p, view=moved, leds=leds))).p
        camera = loaded(with_parameters(sensor, kept, problem.shots.background), tmp_path / "fit").camera
        assert camera.position[2] == pytest.approx(-1e-3 * kept.view[0], rel=1e-5)
        again = problem.inside_bounds(dataclasses.replace(state, p=kept)).p
        np.testing.assert_array_equal(again.view, kept.view, err_msg="what is inside stays")


@pytest.mark.parametrize("name", SENSORS)
def test_bounds_of_an_led_depend_on_no_other(name: str) -> None:
    """Derivatives along bounds move all LEDs at once."""
    problem, state = problem_of(load_sensor(name))
    rng, (count, wide) = np.random.default_rng(3), state.p.leds.shape
    leds = state.p.leds + rng.normal(size=(count, wide)) * [6, 6, 3, 0.3, 0.3, 0.5, 4, 4]

    def inside(leds: np.ndarray) -> np.ndarray:
        return problem.inside_bounds(dataclasses.replace(state, p=dataclasses.replace(state.p, leds=leds))).p.leds

    kept = inside(leds)
    assert (kept != leds).any(), "some are at bounds"
    for k in range(count):
        other = leds.copy()
        other[k] += rng.normal(size=wide) * 0.2
        moved = inside(other)
        assert (moved[k] != kept[k]).any()
        np.testing.assert_array_equal(np.delete(moved, k, 0), np.delete(kept, k, 0))


def test_a_fit_of_a_barrel_lens_ends_in_a_sensor(tmp_path: Path) -> None:
    """Light from where the true view, wider than the given one, would see its source: sources stay beside the fitted view."""
    mini = load_sensor("gelsight_mini")
    response = dataclasses.replace(mini.response.unshaded, gamma=1.4, black_level=(0.0,) * 3, vignetting=(0.0,) * 3)
    lights = leds_in_rows(leds_at_walls(mini, "1,1,1"), None, virtual=True)
    sensor = with_lights(dataclasses.replace(mini, response=response), lights)

    def beside(gap: float) -> SensorSpec:
        """Sources so far [m] from the view at their middle, on the side where they are."""
        (_, right), (_, top) = view_edges(sensor)
        leds = []
        for led in sensor.lights.leds:
            x, y, _ = led.position
            at = (np.sign(x) * (right + gap), 0.0, -4e-3) if abs(x) > right else (0.0, np.sign(y) * (top + gap), -4e-3)
            leds.append(dataclasses.replace(led, position=at))
        return with_lights(sensor, dataclasses.replace(lights, leds=tuple(leds)))

    sensor, truth = beside(2.2e-3), beside(1.1e-3)
    shots, true = direct(truth, circles(8), view=np.array([28.0, -0.06]))
    begin = LightParameters.of(sensor, shots.background)
    start = dataclasses.replace(true, p=dataclasses.replace(true.p, template=sensor.lights, leds=begin.leds, view=begin.view))
    settings = FitSettings(fixed=("gamma", "tone", "mix", "stray", "slope", "distance"), samples=(150, 100))
    problem = DirectFit(sensor, shots, start, settings, factor=4)
    found = problem.solve(start, 40)
    assert found.p.view[1] < -0.03, found.p.view
    loaded(with_parameters(sensor, found.p, shots.background), tmp_path / "fit")


def test_a_start_with_more_distortion_than_a_fit_takes_is_refused_unless_it_is_fixed() -> None:
    mini = load_sensor("gelsight_mini")
    strong = dataclasses.replace(mini, camera=dataclasses.replace(mini.camera, distortion=(0.9, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"camera\.distortion = 0\.9: k1 must be within ±0\.7\d+ .*fix \"distortion\"") as said:
        problem_of(strong)
    assert "0.9" in str(said.value)
    problem, state = problem_of(strong, ("distortion",))
    assert problem.inside_bounds(state).p.view[1] == state.p.view[1] > 0.1


def test_a_camera_stays_behind_the_gel() -> None:
    """One that lies 1 mm behind it cannot come closer by as much as another."""
    mini = load_sensor("gelsight_mini")
    depth = mini.gelpad.thickness + 1e-3
    near = dataclasses.replace(mini, camera=dataclasses.replace(mini.camera, position=(0.0, 0.0, -depth)))
    kept = ViewBounds(near, view_of(near)).inside(np.array([0.1, 0.0]), (), NO_ROOM)
    assert 1e3 * mini.gelpad.thickness < kept[0] < 1e3 * mini.gelpad.thickness + 0.01


@pytest.mark.parametrize("name", SENSORS)
def test_a_camera_whose_view_stays_keeps_its_numbers(name: str) -> None:
    sensor = load_sensor(name)
    grey = np.full((8, 8, 3), 100.0)
    p = LightParameters.of(sensor, grey)
    assert with_parameters(sensor, p, grey).camera == sensor.camera


@pytest.mark.parametrize("at_bound", [True, False])
def test_a_distance_that_ends_at_its_bound_is_not_taken(
    at_bound: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of the solver is given here: at a bound, all else is fitted again with the given view, and the log says why."""
    mini = load_sensor("gelsight_mini")
    at = circles(8)
    blank = Photographs(np.full((240, 320, 3), 90.0), np.full((8, 240, 320, 3), 90.0), at, np.full(8, 3.155e-3))
    distance, fixed = 28.0 * (2.5 if at_bound else 1.2), []

    def solve(problem: DirectFit, state: FitState, *_: object) -> tuple[DirectFit, FitState]:
        fixed.append(problem.settings.fixed)
        view = state.p.view if "distance" in fixed[-1] else np.array([distance, 0.0])
        return problem, problem.inside_bounds(dataclasses.replace(state, p=dataclasses.replace(state.p, view=view)))

    monkeypatch.setattr("raytac.calibrate.ray_fit.solve_direct", solve)
    with caplog.at_level("WARNING", "raytac"):
        options = {"settings": FitSettings(fixed=("tone", "mix")), "rounds": 0, "starts": 1, "tracing": RayTraced(shadows=False)}
        fitted = fit_lights(mini, blank, device="cpu", **options)
    said = "the camera's distance ended at its bound, 70 mm (given: 28 mm)" in caplog.text
    assert said == at_bound
    if at_bound:
        assert fixed == [("tone", "mix"), ("tone", "mix", "distance", "distortion")] and fitted.sensor.camera == mini.camera
    else:
        assert fixed == [("tone", "mix")] and fitted.state.p.view[0] == pytest.approx(distance)


def test_presses_near_the_optical_axis_leave_the_view_as_given(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever they would end at: parallax and distortion grow with the distance from the axis."""
    mini = load_sensor("gelsight_mini")
    at = circles(8)
    assert tells_view(mini, at)
    at[:, :2] = 0.2 * (at[:, :2] - at[:, :2].mean(0)) + mini.camera.principal_point
    assert not tells_view(mini, at)
    grey = np.full((240, 320, 3), 90.0)
    fixed = []

    def solve(problem: DirectFit, state: FitState, *_: object) -> tuple[DirectFit, FitState]:
        fixed.append(problem.settings.fixed)
        return problem, state

    monkeypatch.setattr("raytac.calibrate.ray_fit.solve_direct", solve)
    shots = Photographs(grey, np.repeat(grey[None], 8, axis=0), at, np.full(8, 3.155e-3))
    with caplog.at_level("INFO", "raytac"):
        fit_lights(mini, shots, settings=FitSettings(fixed=("tone",)), rounds=0, starts=1, tracing=RayTraced(shadows=False))
    assert fixed == [("tone", "distance", "distortion")] and "too near to the optical axis" in caplog.text


def test_a_fit_that_ends_in_no_sensor_says_what_to_do() -> None:
    mini = load_sensor("gelsight_mini")
    check_fitted(mini)
    camera = dataclasses.replace(mini.camera, distortion=(-0.9, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"camera\.distortion = .*inverse.*begin with other lights"):
        check_fitted(dataclasses.replace(mini, camera=camera))
