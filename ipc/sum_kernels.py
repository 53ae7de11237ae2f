"""Kernels of ``StepSums``.

Forces, boxes and motions of whole bodies, and forces between two of them.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false
# pyright: reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, MatArray2d, VecArray2d
from ipc.blocks import block_max, block_sum
from ipc.contact.contacts import Contacts
from ipc.contact.friction import Lagged, friction_slope_ratio, sliding

wp.set_module_options({"enable_backward": False})


@wp.struct
class SumLayout:
    """Parts of :class:`ipc.bodies.layout.Layout` that the sums need.

    ``corner`` (A, 3) is the place of each affine body's first corner in its own frame [m], ``gradient`` (A, 4) of ``vec3d`` those of its
    corners' weights [1/m], and ``affine`` (bodies,) the body's number among them, −1 for another. ``framed`` is 1 where a frame carries a
    body, ``share`` the mass of each node [kg].
    """

    framed: IntArray
    affine: IntArray
    node_start: IntArray
    vert_start: IntArray
    vert_body: IntArray
    vert_area: FloatArray
    first_body: IntArray
    share: FloatArray
    row_start: IntArray
    col: IntArray
    mass: FloatArray
    corner: wp.array(dtype=wp.vec3d)
    gradient: wp.array2d(dtype=wp.vec3d)


@wp.struct
class BodySums:
    """Of each body; see ``StepSums``."""

    force: VecArray2d
    torque: VecArray2d
    area: FloatArray2d
    low: VecArray2d
    high: VecArray2d
    rotation: MatArray2d
    position: VecArray2d
    centre: VecArray2d
    velocity: VecArray2d
    spin: VecArray2d
    inertia: MatArray2d


@wp.struct
class PairSums:
    """Of each pair of bodies; see ``StepSums``."""

    normal: VecArray2d
    place: VecArray2d
    force: VecArray2d
    torque: VecArray2d


@wp.func
def nearest_rotation(A: wp.mat33d) -> wp.mat33d:
    """The rotation nearest to A: U Vᵀ of its singular value decomposition."""
    U, _sigma, V = wp.svd3(A)
    if wp.determinant(U) * wp.determinant(V) < wp.float64(0.0):
        for i in range(3):
            U[i, 2] = -U[i, 2]
    return U * wp.transpose(V)


@wp.func
def sum_vector(v: wp.vec3d) -> wp.vec3d:
    """Sum over the threads of the block, for each of them."""
    return wp.vec3d(block_sum(v[0]), block_sum(v[1]), block_sum(v[2]))


@wp.func
def sum_matrix(A: wp.mat33d) -> wp.mat33d:
    """The same of matrices."""
    return wp.matrix_from_rows(sum_vector(A[0]), sum_vector(A[1]), sum_vector(A[2]))


@wp.func
def max_vector(v: wp.vec3d) -> wp.vec3d:
    """The largest of each component."""
    return wp.vec3d(block_max(v[0]), block_max(v[1]), block_max(v[2]))


@wp.kernel
def sum_bodies(
    layout: SumLayout, x: VecArray2d, y: VecArray2d, v: VecArray2d, R: MatArray2d, t: VecArray2d, gradient: VecArray2d,
    threads: wp.int32,
    # outputs
    out: BodySums,
):  # fmt: skip
    """A block of ``threads`` for each environment and body."""
    env, body, lane = wp.tid()
    turn, origin = wp.identity(n=3, dtype=wp.float64), wp.vec3d()
    first, last = layout.node_start[body], layout.node_start[body + 1]
    if layout.framed[body] != 0:
        turn = R[env, body] + wp.mat33d()
        origin = t[env, body] + wp.vec3d()
    elif layout.affine[body] >= 0:
        A, a = wp.mat33d(), layout.affine[body]
        for k in range(4):
            A += wp.outer(y[env, first + k], layout.gradient[a, k])
        origin = y[env, first] - A * layout.corner[a]
        turn = nearest_rotation(A)
    force, torque, area = wp.vec3d(), wp.vec3d(), wp.vec3d()
    for k in range(layout.vert_start[body] + lane, layout.vert_start[body + 1], threads):
        f = -gradient[env, k]
        if wp.length_sq(f) > wp.float64(0.0):
            area[0] = area[0] + layout.vert_area[k]
            force += f
            torque += wp.cross(x[env, k] - origin, f)
    force, torque, area = sum_vector(force), sum_vector(torque), sum_vector(area)
    low, high = wp.vec3d(wp.float64(wp.inf)), wp.vec3d(-wp.float64(wp.inf))
    for i in range(first + lane, last, threads):
        low, high = wp.min(low, y[env, i]), wp.max(high, y[env, i])
    low, high = -max_vector(-low), max_vector(high)
    if lane == 0:
        out.rotation[env, body] = turn
        out.position[env, body] = origin
        out.force[env, body] = force
        out.torque[env, body] = torque
        out.area[env, body] = area[0]
        out.low[env, body] = low
        out.high[env, body] = high
    if first == last:
        return
    frame = R[env, body] + wp.mat33d()
    start = t[env, body] + wp.vec3d()
    if layout.framed[body] == 0:
        frame = wp.identity(n=3, dtype=wp.float64)
        start = wp.vec3d()
    total, centre, velocity = wp.vec3d(), wp.vec3d(), wp.vec3d()
    for i in range(first + lane, last, threads):
        total[0] = total[0] + layout.share[i]
        centre += layout.share[i] * y[env, i]
        velocity += layout.share[i] * v[env, i]
    total = sum_vector(total)
    centre, velocity = sum_vector(centre) / total[0], sum_vector(velocity) / total[0]
    second, momentum = wp.mat33d(), wp.vec3d()
    for i in range(first + lane, last, threads):
        arm = frame * (y[env, i] - centre)
        carried, moved = layout.share[i] * arm, layout.share[i] * (v[env, i] - velocity)
        if layout.affine[body] >= 0:  # whose mass is not lumped
            carried, moved = wp.vec3d(), wp.vec3d()
            for k in range(layout.row_start[i], layout.row_start[i + 1]):
                j = layout.col[k]
                carried += layout.mass[k] * (y[env, j] - centre)
                moved += layout.mass[k] * (v[env, j] - velocity)
        second += wp.outer(arm, carried)
        momentum += wp.cross(arm, moved)
    second, momentum = sum_matrix(second), sum_vector(momentum)
    inertia = wp.trace(second) * wp.identity(n=3, dtype=wp.float64) - second
    if lane == 0:
        out.centre[env, body] = frame * centre + start
        out.velocity[env, body] = velocity
        out.inertia[env, body] = inertia
        out.spin[env, body] = wp.inverse(inertia) * momentum


@wp.func
def point_of(layout: SumLayout, x: VecArray2d, env: wp.int32, verts: wp.vec4i, coef: wp.vec4d, side: wp.float64) -> wp.vec3d:
    """Point of action on the pair's first body [m]."""
    point, total = wp.vec3d(), wp.float64(0.0)
    for i in range(4):
        if verts[i] >= 0:
            weight = wp.max(side * coef[i], wp.float64(0.0))
            point += weight * x[env, verts[i]]
            total += weight
    return point / total


@wp.func
def side_of(layout: SumLayout, verts: wp.vec4i, pair: wp.int32) -> wp.float64:
    """1 or −1: the force on the pair's first body is this times that of the contact."""
    if layout.vert_body[verts[0]] == layout.first_body[pair]:
        return wp.float64(1.0)
    return wp.float64(-1.0)


@wp.kernel
def sum_pairs(
    layout: SumLayout, x: VecArray2d, x_start: VecArray2d, contacts: Contacts, lagged: Lagged, eps: wp.float64,
    threads: wp.int32,
    # outputs
    out: PairSums,
):  # fmt: skip
    """A block of ``threads`` for each environment and pair.

    Without friction ``lagged`` has no pairs.
    """
    env, pair, lane = wp.tid()
    normal, place, weight = wp.vec3d(), wp.vec3d(), wp.vec3d()
    count = wp.min(contacts.count[env], contacts.force.shape[1])
    for k in range(lane, count, threads):
        if contacts.pair[env, k] == pair:
            side, size = side_of(layout, contacts.verts[env, k], pair), contacts.force[env, k]
            normal += side * size * contacts.normal[env, k]
            place += size * point_of(layout, x, env, contacts.verts[env, k], contacts.coef[env, k], side)
            weight[0] = weight[0] + size
    normal, place, weight = sum_vector(normal), sum_vector(place), sum_vector(weight)
    if lane == 0:
        out.normal[env, pair] = normal
    if weight[0] == wp.float64(0.0):
        if lane == 0:
            out.place[env, pair] = wp.vec3d(wp.float64(wp.nan))
            out.force[env, pair] = wp.vec3d()
            out.torque[env, pair] = wp.vec3d()
        return
    place = place / weight[0]
    force, torque = wp.vec3d(), wp.vec3d()
    for k in range(lane, count, threads):
        if contacts.pair[env, k] == pair:
            verts = contacts.verts[env, k]
            side = side_of(layout, verts, pair)
            f = side * contacts.force[env, k] * contacts.normal[env, k]
            force += f
            torque += wp.cross(point_of(layout, x, env, verts, contacts.coef[env, k], side) - place, f)
    for k in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), threads):
        if lagged.pair[env, k] == pair:
            corners, coef, n = lagged.verts[env, k], lagged.coef[env, k], lagged.normal[env, k]
            s = side_of(layout, corners, pair)
            w = lagged.slip[env, k] + sliding(x, x_start, env, corners, coef, n)
            g = -s * lagged.limit[env, k] * friction_slope_ratio(wp.length(w), eps) * w
            force += g
            torque += wp.cross(point_of(layout, x, env, corners, coef, s) - place, g)
    force, torque = sum_vector(force), sum_vector(torque)
    if lane == 0:
        out.place[env, pair] = place
        out.force[env, pair] = force
        out.torque[env, pair] = torque
