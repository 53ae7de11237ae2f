"""Affine bodies in units of their own stiffness: A = L Lᵀ of each 12 × 12 matrix.

An affine body is 10⁶ times as stiff against strain as against motion. In a system with pads its unknowns are therefore Lᵀ x and its forces
and contact rows L⁻¹ f and L⁻¹ q, for which its matrix is 1; otherwise the difference would be lost to rounding.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, VecArray2d
from ipc.contact.contacts import mat34d
from ipc.solver.linear import SystemView, row_column
from ipc.solver.preconditioners.contact_nodes import Rest, Small

wp.set_module_options({"enable_backward": False})

mat1212d = wp.types.matrix(shape=(12, 12), dtype=wp.float64)


@wp.kernel
def factor_affine(rest: Rest, system: SystemView, active: IntArray, small: Small):
    """L⁻¹ of every affine body, by the first of some threads.

    Where its matrix is not positive definite, that of the mean diagonal of its blocks.
    """
    env, body, lane = wp.tid()
    if active[env] == 0 or lane > 0:
        return
    first = 4 * body
    A = mat1212d()
    for i in range(4):
        node = rest.affine_node[first + i]
        k = system.row_base[node]
        for _ in range(system.row_length[node]):
            j = rest.affine[system.col[k]] - first
            block = system.blocks[env, k]
            for p in range(3):
                for q in range(3):
                    A[3 * i + p, 3 * j + q] = block[p, q]
            k += system.stride
    good = wp.bool(True)
    for j in range(12):
        d = A[j, j]
        for n in range(j):
            d -= A[j, n] * A[j, n]
        if not (d > wp.float64(0.0)):
            good = wp.bool(False)
            d = wp.float64(1.0)
        d = wp.sqrt(d)
        A[j, j] = d
        for i in range(j + 1, 12):
            e = A[i, j]
            for n in range(j):
                e -= A[i, n] * A[j, n]
            A[i, j] = e / d
    # L⁻¹ in the place of L.
    for j in range(12):
        A[j, j] = wp.float64(1.0) / A[j, j]
        for i in range(j + 1, 12):
            e = wp.float64(0.0)
            for n in range(j, i):
                e -= A[i, n] * A[n, j]
            A[i, j] = e / A[i, i]
    for i in range(4):
        for j in range(4):
            block = wp.mat33d()
            if good:
                for p in range(3):
                    for q in range(3):
                        if 3 * i + p >= 3 * j + q:
                            block[p, q] = A[3 * i + p, 3 * j + q]
            elif i == j:
                node = rest.affine_node[first + i]
                size = wp.abs(wp.trace(system.blocks[env, system.diagonal[node]])) / wp.float64(3.0)
                block = (wp.float64(1.0) / wp.sqrt(wp.max(size, wp.float64(1.0e-30)))) * wp.identity(n=3, dtype=wp.float64)
            small.root[env, first + i, j] = block


@wp.func
def scaled_row(g: mat34d, env: wp.int32, rest: Rest, small: Small, first: wp.int32) -> mat34d:
    """L⁻¹ g of a row at the nodes of the affine body whose first node is ``first``."""
    scaled = mat34d()
    for i in range(4):
        v = wp.vec3d()
        for j in range(i + 1):
            v += small.root[env, rest.affine[first] + i, j] * row_column(g, j)
        for c in range(3):
            scaled[c, i] = v[c]
    return scaled


@wp.func
def scaled_force(rest: Rest, small: Small, env: wp.int32, a: wp.int32, r: VecArray2d) -> wp.vec3d:
    """L⁻¹ r at affine node a."""
    f = wp.vec3d()
    first = 4 * (a / 4)
    for j in range(a - first + 1):
        f += small.root[env, a, j] * r[env, rest.affine_node[first + j]]
    return f


@wp.func
def affine_motion(rest: Rest, small: Small, env: wp.int32, a: wp.int32, r: VecArray2d) -> wp.vec3d:
    """L⁻ᵀ (L⁻¹ r − W t) at affine node a.

    L⁻¹ r is computed again, since other threads overwrite z, where it stood.
    """
    x = wp.vec3d()
    first = 4 * (a / 4)
    s = rest.surface[rest.affine_node[first]]
    for i in range(a - first, 4):
        f = scaled_force(rest, small, env, first + i, r)
        if small.count[env] > 0 and small.touched[env, s] != 0:  # none are left where the inverse could not be computed
            k = 3 * (small.slot[env, s] + i)
            f -= wp.vec3d(small.force[env, k], small.force[env, k + 1], small.force[env, k + 2])
        x += wp.transpose(small.root[env, first + i, a - first]) * f
    return x
