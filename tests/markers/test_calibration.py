"""The fit: a search that finds minima, and constants that come back from markers made with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import PadGrid
from raytac.markers.calibration import ProbeData, fit_motion, model_errors, pattern_search, probe_sensor
from raytac.markers.calibration_presses import FIT, HELD_OUT, PressFrame
from raytac.markers.pattern import MarkerPattern
from raytac.markers.registry import models_without_coat
from raytac.markers.tracker import MarkerTracker
from raytac.specs import PunchSpec, SensorSpec, load_sensor, validate_press
from raytac.specs.marker_motion import load_marker_motion, marker_motion_text
from tests.markers.pads import MOTION, fots_presses


def test_pattern_search_finds_the_bottom_of_a_valley() -> None:
    def cost(x: np.ndarray) -> float:
        return abs(x[0] - 0.3) + 3 * (x[1] + 1.2 + 0.5 * x[0]) ** 2

    point, least = pattern_search(cost, np.zeros(2))
    assert point == pytest.approx((0.3, -1.35), abs=0.01) and least < 0.01


def test_presses_fit_the_sensor_and_are_held_out() -> None:
    sensor = load_sensor("gelsight_mini")
    for press in (*FIT, *HELD_OUT):
        validate_press(sensor, press.scene())
    assert not {str(press) for press in FIT} & {str(press) for press in HELD_OUT}
    assert not {(p.kind, *p.params.values()) for p in FIT} & {(p.kind, *p.params.values()) for p in HELD_OUT}


def test_probes_cover_the_view(sensor: SensorSpec) -> None:
    pattern = MarkerPattern.of(probe_sensor(sensor))
    low, high = pattern.pixel[0].min(axis=0), pattern.pixel[0].max(axis=0)
    assert (low < 25).all() and (np.asarray(sensor.camera.resolution) - high < 25).all()


@pytest.fixture(scope="module")
def frames(sensor: SensorSpec, grid: PadGrid) -> list[PressFrame]:
    return fots_presses(sensor, grid)


def test_the_fit_finds_the_constants_again(sensor: SensorSpec, frames: list[PressFrame]) -> None:
    motion = fit_motion(ProbeData.of(sensor, frames), device="cpu")
    for name in ("dilate_gain", "dilate_lambda", "shear_lambda", "shear_max", "twist_lambda", "twist_max"):
        assert getattr(motion, name) == pytest.approx(getattr(MOTION, name), rel=0.1), name


def test_the_fit_finds_the_punch_again(sensor: SensorSpec, grid: PadGrid) -> None:
    """Markers that move around a punch, some of them past its slip; Gaussians do not fit them."""
    punch = PunchSpec(0.6, 6e-3, 700.0, MOTION.dilate_gain, MOTION.dilate_lambda)
    moved = replace(sensor, marker_motion=replace(MOTION, punch=punch))
    frames = fots_presses(moved, grid)
    fitted = replace(sensor, marker_motion=fit_motion(ProbeData.of(sensor, frames), device="cpu"))
    assert fitted.marker_motion is not None and fitted.marker_motion.punch is not None
    for name in vars(punch):
        assert getattr(fitted.marker_motion.punch, name) == pytest.approx(getattr(punch, name), rel=0.1), name
    errors, _ = model_errors(fitted, frames, grid, models=("fots", "fots_published"), device="cpu")
    by = {(e.model, e.load): e.mean for e in errors}
    for load in ("shear", "twist"):
        assert by["fots", load] < 3e-6 and by["fots", load] < 0.3 * by["fots_published", load]


def test_errors_are_small_for_the_model_that_made_the_data_only(
    sensor: SensorSpec, grid: PadGrid, frames: list[PressFrame]
) -> None:
    errors, times = model_errors(sensor, frames, grid, models=("fots", "force_field"), device="cpu")
    by = {(e.model, e.load): e for e in errors}
    for load in ("normal", "shear", "twist"):
        assert by["fots", load].mean < 3e-6
        assert by["fots", load].mean < 0.2 * by["force_field", load].mean
        assert by["fots", load].size == by["force_field", load].size > 5e-6
    assert set(times) == {"surface", "fots", "force_field"}


def test_the_tracker_at_the_probes_gives_what_the_fit_saw(sensor: SensorSpec, grid: PadGrid, frames: list[PressFrame]) -> None:
    data = ProbeData.of(sensor, frames)
    tracker = MarkerTracker(probe_sensor(sensor), "surface", grid)
    seen = [tracker.update(frame.surface).displacement[0] for frame in frames if frame.load != "start"]
    np.testing.assert_allclose(data.truth, np.stack(seen), atol=1e-12)


def test_the_file_of_a_fit_is_read_back(tmp_path) -> None:
    path = tmp_path / "made.toml"
    for made in (MOTION, replace(MOTION, punch=PunchSpec(0.7, 6.25e-3, 1300.0, 3e6, 2e4))):
        path.write_text(marker_motion_text(made))
        again = load_marker_motion(path)
        for name in made.__dataclass_fields__:
            if name == "provenance":
                assert again.provenance.strip() == made.provenance
            elif name == "punch":
                assert again.punch == made.punch
            elif name != "source":
                assert getattr(again, name) == pytest.approx(getattr(made, name), rel=1e-5), name


def test_the_report_tells_every_model_and_every_press(sensor: SensorSpec, frames: list[PressFrame]) -> None:
    from raytac.report.markers import calibrate_markers, error_table

    pytest.importorskip("warp")  # superposition's pad
    fit, held_out = frames[: len(frames) // 3], frames[len(frames) // 3 :]
    report = calibrate_markers(sensor, fit, held_out, level="coarse", device="cpu")
    names = list(dict.fromkeys(str(frame.press) for frame in frames))
    assert len(names) == 3 and list(dict.fromkeys(name for name, _ in report.by_press)) == names
    assert [row.load for _, row in report.by_press] == ["normal", "shear", "normal", "shear", "normal", "twist"]
    # A press alone has the error that it has among others: all held-out twists are of the last press.
    (twist,) = (row for row in report.errors if (row.model, row.load) == ("fots", "twist"))
    assert report.by_press[-1][1].mean == pytest.approx(twist.mean, rel=1e-6)
    text = error_table(report)
    for name in (*models_without_coat(), *names):
        assert f"| {name} |" in text
    assert text.count("| fit |") == 2 and text.count("| held out |") == 4
    assert f"{1e6 * twist.mean:.1f} um" in report.motion.provenance
