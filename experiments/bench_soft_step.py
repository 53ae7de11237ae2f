"""How often is the contact solver called in a step, and what does a step cost in which nothing touches? Against an older commit, by turns.

    git worktree add ../raytac_b682ef2 b682ef2
    python experiments/bench_soft_step.py --against ../raytac_b682ef2 --out runs/bench_soft_step

``push.solves``, ``.newton`` and ``.linear`` are what an environment of PushCube takes in a control step while a pad drags the cube over the
table: calls of the solver, its Newton iterations and those of their conjugate gradients. ``far.ms_per_step`` is the median time of a
control step of ``--far`` environments of a pad with nothing within half a metre, and ``far.solves`` the calls in it. With ``--against``
both checkouts are measured in processes of their own, the times ``--rounds`` times by turns; theirs have the commit's name at the end,
and ``far.speedup_vs_<name>`` is the median over rounds of the ratio of the times. They count alike: what a state's ``report`` says.
"""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.running import recorded, run
from experiments.turns import commit
from raytac.checks import check_whole
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, Metric
from raytac.report import machine


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Solves and times of steps with soft pads."""

    against: Path | None = None
    """Checkout of another commit to take turns with."""
    envs: int = 1
    """Environments of PushCube."""
    steps: int = 4
    """Control steps in which a cube is dragged that count."""
    approach: int = 10
    """Control steps before these, in which the pad comes down on the cube and begins to drag it."""
    far: int = 4
    """Environments with nothing near."""
    rounds: int = 3
    """Of turns."""


def main(args: Args) -> dict[str, Metric]:
    """Measure all and write ``metrics.json``."""
    for name in ("envs", "steps", "approach", "far", "rounds"):
        check_whole(name, getattr(args, name), 1)
    ours = Path(__file__).resolve().parents[1]
    sides = {"": ours}
    if args.against is not None:
        if not (args.against / "raytac").is_dir():
            raise InputError("against", value=args.against, rule="must be a checkout of this project")
        sides[f"_{commit(args.against.resolve())}"] = args.against.resolve()
    with recorded(args, "bench_soft_step", owned=("metrics.json",)) as (_, metrics):
        metrics |= {
            "envs": args.envs,
            "steps": args.steps,
            "far": args.far,
            "rounds": args.rounds,
            "commit": commit(ours),
            **machine(),
        }
        rounds: dict[str, list[dict[str, float]]] = {end: [] for end in sides}
        for k in range(args.rounds):
            for end in list(sides) if k % 2 == 0 else list(sides)[::-1]:
                rounds[end].append(measured(sides[end], far_figures, args.far, args.device))
        for end, rows in rounds.items():
            metrics |= {f"far.{key}{end}": float(np.median([row[key] for row in rows])) for key in rows[0]}
            print(f"far{end}: {metrics[f'far.ms_per_step{end}']:.3g} ms a step", flush=True)
        for end in list(sides)[1:]:
            ratios = [theirs["ms_per_step"] / own["ms_per_step"] for theirs, own in zip(rounds[end], rounds[""], strict=True)]
            metrics[f"far.speedup_vs{end}"] = float(np.median(ratios))
            metrics |= {f"far.speedup_least_vs{end}": min(ratios), f"far.speedup_most_vs{end}": max(ratios)}
        for end, side in sides.items():
            inputs = (args.envs, args.approach, args.steps, args.device, args.seed)
            found = measured(side, push_figures, *inputs)
            metrics |= {f"push.{key}{end}": value for key, value in found.items()}
            print(f"push{end}: {found['solves']:.3g} solves a control step", flush=True)
    return metrics


def measured(checkout: Path, figures: Any, *inputs: Any) -> dict[str, float]:
    """What a function of this file returns in a process that imports a checkout's code."""
    text = f"{inspect.getsource(figures)}\nimport json\nprint(json.dumps({figures.__name__}(*{inputs!r})))"
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    ended = subprocess.run(
        [sys.executable, "-c", text], cwd=checkout, env=environment, capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise RaytacError(f"{figures.__name__} in {checkout} ended with {ended.returncode}: {ended.stderr.strip()[-300:]}")
    return json.loads(ended.stdout.strip().splitlines()[-1])


def push_figures(envs: int, approach: int, steps: int, device: str, seed: int) -> dict[str, float]:
    """What the solver does in a control step in which a pad drags a cube; imports are those of the checkout."""
    import numpy as np

    from raytac.envs import PushCubeVectorEnv

    env = PushCubeVectorEnv(envs, physics="ipc", tactile=None, seed=seed, device=device)
    env.reset(seed=seed)
    rows = []
    for k in range(approach + steps):
        force = -env.batch.world.state().wrench["sensor"][:, 2]
        action = np.zeros((envs, env.single_action_space.shape[0]))  # type: ignore[index]
        action[:, 0] = np.where(force > 1.0, 0.5, 0.0)
        action[:, 2] = np.clip(0.3 * (force - 2.0), -1.0, 1.0)
        before = env.batch.world.state().world_from_body["cube"][:, :3, 3]
        env.step(action)
        state = env.batch.world.state()
        moved = np.linalg.norm(state.world_from_body["cube"][:, :3, 3] - before, axis=1)
        if k >= approach:
            counts = [float(np.mean(state.report[name])) for name in ("substeps", "newton", "linear")]
            rows.append((*counts, 1e3 * float(moved.mean()), float((force > 0.0).mean())))
    return dict(zip(("solves", "newton", "linear", "cube_mm", "in_contact"), np.mean(rows, axis=0).tolist(), strict=True))


def far_figures(envs: int, device: str) -> dict[str, float]:
    """Time of a control step with nothing near [ms], and calls of the solver in it; imports are those of the checkout."""
    import time

    import numpy as np

    from raytac.specs import BodySpec, RobotSpec, TaskScene
    from raytac.world import TactileWorld

    ball = BodySpec("ball", "sphere", {"radius": 0.005}, position=(0.0, 0.0, 0.6), dynamics="fixed")
    scene = TaskScene("far", RobotSpec("fixed_sensor"), (ball,), physics="ipc")
    world, times, solves = TactileWorld(scene, outputs=("wrench",), num_envs=envs, device=device), [], []
    for k in range(40):
        begin = time.perf_counter()
        state = world.step()
        if k >= 10:
            times.append(1e3 * (time.perf_counter() - begin))
            solves.append(float(np.mean(state.report["substeps"])))
    return {"ms_per_step": float(np.median(times)), "solves": float(np.mean(solves))}


if __name__ == "__main__":
    run(main, Args, __doc__)
