"""Cook's membrane by quadratic triangles in NumPy and SciPy: an oracle of its own for elements that lock.

A panel with the corners (0, 0), (48, 44), (48, 60) and (0, 44), clamped at x = 0, under a shear force of 1 that is spread evenly over
x = 48 (Cook 1974). The answer is the displacement along y of the middle of that edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

Floats = NDArray[np.float64]
LENGTH, CLAMPED, END = 48.0, 44.0, 16.0

_GAUSS = np.array([[1 / 6, 1 / 6], [2 / 3, 1 / 6], [1 / 6, 2 / 3]])
"""Points of a triangle's rule of second order; each has a third of the area."""


def panel(points: Floats) -> Floats:
    """Points (…, 2) of the unit square on the panel."""
    x, s = LENGTH * points[..., 0], points[..., 1]
    low, high = CLAMPED * x / LENGTH, CLAMPED + END * x / LENGTH
    return np.stack([x, low + s * (high - low)], axis=-1)


def tip_displacement(young: float, poisson: float, cells: int, *, plane_strain: bool) -> float:
    """Displacement of the middle of the loaded edge, on ``cells`` × ``cells`` squares of two triangles; ``cells`` is even."""
    n = 2 * cells + 1
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    nodes = panel(np.stack([i, j], axis=-1).reshape(-1, 2) / (n - 1))
    number = (i * n + j).astype(int)
    corners = 2 * np.stack(np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"), axis=-1).reshape(-1, 2)
    shapes = [[(0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)], [(0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)]]
    elements = np.concatenate([np.stack([number[tuple((corners + c).T)] for c in shape], axis=1) for shape in shapes])
    if plane_strain:
        young, poisson = young / (1 - poisson**2), poisson / (1 - poisson)
    elasticity = young / (1 - poisson**2) * np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, (1 - poisson) / 2]])
    stiffness = np.zeros((len(elements), 12, 12))
    for r, s in _GAUSS:
        slopes = _slopes(r, s)
        jacobian = np.einsum("ka,ekb->eab", slopes, nodes[elements])
        gradient = np.einsum("eab,kb->eka", np.linalg.inv(jacobian), slopes)
        strain = np.zeros((len(elements), 3, 12))
        strain[:, 0, 0::2], strain[:, 1, 1::2] = gradient[..., 0], gradient[..., 1]
        strain[:, 2, 0::2], strain[:, 2, 1::2] = gradient[..., 1], gradient[..., 0]
        area = np.linalg.det(jacobian)[:, None, None] / 6
        stiffness += area * np.einsum("eai,ab,ebj->eij", strain, elasticity, strain)
    dofs = (2 * elements[:, :, None] + np.arange(2)).reshape(len(elements), 12)
    rows, columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    matrix = coo_matrix((stiffness.ravel(), (rows, columns)), shape=(2 * n * n, 2 * n * n)).tocsr()
    load = np.zeros((n, n, 2))
    for k in range(cells):  # ∫ of a quadratic edge's functions: 1/6, 4/6, 1/6 of its length
        load[-1, 2 * k : 2 * k + 3, 1] += np.array([1, 4, 1]) / 6 / cells
    free = np.ones((n, n, 2), bool)
    free[0] = False
    keep = np.flatnonzero(free.ravel())
    u = np.zeros(2 * n * n)
    u[keep] = np.asarray(spsolve(matrix[keep][:, keep].tocsc(), load.ravel()[keep]))
    return float(u.reshape(n, n, 2)[-1, cells, 1])


def _slopes(r: float, s: float) -> Floats:
    """Derivatives by r and s of the six functions of a triangle: corners, then the middles of its edges, (6, 2)."""
    t = 1 - r - s
    return np.array(
        [
            [1 - 4 * t, 1 - 4 * t],
            [4 * r - 1, 0],
            [0, 4 * s - 1],
            [4 * (t - r), -4 * r],
            [4 * s, 4 * r],
            [-4 * s, 4 * (t - s)],
        ]
    )
