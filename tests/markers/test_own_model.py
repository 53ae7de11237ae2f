"""The example of a user's marker model: one file, whose name works wherever a name does."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from raytac.gel.surface import PadGrid
from raytac.markers import MARKERS, MarkerPerturbation
from raytac.markers.calibration import model_errors
from raytac.observe import ObservationSettings, TactileObserver
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec, load_press
from raytac.view.press_session import PressSession
from tests.markers.pads import fots_presses

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_marker_model.py"
NAME = "gelsight_mini_9x11"


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> type:
    """Configuration of the example, registered for one test."""
    monkeypatch.setattr(MARKERS, "_classes", dict(MARKERS._classes))
    assert "mean_shear" not in MARKERS.names
    return runpy.run_path(str(EXAMPLE))["MeanShear"]


def test_the_example_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(MARKERS, "_classes", dict(MARKERS._classes))
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    fots, by_name, short = (float(line.rsplit(" ", 2)[1]) for line in capsys.readouterr().out.splitlines())
    assert fots > by_name > short > 0.05
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 60


def test_it_presses_observes_and_views_by_name(own: type) -> None:
    options = {"outputs": ("wrench",), "device": "cpu", "pitch": 0.2e-3}
    sensor = TactileSensor(NAME, markers="mean_shear", **options)
    assert sensor.markers == own()
    frame = sensor.press("cylinder")
    same = TactileSensor(NAME, markers=own(), **options).press("cylinder")
    assert frame.markers is not None and same.markers is not None
    np.testing.assert_array_equal(frame.markers.displacement, same.markers.displacement)
    moved = np.linalg.norm(frame.markers.displacement[0], axis=-1)
    assert moved.max() > 1e-4 and frame.markers.visible.all()
    noisy = TactileSensor(NAME, markers=own(MarkerPerturbation(dropout=0.5)), **options).press("cylinder").markers
    assert noisy is not None and not noisy.visible.all()
    observer = TactileObserver(NAME, ObservationSettings(("markers",), markers="mean_shear"))
    assert observer.make_sensor(pitch=0.2e-3).markers == own()
    view = PressSession(sensor, load_press("cylinder"))
    assert view.snapshot().pads[NAME].markers_px is not None


def test_it_is_compared_with_the_others(own: type, sensor: SensorSpec, grid: PadGrid) -> None:
    pytest.importorskip("warp")  # superposition's pad
    errors, times = model_errors(sensor, fots_presses(sensor, grid)[:7], grid, device="cpu")
    by = {(row.model, row.load): row for row in errors}
    assert by["fots", "shear"].mean < by["mean_shear", "shear"].mean < by["mean_shear", "shear"].size
    assert set(times) == set(MARKERS.names)
