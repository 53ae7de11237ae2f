"""The benchmark of the marker models: a small run from end to end."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from experiments import bench_markers as bench
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.markers import MARKERS
from raytac.specs import load_sensor
from tests.clock import steady_clock


@pytest.mark.parametrize("options", [{"envs": "0"}, {"envs": "1,two"}, {"frames": 0}, {"models": "fots,fotz"}, {"models": ""}])
def test_bad_options_are_refused_before_anything_is_written(tmp_path: Path, options: dict) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_a_small_run_times_every_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    steady_clock(monkeypatch, bench)
    pytest.importorskip("warp")  # the surface model is timed on the coat of a soft pad
    bench.main(bench.Args(out=tmp_path, device="cpu", envs="1,3", frames=6))
    metrics = read_metrics(tmp_path / "metrics.json")
    assert metrics["markers"] == 99
    for key in ("fots", "surface_markers", "superposition", "force_field", "fots_published"):
        for envs, suffix in ((1, ""), (3, ".x3")):
            for which in ("_least", ""):
                assert metrics[f"{key}{suffix}.ms_per_frame{which}"] == pytest.approx(1.0 / envs)
            assert metrics[f"{key}{suffix}.device"] == "cpu"
    printed = capsys.readouterr().out
    for model in MARKERS.names:
        for envs, ms in ((1, "1.000"), (3, "0.333")):
            assert re.search(rf"^{model} +{envs} environments +{ms} ms a frame  \(least {ms}\)  on cpu$", printed, re.MULTILINE)


def test_what_is_timed_is_in_contact_and_moves() -> None:
    """But for the first, every state touches; environments are at places of their own."""
    surfaces = bench.pressed(load_sensor("gelsight_mini_9x11"), 3)
    assert not surfaces[0].contact.any()
    for surface in surfaces[1:]:
        assert surface.contact.any(axis=(1, 2)).all() and surface.batch == 3
        assert np.ptp(surface.contact_centre[:, 0]) > 1e-3
    first, last = surfaces[1].pad_from_object, surfaces[-1].pad_from_object
    assert first is not None and last is not None
    assert np.linalg.norm(last[:, :2, 3] - first[:, :2, 3], axis=1).min() > 2e-4
