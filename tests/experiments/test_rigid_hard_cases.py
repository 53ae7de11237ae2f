"""The script of the hard cases of rigid pads: the form of its report, and measures that do not trust the pad."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import rigid_hard_cases as hard
from experiments.rigid_hard_bench import GEL, Bench, Grasps, Outcome, normal_force, on_pad, within_grip
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.physics.objects import object_parts
from raytac.specs import BodySpec


def test_a_run_reports_every_check_and_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {"out": tmp_path, "device": "cpu", "seconds": 0.02, "grasps": 8}
    ran: list[str] = []
    measured = hard.measured
    monkeypatch.setattr(hard, "measured", lambda name, case: (ran.append(name), measured(name, case))[1])
    found = hard.main(hard.Args(**options, cases="drop_5g_1ms-1_[12]ms"))
    assert ran == ["drop_5g_1ms-1_1ms", "drop_5g_1ms-1_2ms", "drop_5g_1ms-1_steps"]
    assert found["rigid_hard.total"] == 3 and found["rigid_hard.passed"] == sum(
        int(found[f"rigid_hard.{name}.passed"]) for name in ran
    )
    assert -0.004 <= float(found["rigid_hard.max_penetration_of_bond_m"]) < 1.0
    assert abs(float(found["rigid_hard.drop_5g_1ms-1_1ms.friction_beyond_its_cone"])) < 0.01
    assert read_metrics(tmp_path / "metrics.json")["rigid_hard.total"] == 3
    text = (tmp_path / "table.txt").read_text()
    assert "steps of 2 and 1 ms: greatest depth" in text and (tmp_path / "rigid_hard.png").stat().st_size > 10_000
    ran.clear()
    hard.main(hard.Args(**options, cases="drop_5g_1ms-1_1ms,grasps_sphere_0"))
    assert ran == ["grasps_sphere_0"]
    with pytest.raises(InputError, match="other settings"):
        hard.main(hard.Args(**{**options, "seconds": 0.03}, cases="pin*"))


def test_processes_and_parts_measure_what_one_process_does(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    options: dict[str, Any] = {
        "device": "cpu",
        "grasps": 8,
        "seconds": 0.25,
        "cases": "grasps_sphere_0,grasps_cylinder_0,grasps_edge_0",
    }
    folders = [tmp_path / name for name in ("one", "two", "both", "alone")]
    first = hard.main(hard.Args(**options, out=folders[0], part="1/2", processes=2, minutes=5.0))
    assert first["rigid_hard.total"] == 2 and first["rigid_hard.grasps"] == 2 and first["rigid_hard.missing"] == 0
    assert "   2/2 grasps_" in capfd.readouterr().out
    hard.main(hard.Args(**options, out=folders[1], part="2/2"))
    both = hard.main(hard.Args(cases="grasps*", device="cpu", combine=(folders[0], folders[1]), out=folders[2]))
    alone = hard.main(hard.Args(**options, out=folders[3]))
    assert both["rigid_hard.total"] == both["rigid_hard.grasps"] == 3 and both["rigid_hard.missing"] == 5
    for key, value in alone.items():
        if key.startswith("rigid_hard") and not key.endswith(("seconds_each", "missing")):
            assert both[key] == value, key
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"combine": (folders[0], folders[2])}, "another folder holds too"),
        ({"combine": (tmp_path / "none",)}, "no record"),
        ({"combine": (folders[0],), "out": folders[1]}, "holds a run already"),
    )
    for changes, text in refused:
        with pytest.raises(InputError, match=text):
            hard.main(hard.Args(**({"out": tmp_path / "new", "device": "cpu"} | changes)))
    other = tmp_path / "other"
    other.mkdir()
    (other / "cases.json").write_text((folders[1] / "cases.json").read_text().replace('"grasps": 8', '"grasps": 16'))
    with pytest.raises(InputError, match="other settings"):
        hard.main(hard.Args(combine=(folders[0], other), out=tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_names_of_failing_cases_are_in_the_metrics() -> None:
    rows = [{"case": name, "passed": name == "good", "penetration_m": None, "checks": []} for name in ("good", "bad", "worse")]
    assert hard.summary(rows)["rigid_hard.failing"] == "bad worse"


def test_bad_options_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for options, text in (
        ({"cases": "spike"}, "drop_5g"),
        ({"seconds": 0.0}, "greater than 0"),
        ({"grasps": -1}, "0 or more"),
        ({"part": "3/2"}, "1 <= i <= n"),
        ({"part": "half"}, "1 <= i <= n"),
        ({"processes": 0}, "1 or more"),
        ({"processes": 2, "minutes": 0.0}, "greater than 0"),
        ({"minutes": 1.0}, "two processes"),
    ):
        with pytest.raises(InputError, match=text):
            hard.main(hard.Args(out=out, device="cpu", **options))  # type: ignore[arg-type]
    assert not out.exists()


def test_a_case_that_breaks_off_has_failed_and_says_why() -> None:
    def case() -> Outcome:
        raise ValueError("no such thing")

    row = hard.measured("broken", case)
    assert not row["passed"] and "ValueError: no such thing" in hard.line(row)


def test_penetration_is_seen_at_sub_steps_whatever_the_pad_says() -> None:
    """A ball that is put through the pad without a step of the pad: the record alone finds it."""
    ball = BodySpec("ball", "sphere", {"radius": 5e-3}, position=(0.0, 0.0, 0.006), mass=0.01)
    with Bench(on_pad([ball], 1e-3)) as bench:
        bench.run(2e-3)
        assert bench.penetration() == pytest.approx(-GEL.thickness - 0.001, abs=5e-5)
        bench._poses[0][0, 2, 3] = -1e-3
        assert bench.penetration() == pytest.approx(0.006 - GEL.thickness, abs=1e-5)
        outcome = bench.common(Outcome())
    assert not outcome.passed and [c.name for c in outcome.checks if not c.passed] == ["beyond the bonded face"]


def test_the_normal_load_is_that_along_the_gel_where_a_body_presses() -> None:
    """A ball beside the pad's centre presses along the dome's normal, which goes through its own centre."""
    ball = BodySpec("ball", "sphere", {"radius": 8e-3}, position=(0.0, 0.0, 0.0), mass=0.02)
    pose, (x, y) = np.eye(4), (6e-3, -4e-3)
    dome = 0.5 * GEL.size[0] ** 2 / 4.0 / float(GEL.sag(0.5 * GEL.size[0], 0.0))
    pose[:3, 3] = x, y, 8e-3 - float(GEL.sag(x, y)) - 0.3e-3
    normal = np.array([x, y, dome + 8e-3]) / np.linalg.norm([x, y, dome + 8e-3])
    along = np.cross(normal, [0.0, 1.0, 0.0])
    load = normal_force(-2.0 * normal + 0.7 * along, pose, object_parts(ball))
    assert load == pytest.approx(2.0, abs=1e-3)


def test_two_pads_press_each_other_beyond_where_their_gels_meet() -> None:
    with Bench(within_grip([], 5e-3, 0.5e-3)) as bench:
        bench.press_pads_together()
        bench.force = lambda t: 2.0 * min(t / 0.1, 1.0)
        bench.run(0.4)
        assert bench.normal[-1] == pytest.approx([2.0, 2.0], rel=0.01)
        assert bench.between_pads()[-1] < -0.05e-3


def test_a_grasp_with_little_force_has_hold_of_its_body_before_the_load_comes() -> None:
    radius = 5e-3
    ball = BodySpec("ball", "sphere", {"radius": radius}, mass=0.03)
    grasp = Grasps(within_grip([ball], 4e-3, 2.0 * radius + 8e-3), 2)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 4e-3, 1e-3, 2e-3
    grasp.close(poses, np.full(2, 2.0 * radius), np.array([0.3, 0.3]), 2)
    assert grasp.felt == 2 and grasp.failed == 0
    held = np.array([data.qpos[grasp.world.composed.bodies["ball"].qpos :][:3] for data in grasp.world.data])
    np.testing.assert_allclose(held[:, [0, 2]], poses[:, [0, 2], 3], atol=1e-3)


@pytest.mark.parametrize("name", ["corner", "pin"])
def test_what_is_held_near_a_case_does_not_feel_its_friction_across_the_gap(name: str) -> None:
    """At 10 ms the contacts of the case are foreseen while the gel carries the load; they dropped the body."""
    outcome = hard.grip(*hard.grips()[name], 1e-2, 0.1)
    assert outcome.passed, [check for check in outcome.checks if not check.passed]


def test_drops_begin_at_one_height_whatever_the_step() -> None:
    begun = [hard.drop(0.05, 0.1, dt).curves["depth"][0] for dt in (2e-3, 10e-3)]
    assert begun[0] == begun[1]


def test_steps_are_compared_within_one_speed() -> None:
    """The speed of a drop reads like a step: 2ms-1."""

    def row(name: str, force: float) -> hard.Row:
        return {"case": name, "curves": {"result_of": ["greatest force"], "result": [force]}}

    speeds = (1.0, 2.0, 5.0)
    rows = [row(f"drop_5g_{v:g}ms-1_{dt}ms", 10.0 * v + (0.1 if dt == 2 else 0.0)) for v in speeds for dt in (1, 2, 10)]
    compared = hard.agreement(rows)
    assert [one["case"] for one in compared] == [f"drop_5g_{v:g}ms-1_steps" for v in speeds]
    assert [one["checks"][0]["value"] for one in compared] == pytest.approx([0.01 / v for v in speeds])


def test_full_runs_have_every_combination() -> None:
    quick, full = hard.all_cases(hard.Args()), hard.all_cases(hard.Args(full=True))
    drops = [name for name in full if name.startswith("drop")]
    assert len(drops) == 3 * 6 * 5 and set(quick) <= set(full)
    assert {f"lift_mu{mu:g}_2ms" for mu in (0.1, 0.3, 1.0, 1.5)} <= set(full)
    counts = {name: case.args[1] for name, case in full.items() if name.startswith("grasps")}  # type: ignore[attr-defined]
    shares = [sum(n for name, n in counts.items() if name.startswith(f"grasps_{thing}_")) for thing in hard.OBJECTS]
    assert sum(counts.values()) == sum(shares) == 10_000 and np.ptp(shares) <= 1 and max(counts.values()) <= 128
