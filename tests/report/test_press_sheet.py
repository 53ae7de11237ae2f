"""The demo's experiment, small: one folder a press, one sheet, one metrics file of numbers from all."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments import press_sheet
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.sensor import TactileSensor
from tests.conftest import Shader


def test_presses_and_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TactileSensor, "optical_mode", property(lambda sensor: Shader(sensor.spec, sensor.resolution)))
    press_sheet.main(press_sheet.Args(out=tmp_path / "demo", scenes=("sphere", "pins")))
    for name in ("sphere", "pins"):
        assert (tmp_path / "demo" / name / "frame.exr").is_file()
    sheet = read_png(tmp_path / "demo" / "sheet.png")
    pictures = [read_png(tmp_path / "demo" / name / "preview.png") for name in ("sphere", "pins")]
    assert sheet.shape[0] >= sum(picture.shape[0] for picture in pictures) and sheet.shape[1] == pictures[0].shape[1]
    metrics = read_metrics(tmp_path / "demo" / "metrics.json")
    assert {"sphere.time.optics_ms", "pins.time.physics_ms", "pins.contact.max_indentation_mm", "wall_s"} <= set(metrics)


def test_quick_is_one_small_press(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TactileSensor, "optical_mode", property(lambda sensor: Shader(sensor.spec, sensor.resolution)))
    press_sheet.main(press_sheet.Args(out=tmp_path, quick=True))
    assert read_png(tmp_path / "coin" / "rgb.png").shape == (60, 80, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["coin", "metrics.json", "sheet.png"]
