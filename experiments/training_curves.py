"""Learning curves of ``experiments/train_ppo.py``: median and range over seeds, with and without touch.

python experiments/training_curves.py runs/train_ppo/PushCube
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from raytac.errors import InputError, RaytacError

__all__ = ["draw_curves"]

_COLOURS = ("#2b6cb0", "#b7791f", "#2f855a", "#805ad5")


def draw_curves(folder: Path, *, title: str | None = None) -> Path:
    """``curves.png`` of all trainings under a folder: success rate and return on held-out seeds by environment steps; its path.

    Raises:
        InputError: no training was evaluated there.
    """
    kinds = sorted(
        {path.parent.parent.name for path in folder.glob("*/seed*/evaluation.csv")}, key=lambda name: (name == "none", name)
    )
    if not kinds:
        raise InputError("folder", value=folder, rule="must hold trainings: <tactile>/seed<k>/evaluation.csv")
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    for kind, colour in zip(kinds, _COLOURS * len(kinds), strict=False):
        runs = [_columns(path) for path in sorted(folder.glob(f"{kind}/seed*/evaluation.csv"))]
        label = f"{'no touch' if kind == 'none' else 'touch' if kind == 'task' else kind}, {len(runs)} seeds"
        for axes, key, factor in ((left, "success", 100.0), (right, "return", 1.0)):
            steps, values = _common([(run["steps"], factor * run[key]) for run in runs])
            axes.fill_between(1e-3 * steps, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.2, linewidth=0)
            axes.plot(1e-3 * steps, np.median(values, axis=0), color=colour, label=label)
    left.set(ylabel="success on held-out seeds [%]", ylim=(-3, 103))
    right.set(ylabel="return")
    for axes in (left, right):
        axes.set_xlabel("environment steps [thousands]")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False, fontsize="small", loc="best")
    figure.suptitle(f"{title or folder.name}: median and range over seeds", fontsize="medium")
    path = folder / "curves.png"
    figure.savefig(path, dpi=160)
    return path


def _columns(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in ("steps", "success", "return")}


def _common(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n,) up to where the shortest run ends, and values (runs, n) there, between evaluations along straight lines."""
    end = min(steps[-1] for steps, _ in runs)
    grid = np.unique(np.concatenate([steps[steps <= end] for steps, _ in runs]))
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in runs])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python experiments/training_curves.py FOLDER")
    try:
        print(draw_curves(Path(sys.argv[1])))
    except RaytacError as error:
        sys.exit(f"error: {error}")
