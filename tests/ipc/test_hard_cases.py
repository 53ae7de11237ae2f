"""The hard cases of experiments/hard_cases.py: open gaps, no inverted element, bounded iterations."""

from __future__ import annotations

import pytest

from experiments import hard_cases

QUICK = ["spike_on_spike", "wedge_on_wedge", "spike_in_hole", "wedge_in_crack", "cliff", "vertex_alignment", "dt_1s"]
ARGS = hard_cases.Args(device="cpu")


def check(name: str, worst: hard_cases.Worst) -> None:
    told = f"{name}: gap {worst.min_gap:.3g} m, det F {worst.min_det:.3g}, {worst.max_newton} Newton iterations, {worst.notes}"
    assert worst.passed(hard_cases.MAX_NEWTON), told
    assert worst.unconverged == 0, f"{name}: {worst.unconverged} steps did not converge"


@pytest.mark.parametrize("name", QUICK)
def test_quick_cases_pass(name: str) -> None:
    check(name, hard_cases.CASES[name](ARGS))


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in hard_cases.CASES if n not in QUICK])
def test_other_cases_pass(name: str) -> None:
    check(name, hard_cases.CASES[name](ARGS))


def test_random_presses_pass() -> None:
    check("random_presses", hard_cases.random_presses(ARGS, 8))


@pytest.mark.slow
def test_a_thousand_random_presses_pass() -> None:
    check("random_presses", hard_cases.random_presses(ARGS, 1000))
