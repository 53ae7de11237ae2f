"""The matrix of the Newton system at rest, without contact, on the host.

At F = 1 the second derivative of the energies in ``ipc/solver/elasticity.py`` couples the corners a and b of a tetrahedron by

    V (m g_a·g_b 1 + k g_a g_bᵀ + λ g_a g_bᵀ + m [g_a × g_b]_×),      m = μ, k = 0 (stable);   m = 3μ/4, k = μ/8 (stable_log),

since c = −m there (the rest state carries no stress), and K_0 = K + M/h² + damping. Elements of a volume block have λ' for λ; the
block couples its nodes by q_i q_jᵀ with q = √((λ − λ')/V_b) Σ V_e ∇w (``ipc/solver/dilation.py``).
"""

from __future__ import annotations

from itertools import pairwise

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


def couplings(layout: Layout) -> tuple[Ints, Ints]:
    """Pairs of nodes (K',), by row, that the matrix couples, volume blocks included."""
    rows, cols = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start)), layout.col
    if len(layout.block_volume) == 0:
        return rows, cols
    n = len(layout.node_rest)
    one, other = _block_pairs(layout)
    inside = layout.pair_node[one].astype(np.int64) * n + layout.pair_node[other]
    keys = np.union1d(rows.astype(np.int64) * n + cols, inside)
    return keys // n, keys % n


def _block_pairs(layout: Layout) -> tuple[Ints, Ints]:
    """Every two entries of ``layout.pair_node`` that belong to one volume block."""
    spans = [np.arange(a, b) for a, b in pairwise(layout.block_pair_start)]
    meshed = [np.meshgrid(span, span, indexing="ij") for span in spans]
    return np.concatenate([m[0].ravel() for m in meshed]), np.concatenate([m[1].ravel() for m in meshed])


def rest_blocks(layout: Layout, settings: Settings) -> Floats:
    """Blocks of K_0 [N/m] between :func:`couplings` (K', 3, 3), except for affine bodies."""
    log = (layout.model == 1)[:, None, None]
    mu, lam = layout.mu[:, None, None], layout.own[:, None, None]
    m, k = np.where(log, 0.75 * mu, mu), np.where(log, mu / 8, 0.0)
    g, eye = layout.grads, np.eye(3)
    dot = np.einsum("tai,tbi->tab", g, g)
    outer = np.einsum("tai,tbj->tabij", g, g)
    # [g_a × g_b]_× = g_b g_aᵀ − g_a g_bᵀ
    turn = np.swapaxes(outer, 3, 4) - outer
    part = (m * dot)[..., None, None] * eye + (k + lam)[..., None, None] * outer + m[..., None, None] * turn
    part *= layout.volume[:, None, None, None, None]
    parts = part.reshape(-1, 3, 3)[layout.part].reshape(-1, 9)
    rows, cols = couplings(layout)
    n = len(layout.node_rest)
    own = np.repeat(np.arange(n), np.diff(layout.row_start)).astype(np.int64) * n + layout.col
    place = np.searchsorted(rows.astype(np.int64) * n + cols, own)  # of the layout's pattern in that of the couplings
    which = np.repeat(place, np.diff(layout.part_start))
    if len(layout.block_volume):
        one, other = _block_pairs(layout)
        q = _rest_rows(layout)
        parts = np.concatenate([parts, (q[one][:, :, None] * q[other][:, None, :]).reshape(-1, 9)])
        keys = layout.pair_node[one].astype(np.int64) * n + layout.pair_node[other]
        which = np.concatenate([which, np.searchsorted(rows.astype(np.int64) * n + cols, keys)])
    sums = [np.bincount(which, weights=parts[:, c], minlength=len(cols)) for c in range(9)]
    blocks = np.stack(sums, axis=1).reshape(-1, 3, 3)
    inertia = np.zeros(len(cols))
    inertia[place] = 1.0 / settings.dt**2 * layout.mass
    inertia[rows == cols] += layout.node_damping / settings.dt
    return blocks + inertia[:, None, None] * eye


def _rest_rows(layout: Layout) -> Floats:
    """q of every pair of a volume block and a node at rest (S, 3) [√(N/m)]."""
    e, a = layout.pair_corner // 4, layout.pair_corner % 4
    which = np.repeat(np.arange(len(layout.pair_node)), np.diff(layout.pair_corner_start))
    slopes = layout.volume[e, None] * layout.grads[e, a]
    sums = np.stack([np.bincount(which, weights=slopes[:, c], minlength=len(layout.pair_node)) for c in range(3)], axis=1)
    scale: Floats = np.sqrt(layout.block_lam / layout.block_volume)
    return scale[layout.pair_block, None] * sums.astype(np.float64)


def dense_block(layout: Layout, blocks: Floats, rows: Ints, cols: Ints) -> Floats:
    """The part of a matrix between two lists of nodes, shape (3 rows, 3 cols)."""
    count = len(layout.node_rest)
    place, across = np.full(count, -1), np.full(count, -1)
    place[rows], across[cols] = np.arange(len(rows)), np.arange(len(cols))
    first, second = couplings(layout)
    i, j = place[first], across[second]
    inside = (i >= 0) & (j >= 0)
    dense = np.zeros((len(rows), 3, len(cols), 3))
    dense[i[inside], :, j[inside], :] = blocks[inside]
    return dense.reshape(3 * len(rows), 3 * len(cols))
