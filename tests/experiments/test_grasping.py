"""The grasping experiments, small: they run, write what they promise, and hold what can be held."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import endurance, lift, twist
from raytac.errors import InputError, RaytacError
from raytac.io.metrics import read_metrics

pytestmark = pytest.mark.usefixtures("few_cells")


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


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures and films take longer than what they show; those of the first grasp are looked at."""
    for name in ("plot", "draw_strip", "film"):
        for script in (lift, twist):
            if hasattr(script, name):
                monkeypatch.setattr(script, name, lambda *args: None)


def test_a_grasp_without_friction_enough_slips(tmp_path, undrawn):
    """2 μ N = 0.4 N at most against a weight of 0.49 N: the fingers go up and the cube stays."""
    lift.main(lift.Args(out=tmp_path / "lift", cases=("cube:0.05",), physics=("ipc",), quick=True, device="cpu"))
    found = read_metrics(tmp_path / "lift" / "metrics.json")
    value = {key.removeprefix("lift.cube_mu0p05.ipc."): found[key] for key in found}
    assert abs(float(value["lifted_mm"])) < 0.05 < 0.25 < float(value["slip_mm"])
    assert 0.2 < float(value["weight_seen"]) < 0.99 and float(value["min_gap_m"]) > 0.0  # the table bears the rest
    assert "lift.held_s" not in found  # of grasps that are to hold only


def test_lift_names_what_it_does_not_know():
    with pytest.raises(InputError, match=r"cases = 'cup'.*cube, sphere, soft"):
        lift.kind_of("cup")
    with pytest.raises(InputError, match="number after the colon"):
        lift.kind_of("cube:oil")


def test_twist_keeps_everything_apart_and_upright(tmp_path, undrawn):
    twist.main(twist.Args(out=tmp_path / "twist", quick=True, device="cpu"))
    found = read_metrics(tmp_path / "twist" / "metrics.json")
    assert float(found["twist.min_gap_m"]) > 0.0 and float(found["twist.min_det_f"]) > 0.0
    assert float(found["twist.longest_mm"]) > 0.2 and float(found["twist.twisted_deg"]) > 2.0


SHORT_BEAM = """
physics = "ipc"
pad = "coarse"
timestep_s = 0.001
[robot]
model = "floating_gripper"
opening_mm = 20
position_mm = [0, 0, 38]
quaternion_wxyz = [0, 1, 0, 0]
[[body]]
name = "plate"
kind = "box"
length_mm = 40
width_mm = 40
height_mm = 10
dynamics = "fixed"
position_mm = [0, 0, -5]
[[body]]
name = "beam"
kind = "box"
length_mm = 8
width_mm = 8
height_mm = 32
dynamics = "soft"
density_kg_m3 = 1000
youngs_modulus_kpa = 100
poisson_ratio = 0.4
cell_mm = 4
held_by = "plate"
position_mm = [0, 0, 16]
"""


@pytest.mark.slow
def test_a_stretched_beam_slips_out_snaps_back_and_comes_to_rest_where_it_was(tmp_path):
    """Held by its uppermost 5 mm. The pull cannot pass friction's limit.

    What is let go moves on by itself, faster than a pad may be driven, and swings through its place at rest.
    """
    (tmp_path / "short.toml").write_text(SHORT_BEAM, "utf-8")
    args = twist.Args(
        out=tmp_path / "twist",
        scene=str(tmp_path / "short.toml"),
        force=6.0,
        twist_deg=20.0,
        stretch_mm=24.0,
        rest_s=0.1,
        gap_mm=0.2,
        device="cpu",
    )
    world = twist.make_world(args)
    record, _, times = twist.twist(world, args)
    found = {key: float(value) for key, value in twist.summary(record, times).items()}
    assert found["snapped"] == 1 and found["min_gap_m"] > 0.0 and found["min_det_f"] > 0.0
    assert found["longest_mm"] > 4.0 and abs(found["left_mm"]) < 0.05 and found["unconverged_steps"] == 0
    pull, normal, height = np.array(record.wrench)[:, 2], np.array(record.normal), np.array(record.tip)[:, 2]
    mu = world.composed.sensor_specs[0].gelpad.friction
    pressed = np.maximum(normal[1:], normal[:-1])  # friction's limit is that of the step before
    assert (pull[1:] <= 2.0 * mu * pressed + 0.01).all() and pull.max() > 0.4
    after = int(np.flatnonzero(normal > 0.0)[-1]) + 1
    assert np.abs(np.array(record.wrench)[after:]).max() < 1e-9 and len(height) - after > 10  # torn off, for good
    assert height[after:].min() < height[-1] - 0.2e-3 and float(np.ptp(height[-5:])) < 2e-6  # through its place, and to rest


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
    assert (
        float(one["endurance.frame_m"]) < 1e-12 and float(one["endurance.drift_mm"]) < 2e-3
    )  # some elastic slips of its contacts
    # Volume blocks keep the volume of their elements together; a single one is squeezed by half.
    assert one["endurance.unconverged_steps"] == 0 and float(one["endurance.min_det_f"]) > 0.4
    assert 0.3 < float(one["endurance.lifted_least_mm"]) < 0.5 and 0.0 < float(one["endurance.bond_share"]) < 1e-3
    for key in ("min_gap_m", "min_det_f", "drift_mm"):
        assert one[f"endurance.{key}"] == pytest.approx(two[f"endurance.{key}"], rel=1e-6, abs=1e-8)
    with pytest.raises(RaytacError, match="other settings"):
        endurance.main(endurance.Args(out=tmp_path / "parts", steps=108, force=2.0, **small))
