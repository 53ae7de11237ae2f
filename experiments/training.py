"""Common parts of trainings: held-out seeds, results of an evaluation, and tables of rows that a resume cuts."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import raytac.envs
from raytac.envs import SCRIPTED, TactileVectorEnv
from raytac.errors import InputError
from raytac.io import parse_names, write_atomic
from raytac.report import wilson_interval

__all__ = ["HELD_OUT", "KINDS", "PHYSICS", "Evaluation", "append_row", "keep_rows", "parse_seeds", "segment_seed"]

KINDS: Mapping[str, type[TactileVectorEnv]] = {name: getattr(raytac.envs, f"{name}VectorEnv") for name in SCRIPTED}
"""Vector of each task."""
PHYSICS = ("rigid", "ipc")
"""Pads that a task can be trained and played on."""
HELD_OUT = 2**31
"""Seeds of evaluation start here; those of training are below."""


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


def segment_seed(seed: int, done: int) -> int:
    """Seed of the first environment in what follows after ``done`` steps or updates; below ``HELD_OUT``."""
    return int(np.random.SeedSequence([seed, done]).generate_state(1)[0]) % (HELD_OUT - 2**20)


def parse_seeds(text: str) -> list[int]:
    """Whole numbers joined by commas. Raises ``InputError`` for others."""
    names = parse_names(text, "seeds")
    for name in names:
        if not name.isdecimal():
            raise InputError("seeds", value=name, rule="must be whole numbers >= 0 joined by commas")
    return [int(name) for name in names]


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row to a CSV file, with the names above the first."""
    fresh = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if fresh:
            writer.writeheader()
        writer.writerow(row)


def keep_rows(path: Path, steps: int) -> None:
    """Drop rows that a training beyond its last checkpoint has left: of more than ``steps``."""
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
