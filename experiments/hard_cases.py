"""The cases that break contact solvers, made in code: sharp, aligned, fast, lopsided, blocked, twisted, piled up, threaded, squeezed out.

    python experiments/hard_cases.py --out runs/hard_cases                 # all, with 1,000 random presses
    python experiments/hard_cases.py --cases "spike_in_hole,arch_*" --out runs/hard_cases
    python experiments/hard_cases.py --device cuda --minutes 8 --out runs/hard_cases_cuda    # again, until none is missing

A case passes if after every step no surfaces cross or touch (by ``ipc.World.overlap``, which is exact, and by ipctk), the least gap and
the least det F over all accepted states are positive (the sign of det F is computed again in rational numbers), all numbers are finite,
and what its name says came about: bodies met, a weight is carried, a cube slid as Coulomb says, an arch stood or fell by the least
friction of its geometry, a nut advanced by the pitch, a twist was followed to its end. Every step must converge within the Newton
iterations that it may take, but for the cases that jam (``Worst.jams``), whose steps say in their reports that they have not. In
converged steps the momentum of free bodies changes by their contact forces and gravity alone, and where nothing is driven the energy
never rises.

Sources: Erleben 2018, "Methodology for Assessing Mesh-Based Contact Point Methods"; Li et al. 2020, "Incremental Potential Contact";
Ferguson et al. 2021, "Intersection-free Rigid Body Dynamics"; Lan et al. 2022, "Affine Body Dynamics".

Writes metrics.json, the table hard_cases.md and a picture of the last states of each group of cases, hard_cases_GROUP.png. Each case is
kept in cases.json and states/ when it is done: an interrupted run goes on with the next one.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from typing import Any

import ipc
from experiments.running import recorded, resumed, run, store
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric
from tests.ipc.hard.cases import CASES, GROUPS
from tests.ipc.hard.run import Setup, Worst
from tests.ipc.hard.scenes import random_presses

PRESSES = "random_presses"
PACKAGES = ("warp-lang", "ipctk")
PICTURES = tuple(f"hard_cases_{group}.png" for group in GROUPS)

Row = dict[str, Any]
"""What is kept of a case."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Run the solver's hard cases and tabulate the worst figures of each."""

    cases: str = ""
    """Names or patterns joined by commas; empty for all."""
    presses: int = 1000
    """Number of random presses."""
    large: bool = False
    """Finer meshes and more turns in the twists."""
    minutes: float = math.inf
    """No case begins after this time; the same command goes on with those that are missing."""


def chosen(patterns: str) -> list[str]:
    """Names of the cases that the patterns name, in their order.

    Raises:
        InputError: a pattern names none.
    """
    names, asked = [*CASES, PRESSES], [p for p in patterns.split(",") if p] or ["*"]
    for pattern in asked:
        if not any(fnmatch(name, pattern) for name in names):
            raise InputError("cases", value=pattern, rule=f"names no case: choose from {', '.join(names)}")
    return [name for name in names if any(fnmatch(name, pattern) for pattern in asked)]


def outcome(name: str, setup: Setup, args: Args) -> Worst:
    """Worst figures of a case; one that the package refuses has failed, with the reason as its note."""
    try:
        return random_presses(setup, args.presses, args.seed) if name == PRESSES else CASES[name](setup)
    except ipc.IpcError as error:
        return Worst().expect(False, f"{type(error).__name__}: {error}")


def measured(name: str, worst: Worst, seconds: float) -> Row:
    """Row of a case; gaps and det F only where there were any."""
    return {
        "case": name,
        "passed": worst.passed(),
        "notes": worst.notes,
        "min_gap_m": worst.min_gap if math.isfinite(worst.min_gap) else None,
        "min_det_f": worst.min_det if math.isfinite(worst.min_det) else None,
        "max_newton": worst.max_newton,
        "mean_newton": worst.newton / max(worst.steps, 1),
        "unconverged": worst.unconverged,
        "crossed": worst.crossed,
        "crossed_by_ipctk": worst.crossed_by_oracle,
        "steps": worst.steps,
        "blocked": worst.blocked,
        "seconds": seconds,
    }


def verdict(row: Row) -> str:
    """Whether a case passed, and if not, why."""
    if row["passed"]:
        return ""
    return "; ".join(row["notes"]) or "unconverged" * bool(row["unconverged"]) or "unsound"


def table(rows: Sequence[Row]) -> str:
    """Markdown table of the worst figures, a row a case."""
    head = "| case | least gap [m] | least det F | most Newton iterations a step | steps unconverged | fails |\n|---|---|---|---|---|---|\n"
    return head + "".join(
        f"| {r['case']} | {_digits(r['min_gap_m'], '.1e')} | {_digits(r['min_det_f'], '.4f')} | {r['max_newton']} "
        f"| {r['unconverged']} of {r['steps']} | {verdict(r)} |\n"
        for r in rows
    )


def _digits(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def metrics_of(rows: Sequence[Row], missing: int) -> dict[str, Metric]:
    """Every figure of every case under its name, and how many passed."""
    failing = [row["case"] for row in rows if not row["passed"]]
    return {
        "cases.passed": len(rows) - len(failing),
        "cases.total": len(rows),
        "cases.missing": missing,
        "cases.failing": " ".join(failing),
        **{
            f"{row['case']}.{key}": int(value) if key == "passed" else value
            for row in rows
            for key, value in row.items()
            if key not in ("case", "notes") and value is not None
        },
    }


def main(args: Args) -> dict[str, Metric]:
    from experiments.hard_figure import draw_last_states, load_state, save_state, state_of

    start, names, device = time.perf_counter(), chosen(args.cases), resolve_device(args.device, ray_tracing=False)
    out, setup = args.folder("hard_cases"), Setup(device, args.large)
    settings = {"device": device, "large": args.large, "presses": args.presses, "seed": args.seed}
    rows: dict[str, Row] = {row["case"]: row for row in resumed(out / "cases.json", settings)}
    print(f"{'case':28} {'min gap [m]':>11} {'min det F':>9} {'newton':>6} {'unconverged':>12} {'crossed':>7} {'s':>6}  fails")
    for name in names:
        if name in rows or time.perf_counter() - start > 60 * args.minutes:
            continue
        begin = time.perf_counter()
        worst = outcome(name, setup, args)
        row = rows[name] = measured(name, worst, time.perf_counter() - begin)
        print(
            f"{name:28} {worst.min_gap:11.3e} {worst.min_det:9.4f} {worst.max_newton:6d} {worst.unconverged:5d} of {worst.steps:3d} "
            f"{worst.crossed + worst.crossed_by_oracle:7d} {row['seconds']:6.1f}  {verdict(row)}",
            flush=True,
        )
        if worst.world:
            save_state(state_of(worst.world), out / "states" / f"{name}.npz")
        store(out / "cases.json", settings, list(rows.values()))
    done = [name for name in (*CASES, PRESSES) if name in rows]
    with recorded(args, "hard_cases", device=device, owned=(*PICTURES, "hard_cases.md"), packages=PACKAGES) as (folder, metrics):
        metrics |= metrics_of([rows[name] for name in done], sum(name not in rows for name in names))
        (folder / "hard_cases.md").write_text(table([rows[name] for name in done]), encoding="utf-8")
        for (group, cases), picture in zip(GROUPS.items(), PICTURES, strict=True):
            members = [*cases, PRESSES] if group == "basic" else cases
            states = {n: load_state(out / "states" / f"{n}.npz") for n in members if (out / "states" / f"{n}.npz").exists()}
            if states:
                draw_last_states(states, folder / picture)
    if metrics["cases.failing"] or metrics["cases.missing"]:
        sys.exit(f"{metrics['cases.missing']} cases are missing; failing: {metrics['cases.failing'] or 'none'}")
    return metrics


if __name__ == "__main__":
    run(main, Args)
