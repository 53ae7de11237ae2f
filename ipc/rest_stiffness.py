"""The matrix of the Newton system at rest, without contact, on the host: what a bonded body has in every environment and every step.

At F = 1 the second derivative of the energies in ``ipc/elasticity.py`` couples the corners a and b of a tetrahedron by

    V (m g_a·g_b 1 + k g_a g_bᵀ + λ g_a g_bᵀ + m [g_a × g_b]_×),      m = μ, k = 0 (stable);   m = 3μ/4, k = μ/8 (stable_log),

since c = −m there (the rest state carries no stress), and K_0 = K + M/h² + damping.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipc.layout import Layout
from ipc.settings import Settings

__all__ = ["bonded_bodies", "rest_blocks", "rest_inverse"]

Floats = NDArray[np.float64]


def bonded_bodies(layout: Layout) -> list[int]:
    """Soft bodies with bonded vertices: in their frame the rest state stays what it is, wherever the frame goes."""
    return [b for b in range(len(layout.names)) if layout.framed[b] and layout.node_start[b] < layout.node_start[b + 1]]


def rest_blocks(layout: Layout, settings: Settings) -> Floats:
    """Blocks of K_0 [N/m] in the pattern of the layout, shape (K, 3, 3); those of affine bodies mean nothing.

    BDF2 weighs inertia by 9/4 (``ipc/dynamics.py``), except in first steps; its matrix stands for both, and is within that factor.
    """
    scale = (2.25 if settings.integrator == "bdf2" else 1.0) / settings.dt**2
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
    inertia = scale * layout.mass
    rows = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
    inertia[rows == layout.col] += layout.node_damping / settings.dt
    return blocks + inertia[:, None, None] * eye


def rest_inverse(layout: Layout, blocks: Floats, nodes: NDArray[np.integer]) -> NDArray[np.float32]:
    """K_0⁻¹ of some nodes [m/N], the others held, dense and symmetric, shape (3n, 3n).

    Raises:
        numpy.linalg.LinAlgError: if the inverse rounded to single precision is not positive definite.
    """
    place = np.full(len(layout.node_rest), -1)
    place[nodes] = np.arange(len(nodes))
    rows = place[np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))]
    cols = place[layout.col]
    inside = (rows >= 0) & (cols >= 0)
    dense = np.zeros((len(nodes), 3, len(nodes), 3))
    dense[rows[inside], :, cols[inside], :] = blocks[inside]
    inverse = np.linalg.inv(dense.reshape(3 * len(nodes), 3 * len(nodes)))
    single = (0.5 * (inverse + inverse.T)).astype(np.float32)
    np.linalg.cholesky(single.astype(np.float64))
    return single
