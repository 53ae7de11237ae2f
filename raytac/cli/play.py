"""``raytac play``: a policy watched and counted."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

import tyro

from raytac.cli.shared import SolverOptions, named, print_paths
from raytac.optics import OPTICS
from raytac.physics import PHYSICS, Ipc


@dataclass(frozen=True, kw_only=True)
class PlayArgs(SolverOptions):
    """Play a policy: a film of the scene beside what its sensors see, and a success rate.

    Writes film.gif, strip.png (four moments) and metrics.json. Episodes are held out: no training has seen their starts. The film needs
    MuJoCo's offscreen renderer (MUJOCO_GL, egl unless it is set); without it the rate is counted all the same. Without --out the folder
    is runs/play/POLICY. Needs raytac[envs], and no PyTorch.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    """Name of a shipped policy, as push_cube_ppo, path of a policy.pt, or scripted."""
    task: str | None = None
    """Task of the scripted policy, as LiftCube; a trained one knows its own."""
    physics: Annotated[str | None, named(PHYSICS.names)] = None
    """Pads that it is played on, those that it was trained on if not given.

    Soft ones take a CPU seconds a step."""
    episodes: int = 100
    """Episodes that are played for the success rate; 0 is the film alone."""
    num_envs: int = 16
    """Most of them that run at a time."""
    film: bool = True
    """Draw an episode; seed is its number among the held-out ones."""
    mp4: bool = False
    """Write the film as MP4 in place of a GIF; needs raytac[video]."""
    optics: Annotated[str, named(OPTICS.names)] = "raytrace"
    """Optical mode of the images in the film; the policy is not given them."""

    def run(self) -> int:
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported, which is below
        from raytac.learn import find_player, play_policy

        player = find_player(self.policy, self.task)
        self.prepare_warp(soft=isinstance(PHYSICS.config(self.physics or player.physics), Ipc))
        out = self.folder("play", player.name)
        metrics = play_policy(
            player,
            out,
            episodes=self.episodes,
            num_envs=self.num_envs,
            physics=self.physics,
            film=self.film,
            mp4=self.mp4,
            optics=self.optics,
            device=self.device,
            seed=self.seed,
        )
        if self.episodes:
            print(
                f"{metrics['task']}: success {metrics['successes']}/{metrics['episodes']} "
                f"(95 %: {metrics['success_low']:.3f} to {metrics['success_high']:.3f}), "
                f"return {metrics['return']:.1f}, length {metrics['length']:.0f}"
            )
        return print_paths(
            sorted(out / name for name in ("film.gif", "film.mp4", "strip.png", "metrics.json") if (out / name).exists())
        )
