"""The sheet of both physics, small: one scene, both pads, numbers of each."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import physics_sheet
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.sensor import TactileSensor
from tests.conftest import Shader


def test_quick_is_one_scene_under_both_pads(tmp_path, monkeypatch):
    monkeypatch.setattr(TactileSensor, "optical_mode", property(lambda sensor: Shader(sensor.spec, sensor.resolution)))
    drawn, draw = [], physics_sheet.sheet_figure
    monkeypatch.setattr(physics_sheet, "sheet_figure", lambda *args: drawn.append(draw(*args)) or drawn[-1])
    physics_sheet.Args(out=tmp_path, quick=True, scenes="sphere,coin").run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["metrics.json", "sheet.png"]
    assert read_png(tmp_path / "sheet.png").shape[2] == 3
    maps = [axis.images[0] for axis in drawn[0].axes if axis.images and axis.images[0].get_array().ndim == 2]
    assert len(maps) == 3  # two indentations and their difference
    for shown in maps:
        (low, high), values = shown.get_clim(), shown.get_array()
        assert low <= values.min() < values.max() <= high  # no scale cuts anything off
    (low, high), off = maps[2].get_clim(), maps[2].get_array()
    assert high == -low and high - np.abs(off).max() <= physics_sheet.STEP_MM
    read = read_metrics(tmp_path / "metrics.json")
    assert not any(key.startswith("coin") for key in read)
    metrics = {key: float(value) for key, value in read.items() if key.startswith("sphere")}
    for physics in ("rigid", "ipc"):
        assert metrics[f"sphere.{physics}.imprint_mm"] == pytest.approx(0.8, rel=0.02)
    assert metrics["sphere.ipc.bulge_mm"] > 0.005 > metrics["sphere.rigid.bulge_mm"]
    assert metrics["sphere.contact_um"] < 5.0 < metrics["sphere.ring_um"] < 60.0


def test_widening_reaches_as_far_as_asked():
    mask = np.zeros((21, 31), bool)
    mask[10, 15] = True
    wide = physics_sheet.widened(mask, 0.5e-3, (0.1e-3, 0.25e-3))
    assert wide.sum() == 11 * 5 and wide[8:13, 10:21].all()


def test_an_unknown_level_is_named(tmp_path):
    from raytac.errors import InputError

    with pytest.raises(InputError, match=r"pad.*'huge'.*coarse"):
        physics_sheet.Args(out=tmp_path, pad="huge").run()


@pytest.mark.slow
def test_levels_against_a_finer_one(tmp_path):
    physics_sheet.Args(out=tmp_path, quick=True, scenes="sphere", against="medium").run()
    read = read_metrics(tmp_path / "metrics.json")
    found = {key: float(value) for key, value in read.items() if key.startswith("sphere")}
    assert found["sphere.coarse.contact_um"] < 2.0 < found["sphere.coarse.near_um"] < 20.0
    assert found["sphere.coarse.ring_um"] < 20.0
    assert found["sphere.coarse.force_n"] > found["sphere.medium.force_n"] > 1.5


def test_the_coarsest_level_has_none_below_it(tmp_path):
    from raytac.errors import InputError

    with pytest.raises(InputError, match=r"against.*'coarse'.*medium"):
        physics_sheet.Args(out=tmp_path, against="coarse").run()
