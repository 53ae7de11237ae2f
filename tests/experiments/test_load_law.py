"""The study of the load law, small: its truth, its laws and its figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments import load_law
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics


def test_a_quick_run_tells_laws_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load_law, "QUICK", ("disc_4", "quarters_4", "sphere"))
    load_law.main(load_law.Args(out=tmp_path, quick=True))
    read = {
        key: float(value) for key, value in read_metrics(tmp_path / "metrics.json").items() if isinstance(value, (int, float))
    }
    assert read["disc_4.0.3.layer_n"] == pytest.approx(4.47, rel=0.02)  # a disc of 4 mm by the integral equation: 4.51 N
    for case, rest in (("disc_4.0.3", ()), ("quarters_4.0.3", ()), ("sphere.0.2", ("world",)), ("sphere.0.8", ("world",))):
        assert all(abs(read[f"{case}.{kind}"]) < 0.08 for kind in ("law", *rest)), case
    assert read["quarters_4.0.3.area"] < -0.25
    assert read["law.worst"] < 0.08 < read["area.worst"]
    assert read_png(tmp_path / "figure.png").shape[2] == 3


def test_shapes_are_what_they_are_called() -> None:
    line = (np.arange(240) - 120) * 0.1e-3
    gaps = {name: gap(line[None, :], line[:, None]) for name, (gap, _) in load_law.shapes().items()}
    area = {name: 0.01 * float(np.isfinite(gap).sum()) for name, gap in gaps.items()}
    assert area["pins_25"] == pytest.approx(25.0 * np.pi * 0.25, rel=0.05)
    assert area["holed_plate"] == pytest.approx(100.0 - 16.0 * np.pi * 0.64, rel=0.05)
    assert area["quarters_0"] == pytest.approx(area["quarters_4"], rel=0.03) == area["square_4"]
    assert all(gap.min() < 5e-6 for gap in gaps.values())
