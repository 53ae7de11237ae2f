"""The cases that break contact solvers, made in code: sharp, aligned, fast, lopsided, blocked, twisted, piled up, threaded, squeezed out.

    python experiments/hard_cases.py --out runs/hard_cases                 # all, with 1,000 random presses
    python experiments/hard_cases.py --cases "spike_in_hole,arch_*" --out runs/hard_cases
    python experiments/hard_cases.py --device cuda --out runs/hard_cases_cuda

A case passes if after every step no surfaces cross or touch (by ``ipc.World.overlap``, which is exact, and by ipctk), the least gap and
the least det F over all accepted states are positive (the sign of det F is computed again in rational numbers), all numbers are finite,
and what its name says came about: bodies met, a weight is carried, a cube slid as Coulomb says, an arch stood or fell by the least
friction of its geometry, a nut advanced by the pitch, a twist was followed to its end. Every step must converge within the Newton
iterations that it may take, but for the cases that jam (``Worst.jams``), whose steps say in their reports that they have not. In
converged steps the momentum of free bodies changes by their contact forces and gravity alone, and where nothing is driven the energy
never rises.

Sources: Erleben 2018, "Methodology for Assessing Mesh-Based Contact Point Methods"; Li et al. 2020, "Incremental Potential Contact";
Ferguson et al. 2021, "Intersection-free Rigid Body Dynamics"; Lan et al. 2022, "Affine Body Dynamics".

Writes metrics.json and a picture of the last states of each group of cases, hard_cases_GROUP.png.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from fnmatch import fnmatch

import ipc
from experiments.running import recorded, run
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric
from tests.ipc.hard.cases import CASES, GROUPS
from tests.ipc.hard.run import Setup, Worst
from tests.ipc.hard.scenes import random_presses

PRESSES = "random_presses"
PICTURES = tuple(f"hard_cases_{group}.png" for group in GROUPS)


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Run the solver's hard cases and tabulate the worst figures of each."""

    cases: str = ""
    """Names or patterns joined by commas; empty for all."""
    presses: int = 1000
    """Number of random presses."""
    large: bool = False
    """Finer meshes and more turns in the twists."""


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


def figures(name: str, worst: Worst, seconds: float) -> dict[str, Metric]:
    """Metrics of a case; gaps and det F only where there were any."""
    measured = {"min_gap_m": worst.min_gap, "min_det_f": worst.min_det}
    return {
        **{f"{name}.{key}": value for key, value in measured.items() if math.isfinite(value)},
        f"{name}.passed": int(worst.passed()),
        f"{name}.max_newton": worst.max_newton,
        f"{name}.mean_newton": worst.newton / max(worst.steps, 1),
        f"{name}.unconverged": worst.unconverged,
        f"{name}.crossed": worst.crossed,
        f"{name}.crossed_by_ipctk": worst.crossed_by_oracle,
        f"{name}.steps": worst.steps,
        f"{name}.blocked": worst.blocked,
        f"{name}.seconds": seconds,
    }


def main(args: Args) -> dict[str, Metric]:
    from experiments.hard_figure import draw_last_states, state_of

    names, device = chosen(args.cases), resolve_device(args.device, ray_tracing=False)
    setup, results = Setup(device, args.large), dict[str, Worst]()
    with recorded(args, "hard_cases", device=device, owned=PICTURES, packages=("warp-lang", "ipctk")) as (
        folder,
        metrics,
    ):
        print(
            f"{'case':24} {'min gap [m]':>12} {'min det F':>10} {'newton':>7} {'unconverged':>13} {'crossed':>7} {'s':>6}  verdict"
        )
        for name in names:
            begin = time.perf_counter()
            worst = results[name] = outcome(name, setup, args)
            seconds = time.perf_counter() - begin
            metrics |= figures(name, worst, seconds)
            verdict = "; ".join(("pass" if worst.passed() else "FAIL", *worst.notes))
            print(
                f"{name:24} {worst.min_gap:12.3e} {worst.min_det:10.4f} {worst.max_newton:7d} {worst.unconverged:5d} of {worst.steps:4d} "
                f"{worst.crossed + worst.crossed_by_oracle:7d} {seconds:6.1f}  {verdict}",
                flush=True,
            )
        failing = [name for name, worst in results.items() if not worst.passed()]
        metrics |= {"cases.passed": len(names) - len(failing), "cases.total": len(names), "cases.failing": " ".join(failing)}
        for group, picture in zip(GROUPS.values(), PICTURES, strict=True):
            drawn = {
                n: state_of(w.world)
                for n, w in results.items()
                if w.world and (n in group or (n == PRESSES and group is GROUPS["basic"]))
            }
            if drawn:
                draw_last_states(drawn, folder / picture)
    if failing:
        sys.exit(f"{len(failing)} of {len(names)} fail: {' '.join(failing)}")
    return metrics


if __name__ == "__main__":
    run(main, Args)
