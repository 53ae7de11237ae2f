"""A press without a contact barrier: linear elasticity on the same tetrahedra, contact exact at their vertices. It errs by its mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

import ipc
from tests.ipc.oracles.closed_forms import Elastic, boussinesq_displacement

Floats = NDArray[np.float64]


def stiffness(mesh: ipc.TetMesh, solid: Elastic) -> sparse.csc_matrix:
    """The matrix of linear tetrahedra [N/m], (3N, 3N)."""
    x = mesh.vertices[mesh.tets]
    inverse = np.linalg.inv(x[:, 1:] - x[:, :1])
    grads = np.concatenate([-inverse.sum(axis=2)[:, None], np.swapaxes(inverse, 1, 2)], axis=1)
    volume = np.linalg.det(x[:, 1:] - x[:, :1]) / 6
    mu, lam = solid.shear, 2 * solid.shear * solid.poisson / (1 - 2 * solid.poisson)
    dots = np.einsum("tai,tbi->tab", grads, grads)
    blocks = lam * np.einsum("tai,tbj->tabij", grads, grads) + mu * np.einsum("tbi,taj->tabij", grads, grads)
    blocks += mu * dots[..., None, None] * np.eye(3)
    blocks *= volume[:, None, None, None, None]
    dof = 3 * mesh.tets[..., None].astype(np.int64) + np.arange(3)
    rows = np.broadcast_to(dof[:, :, None, :, None], blocks.shape)
    cols = np.broadcast_to(dof[:, None, :, None, :], blocks.shape)
    size = 3 * len(mesh.vertices)
    return sparse.csc_matrix((blocks.ravel(), (rows.ravel(), cols.ravel())), shape=(size, size))


def nodal_press(mesh: ipc.TetMesh, bonded: NDArray, solid: Elastic, limit: Floats, far_field: bool = True) -> float:
    """Force [N] that keeps every vertex at or below ``limit``.

    Args:
        mesh: its upper side is z = 0.
        bonded: vertices that carry the far field of the press, or nothing if ``far_field`` is false.
        solid: the material.
        limit: highest displacement along z of each vertex [m], (N,); infinite where the tool does not reach.
        far_field: see ``bonded``.

    The search for the vertices in contact adds those that cross and drops those that are pulled, until there are neither.
    """
    n = len(mesh.vertices)
    K = stiffness(mesh, solid)
    fixed = np.zeros(3 * n, bool)
    fixed[(3 * bonded[:, None] + np.arange(3)).ravel()] = True
    free = np.flatnonzero(~fixed)
    factor = splu(K[np.ix_(free, free)], permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
    place = np.full(3 * n, -1)
    place[free] = np.arange(len(free))
    unit = np.zeros(3 * n)
    unit[(3 * bonded[:, None] + np.arange(3)).ravel()] = boussinesq_displacement(solid, 1.0, mesh.vertices[bonded]).ravel()
    from_far = (
        factor.solve(-(K @ unit)[free]) if far_field else np.zeros(len(free))
    )  # effect of a unit force through the far field
    candidates = np.flatnonzero(np.isfinite(limit) & (place[2::3] >= 0))
    rows = place[3 * candidates + 2]
    right = np.zeros((len(free), len(candidates)))
    right[rows, np.arange(len(candidates))] = 1.0
    # Compliance: displacement of each candidate under a unit force on each, the far field of that force included.
    compliance = factor.solve(right)[rows] - from_far[rows][:, None]
    touching = limit[candidates] < 0
    for _ in range(100):
        force = np.zeros(len(candidates))
        force[touching] = np.linalg.solve(compliance[np.ix_(touching, touching)], limit[candidates][touching])
        crossed = ~touching & (compliance @ force > limit[candidates] + 1e-15)
        pulled = touching & (force > 0)
        if not crossed.any() and not pulled.any():
            return float(-force.sum())
        touching = (touching | crossed) & ~pulled
    raise ArithmeticError("the set of touching vertices did not settle")
