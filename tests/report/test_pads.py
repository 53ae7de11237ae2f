"""The same presses on rigid and soft pads: figures, sheet, report, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.errors import InputError
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.report import pads


def test_a_quick_comparison_reports_both_pads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    costs, draw_cost = [], pads.error_cost_figure
    monkeypatch.setattr(pads, "error_cost_figure", lambda *args: costs.append(draw_cost(*args)) or costs[-1])
    drawn, draw = [], pads.sheet_figure
    monkeypatch.setattr(pads, "sheet_figure", lambda *args: drawn.append(draw(*args)) or drawn[-1])
    assert main(["compare-physics", "--quick", "--scenes", "sphere,coin", "--device", "cpu", "--out", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["error_cost.png", "metrics.json", "report.html", "sheet.png"]
    assert read_png(tmp_path / "sheet.png").shape[2] == 3
    maps = [axis.images[0] for axis in drawn[0].axes if axis.images and axis.images[0].get_array().ndim == 2]
    assert len(maps) == 3  # two indentations and their difference
    for shown in maps:
        (low, high), values = shown.get_clim(), shown.get_array()
        assert low <= values.min() < values.max() <= high  # no scale cuts anything off
    (low, high), off = maps[2].get_clim(), maps[2].get_array()
    assert high == -low and high - np.abs(off).max() <= pads.STEP_MM
    read = read_metrics(tmp_path / "metrics.json")
    assert not any(key.startswith("coin") for key in read)
    metrics = {key: float(value) for key, value in read.items() if key.startswith("sphere")}
    for pad in ("rigid", "coarse"):
        assert metrics[f"sphere.{pad}.imprint_mm"] == pytest.approx(0.8, rel=0.02)
        assert 1.0 < metrics[f"sphere.{pad}.force_n"] < 3.0 and metrics[f"sphere.{pad}.press_s"] > 0.0
    assert metrics["sphere.coarse.bulge_mm"] > 0.005 > metrics["sphere.rigid.bulge_mm"]
    assert metrics["sphere.rigid.contact_um"] < 5.0 < metrics["sphere.rigid.beyond_um"] < 60.0
    assert 0.0 < metrics["sphere.rigid.image"] < 20.0 and "sphere.coarse.image" not in metrics
    # Pads and image modes in one plot: the finest pad is the reference, the others have an error beside their time.
    curves = {line.get_label(): line for line in costs[0].axes[0].lines if not str(line.get_label()).startswith("_")}
    assert set(curves) == {"rigid pad", "soft pad, coarse: the reference", "phong, on the finest pad"}
    at = {name: tuple(float(np.atleast_1d(v)[0]) for v in curves[name].get_data()) for name in curves}
    assert at["rigid pad"] == pytest.approx((metrics["sphere.rigid.press_s"], metrics["sphere.rigid.image"]))
    phong = (1e-3 * metrics["sphere.phong.frame_ms"], metrics["sphere.phong.image"])
    assert at["phong, on the finest pad"] == pytest.approx(phong) and phong[0] < 1.0 < phong[1]
    page = (tmp_path / "report.html").read_text("utf-8")
    assert f"<td>{metrics['sphere.coarse.force_n']:.2f}</td>" in page and "data:image/png;base64," in page


@pytest.mark.slow
def test_levels_against_a_finer_one() -> None:
    presses, _ = pads.press_pads(("sphere",), ("medium", "coarse"), resolution=(80, 60), device="cpu")
    assert [press.pad for press in presses] == ["rigid", "coarse", "medium"]
    metrics = pads.pad_metrics(presses)
    assert float(metrics["sphere.coarse.contact_um"]) < 2.0 < float(metrics["sphere.coarse.near_um"]) < 20.0
    assert float(metrics["sphere.coarse.beyond_um"]) < 20.0 and float(metrics["sphere.medium.force_n"]) > 1.5


def test_widening_reaches_as_far_as_asked() -> None:
    mask = np.zeros((21, 31), bool)
    mask[10, 15] = True
    wide = pads.widened(mask, 0.5e-3, (0.1e-3, 0.25e-3))
    assert wide.sum() == 11 * 5 and wide[8:13, 10:21].all()


def test_bad_input(tmp_path: Path) -> None:
    for scenes, levels, text in (
        (("sphere",), ("huge",), "levels = 'huge'.*coarse"),
        ((), ("coarse",), "scenes"),
        (("sphere",), (), "levels"),
        (("sphere", "sphere"), ("coarse",), "names that differ"),
    ):
        with pytest.raises(InputError, match=text):
            pads.press_pads(scenes, levels)
    assert main(["compare-physics", "--levels", "coarse,huge", "--out", str(tmp_path / "out")]) == 2
    assert main(["compare-physics", "--modes", "phong,taxi", "--out", str(tmp_path / "out")]) == 2
    assert main(["compare-physics", "--scenes", "sphre", "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
