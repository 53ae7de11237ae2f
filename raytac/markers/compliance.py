"""Unit-load displacement fields of a pad at rest: how every coat vertex moves when one of them is pushed with 1 N.

The linear stiffness of the solver's own tetrahedra with the solver's Lamé constants, which is what its elastic energy is at rest to second
order, held where the case holds the pad; inverted once and kept on disk.
"""

from __future__ import annotations

import hashlib
import io

import numpy as np

from raytac.io.arrays import npy_bytes
from raytac.io.cache import cache_folder, keep_cached, read_cached
from raytac.io.code_digest import code_digest
from raytac.physics.soft.mesh import PadMesh
from raytac.specs.sensor import GelpadSpec

__all__ = ["cached_compliance", "coat_compliance", "rest_stiffness"]


def rest_stiffness(mesh: PadMesh, gelpad: GelpadSpec) -> np.ndarray:
    """Stiffness of all vertices [N/m], shape (3N, 3N): linear elasticity on constant-strain tetrahedra.

    A tetrahedron of volume V whose shape functions have gradients g adds V (λ g_a g_bᵀ + μ g_b g_aᵀ + μ (g_a · g_b) 1) to block (a, b).
    """
    young, poisson = gelpad.youngs_modulus, gelpad.poisson_ratio
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    tets = mesh.tets.tets
    x = mesh.tets.vertices[tets]
    edges = (x[:, 1:] - x[:, :1]).transpose(0, 2, 1)
    last = np.linalg.inv(edges)
    g = np.concatenate([-last.sum(axis=1, keepdims=True), last], axis=1)
    volume = np.linalg.det(edges) / 6
    blocks = lam * np.einsum("tai,tbj->taibj", g, g) + mu * np.einsum("taj,tbi->taibj", g, g)
    blocks += mu * np.einsum("tak,tbk,ij->taibj", g, g, np.eye(3))
    blocks *= volume[:, None, None, None, None]
    dof = (3 * tets[:, :, None] + np.arange(3)).reshape(len(tets), 12)
    n = 3 * len(mesh.tets.vertices)
    flat = (dof[:, :, None] * n + dof[:, None, :]).ravel()
    return np.bincount(flat, blocks.reshape(-1), minlength=n * n).reshape(n, n)


def coat_compliance(mesh: PadMesh, gelpad: GelpadSpec) -> np.ndarray:
    """Displacement of the coat's vertices by unit loads on them [m/N], shape (3V, 3V); degree of freedom 3 v + axis."""
    stiffness = rest_stiffness(mesh, gelpad)
    count = len(mesh.tets.vertices)
    free = np.setdiff1d(np.arange(count), mesh.bonded)
    dof = (3 * free[:, None] + np.arange(3)).ravel()
    number = np.full(count, -1)
    number[free] = np.arange(len(free))
    loads = number[mesh.coat_vertices]
    found = np.zeros((3 * len(loads), 3 * len(loads)))
    held = loads >= 0
    at = (3 * loads[held][:, None] + np.arange(3)).ravel()
    unit = np.zeros((len(dof), len(at)))
    unit[at, np.arange(len(at))] = 1.0
    fields = np.linalg.solve(stiffness[np.ix_(dof, dof)], unit)
    own = (3 * np.flatnonzero(held)[:, None] + np.arange(3)).ravel()
    found[np.ix_(own, own)] = fields[at]
    return found


def cached_compliance(mesh: PadMesh, gelpad: GelpadSpec) -> np.ndarray:
    """``coat_compliance``, float32, from the user's cache if it was made before; one that is damaged is made again, with a warning."""
    arrays = mesh.tets.vertices, mesh.tets.tets, mesh.bonded, mesh.coat_vertices
    basis = repr(gelpad), *(array.tobytes() for array in arrays), code_digest(__name__)
    digest = hashlib.sha256(repr(basis).encode()).hexdigest()[:24]
    folder = cache_folder("markers")
    path = None if folder is None else folder / f"compliance-{digest}.npy"
    kept = read_cached(path)
    if kept is not None:
        return np.load(io.BytesIO(kept), allow_pickle=False)
    fields = coat_compliance(mesh, gelpad).astype(np.float32)
    keep_cached(path, npy_bytes(fields))
    return fields
