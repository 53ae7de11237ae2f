"""Cubic splines through values at uneven grid lines, as small matrices."""

from __future__ import annotations

import numpy as np


class SplineAxis:
    """The natural cubic spline through values at n lines: C², with zero curvature at both ends.

    With M the second derivatives at the lines, the spline in the cell between lines i and i + 1 of length h is
    a y_i + b y_{i+1} + ((a³ − a) M_i + (b³ − b) M_{i+1}) h²/6, a = (t_{i+1} − t)/h, b = 1 − a. Continuity of the slope makes M a
    linear function of y (a tridiagonal system; de Boor, A Practical Guide to Splines, chapter IV).
    """

    def __init__(self, lines: np.ndarray) -> None:
        """``lines`` [m], shape (n,), ascending, n >= 2."""
        self.lines = np.asarray(lines, float)
        n, h = len(lines), np.diff(lines)
        system, right = np.eye(n), np.zeros((n, n))
        for i in range(1, n - 1):
            system[i, i - 1 : i + 2] = h[i - 1] / 6.0, (h[i - 1] + h[i]) / 3.0, h[i] / 6.0
            right[i, i - 1 : i + 2] = 1.0 / h[i - 1], -1.0 / h[i - 1] - 1.0 / h[i], 1.0 / h[i]
        self.bending = np.linalg.solve(system, right)
        """Second derivatives at the lines from the values there, shape (n, n)."""

    def weights(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells (P,) of positions ``t`` [m], and weights (4, P) of (y_i, y_{i+1}, M_i, M_{i+1}).

        Positions beyond the ends take the value at the end.
        """
        lines = self.lines
        t = np.clip(t, lines[0], lines[-1])
        cell = np.clip(np.searchsorted(lines, t, side="right") - 1, 0, len(lines) - 2)
        h = lines[cell + 1] - lines[cell]
        b = (t - lines[cell]) / h
        a = 1.0 - b
        return cell, np.stack([a, b, (a**3 - a) * h**2 / 6.0, (b**3 - b) * h**2 / 6.0])

    def matrix(self, t: np.ndarray) -> np.ndarray:
        """Matrix from values at the lines to values at ``t`` [m], shape (P, n)."""
        cell, (a, b, c, d) = self.weights(t)
        rows = np.arange(len(cell))
        out = c[:, None] * self.bending[cell] + d[:, None] * self.bending[cell + 1]
        out[rows, cell] += a
        out[rows, cell + 1] += b
        return out


def cell_lengths(lines: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Length of the cell between ``lines`` (n,) around each place ``t`` (P,), shape (P,)."""
    return np.diff(lines)[np.clip(np.searchsorted(lines, t, side="right") - 1, 0, len(lines) - 2)]


def hat_matrix(lines: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Matrix (P, n) of linear interpolation from ``lines`` (n,) to ``t`` (P,); rows sum to 1."""
    cell, (a, b, _, _) = SplineAxis(lines).weights(t)
    out = np.zeros((len(cell), len(lines)))
    rows = np.arange(len(cell))
    out[rows, cell], out[rows, cell + 1] = a, b
    return out


def sampled(field: np.ndarray, x: np.ndarray, y: np.ndarray, at_x: np.ndarray, at_y: np.ndarray) -> np.ndarray:
    """Bilinear interpolation of fields (…, Ny, Nx) on regular lines at places (V,); (…, V).

    Beyond the edges the value at the edge is taken. A place that is NaN gives NaN.
    """
    parts = []
    for line, at in ((x, at_x), (y, at_y)):
        t = np.clip((at - line[0]) / (line[1] - line[0]), 0.0, len(line) - 1.0)
        first = np.minimum(np.nan_to_num(t).astype(int), len(line) - 2)
        parts += [first, t - first]
    i, a, j, b = parts
    near, far = ((1.0 - a) * field[..., row, i] + a * field[..., row, i + 1] for row in (j, j + 1))
    return (1.0 - b) * near + b * far
