"""Session drift and grain of photographs in figures and as a table."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from raytac.calibrate.drift import Drift
from raytac.calibrate.light_parameters import CHANNELS
from raytac.io.metrics import Metric
from raytac.specs.sensor import NoiseSpec


def drift_metrics(drift: Drift, background: Drift, level: float) -> dict[str, Metric]:
    """Figures of presses and of the photograph at rest: change of a pixel of ``level`` [levels]."""
    figures: dict[str, Metric] = {"drift.level": level}
    for k, channel in enumerate(CHANNELS):
        figures[f"drift.background.{channel}"] = float(background.at(level)[0, k])
        figures[f"drift.presses.{channel}"] = float(np.abs(drift.at(level)[:, k]).mean())
        figures[f"drift.presses.largest_{channel}"] = float(np.abs(drift.at(level)[:, k]).max())
    return figures


def drift_rows(names: tuple[str, ...], drift: Drift) -> list[str]:
    """Lines of a table, a press each: its name, then gains and offsets by channel."""
    head = ["press", *(f"gain_{c}" for c in CHANNELS), *(f"offset_{c}" for c in CHANNELS)]
    values = np.concatenate([drift.gain, drift.offset], axis=1)
    rows = [
        ",".join([name, *(f"{v:.5f}" for v in row[:3]), *(f"{v:.3f}" for v in row[3:])])
        for name, row in zip(names, values, strict=True)
    ]
    return [",".join(head), *rows]


def session_lines(metrics: Mapping[str, Metric]) -> list[str]:
    """Markdown of drift and grain, as of ``drift_metrics`` and ``grain_metrics``; may be empty."""
    if "drift.level" not in metrics or "grain.level" not in metrics:
        return []
    rows = (
        ("drift of the photograph at rest", "drift.background.{}"),
        ("drift of presses, mean", "drift.presses.{}"),
        ("drift of presses, largest", "drift.presses.largest_{}"),
        ("grain, standard deviation", "grain.{}"),
    )
    lines = [f"| at level {metrics['drift.level']:.0f}, in levels | " + " | ".join(CHANNELS) + " |", "|" + "---|" * 4]
    for text, key in rows:
        lines.append(f"| {text} | " + " | ".join(f"{metrics[key.format(c)]:.2f}" for c in CHANNELS) + " |")
    return [*lines, ""]


def grain_metrics(noise: NoiseSpec | None, level: float) -> dict[str, Metric]:
    """Standard deviations [levels] of grain at ``level`` and the ends; none if unknown."""
    if noise is None:
        return {}
    figures: dict[str, Metric] = {"grain.level": level}
    for k, channel in enumerate(CHANNELS):
        dark, bright = noise.dark_variance[k], noise.bright_variance[k]
        figures[f"grain.{channel}"] = float(np.sqrt(dark + (bright - dark) * level / 255))
        figures[f"grain.dark.{channel}"], figures[f"grain.bright.{channel}"] = float(np.sqrt(dark)), float(np.sqrt(bright))
    return figures
