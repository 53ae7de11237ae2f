"""How do policies that were trained on rigid pads do on soft ones? Success on both, from the same held-out starts.

    python experiments/soft_policies.py --episodes 4 --num-envs 4
    python experiments/soft_policies.py --policies roll_ball_ppo --episodes 64 --num-envs 64 --device cuda

Plays each policy as ``raytac play --physics rigid`` and ``--physics ipc`` do and writes, for each task and pads, ``success`` with its
95 % interval, ``return``, ``length``, ``failed`` (episodes that ended since the physics broke down) and ``minutes``. An interrupted run
goes on where it stopped: ``rows.json`` has what was played.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from experiments.running import recorded, resumed, run, store
from raytac.errors import InputError
from raytac.io import CommonOptions, Metric, parse_names
from raytac.learn import find_player, success_rate
from raytac.physics import PHYSICS
from raytac.report import machine

_ROWS = "rows.json"


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Play policies on rigid and on soft pads."""

    policies: str = "push_cube_ppo,roll_ball_ppo,balance_pole_ppo"
    """Shipped policies or files of ``raytac train``, joined by commas; ``scripted:<task>`` is a task's scripted policy."""
    episodes: int = 4
    """Episodes of each policy on each kind of pads."""
    num_envs: int = 4
    """Most of them that run at a time."""


def main(args: Args) -> dict[str, Metric]:
    """Play all and write ``metrics.json``."""
    if args.episodes < 1:
        raise InputError("episodes", value=args.episodes, rule="must be 1 or more")
    names, device = parse_names(args.policies, "policies"), "cpu" if args.device == "auto" else args.device
    settings = {"episodes": args.episodes, "num_envs": args.num_envs, "device": device}
    kept = (args.out or Path("runs/soft_policies")) / _ROWS
    rows = [row for row in resumed(kept, settings) if row["policy"] in names]
    kept.parent.mkdir(parents=True, exist_ok=True)
    with recorded(args, "soft_policies", device=device, packages=("gymnasium",)) as (_, metrics):
        for policy in names:
            for physics in PHYSICS.names:
                if any((row["policy"], row["physics"]) == (policy, physics) for row in rows):
                    continue
                rows.append(played(policy, physics, args))
                store(kept, settings, rows)
                print(text_of(rows[-1]), flush=True)
        metrics |= {"episodes": args.episodes, "num_envs": args.num_envs, **machine()}
        for row in rows:
            prefix = f"{row['task']}.{row['physics']}"
            metrics |= {f"{prefix}.{key}": row[key] for key in row if key not in ("policy", "physics", "task")}
    return metrics


def played(policy: str, physics: str, args: Args) -> dict[str, Metric]:
    """Success of a policy on pads of one kind."""
    is_scripted = policy.startswith("scripted:")
    player = find_player("scripted", policy.removeprefix("scripted:")) if is_scripted else find_player(policy)
    begin = time.perf_counter()
    result = success_rate(player, args.episodes, num_envs=args.num_envs, physics=physics, device=args.device)
    low, high = result.interval
    return {
        "policy": policy,
        "physics": physics,
        "task": player.task,
        "success": result.successes / result.episodes,
        "successes": result.successes,
        "success_low": low,
        "success_high": high,
        "return": result.mean_return,
        "length": result.mean_length,
        "failed": result.failures,
        "minutes": (time.perf_counter() - begin) / 60.0,
    }


def text_of(row: dict[str, Metric]) -> str:
    """One line about a policy on pads of one kind."""
    return (
        f"{row['policy']} on {row['physics']}: {row['successes']} successes, return {row['return']:.1f}, "
        f"{row['failed']} failed, {row['minutes']:.1f} minutes"
    )


if __name__ == "__main__":
    run(main, Args, __doc__)
