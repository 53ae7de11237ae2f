"""A contact sheet: the first presses of a data set, images over maps of their indentation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.checks import check_whole
from raytac.dataset.loader import PressDataset
from raytac.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDE, _HIGH, _DPI = 1.75, 1.4, 100
"""Size of a panel [inch], and pixels to an inch."""
_BAR = 5e-3
"""Length of the scale bar [m]."""


def contact_sheet(data: PressDataset, count: int = 24, columns: int = 6) -> np.ndarray:
    """The picture of ``contact_figure``, shape (H, W, 3), uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(contact_figure(data, count, columns))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def contact_figure(data: PressDataset, count: int = 24, columns: int = 6) -> Figure:
    """Figure of the first ``count`` presses: number, object, depth, image and indentation.

    Of videos it shows the last frames.

    All maps have one colour scale, from 0 (what comes up counts as 0) to the greatest indentation shown.

    Raises ``InputError``: the data set has neither images nor heights, or no sound press, or a number is not whole or below 1.
    """
    count, columns = check_whole("count", count), check_whole("columns", columns)
    shown = [name for name in ("rgb", "height") if name in data.description["arrays"]]
    if not shown or not len(data):
        raise InputError("data set", value=data.folder, rule="must hold a sound press with an image or a height")
    from matplotlib.figure import Figure

    presses = range(min(count, len(data)))
    columns = min(columns, len(presses))
    rows = -(-len(presses) // columns)
    figure = Figure(figsize=(_WIDE * columns + 0.8, (_HIGH * len(shown) + 0.2) * rows), dpi=_DPI, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.0)  # type: ignore[union-attr, call-arg]
    axes = figure.subplots(rows * len(shown), columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    samples = [{name: data[i][name][-1] if data.frames else data[i][name] for name in shown} for i in presses]
    dents = [data.shared(i)["rest_height"].astype(float) - samples[i]["height"] for i in presses if "height" in shown]
    deepest = max((float(np.nanmax(dent)) for dent in dents), default=0.0)
    maps = None
    for i in presses:
        block = axes[i // columns * len(shown) : (i // columns + 1) * len(shown), i % columns]
        block[0].set_title(_title(data, i), fontsize=8, pad=3)
        for axis, name in zip(block, shown, strict=True):
            if name == "rgb":
                axis.imshow(samples[i]["rgb"])
                pixel = data.description["sensors"][data.manifest["sensor"][i].as_py()]["pixel_m"][0]
                _bar(axis, _BAR / pixel)
            else:
                shared = data.shared(i)
                x, y = 1e3 * shared["grid_x"], 1e3 * shared["grid_y"]
                extent = (x[0], x[-1], y[-1], y[0])
                maps = axis.imshow(1e3 * dents[i], extent=extent, cmap="cividis", vmin=0.0, vmax=1e3 * deepest or 1.0)
                _bar(axis, 1e3 * _BAR)
    if maps is not None:
        bar = figure.colorbar(maps, ax=list(axes.flat), shrink=0.6, aspect=30, pad=0.01, extend="min")
        bar.set_label("indentation [mm]", fontsize=9)
        bar.ax.tick_params(labelsize=8)
    return figure


def _title(data: PressDataset, i: int) -> str:
    row = {name: data.manifest[name][i].as_py() for name in ("index", "object", "press_depth")}
    return f"{row['index']}: {row['object']}, {1e3 * row['press_depth']:.2f} mm"


def _bar(axis: Any, length: float) -> None:
    """A white scale bar of ``_BAR``, ``length`` in the axis' own unit, in the lower left corner."""
    (x_low, x_high), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    x, y = x_low + 0.05 * (x_high - x_low), bottom + 0.07 * (top - bottom)
    axis.plot([x, x + length], [y, y], color="white", linewidth=2.0, solid_capstyle="butt", label="scale bar")
    middle, above = x + 0.5 * length, y + 0.03 * (top - bottom)
    axis.text(middle, above, f"{1e3 * _BAR:g} mm", color="white", fontsize=7, ha="center", va="bottom")
