"""Policies in held-out episodes: their success, and tables of rows that a resume cuts."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

import raytac.envs
from raytac.envs.environments import TactileVectorEnv
from raytac.envs.scripted import SCRIPTED
from raytac.io.atomic import write_atomic
from raytac.optics.base import OpticsConfig
from raytac.report.measure import wilson_interval

KINDS: Mapping[str, type[TactileVectorEnv]] = {name: getattr(raytac.envs, f"{name}VectorEnv") for name in SCRIPTED}
"""Vector of each task."""
HELD_OUT = 2**31
"""Seeds of evaluation start here; those of training are below."""


class Outcome(NamedTuple):
    """Result of one step in B environments, each (B,)."""

    reward: np.ndarray
    ended: np.ndarray
    success: np.ndarray
    """Of an episode that has ended: that of its last step."""
    failed: np.ndarray
    """Physics broke down."""


class Episodes(Protocol):
    """Environments of one task, each of which begins again where it ends, and who acts in them."""

    @property
    def num_envs(self) -> int: ...

    def reset(self, seed: int) -> None:
        """Begin all episodes, environment b with seed + b."""
        ...

    def step(self) -> Outcome:
        """One action in all environments."""
        ...


class ShownEpisodes(Episodes, Protocol):
    """Episodes that can be drawn."""

    @property
    def control_timestep(self) -> float:
        """Duration of a step [s]."""
        ...

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that a picture shows."""
        ...

    def picture(self) -> np.ndarray:
        """Scene and sensors of environment 0, 8 bits (H, W, 3); of episodes that are shown."""
        ...


class Player(Protocol):
    """Policy of a task that makes the environments in which it acts."""

    name: str
    task: str
    physics: str
    """Pads that it was trained on."""

    def episodes(self, num_envs: int, *, physics: str, device: str, shown: OpticsConfig | str | None = None) -> ShownEpisodes:
        """Environments on such pads; with ``shown``, an optical mode, they can be drawn."""
        ...


@dataclass(frozen=True)
class Evaluation:
    """Held-out episodes of the deterministic policy; success is that of an episode's last step."""

    episodes: int
    successes: int
    mean_return: float
    mean_length: float
    failures: int
    """Episodes that ended because the physics broke down."""

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return wilson_interval(self.successes, self.episodes)


def evaluate(played: Episodes, count: int, *, first_seed: int = 0) -> Evaluation:
    """``count`` episodes from the held-out seeds ``first_seed``, …, one a seed."""
    returns, lengths, successes, failures = [], [], 0, 0
    while len(returns) < count:
        played.reset(HELD_OUT + first_seed + len(returns))
        running, earned, steps = np.arange(played.num_envs) < count - len(returns), np.zeros(played.num_envs), 0
        while running.any():
            result = played.step()
            earned, steps = earned + result.reward * running, steps + 1
            ended = running & (np.asarray(result.ended) > 0.0)
            returns += earned[ended].tolist()
            lengths += [steps] * int(ended.sum())
            successes += int(np.asarray(result.success)[ended].sum())
            failures += int(np.asarray(result.failed)[ended].sum())
            running &= ~ended
    return Evaluation(count, successes, float(np.mean(returns)), float(np.mean(lengths)), failures)


def segment_seed(seed: int, done: int) -> int:
    """Seed of the first environment after ``done`` steps or updates, below ``HELD_OUT``."""
    return int(np.random.SeedSequence([seed, done]).generate_state(1)[0]) % (HELD_OUT - 2**20)


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row to a CSV file, with the names above the first."""
    fresh = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow(row)


def keep_rows(path: Path, steps: int) -> None:
    """Drop rows of more than ``steps``: of a training beyond its last checkpoint."""
    if not path.exists():
        return
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if int(row["steps"]) <= steps]
    if not rows:
        path.unlink()
        return
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(path, text.getvalue().encode())
