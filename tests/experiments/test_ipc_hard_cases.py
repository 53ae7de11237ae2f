"""The script of the solver's hard cases: what it reports, how it goes on, and that a failing case is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import hard_cases as hard
from experiments.hard_figure import load_state, save_state, state_of
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from tests.ipc.hard.cases import CASES
from tests.ipc.hard.run import Setup, Worst


def test_a_run_reports_every_case_and_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {"out": tmp_path, "device": "cpu", "presses": 4}
    ran: list[str] = []
    outcome = hard.outcome
    monkeypatch.setattr(hard, "outcome", lambda name, *rest: (ran.append(name), outcome(name, *rest))[1])
    metrics = hard.main(hard.Args(**options, cases="steep_slope_holds_*"))
    assert ran == ["steep_slope_holds_soft", "steep_slope_holds_affine"]
    assert metrics["cases.passed"] == metrics["cases.total"] == 2 and metrics["cases.missing"] == 0
    assert metrics["steep_slope_holds_soft.passed"] == 1 and 0 < float(metrics["steep_slope_holds_soft.min_gap_m"]) < 1e-4
    assert (tmp_path / "hard_cases_piles.png").stat().st_size > 10_000 and not (tmp_path / "hard_cases_gels.png").exists()
    ran.clear()
    hard.main(hard.Args(**options, cases="steep_slope_*_affine"))
    assert ran == ["steep_slope_slides_affine"]
    assert read_metrics(tmp_path / "metrics.json")["cases.total"] == 3
    assert (tmp_path / "hard_cases.md").read_text(encoding="utf-8").count("\n") == 5
    with pytest.raises(InputError, match="other settings"):
        hard.main(hard.Args(**{**options, "presses": 8}, cases="cliff"))
    with pytest.raises(InputError, match="names no case"):
        hard.main(hard.Args(**options, cases="cliff,arch_flies"))


def test_failing_and_missing_cases_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CASES, "cliff", lambda _: Worst(min_gap=1e-5, min_det=0.5, steps=3).expect(False, "it stayed"))
    options: dict[str, Any] = {"out": tmp_path, "device": "cpu"}
    with pytest.raises(SystemExit, match="0 cases are missing; failing: cliff"):
        hard.main(hard.Args(**options, cases="cliff"))
    assert "it stayed" in (tmp_path / "hard_cases.md").read_text(encoding="utf-8")
    with pytest.raises(SystemExit, match="2 cases are missing"):
        hard.main(hard.Args(**options, cases="cliff,tower_*", minutes=0.0))
    metrics = read_metrics(tmp_path / "metrics.json")
    assert (metrics["cases.passed"], metrics["cases.total"], metrics["cases.missing"]) == (0, 1, 2)


def test_a_start_that_the_package_refuses_is_a_failure_with_its_reason() -> None:
    def refused(setup: Setup) -> Worst:
        raise hard.ipc.OverlapError("goes 1 mm through")

    CASES["refused"] = refused
    try:
        worst = hard.outcome("refused", Setup(), hard.Args())
    finally:
        del CASES["refused"]
    assert not worst.passed() and worst.notes == ["OverlapError: goes 1 mm through"]


def test_states_are_kept_as_they_are(tmp_path: Path) -> None:
    worst = CASES["steep_slope_holds_affine"](Setup())
    assert worst.world is not None
    state = state_of(worst.world)
    save_state(state, tmp_path / "state.npz")
    again = load_state(tmp_path / "state.npz")
    assert again.floor == state.floor and [s.name for s in again.surfaces] == [s.name for s in state.surfaces]
    for one, other in zip(again.surfaces, state.surfaces, strict=True):
        assert np.array_equal(one.triangles, other.triangles)
        assert one.traction is not None and other.traction is not None and np.array_equal(one.traction, other.traction)
