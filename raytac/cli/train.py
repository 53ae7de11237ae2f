"""``raytac train``: policies for the tasks, by PPO."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from raytac.cli.shared import kept_if_interrupted, print_paths
from raytac.io.options import DeviceName
from raytac.learn.settings import PpoSettings
from raytac.warp_messages import quiet_warp


@dataclass(frozen=True, kw_only=True)
class TrainArgs(PpoSettings):
    """Train a task by PPO alone, without demonstrations, with rsl_rl's PPO.

    Each pair of touch and seed is one training in OUT/TOUCH/seedK/: progress.csv, evaluation.csv (held-out episodes of the deterministic
    policy), checkpoint.pt, policy.pt (which raytac play and raytac view play) and metrics.json; TensorBoard's events too, where it is
    installed. The same command again goes on from the checkpoints, after Ctrl-C, a crash or --minutes. OUT/metrics.json gathers all.
    Without --out the folder is runs/train/TASK, with soft pads TASK_ipc. Needs raytac[rl], with --worlds mujoco_warp raytac[gpu,rl].
    """

    out: Path | None = None
    """Folder to write to, created if need be; one under runs/ for the task if not given."""
    device: DeviceName = "auto"
    """Device of the networks, and of the worlds of mujoco_warp; auto is CUDA if it works."""
    verbose: bool = False
    """Let Warp, in which contacts are computed, list devices and the kernels that it loads."""

    def __post_init__(self) -> None:
        """Nothing: settings are checked by ``run``, whose errors are one line."""

    def run(self) -> int:
        settings = PpoSettings(**{one.name: getattr(self, one.name) for one in fields(PpoSettings)})
        from raytac.learn import train_policies

        quiet_warp(not self.verbose)
        out = self.out or Path("runs", "train", self.task if self.physics == "rigid" else f"{self.task}_{self.physics}")
        with kept_if_interrupted(f"checkpoints that were written are kept in {out}"):
            train_policies(settings, out, device=self.device)
        return print_paths([out / "metrics.json"])
