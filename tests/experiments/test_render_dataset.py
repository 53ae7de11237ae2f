"""The command that renders data sets: what it is given goes before the sweep's file; it resumes and verifies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments.render_dataset import Args, main
from raytac.dataset import PressDataset
from raytac.errors import InputError, SpecError
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
    asked: dict[str, Any] = {"sweep": str(tmp_path / "small.toml"), "out": tmp_path / "data", "device": "cpu"}
    args = Args(**asked, count=3, shard_size=2, seed=9, outputs="height", batch=2, sheet=3)
    main(args)
    data = PressDataset(tmp_path / "data")
    assert len(data) == 3 and set(data[0]) == {"index", "height", "pad_from_object", "object", "label"}
    assert data.description["plan"]["seed"] == 9
    assert read_png(tmp_path / "data/sheet.png").shape[2] == 3
    metrics = read_metrics(tmp_path / "data/metrics.json")
    assert metrics["presses"] == 3 and metrics["rendered.shards"] == 2 and isinstance(metrics["presses_per_s"], float)
    (tmp_path / "data/shards/000001.npz").unlink()
    with pytest.raises(InputError, match="1 of 2 shards"):
        main(Args(**asked, verify=True))
    assert "shard 1: 000001.npz is missing" in capsys.readouterr().out
    main(args)
    assert read_metrics(tmp_path / "data/metrics.json")["rendered.shards"] == 1
    main(Args(**asked, verify=True))
    assert "2 shards are whole" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"sheet": -3}, "sheet = -3"),
        ({"sheet": 3, "outputs": "wrench"}, "sheet = 3"),
        ({"resolution": "32"}, "resolution = '32'"),
        ({"optics": "x"}, "optics = 'x'"),
    ],
)
def test_bad_options_are_told(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SWEEP)
    with pytest.raises((InputError, SpecError), match=message):
        main(Args(sweep=str(tmp_path / "small.toml"), out=tmp_path / "data", **options))
    assert not (tmp_path / "data").exists()
