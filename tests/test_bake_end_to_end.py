"""``raytac bake`` from command to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.optics.taxim.folder import CALIBRATION_FILES, load_calibration


def test_quick_bake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "table"
    args = [
        "bake",
        "gelsight_mini",
        "--quick",
        "--resolution",
        "80x60",
        "--scenes",
        "sphere",
        "--device",
        "cpu",
        "--out",
        str(out),
    ]
    assert main(args) == 0
    written = {path.name for path in out.iterdir()}
    assert written == {*CALIBRATION_FILES, "coverage.png", "sheet.png", "metrics.json"}
    assert {Path(line).name for line in capsys.readouterr().out.splitlines()} == written
    table = load_calibration(out)
    assert table.resolution == (80, 60) and table.covered is not None and 0.3 < table.covered.mean() < 1
    (kept,) = (tmp_path / "cache" / "tables").iterdir()
    assert np.array_equal(load_calibration(kept).gradients, table.gradients)
    metrics = read_metrics(out / "metrics.json")
    assert float(metrics["taxim.sphere.psnr_box_db"]) > 28 and metrics["taxim_shadow.sphere.uncovered_share"] == 0
    assert 30 < float(metrics["bake.steepest_covered_deg"]) < 90
    assert read_png(out / "coverage.png").std() > 10 and read_png(out / "sheet.png").std() > 10


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["gelsight_min"], ["'gelsight_min'", "gelsight_mini"]),
        (["gelsight_mini", "--scenes", "shpere"], ["'shpere'", "sphere"]),
        (["gelsight_mini", "--resolution", "80*60"], ["resolution", "WIDTHxHEIGHT"]),
        (["gelsight_mini", "--seed", "-1"], ["seed = -1"]),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(
    args: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "cache"))
    assert main(["bake", *args]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("raytac: error: ") and told.err.count("\n") == 1
    for word in words:
        assert word in told.err
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
