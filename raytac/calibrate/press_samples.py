"""What cheap models are fitted to: slopes as their own front step sees them, and the real colours, of ball presses with known imprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.calibrate.imprint import KNOTS, press_surface
from raytac.calibrate.photographs import Photographs
from raytac.gel.surface import make_grid
from raytac.optics.image.config import Phong
from raytac.specs.sensor import SensorSpec

__all__ = ["MOVED", "PressSamples", "press_samples"]

MOVED = 5e-6
"""Least displacement [m] of a pixel that counts as a sample."""
GRID_PITCH = 0.06e-3
"""Spacing of the pad's nodes [m], about a pixel's."""


@dataclass(frozen=True)
class PressSamples:
    """One row a pixel that moved: press, row, column, slopes of the displacement and whether the ball touches, each (K,), and
    the difference from the background [levels], (K, 3)."""

    press: np.ndarray
    row: np.ndarray
    column: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray
    touched: np.ndarray
    difference: np.ndarray


def press_samples(
    sensor: SensorSpec,
    shots: Photographs,
    circles: np.ndarray,
    slopes: np.ndarray,
    *,
    device: str = "auto",
    reach: float = KNOTS[-1],
) -> PressSamples:
    """Samples within ``reach`` radii of the ``circles`` (N, 3) [px] of ``shots``, whose imprints have the ``slopes`` of ``imprint``."""
    height, width = shots.background.shape[:2]
    background = np.zeros((height, width, 3), np.uint8)  # the front step needs none
    front = Phong(background=background).build(sensor, resolution=(width, height), device=device)
    grid = make_grid(sensor.gelpad, GRID_PITCH)
    aspect = front.pitch[0] / front.pitch[1]
    distance = Photographs(shots.background, shots.presses, circles, shots.radius).distance(sensor)
    parts = []
    for k in range(len(circles)):
        _, moved = front.image_heights(press_surface(sensor, grid, circles[k : k + 1], shots.radius[k : k + 1], slopes))
        moved = moved[0].astype(float)
        inner = np.pad(moved[1:-1, 1:-1], 1, mode="edge")
        slope_x, slope_y = np.zeros_like(moved), np.zeros_like(moved)
        slope_x[1:-1, 1:-1] = 0.5 * (moved[1:-1, 2:] - moved[1:-1, :-2])
        slope_y[1:-1, 1:-1] = 0.5 * aspect * (moved[2:, 1:-1] - moved[:-2, 1:-1])
        row, column = np.nonzero((distance[k] < reach) & (inner > MOVED / front.pitch[0]))
        keep = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
        row, column = row[keep], column[keep]
        change = shots.presses[k, row, column] - shots.background[row, column]
        touched = distance[k, row, column] < 1
        parts.append((np.full(len(row), k), row, column, slope_x[row, column], slope_y[row, column], touched, change))
    return PressSamples(*(np.concatenate(column) for column in zip(*parts, strict=True)))
