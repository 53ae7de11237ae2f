"""Pictures of a comparison: error against time, and images with signed errors by scene."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from raytac.report.compare.metrics import known, resolutions, select, summaries
from raytac.report.compare.run import Comparison
from raytac.report.compare.store import Row

WIDTH_IN = 7.16
"""Width of two columns of an IEEE paper [in]."""
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.linewidth": 0.6,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "savefig.dpi": 300,
}
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#56B4E9", "#D55E00", "#CC79A7", "#000000")
"""Colours of Okabe and Ito, which families take in turn; markers tell them apart too."""
MARKERS = ("o", "D", "^", "v", "s", "P", "X", "*", "h", "<", ">")
PANELS = (("frame_mae", "whole frame"), ("contact_mae", "contact"), ("ring_mae", "shadow ring"))


@dataclass(frozen=True)
class Look:
    """Style in which a family of modes is drawn."""

    colour: str
    marker: str
    line: Any
    named_below: bool
    """Its name goes below the point: every second one, so that names of neighbours do not meet."""
    words: str
    timed_only: bool
    """It has no error against our reference."""


def write_pareto(comparison: Comparison, path: Path) -> None:
    """Error against time of a frame, log axes: frame, contact, shadow ring; a row a resolution.

    A point is a mode: median of times and mean of errors over the scenes, whiskers from the best scene to the worst. The hatched band is
    the mean noise of the reference, below which no error can be resolved.
    """
    rows, names = comparison.rows, resolutions(comparison.rows)
    looks = _looks(rows)
    columns = 4
    with matplotlib.rc_context(STYLE):
        height = 0.35 + 0.17 * math.ceil(len(looks) / columns) + 2.3 * len(names)
        figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
        grid = figure.subplots(len(names), len(PANELS), squeeze=False, sharex="row", sharey="row")
        for line, resolution in zip(grid, names, strict=True):
            here = select(rows, resolution=resolution)
            _scales(line[0], here)
            for axes, (column, title) in zip(line, PANELS, strict=True):
                _panel(axes, here, column, looks)
                axes.set_title(f"{title}, {resolution.replace('x', ' × ')}")
                axes.set_xlabel("time of a frame, batch 1 [ms]")
            line[0].set_ylabel("MAE [levels of 255]")
        handles = [_handle(look) for look in looks.values()]
        figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, columnspacing=1.2)
        figure.savefig(path)


def _looks(rows: Sequence[Row]) -> dict[str, Look]:
    """Style of every family, in the order of the rows."""
    looks: dict[str, Look] = {}
    for s in summaries(rows):
        if s.family not in looks:
            k, timed = len(looks), not s.errors
            line = (":" if timed else "none") if s.spp is None else ("-" if s.unbiased else "--")
            looks[s.family] = Look(COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)], line, k % 2 == 1, s.words, timed)
    return looks


def _handle(look: Look) -> Line2D:
    if look.timed_only:
        return Line2D([], [], color=look.colour, linestyle=look.line, linewidth=0.8, label=f"{look.words}: time only")
    style: dict[str, Any] = {"marker": look.marker, "linestyle": look.line, "linewidth": 1.0, "markersize": 4.5}
    return Line2D([], [], color=look.colour, label=look.words, **style)


def _scales(axes: Axes, rows: Sequence[Row]) -> None:
    """Log axes that hold every point of a row of panels, with room for labels."""
    times, errors = known(rows, "ms"), [v for column, _ in PANELS for v in known(rows, column) if v > 0]
    noise = [v for column, _ in PANELS for v in known(rows, f"noise_{column}") if v > 0]
    axes.set(xscale="log", yscale="log", xlim=(0.6 * min(times), 2.2 * max(times)))
    if errors:
        axes.set_ylim(0.7 * min(errors + noise), 1.6 * max(errors))
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0,) if math.log10(high / low) > 2.2 else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.3g}" if value < 1000 else f"{value:,.0f}"))
        axis.set_minor_formatter(NullFormatter())


def _panel(axes: Axes, rows: Sequence[Row], column: str, looks: dict[str, Look]) -> None:
    all_summaries = summaries(rows)
    for family in dict.fromkeys(summary.family for summary in all_summaries):
        look = looks[family]
        colour, own = look.colour, [summary for summary in all_summaries if summary.family == family]
        if look.timed_only:
            for s in own:
                axes.axvline(s.ms, color=colour, linestyle=look.line, linewidth=0.8, zorder=1)
            continue
        points = sorted((s for s in own if s.errors.get(column, 0) > 0), key=lambda s: s.spp or 0)
        for s in points:
            values = known(select(rows, mode=s.mode), column)
            axes.plot([s.ms, s.ms], [min(values), max(values)], color=colour, linewidth=0.6, alpha=0.5, zorder=2)
            label = s.short if s.spp is None else f"{s.spp}"
            place: dict[str, Any] = {"xytext": (3.5, 2.5), "textcoords": "offset points"}
            # To the left where the right half of the panel would cut it off.
            if s.spp is None and s.ms > math.sqrt(axes.get_xlim()[0] * axes.get_xlim()[1]):
                place |= {"xytext": (-3.5, 2.5), "ha": "right"}
            if look.named_below:
                place["xytext"] = (place["xytext"][0], -8.0)
            axes.annotate(label, (s.ms, s.errors[column]), fontsize=6, color=colour, zorder=4, **place)
        x, y = [s.ms for s in points], [s.errors[column] for s in points]
        axes.plot(x, y, color=colour, marker=look.marker, linestyle=look.line, linewidth=1.0, markersize=4.5, zorder=3)
    noise = [value for value in known(rows, f"noise_{column}") if value > 0]
    if noise:
        floor = statistics.mean(noise)
        axes.axhspan(axes.get_ylim()[0], floor, facecolor="none", edgecolor="0.8", hatch="////", linewidth=0, zorder=0)
        axes.axhline(floor, color="0.6", linewidth=0.6, zorder=0)
        label = axes.text(0.98, 0.02, "noise of the reference", fontsize=6, color="0.3", ha="right", va="bottom")
        label.set(transform=axes.transAxes, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.8})
    axes.grid(True, linewidth=0.3, color="0.9")
    axes.set_axisbelow(True)


def signed_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Image − reference, mean of the three channels [levels], (H, W)."""
    return (image.astype(np.float64) - reference).mean(axis=-1)


def error_range(errors: Sequence[np.ndarray]) -> float:
    """Range of signed errors, at least 2 levels: 99th percentile of the middle image, rounded."""
    if not errors:
        return 2.0
    typical = statistics.median(float(np.percentile(np.abs(error), 99)) for error in errors)
    return next((step for step in (2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if step >= typical), 100.0)


def write_sheet_of_scene(comparison: Comparison, scene: str, resolution: str, path: Path) -> None:
    """The reference, then every mode with its signed error below it; one colour scale."""
    rows = select(comparison.rows, scene=scene, resolution=resolution)
    columns = min(max(3, len(rows) + 1), 6)
    reference = comparison.references[scene, resolution]
    compared = [row for row in rows if row.figures["frame_mae"] is not None]
    steady = [row for row in compared if row.figures["spp"] is None] or compared
    reach = error_range([signed_error(row.image, reference) for row in steady])
    lines, gap, caption, foot = math.ceil((len(rows) + 1) / columns), 0.04, 0.27, 0.5  # [in]
    wide = (WIDTH_IN - gap * (columns - 1)) / columns
    high = wide * reference.shape[0] / reference.shape[1]
    line_in = caption + 2 * high + gap
    total = lines * line_in + foot
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, total))

        def cell(k: int, lower: bool) -> Axes:
            x, top = (k % columns) * (wide + gap), (k // columns) * line_in + caption + lower * (high + gap)
            axes = figure.add_axes((x / WIDTH_IN, 1 - (top + high) / total, wide / WIDTH_IN, high / total))
            axes.set_axis_off()
            return axes

        def picture(k: int, image: np.ndarray, title: str) -> None:
            axes = cell(k, False)
            axes.imshow(image, interpolation="none", aspect="auto")
            axes.set_title(title, fontsize=6, pad=2, linespacing=0.95)

        def words(k: int, text: str) -> None:
            axes = cell(k, True)
            axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=6.5, color="0.3", transform=axes.transAxes)

        picture(0, reference, f"reference\n{comparison.settings.reference_spp:,} spp")
        words(0, f"{scene}\n{resolution.replace('x', ' × ')}\nbelow each mode:\nits signed error")
        look: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -reach, "vmax": reach, "interpolation": "none", "aspect": "auto"}
        shown = None
        for k, row in enumerate(rows, start=1):
            picture(k, row.image, _caption(row))
            if row.figures["frame_mae"] is None:
                words(k, "another sensor:\nno error against\nour reference")
            else:
                shown = cell(k, True).imshow(signed_error(row.image, reference), **look)
        if shown is not None:
            place = figure.add_axes((0.3, 0.34 / total, 0.4, 0.07 / total))
            bar = figure.colorbar(shown, cax=place, orientation="horizontal", extend="both")
            bar.set_label("image − reference, mean of the channels [levels of 255]", fontsize=7, labelpad=1)
            bar.ax.tick_params(labelsize=6, pad=1)
            bar.outline.set_linewidth(0.6)  # type: ignore[operator]
        figure.savefig(path)


def _caption(row: Row) -> str:
    figures = row.figures
    label = str(figures["label"]).replace("raytac ", "").replace(" table with shadow", " + shadow")
    label = label.replace(" with shadow", " + shadow").replace("denoised", "den.").replace(" a pixel", "")
    ms = float(figures["ms"] or 0)
    time = f"{ms:,.0f} ms" if ms >= 100 else f"{ms:.3g} ms"
    mae = "" if figures["frame_mae"] is None else f", MAE {float(figures['frame_mae']):.2f}"
    return f"{label}\n{time}{mae}"
