"""The hard cases of experiments/hard_cases.py: open gaps, no inverted element, bounded iterations, and what each name says came about."""

from __future__ import annotations

from dataclasses import replace

import ipctk
import numpy as np
import pytest

import ipc
from experiments.hard_run import MAX_NEWTON, Setup, Worst
from experiments.hard_scenes import CASES, random_presses

SLOW = ["crush", "beam_twist", "mat_twist", "squeeze_and_release", "edge_alignment"]
"""Those that take longer than some two seconds."""
SETUP = Setup()


def check(name: str, worst: Worst, most: int = MAX_NEWTON) -> None:
    """``most``: Newton iterations a step."""
    told = f"{name}: gap {worst.min_gap:.3g} m, det F {worst.min_det:.3g}, {worst.max_newton} Newton iterations, {worst.notes}"
    assert worst.passed(), f"{told}, {worst.unconverged} unconverged"
    assert worst.max_newton <= most, told
    assert worst.world is not None
    layout, x = worst.world.layout, np.asfortranarray(surface_positions(worst.world))
    assert not ipctk.has_intersections(ipctk.CollisionMesh(x, layout.edges, layout.faces), x), f"{name}: surfaces cross"


def surface_positions(world: ipc.World) -> np.ndarray:
    """World positions of all surface vertices of the first environment, (V, 3)."""
    parts = []
    for body in world.bodies:
        if isinstance(body, ipc.SoftBody):
            parts.append(world.positions(body.name)[0][world.surface(body.name)[0]])
        elif not isinstance(body, ipc.HalfSpace):
            parts.append(world.positions(body.name)[0])
    return np.concatenate(parts)


@pytest.mark.parametrize("name", [n for n in CASES if n not in SLOW])
def test_quick_cases_pass(name: str) -> None:
    check(name, CASES[name](SETUP))


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_slow_cases_pass(name: str) -> None:
    check(name, CASES[name](SETUP))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["beam_twist", "mat_twist"])
def test_large_twists_pass(name: str) -> None:
    check(name, CASES[name](Setup(large=True)), most=300)


def test_random_presses_pass() -> None:
    check("random_presses", random_presses(SETUP, 8))


@pytest.mark.slow
def test_a_thousand_random_presses_pass() -> None:
    check("random_presses", random_presses(SETUP, 1000))


def test_a_case_that_did_not_happen_fails() -> None:
    """The verdict is not given away: a closed gap, an unconverged step, an expectation missed, all fail."""
    good = Worst(min_gap=1e-5, min_det=0.5)
    assert good.passed()
    for change in ("min_gap", "min_det"):
        assert not replace(good, **{change: 0.0}).passed()
    assert not replace(good, unconverged=1).passed()
    assert not replace(good, finite=False).passed()
    assert not replace(good, notes=["missed"]).passed()
