"""Conjugate gradients of an environment by one block of threads, in one launch.

A launch costs more than an iteration of a small system; a block can wait for its own threads at no such cost. One block has one
multiprocessor's bandwidth, so a single large system is better served by the launches of :mod:`ipc.solver.pcg`. On a CPU a block is one
thread, which does everything in order: Warp's own conjugate gradients take 10 ms there for one dot product of 9,450 numbers.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, MatArray2d, VecArray2d
from ipc.blocks import block_sum, wait_for_block
from ipc.contact.contacts import Contacts, rows_of
from ipc.solver.affine_elimination import Elimination, finish_elimination
from ipc.solver.linear import SystemView, add_row, block_row, find_volume_motion

wp.set_module_options({"enable_backward": False})


@wp.struct
class Scalars:
    """r·z of even and odd iterations, ‖r‖² at the start, iterations, negative curvature."""

    rz: FloatArray2d
    rr0: FloatArray
    iterations: IntArray
    negative: IntArray


@wp.func
def dot_share(env: wp.int32, lane: wp.int32, threads: wp.int32, r: VecArray2d, z: VecArray2d) -> wp.float64:
    """A thread's share of r·z."""
    total = wp.float64(0.0)
    for i in range(lane, r.shape[1], threads):
        total += wp.dot(r[env, i], z[env, i])
    return total


@wp.kernel
def solve_in_one_block(
    system: SystemView,
    contacts: Contacts,
    inverse: MatArray2d,
    affine: Elimination,
    tolerance: wp.float64,
    max_iterations: wp.int32,
    threads: wp.int32,
    lanes: wp.int32,
    active: IntArray,
    p: VecArray2d,
    Ap: VecArray2d,
    # outputs
    r: VecArray2d,
    x: VecArray2d,
    s: Scalars,
):
    """``threads`` work on an environment, ``lanes`` of them on its contact rows; CPU: 1."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    n = r.shape[1]
    affines = affine.node.shape[0]
    volumes = system.volume_motion.shape[1]
    rows = rows_of(contacts, env)
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    i = lane
    while i < n:
        z = inverse[env, i] * r[env, i]
        p[env, i] = z
        a += wp.length_sq(r[env, i])
        b += wp.dot(r[env, i], z)
        i += threads
    if affines > 0:
        wait_for_block()
        finish_elimination(affine, inverse, env, lane, threads, r, p)
        b = dot_share(env, lane, threads, r, p)
    rr0 = block_sum(a)
    rz = block_sum(b)
    if lane == 0:
        s.iterations[env] = 0
        s.negative[env] = 0
    if rr0 == wp.float64(0.0):
        return
    wait_for_block()
    for it in range(max_iterations):
        a = wp.float64(0.0)
        if volumes > 0:
            i = lane
            while i < volumes:
                find_volume_motion(system, env, i, p)
                i += threads
            wait_for_block()
        i = lane
        while i < n:
            f = wp.vec3d()
            if system.free[i] != 0:
                f = block_row(system, env, i, p)
                a += wp.dot(p[env, i], f)
            Ap[env, i] = f
            i += threads
        wait_for_block()
        i = lane
        if lane < lanes:
            while i < rows:
                a += add_row(system, contacts, env, i, p, Ap)
                i += lanes
        curvature = block_sum(a)
        if not (curvature > wp.float64(0.0)):
            if lane == 0:
                s.negative[env] = 1
            return
        if lane == 0:
            s.iterations[env] = it + 1
        wait_for_block()
        alpha = rz / curvature
        a = wp.float64(0.0)
        b = wp.float64(0.0)
        i = lane
        while i < n:
            x[env, i] = x[env, i] + alpha * p[env, i]
            r_new = r[env, i] - alpha * Ap[env, i]
            r[env, i] = r_new
            z = inverse[env, i] * r_new
            Ap[env, i] = z
            a += wp.length_sq(r_new)
            b += wp.dot(r_new, z)
            i += threads
        if affines > 0:
            wait_for_block()
            finish_elimination(affine, inverse, env, lane, threads, r, Ap)
            b = dot_share(env, lane, threads, r, Ap)
        rr = block_sum(a)
        rz_new = block_sum(b)
        if not (rr > tolerance * tolerance * rr0):
            return
        beta = rz_new / rz
        rz = rz_new
        i = lane
        while i < n:
            p[env, i] = Ap[env, i] + beta * p[env, i]
            i += threads
        wait_for_block()
