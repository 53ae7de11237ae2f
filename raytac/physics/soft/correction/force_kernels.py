"""Forces on vertices in contact that hold a mesh where it is, by one block a pad."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from ipc.solver.pcg_block import block_sum, wait_for_block

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
THREADS = 128
"""Threads of a block on CUDA."""


@wp.struct
class Unknowns:
    """Unknowns of the linear systems of B pads, of n numbers each."""

    count: wp.array(dtype=wp.int32)
    """Unknowns that are free, (B,)."""
    index: wp.array2d(dtype=wp.int32)
    """Their numbers, (B, n)."""


@wp.kernel
def solve_in_one_block(
    matrix: wp.array2d(dtype=wp.float64),
    unknowns: Unknowns,
    wanted: wp.array2d(dtype=wp.float64),
    tolerance: wp.float64,
    iterations: wp.int32,
    threads: wp.int32,
    # outputs
    r: wp.array2d(dtype=wp.float64),
    p: wp.array2d(dtype=wp.float64),
    Ap: wp.array2d(dtype=wp.float64),
    x: wp.array2d(dtype=wp.float64),
):
    """x (B, n) with (matrix x) = ``wanted`` at the free unknowns, 0 elsewhere.

    By conjugate gradients. ``matrix`` (n, n) is symmetric and positive definite over them. It ends when ‖r‖ is below ``tolerance``.
    """
    env, lane = wp.tid()
    n = unknowns.count[env]
    i = lane
    while i < x.shape[1]:
        x[env, i] = _0
        i += threads
    wait_for_block()
    a = wp.float64(0.0)
    i = lane
    while i < n:
        residual = wanted[env, unknowns.index[env, i]]
        r[env, i] = residual
        p[env, i] = residual
        a += residual * residual
        i += threads
    rr = block_sum(a)
    wait_for_block()
    for _it in range(iterations):
        if not (rr > tolerance * tolerance):
            return
        a = wp.float64(0.0)
        i = lane
        while i < n:
            row = unknowns.index[env, i]
            total = wp.float64(0.0)
            k = wp.int32(0)
            while k < n:
                total += matrix[row, unknowns.index[env, k]] * p[env, k]
                k += 1
            Ap[env, i] = total
            a += p[env, i] * total
            i += threads
        pAp = block_sum(a)
        wait_for_block()
        if not (pAp > _0):  # only rounding remains
            return
        alpha = rr / pAp
        a = wp.float64(0.0)
        i = lane
        while i < n:
            number = unknowns.index[env, i]
            x[env, number] = x[env, number] + alpha * p[env, i]
            residual = r[env, i] - alpha * Ap[env, i]
            r[env, i] = residual
            a += residual * residual
            i += threads
        rr_new = block_sum(a)
        beta = rr_new / rr
        rr = rr_new
        i = lane
        while i < n:
            p[env, i] = r[env, i] + beta * p[env, i]
            i += threads
        wait_for_block()


@wp.kernel
def respond(
    matrix: wp.array2d(dtype=wp.float64), unknowns: Unknowns, forces: wp.array2d(dtype=wp.float64),
    # outputs
    moved: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Matrix times forces, (B, rows), by (environment, row); free unknowns alone have forces."""
    env, row = wp.tid()
    total = wp.float64(0.0)
    k, end = wp.int32(0), unknowns.count[env]
    while k < end:
        number = unknowns.index[env, k]
        total += matrix[row, number] * forces[env, number]
        k += 1
    moved[env, row] = total


@wp.kernel
def take_component(values: wp.array3d(dtype=wp.float64), component: wp.int32, out: wp.array2d(dtype=wp.float64)):
    """One component of values (B, C, n)."""
    env, i = wp.tid()
    out[env, i] = values[env, component, i]
