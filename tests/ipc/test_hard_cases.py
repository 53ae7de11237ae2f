"""The hard cases: surfaces apart after every step, elements upright, bounded iterations, what each says."""

from __future__ import annotations

from dataclasses import replace

import pytest

import ipc
from tests.ipc.hard.cases import CASES, GROUPS
from tests.ipc.hard.run import MAX_NEWTON, Mechanics, Setup, Worst
from tests.ipc.hard.scenes import SOFT, random_presses
from tests.ipc.hard.shapes import cube

SLOW = ["crush", "beam_twist", "mat_twist", "squeeze_and_release", "edge_alignment", "wedge_out_of_crack"]
"""Basic cases that take longer than some two seconds."""
QUICK = [
    *(name for name in GROUPS["basic"] if name not in SLOW),
    *(
        "steep_slope_holds_soft",
        "steep_slope_holds_affine",
        "steep_slope_slides_soft",
        "steep_slope_slides_affine",
        "chain_affine",
    ),
    *("peg_in_hole_affine", "needle_nu_0495", "d_hat_1um_soft", "d_hat_1um_affine", "d_hat_1mm_soft"),
    *("start_gap_1nm_soft", "start_gap_1nm_affine", "start_gap_1nm_soft_on_affine"),
]
LONG = {"blocked_drive": 250, "wrecking_ball": 1500}
"""Newton iterations of cases that may take more than the others.

A blocked drive: det F falls to 0.015, and advances into the block are many. The wrecking ball: two steps do not converge as a whole, and
the attempt counts beside their halves.
"""
SETUP = Setup()
FALL = ipc.Settings(gravity=(0.0, 0.0, -9.81))


def check(name: str, worst: Worst, most: int = MAX_NEWTON) -> None:
    """``most``: Newton iterations a step."""
    said = f"{name}: gap {worst.min_gap:.3g} m, det F {worst.min_det:.3g}, {worst.max_newton} Newton iterations, {worst.notes}"
    crossed = f"surfaces cross in {worst.crossed}, by ipctk in {worst.crossed_by_oracle}"
    assert worst.passed(), f"{said}, {worst.unconverged} of {worst.steps} steps unconverged, {crossed}"
    assert worst.max_newton <= most, said


@pytest.mark.parametrize("name", QUICK)
def test_quick_cases_pass(name: str) -> None:
    check(name, CASES[name](SETUP), LONG.get(name, MAX_NEWTON))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in QUICK])
def test_slow_cases_pass(name: str) -> None:
    """Those that renew friction often take several solves a step."""
    check(name, CASES[name](SETUP), LONG.get(name, MAX_NEWTON if name in GROUPS["basic"] else 5 * MAX_NEWTON))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["beam_twist", "mat_twist"])
def test_large_twists_pass(name: str) -> None:
    """A mat snaps: rounding decides the number of iterations (173 to 321, for 1e-10 of its stiffness); the mean is steady."""
    worst = CASES[name](Setup(large=True))
    check(name, worst, most=3 * MAX_NEWTON)
    assert worst.newton <= 30 * worst.steps, f"{worst.newton / worst.steps:.3g} Newton iterations a step"


def test_random_presses_pass() -> None:
    check("random_presses", random_presses(SETUP, 8))


@pytest.mark.slow
def test_a_thousand_random_presses_pass() -> None:
    check("random_presses", random_presses(SETUP, 1000))


def test_a_case_that_did_not_happen_fails() -> None:
    """The verdict is not given away: a closed gap, surfaces that cross, an unconverged step, an expectation missed, all fail."""
    good = Worst(min_gap=1e-5, min_det=0.5)
    assert good.passed()
    for change in ("min_gap", "min_det"):
        assert not replace(good, **{change: 0.0}).passed()
    assert not replace(good, unconverged=1).passed()
    assert replace(good, unconverged=1, jams=True).passed()
    assert not replace(good, crossed=1, jams=True).passed()
    assert not replace(good, crossed_by_oracle=1, jams=True).passed()
    assert not replace(good, finite=False).passed()
    assert not replace(good, notes=["missed"]).passed()


def test_motion_from_nowhere_is_noticed() -> None:
    """A push that no force explains breaks both laws; the fall before it breaks none."""
    world = ipc.World([ipc.SoftBody("cube", cube(), SOFT), ipc.HalfSpace("floor", ipc.Pose((0, 0, -1.0)))], FALL, device="cpu")
    mechanics = Mechanics(world, driven=False)
    mechanics.add(world.step())
    assert mechanics.force_error < 1e-9 and mechanics.energy_rise < 1e-9
    world.set_velocity("cube", (0.0, 0.0, 1.0))
    mechanics.add(world.step())
    assert mechanics.force_error > 1 and mechanics.energy_rise > 0.5
