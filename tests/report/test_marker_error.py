"""Marker rows of the comparison: on made-up presses whose truth is one of the models, and on the soft pad by the command itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.io.metrics import check_metrics, read_metrics
from raytac.markers.calibration import model_errors
from raytac.markers.registry import models_without_coat
from raytac.report.compare.marker_error import MarkerErrors, marker_error_metrics, marker_errors
from raytac.report.compare.metrics import compare_metrics
from raytac.report.compare.page import report_html
from raytac.report.compare.run import Comparison
from raytac.report.compare.settings import CompareSettings
from tests.markers.pads import flat_sensor, fots_presses, pad_grid

pytest.importorskip("warp")
LOADS = ("normal", "shear", "twist")

MODELS = models_without_coat()


@pytest.fixture(scope="module")
def found() -> MarkerErrors:
    """Presses whose coat is moved by FOTS itself."""
    sensor = flat_sensor()
    return marker_errors(sensor, fots_presses(sensor, pad_grid(sensor)), pad="coarse", device="cpu")


def test_the_model_that_made_the_presses_has_the_least_error(found: MarkerErrors) -> None:
    assert found.loads == LOADS and set(found.times_ms) == {"surface", *MODELS}
    by = {name: errors for name, errors, _ in found.by_model()}
    assert tuple(by) == MODELS
    for k, load in enumerate(LOADS):
        fots, published, superposition, field = (by[name][k] for name in MODELS)
        assert fots.load == superposition.load == field.load == load
        assert published.mean == fots.mean  # the constants of these presses have no punch
        assert fots.mean < 0.2 * min(superposition.mean, field.mean) and found.truth[load] > 5e-6
        assert field.mean_px == pytest.approx(field.mean / np.mean(flat_sensor().camera.pixel_pitch), rel=0.01)


def test_the_rows_are_those_of_the_calibration(found: MarkerErrors) -> None:
    sensor, grid = flat_sensor(), pad_grid(flat_sensor())
    errors, _ = model_errors(sensor, fots_presses(sensor, grid), grid, device="cpu")
    assert tuple(errors) == found.errors


def test_metrics_and_page_hold_every_model_and_load(found: MarkerErrors, tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    settings = CompareSettings(device="cpu", markers=True)
    comparison = Comparison(settings, "cpu", (), {}, (), 0, {"versions.raytac": "0"}, markers=found)
    metrics = compare_metrics(comparison)
    check_metrics(metrics | {"wall_s": 1.0})
    for model in MODELS:
        assert float(metrics[f"markers.coarse.{model}.ms_per_frame"]) > 0
        for load in LOADS:
            mean, truth = (float(metrics[f"markers.coarse.{model}.{load}.{name}_um"]) for name in ("mean", "truth_mean"))
            assert mean > 0 and truth == pytest.approx(1e6 * found.truth[load])
    picture = tmp_path / "pareto.png"
    picture.write_bytes(b"")
    page = report_html(comparison, picture, [])
    assert "Marker models against surface tracking" in page
    for row in found.errors:
        assert f"{1e6 * row.mean:.1f}" in page and f"{row.mean_px:.2f}" in page
    without = replace(comparison, markers=None)
    assert "Marker models" not in report_html(without, picture, [])
    assert not [key for key in compare_metrics(without) if key.startswith("markers.")]


def test_a_load_under_which_nothing_moves_far_has_no_figure_for_what_moved(found: MarkerErrors) -> None:
    still = replace(found, errors=tuple(replace(row, moved=np.nan) for row in found.errors))
    assert not [key for key in marker_error_metrics(still) if key.endswith("moved_um")]


@pytest.mark.slow
def test_the_command_reports_models_on_the_soft_pad(tmp_path: Path) -> None:
    assert main(["compare", "--quick", "--markers", "--device", "cpu", "--out", str(tmp_path)]) == 0
    metrics = read_metrics(tmp_path / "metrics.json")
    for load in LOADS:
        fots, field, truth = (
            float(metrics[f"markers.coarse.{key}_um"])
            for key in (f"fots.{load}.mean", f"force_field.{load}.mean", f"fots.{load}.truth_mean")
        )
        assert 1 < fots < 0.6 * truth and fots < field
    assert "Marker models against surface tracking" in (tmp_path / "report.html").read_text(encoding="utf-8")
