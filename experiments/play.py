"""Watch a policy, as ``raytac play`` does: a film and a success rate. Either of ``train_ppo.py`` or of ``raytac train``.

    python experiments/play.py experiments/policies/balance_pole_wrench.pt
    python experiments/play.py experiments/policies/push_cube_markers.pt --physics ipc --episodes 4 --no-film
    python experiments/play.py runs/train/PushCube/wrench/seed0/checkpoint.pt

A checkpoint of ``train_ppo.py`` is a network of stable-baselines3, and needs raytac[rl]. One of ``raytac train`` is of rsl_rl, and
needs no PyTorch. Files, options and seeds are those of ``raytac play``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from experiments.running import run
from raytac.io import CommonOptions, Metric

if TYPE_CHECKING:
    from raytac.learn import Player


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Play a checkpoint; ``seed`` is the number of the film's episode among the held-out ones."""

    checkpoint: tyro.conf.Positional[Path]
    """A file .pt that ``train_ppo.py`` or ``raytac train`` has written."""
    physics: str | None = None
    """Pads that it is played on: ``rigid`` or ``ipc``, those that it was trained on if not given."""
    episodes: int = 100
    """Episodes that are played for the success rate; 0: the film alone."""
    num_envs: int = 16
    """Most of them that run at a time."""
    film: bool = True
    """Draw an episode."""
    mp4: bool = False
    """Write the film as MP4 instead of as GIF."""
    optics: str = "raytrace"
    """Optical mode of the sensors' images in the film, where the policy is not given images itself."""


def player_of(path: Path) -> Player:
    """Player of a checkpoint of either training; the file says which. Raises ``InputError`` for a file that is none."""
    from raytac.envs import FlatPolicy
    from raytac.learn import PolicyPlayer

    if FlatPolicy.is_one(path):
        return PolicyPlayer(path)
    from experiments.ppo_learner import CheckpointPlayer

    return CheckpointPlayer(path)


def main(args: Args) -> dict[str, Metric]:
    """Play it and write the film, the strip and the metrics."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported, which is below
    from raytac.learn import play_policy

    player = player_of(args.checkpoint)
    out = args.folder("play", player.name)
    metrics = play_policy(
        player, out, episodes=args.episodes, num_envs=args.num_envs, physics=args.physics, film=args.film, mp4=args.mp4,
        optics=args.optics, device=args.device, seed=args.seed,
    )  # fmt: skip
    if args.episodes:
        print(f"{player.task}: success {metrics['successes']}/{metrics['episodes']}, return {metrics['return']:.1f}")
    print(f"written: {out}")
    return metrics


if __name__ == "__main__":
    run(main, Args, __doc__)
