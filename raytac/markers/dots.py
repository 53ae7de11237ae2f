"""Ink of the dots on the coat: which share of the skin around every node of the pad's grid is covered."""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import PadGrid

__all__ = ["dot_ink"]


def dot_ink(grid: PadGrid, centres: np.ndarray, radius: float) -> np.ndarray:
    """Coverage by round dots, shape (B, Ny, Nx), float32 in [0, 1].

    ``centres`` [m], (B, M, 2) or (B, M, 3), pad frame: of the dots where the gel has carried them; ``radius`` [m]. A dot stays round: the
    strain inside one is left out. Its edge is one grid spacing wide, so that images interpolate it without steps. Centres that are not
    finite leave no dot.
    """
    dx, dy = grid.pitch
    ny, nx = grid.shape
    batch = len(centres)
    ink = np.zeros((batch, ny, nx), dtype=np.float32)
    env, marker = np.nonzero(np.isfinite(centres[..., :2]).all(axis=-1))
    x, y = centres[env, marker, 0], centres[env, marker, 1]
    kx, ky = int(np.ceil(radius / dx)) + 1, int(np.ceil(radius / dy)) + 1
    column, row = np.rint((x - grid.x[0]) / dx).astype(int), np.rint((y - grid.y[0]) / dy).astype(int)
    columns, rows = column[:, None] + np.arange(-kx, kx + 1), row[:, None] + np.arange(-ky, ky + 1)
    ex, ey = grid.x[0] + columns * dx - x[:, None], grid.y[0] + rows * dy - y[:, None]
    apart = np.sqrt(ex[:, None, :] ** 2 + ey[:, :, None] ** 2)
    share = np.clip((radius - apart) / max(dx, dy) + 0.5, 0.0, 1.0)
    on_pad = ((rows >= 0) & (rows < ny))[:, :, None] & ((columns >= 0) & (columns < nx))[:, None, :]
    node = (env[:, None, None] * ny + rows[:, :, None]) * nx + columns[:, None, :]
    kept = on_pad & (share > 0)
    node, share, flat = node[kept], share[kept].astype(np.float32), ink.reshape(-1)
    # The greatest share of each node. Dots seldom lie over one another, so one round does, in a tenth of the time of ``np.maximum.at``.
    while len(node):
        flat[node] = share
        more = share > flat[node]
        node, share = node[more], share[more]
    return ink
