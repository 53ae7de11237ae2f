"""``raytac dataset``: what it is given goes before the sweep's file; it resumes and verifies."""

from __future__ import annotations

from pathlib import Path

import pytest

from raytac.cli import main
from raytac.dataset import PressDataset
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics

SWEEP = """
objects = ["sphere"]
count = 100
optics = "phong"
pitch_mm = 0.4
[press]
depth_mm = [0.2, 0.8]
"""


def test_render_resume_and_verify(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    asked = ["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), "--device", "cpu"]
    small = ["--count", "3", "--shard-size", "2", "--seed", "9", "--outputs", "height", "--batch", "2", "--sheet", "3"]
    assert main([*asked, *small]) == 0
    data = PressDataset(tmp_path / "data")
    assert len(data) == 3 and set(data[0]) == {"index", "height", "pad_from_object", "object", "label"}
    assert data.description["plan"]["seed"] == 9
    assert read_png(tmp_path / "data/sheet.png").shape[2] == 3
    metrics = read_metrics(tmp_path / "data/metrics.json")
    assert metrics["presses"] == 3 and metrics["rendered.shards"] == 2 and isinstance(metrics["presses_per_s"], float)
    (tmp_path / "data/shards/000001.npz").unlink()
    capsys.readouterr()
    assert main([*asked, "--verify"]) == 2
    said = capsys.readouterr()
    assert "shard 1: 000001.npz is missing" in said.out and "1 of 2 shards" in said.err
    assert main([*asked, *small]) == 0
    assert "raytac: 1 of 2 shards are there and whole" in capsys.readouterr().err
    assert read_metrics(tmp_path / "data/metrics.json")["rendered.shards"] == 1
    assert main([*asked, "--verify"]) == 0
    assert "2 shards are whole" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--count", "0"], "count = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--sheet", "-3"], "sheet = -3"),
        (["--sheet", "3", "--outputs", "wrench"], "sheet = 3"),
        (["--resolution", "32"], "resolution = '32'"),
        (["--optics", "x"], "optics = 'x'"),
    ],
)
def test_bad_options_are_told(options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    assert main(["dataset", str(tmp_path / "small.toml"), "--out", str(tmp_path / "data"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
