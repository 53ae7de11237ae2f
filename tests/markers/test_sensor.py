"""Markers in ``TactileSensor`` and at the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.errors import InputError
from raytac.markers import MarkerPerturbation, SurfaceMarkers
from raytac.sensor import TactileSensor
from raytac.specs import PressScene
from raytac.specs.press import ObjectSpec, StageSpec

BALL = ObjectSpec("sphere", {"radius": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
SHEARED = PressScene("sheared", BALL, (StageSpec("indent", depth=6e-4), StageSpec("shear", shear=(4e-4, 0.0))))
NAME = "gelsight_mini_9x11"


def test_a_press_knows_its_shear() -> None:
    """The frame at the peak needs the stages before it."""
    sensor = TactileSensor(NAME, outputs=("height",), markers="fots", device="cpu")
    markers = sensor.press(SHEARED).markers
    assert markers is not None
    middle = np.linalg.norm(markers.rest[0, :, :2], axis=1).argmin()
    assert markers.displacement[0, middle, 0] == pytest.approx(4e-4, rel=0.15)
    again = sensor.press(SHEARED).markers
    assert again is not None
    np.testing.assert_array_equal(again.displacement, markers.displacement)


def test_a_loop_gives_what_a_press_gives() -> None:
    sensor = TactileSensor(NAME, outputs=("height",), markers="fots", device="cpu")
    at_once = sensor.press(SHEARED).markers
    frames = [sensor.update(state) for state in sensor.load(SHEARED).run(steps_per_stage=3)]
    last = frames[-1].markers
    assert at_once is not None and last is not None
    np.testing.assert_allclose(last.displacement, at_once.displacement, atol=2e-6)
    assert not frames[0].markers.displacement.any()
    assert frames[-1].time_ms["markers"] > 0


def test_rest_and_reset_of_the_sensor() -> None:
    sensor = TactileSensor(NAME, outputs=("height",), markers="fots", device="cpu", num_envs=2)
    pad = sensor.load(SHEARED)
    states = list(pad.run())
    sensor.update(states[1])
    rest = sensor.rest().markers
    assert rest is not None and rest.displacement.shape == (1, 99, 2) and not rest.displacement.any()
    kept = sensor.update(states[2]).markers
    sensor.reset_markers([1])
    fresh = sensor.update(states[2]).markers
    assert kept is not None and fresh is not None
    np.testing.assert_array_equal(fresh.displacement[0], kept.displacement[0])
    assert np.abs(fresh.displacement[1] - kept.displacement[1]).max() > 1e-4


def test_dots_in_the_image_are_where_the_markers_are() -> None:
    sensor = TactileSensor(NAME, optics="phong", markers="fots", device="cpu", resolution=(320, 240))
    frame = sensor.press(SHEARED)
    bare = sensor.optical_mode.render(replace(frame.surface, ink=None))
    assert bare.rgb is not None
    darker = (bare.rgb[0].astype(float) - frame.rgb[0]).sum(axis=-1)
    v, u = np.mgrid[0:240, 0:320] + 0.5
    inside = (np.abs(frame.markers.pixel[0] - (160, 120)) < (148, 108)).all(axis=1)
    for pixel in frame.markers.pixel[0][inside][::7]:
        near = np.hypot(u - pixel[0], v - pixel[1]) < 9
        weight = darker * near
        assert weight.sum() > 0
        centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
        assert centre == pytest.approx(tuple(pixel), abs=0.35)
    assert sensor.rest().rgb is not None


def test_without_markers_nothing_is_there() -> None:
    frame = TactileSensor(NAME, outputs=("height",), device="cpu").press(SHEARED)
    assert "markers" not in frame.outputs and frame.surface.ink is None


def test_errors_come_early() -> None:
    with pytest.raises(InputError, match="did you mean 'surface'"):
        TactileSensor(NAME, markers="surfaces")
    with pytest.raises(InputError, match="physics='rigid' has none"):
        TactileSensor(NAME, markers="surface", physics="rigid")
    with pytest.raises(InputError, match="has no markers"):
        TactileSensor("gelsight_mini", markers="fots")
        TactileSensor(NAME, markers=SurfaceMarkers(), physics="rigid")
    with pytest.raises(InputError, match=r"must be a known name or a MarkersConfig.*fots"):
        TactileSensor(NAME, markers=MarkerPerturbation(noise_px=1.0))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="was not asked for"):
        TactileSensor(NAME).reset_markers()


def test_press_writes_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["press", "sphere", "--sensor", NAME, "--markers", "force_field", "--outputs", "height", "--out", str(tmp_path)]
    assert main([*args, "--device", "cpu"]) == 0
    with np.load(tmp_path / "markers.npz") as kept:
        assert kept["displacement"].shape == kept["displacement_px"].shape == (99, 2)
        np.testing.assert_allclose(kept["position"][:, :2] - kept["rest"][:, :2], kept["displacement"])
    assert main(["press", "sphere", "--markers", "fots", "--device", "cpu", "--out", str(tmp_path)]) == 2
    assert "has no markers" in capsys.readouterr().err


def test_calibrate_refuses_what_it_does_not_know(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "markers", "--level", "finest", "--out", str(tmp_path)]) == 2
    assert "did you mean 'fine'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_calibrate_quickly_and_go_on_after_an_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import raytac.report.markers as report
    from raytac.io.metrics import read_metrics
    from raytac.report.markers import FILES
    from raytac.specs import load_marker_motion

    out, begun = tmp_path / "fit", []
    args = ["calibrate", "markers", "--level", "coarse", "--quick", "--device", "cpu", "--out", str(out)]
    simulate = report.simulate_press

    def interrupted(sensor, press, **options):
        begun.append(press.name)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return simulate(sensor, press, **options)

    monkeypatch.setattr(report, "simulate_press", interrupted)
    assert main(args) == 130
    assert "presses that are finished are kept" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["presses"] and len(list((out / "presses").iterdir())) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["fit"]
    assert main(args) == 0
    assert len(begun) == 5 and begun[2] == begun[3]  # those before are not pressed again
    assert {path.name for path in out.iterdir()} == {*FILES, "presses"}
    metrics = read_metrics(out / "metrics.json")
    assert (metrics["presses"], metrics["presses_reused"]) == (4, 2)
    still = metrics["held_out.fots.normal.truth_mean_um"]
    assert isinstance(still, float) and 0 < float(metrics["held_out.fots.normal.mean_um"]) < 0.7 * still
    motion = load_marker_motion(out / "marker_motion.toml")
    for part in ("Presses held out", "level coarse", "warp-lang", "simulated on cpu"):
        assert part in motion.provenance
    assert f"held out: normal {float(metrics['held_out.fots.normal.mean_um']):.1f} um" in motion.provenance


def test_a_gel_of_other_markers_is_its_base_otherwise(tmp_path: Path) -> None:
    from raytac.specs import load_sensor

    path = tmp_path / "mine.toml"
    path.write_text('base = "gelsight_mini"\n[markers]\nrows = 2\ncolumns = 3\npitch_mm = [3, 3]\nradius_mm = 0.5\n')
    sensor = load_sensor(path)
    assert (sensor.name, sensor.markers.rows, sensor.gelpad) == ("mine", 2, load_sensor("gelsight_mini").gelpad)
