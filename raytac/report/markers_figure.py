"""Figures of marker motion: arrow plots, and errors of the models."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.markers.tracker import MARKER_MODELS, MarkerFrame, MarkerTracker
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from raytac.markers.calibration_presses import PressFrame
    from raytac.report.markers import MotionReport

__all__ = ["draw_arrows", "write_arrows", "write_errors"]

_STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7,
}
_LABELS = {
    "surface": "surface tracking",
    "fots": "FOTS",
    "fots_published": "FOTS as published",
    "superposition": "superposition",
    "force_field": "force field",
}
_COLOURS = {
    "surface": "#1b1b1b",
    "fots": "#0072b2",
    "fots_published": "#56b4e9",
    "superposition": "#009e73",
    "force_field": "#d55e00",
}
_LONGEST = 1.6
"""Length of the longest arrow in a plot, in spacings of the markers."""


def draw_arrows(
    axes: Axes,
    markers: MarkerFrame,
    resolution: tuple[int, int],
    *,
    magnified: float | None = None,
    colour: str = "#1b1b1b",
    image: np.ndarray | None = None,
) -> float:
    """Displacement in the image as arrows from the markers' places at rest, environment 0; returns how much they are magnified.

    ``magnified``: by what factor; None picks 1, 2, 5, 10 … so that the longest is about as long as markers are apart. ``image``: shown
    underneath, (H, W, 3) uint8.
    """
    width, height = resolution
    rest, way = markers.rest_px[0], markers.displacement_px[0]
    seen = np.isfinite(way).all(axis=1)
    if magnified is None:
        magnified = _magnification(rest, way[seen])
    if image is not None:
        axes.imshow(image, extent=(0, width, height, 0), interpolation="nearest")
    axes.plot(*rest.T, ".", color="0.75" if image is None else "white", markersize=1.2, zorder=1)
    axes.quiver(
        *rest[seen].T,
        *(magnified * way[seen]).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.0045,
        headwidth=3.6,
        headlength=4.2,
        headaxislength=3.8,
        minlength=0.0,
        zorder=2,
    )
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    axes.set_xticks(())
    axes.set_yticks(())
    return magnified


def _magnification(rest: np.ndarray, way: np.ndarray) -> float:
    """1, 2, 5, 10 … at which the longest arrow is not much longer than neighbouring markers are apart."""
    longest = float(np.linalg.norm(way, axis=1).max(initial=0.0))
    apart = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    spacing = float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))
    steps = np.array([1, 2, 5, 10, 20, 50, 100], float)
    fits = steps[steps * longest <= _LONGEST * spacing]
    return float(fits.max(initial=1.0))


def write_arrows(path: Path, sensor: SensorSpec, frames: list[PressFrame], *, device: str = "auto") -> None:
    """One row a kind of load, at the end of a held-out press; one column a model. ``sensor`` has the marker motion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from raytac.markers.calibration import probe_sensor
    from raytac.markers.calibration_presses import LOADS

    probed = probe_sensor(sensor)
    order = ("surface", *(name for name in MARKER_MODELS if name != "surface"))
    presses = [list(group) for _, group in groupby(frames, key=lambda frame: frame.press.name)]
    rows = []
    for load in LOADS:
        chosen = next((press for press in presses if press[-1].load == load or load == "normal"), None)
        if chosen is not None:
            last = max(k for k, frame in enumerate(chosen) if frame.load == load)
            rows.append((load, chosen[: last + 1]))
    resolution = probed.camera.resolution
    with plt.rc_context(_STYLE):
        size = (1.8 * len(order) + 0.1, len(rows) * (1.8 * resolution[1] / resolution[0] + 0.24))
        figure, grid = plt.subplots(len(rows), len(order), figsize=size, squeeze=False, layout="constrained")
        for (load, press), line in zip(rows, grid, strict=True):
            magnified, truth = None, None
            for axes, model in zip(line, order, strict=True):
                tracker = MarkerTracker(probed, model, press[0].surface.grid, device=device)
                markers = [tracker.update(frame.surface) for frame in press][-1]
                magnified = draw_arrows(axes, markers, resolution, magnified=magnified, colour=_COLOURS[model])
                _outline(axes, tracker, press[-1])
                if truth is None:
                    truth = markers.displacement[0]
                    axes.set_title(f"{load}: {_LABELS[model]}, × {magnified:g}", fontsize=7)
                else:
                    off = 1e6 * np.linalg.norm(markers.displacement[0] - truth, axis=1).mean()
                    axes.set_title(f"{_LABELS[model]}, off by {off:.0f} µm", fontsize=7)
        figure.savefig(path, dpi=250)
        plt.close(figure)


def _outline(axes: Axes, tracker: MarkerTracker, frame: PressFrame) -> None:
    """The contact's edge in the image."""
    surface = frame.surface
    if not surface.contact[0].any():
        return
    x, y = np.meshgrid(surface.grid.x, surface.grid.y)
    pixel = tracker.pattern.camera.project(np.stack([x, y, surface.height[0]], axis=-1))
    axes.contour(pixel[..., 0], pixel[..., 1], surface.contact[0].astype(float), levels=[0.5], colors="#cc79a7", linewidths=0.7)


def write_errors(path: Path, report: MotionReport) -> None:
    """Mean error of every model by kind of load, with the 95th percentile, beside the size of the motion itself."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    models = [name for name in _LABELS if name in {row.model for row in report.errors}]
    loads = list(dict.fromkeys(row.load for row in report.errors))
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(figsize=(3.5, 2.4), layout="constrained")
        wide = 0.8 / (len(models) + 1)
        for k, model in enumerate(models):
            rows = {row.load: row for row in report.errors if row.model == model}
            x = np.arange(len(loads)) + (k - 0.5 * len(models)) * wide
            mean = [1e6 * rows[load].mean for load in loads]
            axes.bar(x, mean, 0.92 * wide, color=_COLOURS[model], label=_LABELS[model])
            axes.plot(x, [1e6 * rows[load].p95 for load in loads], "_", color=_COLOURS[model], markersize=7)
        still = {row.load: row.size for row in report.errors}
        x = np.arange(len(loads)) + 0.5 * len(models) * wide
        axes.bar(x, [1e6 * still[load] for load in loads], 0.92 * wide, color="0.8", label="the motion itself")
        axes.axhline(30, color="0.4", linewidth=0.6, linestyle=(0, (4, 3)))
        axes.set_xticks(range(len(loads)), loads)
        axes.set_ylabel("distance [µm]: mean, 95 % (dash)")
        axes.legend(frameon=False, ncols=2, loc="upper left")
        axes.set_ylim(0, 1.35 * axes.get_ylim()[1])
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        figure.savefig(path, dpi=250)
        plt.close(figure)
