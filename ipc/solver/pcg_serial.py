"""Conjugate gradients of an environment by one thread (:mod:`ipc.solver.halves`)."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, MatArray2d, VecArray2d
from ipc.contact.contacts import Contacts
from ipc.solver.affine_elimination import Elimination, finish_elimination
from ipc.solver.halves import multiply_half
from ipc.solver.linear import SystemView
from ipc.solver.lines import Lines, apply_lines
from ipc.solver.pcg_block import Scalars, dot_share

wp.set_module_options({"enable_backward": False})


@wp.func
def precondition(
    lines: Lines, inverse: MatArray2d, affine: Elimination, env: wp.int32, r: VecArray2d, z: VecArray2d
) -> wp.float64:
    """z = M⁻¹ r; returns r·z."""
    rz = apply_lines(lines, inverse, env, r, z)
    if affine.node.shape[0] > 0:
        finish_elimination(affine, inverse, env, 0, 1, r, z)
        rz = dot_share(env, 0, 1, r, z)
    return rz


@wp.kernel
def solve_serially(
    system: SystemView,
    contacts: Contacts,
    inverse: MatArray2d,
    lines: Lines,
    affine: Elimination,
    tolerance: wp.float64,
    max_iterations: wp.int32,
    active: IntArray,
    p: VecArray2d,
    Ap: VecArray2d,
    # outputs
    r: VecArray2d,
    x: VecArray2d,
    s: Scalars,
):
    """Add the solution of H δ = r to x; r becomes the residual."""
    env = wp.tid()
    if active[env] == 0:
        return
    n = lines.node.shape[0]
    rz = precondition(lines, inverse, affine, env, r, p)
    rr0 = dot_share(env, 0, 1, r, r)
    s.iterations[env] = 0
    s.negative[env] = 0
    if rr0 == wp.float64(0.0):
        return
    for it in range(max_iterations):
        curvature = multiply_half(system, contacts, env, p, Ap)
        if not (curvature > wp.float64(0.0)):
            s.negative[env] = 1
            return
        s.iterations[env] = it + 1
        alpha, rr = rz / curvature, wp.float64(0.0)
        for k in range(n):
            i = lines.node[k]
            x[env, i] = x[env, i] + alpha * p[env, i]
            r_new = r[env, i] - alpha * Ap[env, i]
            r[env, i] = r_new
            rr += wp.length_sq(r_new)
        rz_new = precondition(lines, inverse, affine, env, r, Ap)
        if not (rr > tolerance * tolerance * rr0):
            return
        beta = rz_new / rz
        rz = rz_new
        for k in range(n):
            i = lines.node[k]
            p[env, i] = Ap[env, i] + beta * p[env, i]
