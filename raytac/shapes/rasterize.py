"""A z-buffer for triangle meshes seen from below, vectorised over triangles."""

from __future__ import annotations

import numpy as np

_BARELY_FLAT = 1e-12
"""Projected area over squared size below which a triangle counts as vertical."""


def lowest_of_triangles(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lowest z [m] of triangles above each node, shape (Ny, Nx); ``inf`` where there is none.

    ``corners`` [m], shape (T, 3, 3): triangle, corner, xyz in the pad frame. ``x`` (Nx,), ``y`` (Ny,): evenly spaced, ascending. Each
    triangle is cut into grid rows, each row into the run of nodes between its left and right edge; z is the triangle's own plane at the
    node (linear interpolation, exact), so the work is one step per covered row and one per covered node.
    """
    ny, nx = len(y), len(x)
    lowest = np.full(ny * nx, np.inf)
    p = np.asarray(corners, float)
    step_x, step_y = (x[-1] - x[0]) / (nx - 1), (y[-1] - y[0]) / (ny - 1)
    # A reduction over an axis of three is many times slower than two minima.
    low = np.minimum(np.minimum(p[:, 0], p[:, 1]), p[:, 2])
    high = np.maximum(np.maximum(p[:, 0], p[:, 1]), p[:, 2])
    keep = (high[:, 0] >= x[0] - step_x) & (low[:, 0] <= x[-1] + step_x) & (high[:, 1] >= y[0]) & (low[:, 1] <= y[-1])
    edge_a, edge_b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]
    keep &= np.abs(area) > _BARELY_FLAT * ((edge_a**2).sum(axis=1) + (edge_b**2).sum(axis=1))
    p, low, high, edge_a, edge_b, area = (v[keep] for v in (p, low, high, edge_a, edge_b, area))
    slope_x = (edge_a[:, 2] * edge_b[:, 1] - edge_b[:, 2] * edge_a[:, 1]) / area
    slope_y = (edge_b[:, 2] * edge_a[:, 0] - edge_a[:, 2] * edge_b[:, 0]) / area

    # A slack far below any length of interest closes the seam between neighbours that rounding could open at a node on an edge.
    slack = 1e-9
    row_first = np.maximum(np.ceil((low[:, 1] - y[0]) / step_y - slack), 0).astype(np.int64)
    row_last = np.minimum(np.floor((high[:, 1] - y[0]) / step_y + slack), ny - 1).astype(np.int64)
    triangle, offset = _runs(row_last - row_first + 1)
    row = row_first[triangle] + offset
    x_low, x_high = _row_span(p, triangle, y[0] + row * step_y, slack * step_y)
    column_first = np.maximum(np.ceil((x_low - x[0]) / step_x - slack), 0).astype(np.int64)
    column_last = np.minimum(np.floor((x_high - x[0]) / step_x + slack), nx - 1).astype(np.int64)
    span, offset = _runs(column_last - column_first + 1)
    column = column_first[span] + offset
    start = p[triangle, 0]
    at_left_axis = start[:, 2] + slope_y[triangle] * (y[row] - start[:, 1]) - slope_x[triangle] * start[:, 0]
    z = at_left_axis[span] + slope_x[triangle][span] * x[column]
    z = np.clip(z, low[triangle, 2][span], high[triangle, 2][span])
    np.minimum.at(lowest, row[span] * nx + column, z)
    return lowest.reshape(ny, nx)


def _row_span(p: np.ndarray, triangle: np.ndarray, y: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Left and right end [m] of each triangle on the horizontal line at its ``y``."""
    x_low, x_high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    corner_x, corner_y = p[:, :, 0], p[:, :, 1]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        rise = corner_y[:, b] - corner_y[:, a]
        level = np.abs(rise) <= slack
        per_rise = (corner_x[:, b] - corner_x[:, a]) / np.where(level, np.inf, rise)
        low, high = np.minimum(corner_y[:, a], corner_y[:, b]), np.maximum(corner_y[:, a], corner_y[:, b])
        cut_y = np.clip(y, low[triangle], high[triangle])
        cut = corner_x[triangle, a] + per_rise[triangle] * (cut_y - corner_y[triangle, a])
        crosses = np.abs(y - cut_y) <= slack
        x_low = np.where(crosses, np.minimum(x_low, cut), x_low)
        x_high = np.where(crosses, np.maximum(x_high, cut), x_high)
        # A level edge adds its other end too (its neighbours in the triangle carry it unless rounding skipped them).
        both = crosses & level[triangle]
        x_low = np.where(both, np.minimum(x_low, corner_x[triangle, b]), x_low)
        x_high = np.where(both, np.maximum(x_high, corner_x[triangle, b]), x_high)
    missed = x_low > x_high
    return np.where(missed, 0.0, x_low), np.where(missed, -1.0, x_high)


def _runs(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run of each element, and its place in it, of runs of these lengths laid end to end."""
    lengths = np.maximum(lengths, 0)
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
