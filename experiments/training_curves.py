"""Learning curves of ``experiments/train_ppo.py``: every seed and their median, with and without touch.

    python experiments/training_curves.py runs/train_ppo/PushCube
    python experiments/training_curves.py "Pole=runs/pole_*" "Cube=runs/push_0,runs/push_1" --out curves.png

The first draws success and return of one folder into its ``curves.png``, as ``train_ppo.py`` does at its end. The second draws success
alone, one panel an argument: a title and the folders whose trainings belong together, names or patterns joined by commas. So trainings
that ran in processes of their own, each with its own ``--out``, become one figure.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.running import run
from raytac.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_curves", "draw_panels"]

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Of M. Okabe and K. Ito, told apart with every kind of colour vision."""


@dataclass(frozen=True)
class Args:
    """Draw learning curves."""

    panels: tyro.conf.Positional[tuple[str, ...]]
    """One folder, or panels ``TITLE=FOLDER,FOLDER``."""
    out: Path = Path("curves.png")
    """Picture to write, of panels; a folder alone gets its own ``curves.png``."""
    columns: int = 4
    """Panels in a row."""


def draw_curves(folder: Path, *, title: str | None = None) -> Path:
    """``curves.png`` of all trainings under a folder: success rate and return on held-out seeds by environment steps; its path.

    Raises:
        InputError: no training was evaluated there.
    """
    runs = _runs([folder])
    figure = Figure(figsize=(7.2, 2.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw(left, runs, "success")
    _draw(right, runs, "return")
    left.legend(frameon=False, fontsize="small", loc="best")
    figure.suptitle(title or folder.name, fontsize="medium")
    path = folder / "curves.png"
    figure.savefig(path, dpi=160)
    return path


def draw_panels(panels: Mapping[str, Sequence[Path]], path: Path, *, columns: int = 4) -> Path:
    """Success rates by environment steps of several groups of folders beside each other; ``panels``: title to folders.

    Raises:
        InputError: no training was evaluated in a group, or the folders of one have the same touch and seed twice.
    """
    found = {title: _runs(folders) for title, folders in panels.items()}
    columns = min(columns, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(2.5 * columns, 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for one in axes[len(found) :]:
        one.set_visible(False)
    for k, (one, (title, runs)) in enumerate(zip(axes, found.items(), strict=False)):
        _draw(one, runs, "success")
        one.set_title(title, fontsize="small", loc="left", pad=18)
        if k % columns:
            one.set_ylabel("")
        above = {"loc": "lower left", "bbox_to_anchor": (-0.02, 0.99), "ncols": 2}  # curves may be anywhere
        one.legend(
            frameon=False, fontsize="x-small", handlelength=1.6, handletextpad=0.5, columnspacing=1.0, borderpad=0.2, **above
        )
    figure.savefig(path, dpi=200)
    return path


def _runs(folders: Sequence[Path]) -> dict[str, list[dict[str, np.ndarray]]]:
    """Evaluations of the trainings in folders by what was felt, no touch last."""
    found: dict[tuple[str, str], Path] = {}
    for folder in folders:
        for path in sorted(folder.glob("*/seed*/evaluation.csv")):
            key = path.parent.parent.name, path.parent.name
            if key in found:
                rule = f"holds {key[0]}/{key[1]}, which is in {found[key].parents[2]} already"
                raise InputError("folder", value=str(folder), rule=rule)
            found[key] = path
    if not found:
        value = ", ".join(str(folder) for folder in folders)
        raise InputError("folder", value=value, rule="must hold trainings: <tactile>/seed<k>/evaluation.csv")
    kinds = sorted({kind for kind, _ in found}, key=lambda kind: (kind == "none", kind))
    return {kind: [_columns(path) for (own, _), path in sorted(found.items()) if own == kind] for kind in kinds}


def _draw(axes: Axes, runs: Mapping[str, Sequence[Mapping[str, np.ndarray]]], key: str) -> None:
    """Thin lines are seeds; the thick one their median, up to where the shortest ends."""
    factor = 100.0 if key == "success" else 1.0
    for kind, colour in zip(runs, _COLOURS * len(runs), strict=False):
        mine, style = runs[kind], "--" if kind == "none" else "-"
        for curve in mine:
            axes.plot(1e-3 * curve["steps"], factor * curve[key], style, color=colour, alpha=0.45, linewidth=0.7)
        steps, values = _common([(curve["steps"], factor * curve[key]) for curve in mine])
        name = {"none": "no touch", "task": "touch"}.get(kind, kind)
        label = f"{name} (n = {len(mine)})"
        axes.plot(1e-3 * steps, np.median(values, axis=0), style, color=colour, linewidth=2.0, label=label)
    if key == "success":
        axes.set_ylim(-3, 103)
    axes.set_xlim(left=0.0)
    axes.set_ylabel("success on held-out seeds [%]" if key == "success" else key, fontsize="small")
    axes.set_xlabel("environment steps [thousands]", fontsize="small")
    axes.tick_params(labelsize="small")
    axes.grid(alpha=0.3, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _columns(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in ("steps", "success", "return")}


def _common(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Steps (n,) up to where the shortest run ends, and values (runs, n) there, between evaluations along straight lines."""
    end = min(steps[-1] for steps, _ in runs)
    grid = np.unique(np.concatenate([steps[steps <= end] for steps, _ in runs]))
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in runs])


def _folders(text: str) -> list[Path]:
    """Folders by names or patterns joined by commas."""
    found: list[Path] = []
    for name in text.split(","):
        at = Path(name)
        matches = sorted(Path(at.anchor).glob(str(at.relative_to(at.anchor)))) if any(c in name for c in "*?[") else [at]
        if not matches:
            raise InputError("folder", value=name, rule="must match a folder that exists")
        found += matches
    return found


def main(args: Args) -> Path:
    """Draw one folder or panels; the picture's path.

    Raises:
        InputError: no panels, folders without a title beside others, or as ``draw_panels``.
    """
    if len(args.panels) == 1 and "=" not in args.panels[0]:
        return draw_curves(Path(args.panels[0]))
    panels: dict[str, list[Path]] = {}
    for text in args.panels:
        title, _, folders = text.partition("=")
        if not (title and folders) or title in panels:
            raise InputError("panels", value=text, rule="must be TITLE=FOLDER,FOLDER with a title of its own")
        panels[title] = _folders(folders)
    if not panels:
        raise InputError("panels", value=(), rule="must name a folder, or panels TITLE=FOLDER,FOLDER")
    return draw_panels(panels, args.out, columns=args.columns)


if __name__ == "__main__":
    run(lambda args: print(main(args)), Args, __doc__)
