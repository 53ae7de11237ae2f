"""What do looser tolerances of soft worlds cost in force, and what do they save?

    python experiments/soft_world_accuracy.py --out runs/soft_world_accuracy
    python experiments/soft_world_accuracy.py --envs 64 --device cuda --out runs/soft_world_accuracy_gpu

The pad of RollBall goes down on the ball and rolls it to and fro; the motion is the same for all tolerances. Each pair
``TOLERANCE:LINEAR`` of ``--accuracies`` is ``tolerance`` [m] and ``linear_tolerance`` of ``SceneSettings``; the first is what the
others are compared with.

``<pair>.force_error`` is the largest change of the force on the pad over the largest force of the first pair, ``.force_error_rms`` its root
mean square; ``.newton`` and ``.linear`` are iterations of an environment in a control step with the pad pressed, ``.ms_per_step`` is the
median time of a step of all environments.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from experiments.running import recorded, run
from raytac.checks import check_whole
from raytac.envs import RollBallVectorEnv
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric
from raytac.physics import Ipc, SceneSettings
from raytac.report import machine

DOWN = 12
"""Control steps until the pad rests on the ball."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Tolerances of soft worlds."""

    accuracies: str = "2e-8:1e-6,1e-7:1e-4,1e-7:1e-3,5e-7:1e-3,2e-6:1e-2"
    """Pairs TOLERANCE:LINEAR, joined by commas."""
    envs: int = 4
    """Environments, whose balls begin in different places."""
    steps: int = 24
    """Control steps with the pad pressed."""


def main(args: Args) -> dict[str, Metric]:
    """Roll with every pair and write ``metrics.json``."""
    check_whole("envs", args.envs)
    check_whole("steps", args.steps)
    pairs = {name: read(name) for name in args.accuracies.split(",")}
    with recorded(args, "soft_world_accuracy", owned=("metrics.json",), packages=("gymnasium",)) as (_, metrics):
        metrics |= {"envs": args.envs, "steps": args.steps, **machine()}
        first = None
        for name, accuracy in pairs.items():
            forces, counts, wall = roll(accuracy, args)
            first = forces if first is None else first
            change = np.linalg.norm(forces - first, axis=-1) / np.linalg.norm(first, axis=-1).max()
            found = {
                "force_error": float(change.max()),
                "force_error_rms": float(np.sqrt((change**2).mean())),
                "newton": float(counts[:, 0].mean()),
                "linear": float(counts[:, 1].mean()),
                "ms_per_step": 1e3 * float(np.median(wall)),
            }
            metrics |= {f"{name}.{key}": value for key, value in found.items()}
            print(name, ", ".join(f"{key} {value:.4g}" for key, value in found.items()), flush=True)
    return metrics


def read(pair: str) -> SceneSettings:
    """The settings that a pair names."""
    try:
        tolerance, linear = (float(number) for number in pair.split(":"))
    except ValueError:
        raise InputError("accuracies", value=pair, rule="must be TOLERANCE:LINEAR, two numbers") from None
    return SceneSettings(tolerance=tolerance, linear_tolerance=linear)


def roll(accuracy: SceneSettings, args: Args) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces (steps, B, 3) [N], iterations (steps, 2), and times of the pressed steps [s]."""
    env = RollBallVectorEnv(args.envs, physics=Ipc(accuracy=accuracy), tactile=None, seed=args.seed, device=args.device)
    env.reset(seed=args.seed)
    rows = []
    for step in range(DOWN + args.steps):
        action = np.zeros((args.envs, env.single_action_space.shape[0]))  # type: ignore[index]
        action[:, 2] = -0.5 if step < DOWN - 3 else -0.2 if step < DOWN else 0.0
        if step >= DOWN:
            action[:, :2] = np.sin(0.4 * step)
        began = time.perf_counter()
        env.step(action)
        wall, state = time.perf_counter() - began, env.batch.world.state()
        rows.append((state.wrench["sensor"][:, :3].copy(), [state.report[name].mean() for name in ("newton", "linear")], wall))
    forces, counts, wall = (np.array(part) for part in zip(*rows[DOWN:], strict=True))
    return forces, counts, wall


if __name__ == "__main__":
    run(main, Args, __doc__)
