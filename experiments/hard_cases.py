"""The cases that break contact solvers, made in code: sharp, aligned, fast, lopsided, blocked, twisted. A table of their worst figures.

    python experiments/hard_cases.py --out runs/hard_cases                 # all, with 1,000 random presses
    python experiments/hard_cases.py --cases spike_in_hole,cliff --out runs/hard_cases

A case passes if after every step no surfaces cross or touch (``ipc.World.overlap``, which is exact), the least gap and the least det F
over all accepted states are positive, all numbers are finite, and what its name says came about: bodies met, a weight is carried, a cube
slid as Coulomb says, a twist was followed to its end. Every step must converge within the Newton iterations that it may take, but for the
cases about nearly parallel edges that are jammed (``Worst.jams``), whose steps say in their reports that they have not. In converged steps
the momentum of free bodies changes by their contact forces and gravity alone, and where nothing is driven the energy never rises. The
sharp ones follow Erleben 2018, "Methodology for Assessing Mesh-Based Contact Point Methods".

Writes metrics.json and hard_cases.png, the last state of each case.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from raytac.errors import RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, result_folder, versions, write_metrics
from tests.ipc.hard.run import Setup, Worst
from tests.ipc.hard.scenes import CASES, random_presses


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Run the solver's hard cases and tabulate the worst figures of each."""

    cases: str = ""
    """Names joined by commas; empty for all."""
    presses: int = 1000
    """Number of random presses."""
    large: bool = False
    """Finer meshes and more turns in the twists."""


def main(args: Args) -> int:
    from experiments.hard_figure import draw_last_states, state_of

    start, setup = time.perf_counter(), Setup(args.device, args.large)
    names = [n for n in args.cases.split(",") if n] or [*CASES, "random_presses"]
    unknown = [n for n in names if n not in CASES and n != "random_presses"]
    if unknown:
        print(f"--cases {','.join(unknown)}: choose from {', '.join([*CASES, 'random_presses'])}", file=sys.stderr)
        return 2
    metrics: dict[str, Metric] = {}
    results: dict[str, Worst] = {}
    print(f"{'case':22} {'min gap [m]':>12} {'min det F':>10} {'newton':>7} {'unconverged':>11} {'crossed':>7} {'s':>6}  verdict")
    for name in names:
        begin = time.perf_counter()
        worst = random_presses(setup, args.presses, args.seed) if name == "random_presses" else CASES[name](setup)
        results[name] = worst
        print(
            f"{name:22} {worst.min_gap:12.3e} {worst.min_det:10.4f} {worst.max_newton:7d} {worst.unconverged:11d} {worst.crossed:7d} "
            f"{time.perf_counter() - begin:6.1f}  {'pass' if worst.passed() else 'FAIL'} {'; '.join(worst.notes)}",
            flush=True,
        )
        if math.isfinite(worst.min_gap):
            metrics[f"{name}.min_gap_m"] = worst.min_gap
        metrics |= {
            f"{name}.min_det_f": worst.min_det,
            f"{name}.max_newton": worst.max_newton,
            f"{name}.mean_newton": worst.newton / worst.steps,
            f"{name}.unconverged": worst.unconverged,
            f"{name}.crossed": worst.crossed,
            f"{name}.steps": worst.steps,
            f"{name}.blocked": worst.blocked,
        }
    passed = sum(worst.passed() for worst in results.values())
    metrics |= {"cases.passed": passed, "cases.total": len(names)}
    common = {"experiment": "hard_cases", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/hard_cases"), ("metrics.json", "hard_cases.png")) as folder:
        draw_last_states(
            {name: state_of(worst.world) for name, worst in results.items() if worst.world}, folder / "hard_cases.png"
        )
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - start})
    return 0 if passed == len(names) else 1


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
