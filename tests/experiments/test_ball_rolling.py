"""The ball reaches its goal by touch, rolls half as far as the pad, and stays under it."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from experiments.ball_rolling import Args, main
from raytac.io.metrics import read_metrics


def test_a_short_stroke_with_the_rigid_pad(tmp_path: Path) -> None:
    main(Args(physics=("rigid",), quick=True, out=tmp_path / "run"))
    found = read_metrics(tmp_path / "run" / "metrics.json")

    def value(key: str) -> float:
        return float(found[f"ball_rolling.rigid.{key}"])

    assert value("goals_reached") == value("goals") == 1
    assert value("goal_error_mm") < 1.0 and value("ball_off_pad_centre_max_mm") < 5.5
    # Between two parallel planes a ball that slips on neither goes exactly half as far; the dent adds a little: R / (2 R − δ) of the way.
    assert value("ball_over_pad_way") == pytest.approx(0.5, abs=0.03)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"metrics.json", "rigid.png", "rigid.gif", "rigid_strip.png"}
    with Image.open(tmp_path / "run" / "rigid_strip.png") as strip, Image.open(tmp_path / "run" / "rigid.gif") as film:
        assert strip.width > 1000 and strip.height > 300 and film.width >= 320, "too small to see anything on"


@pytest.mark.slow
def test_a_short_stroke_with_the_soft_pad(tmp_path: Path) -> None:
    main(Args(physics=("ipc",), quick=True, out=tmp_path / "run"))
    found = read_metrics(tmp_path / "run" / "metrics.json")
    assert found["ball_rolling.ipc.goals_reached"] == 1
    assert float(found["ball_rolling.ipc.goal_error_mm"]) < 1.0
    assert float(found["ball_rolling.ipc.min_gap_m"]) > 0.0 and float(found["ball_rolling.ipc.min_det_f"]) > 0.5
    assert float(found["ball_rolling.ipc.ball_over_pad_way"]) == pytest.approx(0.5, abs=0.03)
