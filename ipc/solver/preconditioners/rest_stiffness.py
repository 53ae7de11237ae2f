"""The matrix of the Newton system at rest, without contact, on the host.

At F = 1 the second derivative of the energies in ``ipc/solver/elasticity.py`` couples the corners a and b of a tetrahedron by

    V (m g_a·g_b 1 + k g_a g_bᵀ + λ g_a g_bᵀ + m [g_a × g_b]_×),      m = μ, k = 0 (stable);   m = 3μ/4, k = μ/8 (stable_log),

since c = −m there (the rest state carries no stress), and K_0 = K + M/h² + damping.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipc.bodies.layout import Layout
from ipc.settings import Settings

Floats = NDArray[np.float64]
Ints = NDArray[np.integer]


def bonded_bodies(layout: Layout) -> list[int]:
    """Soft bodies with bonded vertices, whose rest state is fixed in their moving frame."""
    return [b for b in range(len(layout.names)) if layout.framed[b] and layout.node_start[b] < layout.node_start[b + 1]]


def free_nodes(layout: Layout, body: int) -> Ints:
    """The nodes of a body that are unknown."""
    span = np.arange(layout.node_start[body], layout.node_start[body + 1])
    return span[layout.node_free[span] != 0]


def rest_blocks(layout: Layout, settings: Settings) -> Floats:
    """Blocks of K_0 [N/m] in the layout's pattern (K, 3, 3), except for affine bodies."""
    log = (layout.model == 1)[:, None, None]
    mu, lam = layout.mu[:, None, None], layout.lam[:, None, None]
    m, k = np.where(log, 0.75 * mu, mu), np.where(log, mu / 8, 0.0)
    g, eye = layout.grads, np.eye(3)
    dot = np.einsum("tai,tbi->tab", g, g)
    outer = np.einsum("tai,tbj->tabij", g, g)
    # [g_a × g_b]_× = g_b g_aᵀ − g_a g_bᵀ
    turn = np.swapaxes(outer, 3, 4) - outer
    part = (m * dot)[..., None, None] * eye + (k + lam)[..., None, None] * outer + m[..., None, None] * turn
    part *= layout.volume[:, None, None, None, None]
    parts = part.reshape(-1, 3, 3)[layout.part].reshape(-1, 9)
    which = np.repeat(np.arange(len(layout.col)), np.diff(layout.part_start))
    sums = [np.bincount(which, weights=parts[:, c], minlength=len(layout.col)) for c in range(9)]
    blocks = np.stack(sums, axis=1).reshape(-1, 3, 3)
    inertia = 1.0 / settings.dt**2 * layout.mass
    rows = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
    inertia[rows == layout.col] += layout.node_damping / settings.dt
    return blocks + inertia[:, None, None] * eye


def dense_block(layout: Layout, blocks: Floats, rows: Ints, cols: Ints) -> Floats:
    """The part of a matrix between two lists of nodes, shape (3 rows, 3 cols)."""
    count = len(layout.node_rest)
    place, across = np.full(count, -1), np.full(count, -1)
    place[rows], across[cols] = np.arange(len(rows)), np.arange(len(cols))
    i, j = place[np.repeat(np.arange(count), np.diff(layout.row_start))], across[layout.col]
    inside = (i >= 0) & (j >= 0)
    dense = np.zeros((len(rows), 3, len(cols), 3))
    dense[i[inside], :, j[inside], :] = blocks[inside]
    return dense.reshape(3 * len(rows), 3 * len(cols))
