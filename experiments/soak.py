"""Do the tasks run on and on? Random actions for 100,000 environment steps each: exceptions, numbers that are not finite, memory.

    python experiments/soak.py --out runs/soak
    python experiments/soak.py --task RollBall --steps 2000 --out runs/soak_roll

Every block of steps is recorded in ``<task>.json``; a run that was interrupted goes on after its last block, with new episodes. An
exception ends the run where it is raised. Memory grows by what the process holds after a sitting's last block beyond what it held after a
tenth of its blocks: by then what is made once is made, such as kernels for every number of environments that begin again together.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import resumed, run, store
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io import VERSIONED, CommonOptions, FolderLock, Metric, parse_names, versions, write_metrics
from raytac.learn import KINDS
from raytac.observe import MODALITIES, ObservationSettings
from raytac.report import machine


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Random actions in vectors of environments."""

    task: str = ",".join(KINDS)
    """Which tasks, joined by commas."""
    steps: int = 100_000
    """Environment steps of each task."""
    envs: int = 16
    """Environments in a vector."""
    modalities: str = "markers,wrench"
    """What is observed of touch, joined by commas."""
    block: int = 1600
    """Environment steps between two records."""


@dataclass(frozen=True)
class Block:
    """What happened in some steps."""

    sitting: int
    """Which start of this program it was in."""
    steps: int
    episodes: int
    failed: int
    """Environments whose physics broke down."""
    nonfinite: int
    """Observations and rewards with a number in them that is not finite."""
    seconds: float
    memory_mb: float
    """Resident at the end."""


def main(args: Args) -> dict[str, Metric]:
    """Run what is missing of every task and write ``metrics.json``."""
    start = time.perf_counter()
    names = parse_names(args.task, "task", tuple(KINDS))
    modalities = parse_names(args.modalities, "modalities", MODALITIES)
    for name, value in (("steps", args.steps), ("envs", args.envs), ("block", args.block)):
        if value < 1:
            raise InputError(name, value=value, rule="must be 1 or more")
    device = resolve_device(args.device)
    out = args.out or Path("runs/soak")
    with FolderLock(out):
        kept = {name: [Block(**row) for row in resumed(out / f"{name}.json", settings_of(args))] for name in names}
        found: dict[str, Metric] = {"experiment": "soak", "device": device, "seed": args.seed, **machine()}
        for name in names:
            blocks = remaining_blocks(name, args, modalities, kept[name], out / f"{name}.json")
            found |= {f"{name}.{key}": value for key, value in summary(blocks).items()}
            print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in summary(blocks).items()), flush=True)
        found |= {"wall_s": time.perf_counter() - start, **versions((*VERSIONED, "gymnasium"))}
        write_metrics(out / "metrics.json", found)
    print(f"-> {out}")
    return found


def remaining_blocks(name: str, args: Args, modalities: tuple[str, ...], blocks: list[Block], path: Path) -> list[Block]:
    """Play the remaining steps of one task, recorded block by block."""
    done = sum(block.steps for block in blocks)
    if done >= args.steps:
        return blocks
    blocks, sitting = list(blocks), blocks[-1].sitting + 1 if blocks else 0
    env = KINDS[name](args.envs, tactile=ObservationSettings(modalities), device=args.device, seed=args.seed)
    env.reset(seed=args.seed + done)
    rng = np.random.default_rng((args.seed, done))
    while done < args.steps:
        begin, steps, episodes, failed, nonfinite = time.perf_counter(), 0, 0, 0, 0
        while steps < args.block and done + steps < args.steps:
            actions = rng.uniform(-1.0, 1.0, env.action_space.shape)  # type: ignore[arg-type]
            observation, reward, terminated, truncated, infos = env.step(actions)
            last = [one for one in infos.get("final_obs", ()) if one is not None]
            nonfinite += sum(count_nonfinite(one) for one in (observation, {"reward": reward}, *last))
            episodes += int((terminated | truncated).sum())
            failed += int(infos["failed"].sum())
            steps += args.envs
        blocks.append(Block(sitting, steps, episodes, failed, nonfinite, time.perf_counter() - begin, memory_mb()))
        done += steps
        store(path, settings_of(args), [vars(block) for block in blocks])
        print(f"{name} {done}: {blocks[-1]}", flush=True)
    return blocks


def count_nonfinite(arrays: dict[str, np.ndarray]) -> int:
    """Number of arrays with a number in them that is not finite."""
    return sum(not np.isfinite(values).all() for values in arrays.values())


def summary(blocks: list[Block]) -> dict[str, Metric]:
    """Keys of one task."""
    growth = 0.0
    for sitting in {block.sitting for block in blocks}:
        memory = [block.memory_mb for block in blocks if block.sitting == sitting]
        growth = max(growth, memory[-1] - memory[len(memory) // 10])
    steps, seconds = sum(block.steps for block in blocks), sum(block.seconds for block in blocks)
    return {
        "steps": steps,
        "nonfinite": sum(block.nonfinite for block in blocks),
        "failed": sum(block.failed for block in blocks),
        "episodes": sum(block.episodes for block in blocks),
        "sittings": len({block.sitting for block in blocks}),
        "memory_growth_mb": growth,
        "memory_mb": max(block.memory_mb for block in blocks),
        "env_steps_per_s": steps / seconds,
    }


def memory_mb() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text("utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def settings_of(args: Args) -> dict[str, object]:
    """What runs that are joined must have in common."""
    return {"envs": args.envs, "modalities": args.modalities, "seed": args.seed, "block": args.block}


if __name__ == "__main__":
    run(main, Args, __doc__)
