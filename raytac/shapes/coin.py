"""The relief of raytac's coin (rim, beads, star, the letters RT) as an elevation map."""

from __future__ import annotations

import numpy as np

_SPACING = 0.03e-3
"""Sample spacing of the map [m]: finer than a sensor's pixel, so that no sample shows."""


def coin_elevation(radius: float, height: float) -> np.ndarray:
    """Elevation [m] of the coin's face (N, N), from 0 (field) to ``height``.

    Over the square of half edge ``radius`` [m]. Rows run along y, columns along x, seen through the coin from its back, so that the
    face-down coin reads the right way in the camera's image (x right, y down). Flanks rise smoothly over 0.035 radius.
    """
    n = min(max(2 * round(radius / _SPACING) + 1, 257), 1025)
    line = np.linspace(-1.0, 1.0, n)
    x, y = line[None, :], line[:, None]
    rho, angle = np.hypot(x, y), np.arctan2(y, x)

    rim = np.abs(rho - 0.93) - 0.045
    beads = 32
    sector = 2.0 * np.pi / beads
    folded = (angle + 0.5 * sector) % sector - 0.5 * sector
    bead = np.hypot(rho * np.cos(folded) - 0.80, rho * np.sin(folded)) - 0.028
    star = np.abs(_star(x, y + 0.16, 0.46, 0.19)) - 0.02
    inner = _star(x, y + 0.16, 0.30, 0.124)
    letters = np.minimum(_strokes(x, y - 0.44, _R, -0.17), _strokes(x, y - 0.44, _T, 0.17)) - 0.038
    raised = [_flank(d) for d in (rim, bead, star, letters)]
    raised.append(0.6 * _flank(inner))
    elevation = np.max(np.broadcast_arrays(*raised), axis=0)
    return height * np.where(rho < 1.0, elevation, 0.0)


_R = (((-0.5, 1.0), (-0.5, -1.0)), ((-0.5, -1.0), (0.3, -1.0)), ((0.3, -1.0), (0.5, -0.75)), ((0.5, -0.75), (0.5, -0.25)),
      ((0.5, -0.25), (0.3, 0.0)), ((0.3, 0.0), (-0.5, 0.0)), ((0.0, 0.0), (0.55, 1.0)))  # fmt: skip
_T = (((-0.6, -1.0), (0.6, -1.0)), ((0.0, -1.0), (0.0, 1.0)))
_LETTER = 0.16
"""Half height of a letter, in radii."""


def _flank(distance: np.ndarray) -> np.ndarray:
    """1 inside, 0 outside, a smooth step over 0.035 radius outside the outline."""
    s = np.clip(1.0 - distance / 0.035, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _star(x: np.ndarray, y: np.ndarray, outer: float, inner: float) -> np.ndarray:
    """Signed distance to a five-pointed star, one point towards −y (up in the image)."""
    sector = 2.0 * np.pi / 5.0
    angle = np.arctan2(x, -y)
    folded = np.abs((angle + 0.5 * sector) % sector - 0.5 * sector)
    rho = np.hypot(x, y)
    px, py = rho * np.cos(folded), rho * np.sin(folded)
    ax, ay = outer, 0.0
    bx, by = inner * np.cos(0.5 * sector), inner * np.sin(0.5 * sector)
    s = np.clip(((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2), 0.0, 1.0)
    distance = np.hypot(px - ax - s * (bx - ax), py - ay - s * (by - ay))
    inside = (bx - ax) * (py - ay) - (by - ay) * (px - ax) > 0.0
    return np.where(inside, -distance, distance)


def _strokes(x: np.ndarray, y: np.ndarray, letter: tuple, shift: float) -> np.ndarray:
    """Distance to the strokes of a letter centred at (``shift``, 0)."""
    nearest = np.full(np.broadcast_shapes(x.shape, y.shape), np.inf)
    for (ax, ay), (bx, by) in letter:
        ax, ay, bx, by = (_LETTER * v for v in (ax, ay, bx, by))
        dx, dy = bx - ax, by - ay
        px, py = x - shift - ax, y - ay
        s = np.clip((px * dx + py * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(px - s * dx, py - s * dy))
    return nearest
