"""What do substeps and tolerances of soft worlds change in the forces, and what do they cost?

    python experiments/soft_world_accuracy.py --device cpu --out runs/soft_world_accuracy
    python experiments/soft_world_accuracy.py --still --envs 1 --device cpu --out runs/soft_world_accuracy_still

A pad comes down on a cube or a ball and holds it with about 1 N while it is moved to and fro (``bench_rl.py``'s policy). The actions of the
first run are repeated with each of ``ACCURACIES``. Keys ``soft_world.<task>.<accuracy>.<key>``: iterations ``newton`` and ``linear`` of an
environment in a control step, its ``solves`` and the ``solves_most`` of any environment, and ``force_error``: root mean square of the
change of the force on the pad against ``fine``, over the mean force, once the pad has landed. That of ``finer`` says how exact ``fine`` is.
With ``--still`` the pad is only pressed on, and not moved to and fro.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from experiments.bench_rl import TASKS
from experiments.running import recorded, run
from raytac.checks import check_whole
from raytac.io import CommonOptions, Metric
from raytac.physics import Ipc, SceneSettings, SubstepLimits
from raytac.report import machine

SHIPPED = SceneSettings()
TIGHT = replace(SHIPPED, tolerance=4e-9, linear_tolerance=1e-7)
ACCURACIES = {
    "shipped": SHIPPED,
    "substeps_0.1mm": replace(SHIPPED, substeps=SubstepLimits()),
    "tight": TIGHT,
    "fine": replace(TIGHT, substeps=SubstepLimits(step=2.5e-5, turn=9e-3)),
    "finer": replace(TIGHT, substeps=SubstepLimits(step=1.25e-5, turn=4.5e-3, most=128)),
}
"""Tight tolerances, and these with substeps of an eighth and of a sixteenth of the length."""
LANDING = 4
"""Control steps from the first touch until the pad has landed."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Accuracy of soft worlds."""

    envs: int = 4
    """Environments, each with actions of its own."""
    steps: int = 28
    """Control steps, from a pad in the air on."""
    still: bool = False
    """Do not move the pad to and fro."""


def main(args: Args) -> dict[str, Metric]:
    """Play all tasks with all accuracies and write ``metrics.json``."""
    check_whole("envs", args.envs)
    check_whole("steps", args.steps)
    with recorded(args, "soft_world_accuracy", owned=("metrics.json",), packages=("gymnasium",)) as (_, metrics):
        metrics |= {"envs": args.envs, "steps": args.steps, **machine()}
        for task in TASKS:
            actions, played = None, {}
            for name, accuracy in ACCURACIES.items():
                actions, *played[name] = play(task, accuracy, actions, args)
            exact, _ = played["fine"]
            landed = int(np.flatnonzero(np.abs(exact[:, :, 2]).max(axis=1))[0]) + LANDING
            for name, (forces, counts) in played.items():
                change = np.linalg.norm(forces - exact, axis=-1)[landed:]
                result: dict[str, Metric] = {
                    "force_error": float(np.sqrt((change**2).mean()) / np.linalg.norm(exact[landed:], axis=-1).mean()),
                    "solves_most": float(counts[landed:, 2].max(axis=1).mean()),
                }
                result |= dict(zip(("newton", "linear", "solves"), counts[landed:].mean(axis=(0, 2)).tolist(), strict=True))
                metrics |= {f"soft_world.{TASKS[task][0]}.{name}.{key}": value for key, value in result.items()}
                print(task, name, ", ".join(f"{key} {value:.4g}" for key, value in result.items()), flush=True)
    return metrics


def play(task: str, accuracy: SceneSettings, actions: np.ndarray | None, args: Args) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions (steps, B, n), forces (steps, B, 3) [N] and iterations (steps, 3, B); actions that hold 1 N if none are given."""
    _, environments, gain = TASKS[task]
    env = environments(args.envs, physics=Ipc(accuracy=accuracy), tactile=None, seed=args.seed, device=args.device)
    env.reset(seed=args.seed)
    rng, size = np.random.default_rng(args.seed), env.single_action_space.shape[0]  # type: ignore[index]
    rows = []
    for step in range(args.steps):
        if actions is None:
            force = -env.batch.world.state().wrench["sensor"][:, 2]
            action = (not args.still) * rng.uniform(-0.1, 0.1, (args.envs, size))
            action[:, 2] = np.where(force > 0.0, np.clip(gain * (force - 1.0), -1.0, 1.0), -0.3)
        else:
            action = actions[step]
        env.step(action)
        state = env.batch.world.state()
        counts = np.array([state.report[name] for name in ("newton", "linear", "substeps")], float)
        rows.append((action, state.wrench["sensor"][:, :3].copy(), counts))
    played, forces, counts = (np.array(part) for part in zip(*rows, strict=True))
    return played, forces, counts


if __name__ == "__main__":
    run(main, Args, __doc__)
