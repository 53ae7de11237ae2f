"""Fields over even lines, read anywhere."""

from __future__ import annotations

import numpy as np

__all__ = ["sampled"]


def sampled(field: np.ndarray, x: np.ndarray, y: np.ndarray, at_x: np.ndarray, at_y: np.ndarray) -> np.ndarray:
    """Fields (…, Ny, Nx) over even lines ``x``, ``y`` at places (V,), bilinear, carried on beyond the edges as they are there; (…, V).

    NaN at a place that is NaN.
    """
    parts = []
    for line, at in ((x, at_x), (y, at_y)):
        t = np.clip((at - line[0]) / (line[1] - line[0]), 0.0, len(line) - 1.0)
        first = np.minimum(np.nan_to_num(t).astype(int), len(line) - 2)
        parts += [first, t - first]
    i, a, j, b = parts
    near, far = ((1.0 - a) * field[..., row, i] + a * field[..., row, i + 1] for row in (j, j + 1))
    return (1.0 - b) * near + b * far
