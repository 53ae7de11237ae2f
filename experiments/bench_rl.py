"""How many environment steps a second? Push cube, rigid pad, by what is observed; the time split into physics, observation and policy.

    python experiments/bench_rl.py --out runs/bench_rl
    python experiments/bench_rl.py --envs 16 --modes fots,table32 --steps 40

Modes: ``none`` (no touch), ``fots`` (9 x 11 marker displacements), ``table32`` (32 x 32 images of the Taxim table), ``raytrace64``
(64 x 64 ray-traced images). The policy is the multilayer perceptron of stable-baselines3's PPO, 2 x 64, in NumPy, with random weights,
a tenth of whose first two actions is taken and whose third is replaced by what presses the pad onto the cube with about 1 N: a random
policy would hardly touch it, and contact is what costs. Medians over steps; ``pressed`` says in how many environments the pad was touched.
"""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from raytac.device import resolve_device
from raytac.envs.push_cube import PushCubeVectorEnv
from raytac.errors import RaytacError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.options import CommonOptions, parse_names
from raytac.observe import ObservationSettings
from raytac.report.machine import machine

MODES: dict[str, ObservationSettings | None] = {
    "none": None,
    "fots": ObservationSettings(("markers",)),
    "table32": ObservationSettings(("rgb",), resolution=(32, 32), optics="taxim"),
    "raytrace64": ObservationSettings(("rgb",), resolution=(64, 64), optics="raytrace"),
}


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time steps of vectors of environments."""

    envs: int = 16
    """Number of environments."""
    modes: str = "fots,table32,raytrace64"
    """What is observed, joined by commas."""
    steps: int = 60
    """Steps that are timed, after a third as many to press the pad on."""


def main(args: Args) -> dict[str, Metric]:
    """Run all and write ``metrics.json``."""
    start = time.perf_counter()
    names = parse_names(args.modes, "modes", tuple(MODES))
    found: dict[str, Metric] = {"device": resolve_device(args.device), "envs": args.envs, "steps": args.steps, **machine()}
    with result_folder(args.out or Path("runs/bench_rl"), ("metrics.json",)) as folder:
        for name in names:
            found |= {f"push.{name}.{key}": value for key, value in timed(MODES[name], args).items()}
            shown = found[f"push.{name}.env_steps_per_s"]
            print(f"{name}: {shown:.0f} environment steps/s")
        found |= {
            "experiment": "bench_rl",
            "seed": args.seed,
            "wall_s": time.perf_counter() - start,
            **versions((*VERSIONED, "gymnasium")),
        }
        write_metrics(folder / "metrics.json", found)
    print(f"-> {args.out or Path('runs/bench_rl')}")
    return found


def timed(tactile: ObservationSettings | None, args: Args) -> dict[str, Metric]:
    """Keys of one mode."""
    env = PushCubeVectorEnv(args.envs, tactile=tactile, seed=args.seed, device=args.device)
    observation, _ = env.reset(seed=args.seed)
    policy = Policy(observation, env.single_action_space.shape[0])  # type: ignore[index]
    wall, share, pressed = [], [], []
    for step in range(args.steps // 3 + args.steps):
        begin, before = time.perf_counter(), dict(env.batch.time_s)
        action = policy(observation)
        force = -env.batch.world.state().wrench["sensor"][:, 2]
        action[:, :2] *= 0.1  # so that the pad stays on the cube
        action[:, 2] = np.clip(0.3 * (force - 1.0), -1.0, 1.0)
        acted = time.perf_counter()
        observation = env.step(action)[0]
        done = time.perf_counter()
        if step < args.steps // 3:
            continue
        spent = {name: value - before[name] for name, value in env.batch.time_s.items()}
        wall.append(done - begin)
        share.append((spent["physics"], spent["observation"], acted - begin))
        pressed.append((force > 0.0).mean())
    middle = np.median(np.array(share), axis=0)
    found = {f"{name}_ms": 1e3 * float(value) for name, value in zip(("physics", "observation", "policy"), middle, strict=True)}
    return {
        "env_steps_per_s": args.envs / float(np.median(wall)),
        "env_steps_per_s_best": args.envs / float(min(wall)),
        "pressed": float(np.mean(pressed)),
        **found,
    }


class Policy:
    """Two hidden layers of 64 with tanh on all observations, flat."""

    def __init__(self, observation: dict[str, np.ndarray], actions: int) -> None:
        rng, size = np.random.default_rng(0), self.flat(observation).shape[1]
        sizes = (size, 64, 64, actions)
        self.weights = [rng.normal(0.0, a**-0.5, (a, b)).astype(np.float32) for a, b in itertools.pairwise(sizes)]

    @staticmethod
    def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate(
            [v.reshape(len(v), -1) / np.float32(255 if v.dtype == np.uint8 else 1) for v in observation.values()], axis=1
        )

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        values = self.flat(observation)
        for weights in self.weights:
            values = np.tanh(values @ weights)
        return values.astype(float)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except RaytacError as error:
        sys.exit(f"error: {error}")
