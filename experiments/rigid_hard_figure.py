"""One picture of the hard cases of rigid pads: drops, creep, a reversal, and every check as a share of its bound."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

__all__ = ["draw"]

Row = dict[str, Any]
PASS, FAIL = "#2f6f9f", "#c0392b"
LEAST, MOST = 1e-5, 1e4
"""Shares of a bound that the axis shows; what lies beyond is drawn at its end."""
STYLES = ("-", "--", ":", "-.")
KINDS = (
    ("environments failed", "no state is lost"),
    ("beyond the bonded face", "bonded face"),
    ("friction beyond", "friction cone"),
    ("energy gained|energy given", "energy"),
    ("against the press", "depth of the press"),
    ("carried", "load carried"),
    ("creep", "creep"),
    ("normal load|force on|force of", "normal load"),
    ("slip force", "slip force"),
    ("steps of 2 and 1", "steps of 2 and 1 ms"),
)
"""Patterns of checks, and what they are called."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the panels that the rows have something for and save the picture."""
    figure = plt.figure(figsize=(10.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(2, 6)
    _impacts(figure.add_subplot(grid[0, :2]), rows)
    _creep(figure.add_subplot(grid[0, 2:4]), rows)
    _reversal(figure.add_subplot(grid[0, 4:]), rows)
    _drops(figure.add_subplot(grid[1, :2]), rows)
    _checks(figure.add_subplot(grid[1, 2:]), rows)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _impacts(axes: Axes, rows: Sequence[Row]) -> None:
    """Depth against time of the fastest drops of the middle ball, by step."""
    drops = [(match, row) for row in rows if (match := _drop(row)) and row["curves"].get("depth")]
    chosen = {(mass, speed) for (mass, speed, _), _ in drops}
    wanted = sorted(chosen, key=lambda one: (abs(np.log(one[0] / 50.0)), abs(np.log(one[1]))))[:1]
    for k, ((mass, speed, dt), row) in enumerate(sorted(((m, r) for m, r in drops if m[:2] in wanted), key=lambda one: one[0])):
        time, depth = np.array(row["curves"]["time"]), np.array(row["curves"]["depth"])
        begin = time[np.argmax(depth > 0.0)] if (depth > 0.0).any() else 0.0
        label = f"{dt:g} ms"
        axes.plot(time - begin, depth, ls=STYLES[k % len(STYLES)], lw=1.2, label=label)
        axes.set_title(f"a   ball of {mass:g} g at {speed:g} m/s", loc="left")
    if drops:
        axes.axhline(4.0, color="0.4", lw=0.8)
        axes.text(
            0.98, 4.05, "bonded face", transform=axes.get_yaxis_transform(), ha="right", va="bottom", fontsize=8, color="0.3"
        )
        axes.set(xlabel="time from touch [ms]", ylabel="depth [mm]", xlim=(-5, 40), ylim=(-1, 5))
        axes.legend(title="step", fontsize=8, title_fontsize=8)
    else:
        axes.set_axis_off()


def _creep(axes: Axes, rows: Sequence[Row]) -> None:
    shown = [row for row in rows if row["case"].startswith("lift") and row["curves"].get("creep")]
    for k, row in enumerate(shown[: len(STYLES) * 2]):
        mu = re.sub(r"lift_mu([\d.]+)_.*", r"μ = \1", row["case"])
        creep = np.maximum(row["curves"]["creep"], 1e-6)
        axes.plot(row["curves"]["time"], creep, ls=STYLES[k % len(STYLES)], lw=1.2, label=mu)
    axes.set_title("b   held at 90 % of the slip limit", loc="left")
    if not shown:
        axes.set_axis_off()
        return
    axes.axhline(20.0, color="0.4", lw=0.8)
    axes.set(xlabel="time [s]", ylabel="creep of the load [µm]", yscale="log", ylim=(5e-7, 100.0))
    axes.text(0.98, 23.0, "bound", transform=axes.get_yaxis_transform(), ha="right", fontsize=8, color="0.3")
    axes.legend(fontsize=8)


def _reversal(axes: Axes, rows: Sequence[Row]) -> None:
    shown = [row for row in rows if row["case"].startswith("reversal") and row["curves"].get("force")]
    for k, row in enumerate(shown):
        axes.plot(
            row["curves"]["place"],
            row["curves"]["force"],
            ls=STYLES[k % len(STYLES)],
            lw=1.0,
            label=row["case"].split("_")[1].replace("ms", " ms"),
        )
    axes.set_title("c   dragged to and fro", loc="left")
    if not shown:
        axes.set_axis_off()
        return
    for side in (-1.0, 1.0):
        axes.axhline(side, color="0.4", lw=0.8)
    axes.set(xlabel="place of the block [mm]", ylabel="friction over μN", ylim=(-1.3, 1.3))
    axes.legend(title="step", fontsize=8, title_fontsize=8)


def _drops(axes: Axes, rows: Sequence[Row]) -> None:
    """Drops by speed and step, one mark a mass."""
    drops = [(match, row) for row in rows if (match := _drop(row))]
    axes.set_title("d   drops", loc="left")
    if not drops:
        axes.set_axis_off()
        return
    masses = sorted({mass for (mass, _, _), _ in drops})
    speeds, steps = sorted({m[1] for m, _ in drops}), sorted({m[2] for m, _ in drops})
    for (mass, speed, dt), row in drops:
        shift = 0.22 * (masses.index(mass) - 0.5 * (len(masses) - 1))
        place = steps.index(dt) + shift, speeds.index(speed)
        axes.plot(
            *place, "o" if row["passed"] else "X", ms=4 + 2.5 * masses.index(mass), color=PASS if row["passed"] else FAIL, mew=0
        )
    axes.set_xticks(range(len(steps)), [f"{dt:g}" for dt in steps])
    axes.set_yticks(range(len(speeds)), [f"{speed:g}" for speed in speeds])
    axes.set(xlabel="step [ms]", ylabel="speed [m/s]", xlim=(-0.6, len(steps) - 0.4), ylim=(-0.6, len(speeds) - 0.4))
    axes.annotate(
        f"left to right {', '.join(f'{m:g}' for m in masses)} g;\n● passes, ✖ fails",
        (0.0, -0.22),
        xycoords="axes fraction",
        fontsize=8,
        va="top",
    )


def _checks(axes: Axes, rows: Sequence[Row]) -> None:
    """All checks as a share of their bounds, by kind; 1 is the bound."""
    names, counts = [], []
    for pattern, name in KINDS:
        shares = [(_share(c), c["passed"]) for row in rows for c in row["checks"] if re.search(pattern, c["name"])]
        if not shares:
            continue
        at = len(names)
        for k, (share, passed) in enumerate(shares):
            offset = 0.5 * ((k * 0.618) % 1.0 - 0.5)
            axes.plot(
                min(max(share, LEAST), MOST),
                at + offset,
                "o" if passed else "X",
                ms=4,
                color=PASS if passed else FAIL,
                mew=0,
                alpha=0.8,
            )
        names.append(name)
        counts.append(f"{sum(passed for _, passed in shares)}/{len(shares)}")
    axes.set_title(f"e   checks: {sum(row['passed'] for row in rows)} of {len(rows)} cases pass all of theirs", loc="left")
    axes.axvline(1.0, color="0.4", lw=0.8)
    axes.set(xscale="log", xlim=(0.6 * LEAST, 30 * MOST), xlabel="measured over its bound (what is 0, or a state, at the ends)")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    for k, count in enumerate(counts):
        axes.text(20 * MOST, k, count, ha="right", va="center", fontsize=9)


def _share(check: Row) -> float:
    """What is measured as a share of its bound; of a bound of 0 the end that it lies on."""
    value, bound = check["value"], check["bound"]
    if value is None or not np.isfinite(value):
        return LEAST if check["passed"] else MOST
    if bound == 0.0:
        return LEAST if check["passed"] else MOST
    return float(bound / max(value, 1e-300) if check["at_least"] else value / bound)


def _drop(row: Row) -> tuple[float, float, float] | None:
    """Mass [g], speed [m/s] and step [ms] of a drop."""
    match = re.fullmatch(r"drop_([\d.]+)g_([\d.]+)ms-1_([\d.]+)ms", row["case"])
    return None if match is None else (float(match[1]), float(match[2]), float(match[3]))
