"""The grasping experiments, small: they run, write what they promise, and hold what can be held."""

from __future__ import annotations

import pytest

from experiments import endurance, lift, twist
from raytac.errors import InputError, RaytacError
from raytac.io.metrics import read_metrics


def test_lift_holds_a_cube_with_both_pads(tmp_path):
    args = lift.Args(out=tmp_path / "lift", cases=("cube",), physics=("ipc",), quick=True, device="cpu")
    lift.main(args)
    found = read_metrics(tmp_path / "lift" / "metrics.json")
    assert found["lift.held_s"] == found["lift.cube.ipc.held_s"] == pytest.approx(0.08, abs=0.02)
    assert float(found["lift.slip_mm"]) < 0.1 and float(found["lift.cube.ipc.hold_slip_mm"]) < 0.1
    for key in ("weight_seen", "weight_seen_worst"):
        assert float(found[f"lift.cube.ipc.{key}"]) == pytest.approx(1.0, abs=0.02)
    assert float(found["lift.cube.ipc.lifted_mm"]) == pytest.approx(0.4, abs=0.15)  # the servos lag
    assert float(found["lift.cube.ipc.min_gap_m"]) > 0.0 and float(found["lift.cube.ipc.min_det_f"]) > 0.0
    for name in ("cube.ipc.png", "cube.ipc_strip.png", "cube.ipc.gif"):
        assert (tmp_path / "lift" / name).stat().st_size > 1000


def test_lift_names_what_it_does_not_know():
    with pytest.raises(InputError, match=r"cases = 'cup'.*cube, sphere, soft"):
        lift.kind_of("cup")
    with pytest.raises(InputError, match="number after the colon"):
        lift.kind_of("cube:oil")


def test_twist_keeps_everything_apart_and_upright(tmp_path):
    twist.main(twist.Args(out=tmp_path / "twist", quick=True, device="cpu"))
    found = read_metrics(tmp_path / "twist" / "metrics.json")
    assert float(found["twist.min_gap_m"]) > 0.0 and float(found["twist.min_det_f"]) > 0.0
    assert float(found["twist.longest_mm"]) > 0.2 and float(found["twist.twisted_deg"]) > 2.0
    assert (tmp_path / "twist" / "twist_strip.png").stat().st_size > 1000


@pytest.mark.slow
def test_endurance_goes_on_where_it_stopped(tmp_path):
    small = {
        "close_steps": 8,
        "lift_steps": 8,
        "hold_steps": 4,
        "lower_steps": 8,
        "open_steps": 8,
        "height_mm": 0.5,
        "gap_mm": 0.2,
        "device": "cpu",
    }
    whole = endurance.Args(out=tmp_path / "whole", steps=72, **small)
    endurance.main(whole)
    for steps in (36, 72):
        endurance.main(endurance.Args(out=tmp_path / "parts", steps=steps, **small))
    one, two = (read_metrics(tmp_path / name / "metrics.json") for name in ("whole", "parts"))
    assert one["endurance.steps"] == two["endurance.steps"] == 72 and one["endurance.bond_m"] == 0.0
    assert 0.3 < float(one["endurance.lifted_least_mm"]) < 0.5 and 0.0 < float(one["endurance.bond_share"]) < 1e-3
    for key in ("min_gap_m", "min_det_f", "drift_mm"):
        assert one[f"endurance.{key}"] == pytest.approx(two[f"endurance.{key}"], rel=1e-6, abs=1e-9)
    with pytest.raises(RaytacError, match="other settings"):
        endurance.main(endurance.Args(out=tmp_path / "parts", steps=108, force=2.0, **small))
