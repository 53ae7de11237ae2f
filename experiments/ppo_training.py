"""One training by stable-baselines3's PPO: segments that can be repeated exactly, checkpoints, evaluation on seeds never trained on.

A segment is some rollouts between two checkpoints. It begins with every environment at the start of an episode and with every random number
generator seeded from the run's seed and the number of steps done, so what follows a checkpoint depends on nothing but the checkpoint: a
training that is interrupted and resumed ends with the same weights, bit for bit, as one that was not (on one machine, with one number
of processes and one version of all libraries).
"""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import contextlib
import csv
import random
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from experiments.imitation import imitate
from experiments.ppo_learner import Checkpoint, Learner, Recipe, evaluate_learner
from raytac.errors import InputError
from raytac.io import FolderLock
from raytac.learn import append_row, keep_rows, segment_seed

__all__ = ["Training"]


class _Progress(BaseCallback):
    """One row of ``progress.csv`` a rollout."""

    def __init__(self, write: Callable[[dict[str, float]], None], done_s: float) -> None:
        super().__init__()
        self._write, self._begin = write, time.perf_counter() - done_s
        self._episodes: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        self._episodes += [info["episode"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        ended = self._episodes
        row = {"steps": self.num_timesteps, "wall_s": round(time.perf_counter() - self._begin, 2), "episodes": len(ended)}
        for name, key in (("return", "r"), ("length", "l"), ("success", "success")):
            row[name] = round(float(np.mean([episode[key] for episode in ended])), 4) if ended else ""  # type: ignore[assignment]
        row["std"] = round(float(self.model.policy.log_std.detach().exp().mean()), 4)  # type: ignore[attr-defined]
        self._write(row)
        for name, value in row.items():
            if value != "":
                self.logger.record(f"rollout/{name}", value)
        self._episodes = []


class Training:
    """A recipe in a folder: ``checkpoint.pt``, ``progress.csv``, ``evaluation.csv``, and ``events.*`` where TensorBoard is installed."""

    def __init__(self, recipe: Recipe, folder: Path, *, evaluation: int = 32, say: Callable[[str], None] = print) -> None:
        """Begin, or go on from the folder's checkpoint. The folder is locked until ``close``.

        Raises:
            InputError: the folder's checkpoint is of another recipe, or another training is running in the folder.
        """
        self.folder, self.recipe, self._evaluation, self._say = folder, recipe, evaluation, say
        self.path = folder / "checkpoint.pt"
        with contextlib.ExitStack() as opened:
            opened.enter_context(FolderLock(folder))
            self._begin(opened)
            self._opened = opened.pop_all()

    def _begin(self, opened: contextlib.ExitStack) -> None:
        recipe, folder = self.recipe, self.folder
        saved = Checkpoint.load(self.path) if self.path.exists() else None
        if saved is not None and replace(saved.recipe, device=recipe.device) != recipe:
            other = {k: v for k, v in asdict(saved.recipe).items() if v != getattr(recipe, k)}
            raise InputError("out", value=folder, rule=f"holds a training of another recipe, with {other}: name another folder")
        self.learner = Learner(recipe)
        opened.callback(self.learner.close)
        if saved is not None:
            self.learner.restore(saved)
        for name in ("progress.csv", "evaluation.csv"):
            keep_rows(folder / name, self.steps)
        self._wall = max(_last_wall(folder / name) for name in ("progress.csv", "evaluation.csv"))
        from stable_baselines3.common.logger import Logger, make_output_format

        formats = []
        with contextlib.suppress(ImportError, AssertionError):  # not installed: the CSV files hold all that it would show
            formats.append(make_output_format("tensorboard", str(folder)))
        self.learner.model.set_logger(Logger(str(folder), formats))

    def close(self) -> None:
        """Close the environments and let another training into the folder."""
        self._opened.close()

    @property
    def steps(self) -> int:
        """Environment steps done."""
        return self.learner.model.num_timesteps

    @property
    def is_done(self) -> bool:
        return self.steps >= self.recipe.total_timesteps

    def run_segment(self) -> None:
        """Train up to the next checkpoint, write it, and evaluate it."""
        recipe, model = self.recipe, self.learner.model
        _seed_all(recipe.seed, self.steps)
        env = model.get_env()
        assert env is not None
        env.seed(segment_seed(recipe.seed, self.steps))
        begin = time.perf_counter()
        if self.steps < recipe.imitation_steps:
            imitate(self.learner)
            self._wall += time.perf_counter() - begin
            return self._conclude()
        model._last_obs = None  # so that learn resets
        progress = _Progress(lambda row: append_row(self.folder / "progress.csv", row), self._wall)
        todo = min(recipe.segment * recipe.n_steps * recipe.num_envs, recipe.total_timesteps - self.steps)
        model.learn(todo, progress, log_interval=1, reset_num_timesteps=False)
        self._wall += time.perf_counter() - begin
        self._conclude()

    def _conclude(self) -> None:
        """Evaluate, write the checkpoint, and say how it is."""
        recipe = self.recipe
        result = evaluate_learner(self.learner, self._evaluation)
        low, high = result.interval
        row = {
            "steps": self.steps, "wall_s": round(self._wall, 2), "episodes": result.episodes,
            "success": result.successes / result.episodes, "low": low, "high": high,
            "return": result.mean_return, "length": result.mean_length,
        }  # fmt: skip
        # Before the checkpoint: a row too many is dropped by a resume, one that is missing never comes back.
        append_row(self.folder / "evaluation.csv", row)
        self.learner.checkpoint().save(self.path)
        self._say(
            f"{recipe.task} {recipe.tactile} seed {recipe.seed}: {self.steps} steps, {self._wall:.0f} s, "
            f"return {result.mean_return:.1f}, length {result.mean_length:.0f}, "
            f"success {result.successes}/{result.episodes} ({low:.2f} to {high:.2f})"
        )

    @property
    def wall_s(self) -> float:
        """Seconds of training so far, those before a resume too; evaluation is not in it."""
        return self._wall


def _seed_all(seed: int, steps: int) -> None:
    word = int(np.random.SeedSequence([seed, steps, 1]).generate_state(1)[0])
    random.seed(word)
    np.random.seed(word)
    torch.manual_seed(word)


def _last_wall(path: Path) -> float:
    if not path.exists():
        return 0.0
    with path.open(newline="", encoding="utf-8") as file:
        return max((float(row["wall_s"]) for row in csv.DictReader(file)), default=0.0)
