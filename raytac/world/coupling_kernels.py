"""Kernels of ``Coupling``.

Contacts of an interval, and the implicit law in a step of MuJoCo; one thread an environment.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.robots.arm_kernels import rotation_vector

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
NOTHING = wp.constant(-1)
"""Side of a contact that stands still.

Bodies of MuJoCo are 0 and more, bodies of the solver −2 and less.
"""


@wp.struct
class Robot:
    """State of MuJoCo in B environments, n coupled bodies, v degrees of freedom; float64."""

    place: wp.array2d(dtype=wp.vec3d)
    """Origins of the bodies' frames [m], (B, n)."""
    turn: wp.array2d(dtype=wp.mat33d)
    centre: wp.array2d(dtype=wp.vec3d)
    """Centres of mass [m], (B, n)."""
    root: wp.array2d(dtype=wp.vec3d)
    """Points about which ``motion`` is given [m], (B, n)."""
    motion: wp.array3d(dtype=wp.float64)
    """Rotation and displacement by each degree of freedom, (B, v, 6): MuJoCo's ``cdof``."""
    moves: wp.array2d(dtype=wp.int32)
    """1 where a degree of freedom moves a body, (n, v)."""
    speed: wp.array2d(dtype=wp.float64)
    free: wp.array2d(dtype=wp.float64)
    """Accelerations without constraints, with w₀, (B, v)."""
    mass: wp.array3d(dtype=wp.float64)
    """Inertia matrix, (B, v, v): its lower triangle."""


@wp.struct
class Contacts:
    """Contacts of an interval, up to K an environment; see ``CoupledContact``."""

    count: wp.array(dtype=wp.int32)
    side: wp.array3d(dtype=wp.int32)
    """(B, K, 2): a coupled body, ``NOTHING``, or body s of the solver as −2 − s."""
    stiffness: wp.array4d(dtype=wp.float64)
    """(B, K, 6, 6)."""
    place: wp.array2d(dtype=wp.vec3d)
    normal: wp.array2d(dtype=wp.vec3d)
    opens: wp.array2d(dtype=wp.int32)
    """1 for a contact that opens where its normal force would pull."""
    force: wp.array2d(dtype=wp.vec3d)
    """Share of the contact in w₀, with ``torque`` about ``place``."""
    torque: wp.array2d(dtype=wp.vec3d)


@wp.struct
class SolverBodies:
    """Bodies that the solver moves, S an environment; see ``SolverBody``."""

    mass: wp.array2d(dtype=wp.float64)
    """[kg]; 0 of one that is not there."""
    inertia: wp.array2d(dtype=wp.mat33d)
    centre: wp.array2d(dtype=wp.vec3d)
    velocity: wp.array2d(dtype=wp.vec3d)
    spin: wp.array2d(dtype=wp.vec3d)
    force: wp.array2d(dtype=wp.vec3d)
    torque: wp.array2d(dtype=wp.vec3d)


@wp.struct
class Interval:
    """Memory of an interval: its beginning, and its bodies since."""

    wrench: wp.array3d(dtype=wp.float64)
    """w₀ on each coupled body about its frame's origin, (B, n, 6)."""
    anchor: wp.array3d(dtype=wp.vec3d)
    """Point of each contact in the frames of its two sides [m], (B, K, 2)."""
    rotation: wp.array2d(dtype=wp.mat33d)
    """Rotation of the first side in the frame of the other, (B, K)."""
    shift: wp.array2d(dtype=wp.vec3d)
    """Displacement of each solver body [m], (B, S), and its rotation vector ``swing`` [rad]."""
    swing: wp.array2d(dtype=wp.vec3d)
    velocity: wp.array2d(dtype=wp.vec3d)
    spin: wp.array2d(dtype=wp.vec3d)
    applied: wp.array3d(dtype=wp.float64)
    """Wrench on each coupled body about its centre of mass, as MuJoCo takes it, (B, n, 6)."""


@wp.struct
class Work:
    """Room for the law in each environment; R = 6 K."""

    points: wp.array2d(dtype=wp.vec3d)
    closed: wp.array2d(dtype=wp.int32)
    factor: wp.array3d(dtype=wp.float64)
    """Cholesky factor of the inertia, (B, v, v)."""
    jacobian: wp.array3d(dtype=wp.float64)
    """J, (B, R, v)."""
    solved: wp.array3d(dtype=wp.float64)
    """J M⁻¹, (B, R, v)."""
    mobility: wp.array3d(dtype=wp.float64)
    """A, (B, R, R)."""
    matrix: wp.array3d(dtype=wp.float64)
    shift: wp.array2d(dtype=wp.float64)
    """Δ + h J v_free, (B, R)."""
    fixed: wp.array2d(dtype=wp.float64)
    """c of opened contacts, (B, R)."""
    c: wp.array2d(dtype=wp.float64)


@wp.func
def rotation_of(r: wp.vec3d) -> wp.mat33d:
    """Rotation matrix of a rotation vector [rad]."""
    angle = wp.length(r)
    if angle == _0:
        return wp.identity(n=3, dtype=wp.float64)
    return wp.quat_to_matrix(wp.quat_from_axis_angle(r / angle, angle))


@wp.func
def turn_of(robot: Robot, interval: Interval, env: wp.int32, side: wp.int32) -> wp.mat33d:
    """Present rotation of a side; a solver body began with the world's axes."""
    if side >= 0:
        return robot.turn[env, side]
    if side == NOTHING:
        return wp.identity(n=3, dtype=wp.float64)
    return rotation_of(interval.swing[env, -2 - side])


@wp.func
def place_of(robot: Robot, bodies: SolverBodies, interval: Interval, env: wp.int32, side: wp.int32) -> wp.vec3d:
    """Present origin of a side [m]."""
    if side >= 0:
        return robot.place[env, side]
    if side == NOTHING:
        return wp.vec3d()
    return bodies.centre[env, -2 - side] + interval.shift[env, -2 - side]


@wp.kernel
def begin_interval(
    chosen: wp.array(dtype=wp.int32), robot: Robot, contacts: Contacts, bodies: SolverBodies,
    # outputs
    interval: Interval,
):  # fmt: skip
    """Remember where contacts and bodies are, in the environments ``chosen`` (B,)."""
    env = wp.tid()
    if chosen[env] == 0:
        return
    for s in range(bodies.mass.shape[1]):
        interval.shift[env, s] = wp.vec3d()
        interval.swing[env, s] = wp.vec3d()
        interval.velocity[env, s] = bodies.velocity[env, s]
        interval.spin[env, s] = bodies.spin[env, s]
    for k in range(contacts.count[env]):
        first, other = contacts.side[env, k, 0], contacts.side[env, k, 1]
        at = contacts.place[env, k]
        turn, turn2 = turn_of(robot, interval, env, first), turn_of(robot, interval, env, other)
        interval.anchor[env, k, 0] = wp.transpose(turn) * (at - place_of(robot, bodies, interval, env, first))
        interval.anchor[env, k, 1] = wp.transpose(turn2) * (at - place_of(robot, bodies, interval, env, other))
        interval.rotation[env, k] = wp.transpose(turn2) * turn


@wp.kernel
def clear_interval(chosen: wp.array(dtype=wp.int32), contacts: Contacts, interval: Interval):
    """No contacts and no forces in the environments ``chosen`` (B,)."""
    env = wp.tid()
    if chosen[env] == 0:
        return
    contacts.count[env] = 0
    for body in range(interval.wrench.shape[1]):
        for i in range(6):
            interval.wrench[env, body, i] = _0
            interval.applied[env, body, i] = _0


@wp.func
def add_wrench(out: wp.array3d(dtype=wp.float64), env: wp.int32, body: wp.int32, force: wp.vec3d, torque: wp.vec3d):
    for i in range(3):
        out[env, body, i] = out[env, body, i] + force[i]
        out[env, body, 3 + i] = out[env, body, 3 + i] + torque[i]


@wp.kernel
def hold_wrenches(robot: Robot, interval: Interval):
    """``applied`` for w₀ alone: from the frames' origins to the centres of mass."""
    env, body = wp.tid()
    w = interval.wrench
    force = wp.vec3d(w[env, body, 0], w[env, body, 1], w[env, body, 2])
    torque = wp.vec3d(w[env, body, 3], w[env, body, 4], w[env, body, 5])
    for i in range(6):
        interval.applied[env, body, i] = _0
    arm = robot.place[env, body] - robot.centre[env, body]
    add_wrench(interval.applied, env, body, force, torque + wp.cross(arm, force))


@wp.func
def factorise(robot: Robot, work: Work, env: wp.int32, n: wp.int32):
    """Cholesky factor L of the inertia."""
    for i in range(n):
        for j in range(i + 1):
            total = wp.float64(robot.mass[env, i, j])
            for k in range(j):
                total -= work.factor[env, i, k] * work.factor[env, j, k]
            if i == j:
                work.factor[env, i, i] = wp.sqrt(total)
            else:
                work.factor[env, i, j] = total / work.factor[env, j, j]


@wp.func
def solve_row(work: Work, env: wp.int32, row: wp.int32, n: wp.int32):
    """``solved[row]`` = M⁻¹ ``jacobian[row]``."""
    for i in range(n):
        total = wp.float64(work.jacobian[env, row, i])
        for k in range(i):
            total -= work.factor[env, i, k] * work.solved[env, row, k]
        work.solved[env, row, i] = total / work.factor[env, i, i]
    for back in range(n):
        i = n - 1 - back
        total = wp.float64(work.solved[env, row, i])
        for k in range(i + 1, n):
            total -= work.factor[env, k, i] * work.solved[env, row, k]
        work.solved[env, row, i] = total / work.factor[env, i, i]


@wp.func
def add_jacobian(robot: Robot, work: Work, env: wp.int32, row: wp.int32, body: wp.int32, point: wp.vec3d, sign: wp.float64):
    """Velocity and spin of a body's point by every degree of freedom.

    Into rows ``row`` to ``row + 5``.
    """
    arm = point - robot.root[env, body]
    for d in range(robot.speed.shape[1]):
        if robot.moves[body, d] != 0:
            m = robot.motion
            turn = wp.vec3d(m[env, d, 0], m[env, d, 1], m[env, d, 2])
            shift = wp.vec3d(m[env, d, 3], m[env, d, 4], m[env, d, 5]) + wp.cross(turn, arm)
            for i in range(3):
                work.jacobian[env, row + i, d] = work.jacobian[env, row + i, d] + sign * shift[i]
                work.jacobian[env, row + 3 + i, d] = work.jacobian[env, row + 3 + i, d] + sign * turn[i]


@wp.func
def cross_matrix(r: wp.vec3d) -> wp.mat33d:
    return wp.mat33d(_0, -r[2], r[1], r[2], _0, -r[0], -r[1], r[0], _0)


@wp.func
def add_block(work: Work, env: wp.int32, row: wp.int32, col: wp.int32, sign: wp.float64, block: wp.mat33d):
    for i in range(3):
        for j in range(3):
            work.mobility[env, row + i, col + j] = work.mobility[env, row + i, col + j] + sign * block[i, j]


@wp.func
def solve_law(work: Work, env: wp.int32, rows: wp.int32):
    """c from ``matrix`` c = c: Gaussian elimination with partial pivoting."""
    a, b = work.matrix, work.c
    for k in range(rows):
        best, size = wp.int32(k), wp.abs(a[env, k, k])
        for i in range(k + 1, rows):
            if wp.abs(a[env, i, k]) > size:
                best, size = wp.int32(i), wp.abs(a[env, i, k])
        if best != k:
            for j in range(k, rows):
                swapped = wp.float64(a[env, k, j])
                a[env, k, j] = a[env, best, j]
                a[env, best, j] = swapped
            kept = wp.float64(b[env, k])
            b[env, k] = b[env, best]
            b[env, best] = kept
        for i in range(k + 1, rows):
            factor = a[env, i, k] / a[env, k, k]
            if factor != _0:
                for j in range(k, rows):
                    a[env, i, j] = a[env, i, j] - factor * a[env, k, j]
                b[env, i] = b[env, i] - factor * b[env, k]
    for back in range(rows):
        i = rows - 1 - back
        total = wp.float64(b[env, i])
        for j in range(i + 1, rows):
            total -= a[env, i, j] * b[env, j]
        b[env, i] = total / a[env, i, i]


@wp.func
def place_contacts(robot: Robot, contacts: Contacts, bodies: SolverBodies, interval: Interval, work: Work, env: wp.int32):
    """Points of the contacts, their Δ in ``shift`` and J."""
    for k in range(contacts.count[env]):
        first, other = contacts.side[env, k, 0], contacts.side[env, k, 1]
        turn, turn2 = turn_of(robot, interval, env, first), turn_of(robot, interval, env, other)
        point = place_of(robot, bodies, interval, env, first) + turn * interval.anchor[env, k, 0]
        there = place_of(robot, bodies, interval, env, other) + turn2 * interval.anchor[env, k, 1]
        turned = turn2 * rotation_vector(wp.transpose(turn2) * turn * wp.transpose(interval.rotation[env, k]))
        work.points[env, k] = point
        work.closed[env, k] = 1
        for i in range(3):
            work.shift[env, 6 * k + i] = point[i] - there[i]
            work.shift[env, 6 * k + 3 + i] = turned[i]
        for i in range(6):
            work.fixed[env, 6 * k + i] = _0
            for d in range(robot.speed.shape[1]):
                work.jacobian[env, 6 * k + i, d] = _0
        if first >= 0:
            add_jacobian(robot, work, env, 6 * k, first, point, _1)
        if other >= 0:
            add_jacobian(robot, work, env, 6 * k, other, point, -_1)


@wp.func
def sign_of(contacts: Contacts, env: wp.int32, k: wp.int32, side: wp.int32) -> wp.float64:
    """1, −1 or 0: whether a solver body is the first side of a contact, the other, or none."""
    if contacts.side[env, k, 0] == side:
        return _1
    if contacts.side[env, k, 1] == side:
        return -_1
    return _0


@wp.func
def find_mobility(
    robot: Robot, contacts: Contacts, bodies: SolverBodies, interval: Interval, work: Work, env: wp.int32, rows: wp.int32
):
    """A = J M⁻¹ Jᵀ of the robot and of the solver's bodies."""
    n = robot.speed.shape[1]
    for i in range(rows):
        solve_row(work, env, i, n)
    for i in range(rows):
        for j in range(rows):
            total = wp.float64(0.0)
            for d in range(n):
                total += work.jacobian[env, i, d] * work.solved[env, j, d]
            work.mobility[env, i, j] = total
    for s in range(bodies.mass.shape[1]):
        if bodies.mass[env, s] == _0:
            continue
        light, quick = _1 / bodies.mass[env, s], wp.inverse(bodies.inertia[env, s])
        for k in range(contacts.count[env]):
            sign = sign_of(contacts, env, k, -2 - s)
            for m in range(contacts.count[env]):
                both = sign * sign_of(contacts, env, m, -2 - s)
                if both != _0:
                    # A point at r from the centre has v − [r] ω, so that this is J M⁻¹ Jᵀ with J = (1, −[r]; 0, 1).
                    centre = bodies.centre[env, s] + interval.shift[env, s]
                    r, q = cross_matrix(work.points[env, k] - centre), cross_matrix(work.points[env, m] - centre)
                    identity = wp.identity(n=3, dtype=wp.float64)
                    add_block(work, env, 6 * k, 6 * m, both, light * identity - r * quick * q)
                    add_block(work, env, 6 * k, 6 * m + 3, both, -r * quick)
                    add_block(work, env, 6 * k + 3, 6 * m, both, quick * q)
                    add_block(work, env, 6 * k + 3, 6 * m + 3, both, quick)


@wp.kernel
def apply_law(
    chosen: wp.array(dtype=wp.int32), robot: Robot, contacts: Contacts, bodies: SolverBodies, h: wp.float64,
    # outputs
    interval: Interval, work: Work,
):  # fmt: skip
    """Add c to ``applied``, and move the solver's bodies by a step of h [s].

    In the environments ``chosen`` (B,).
    """
    env = wp.tid()
    count = contacts.count[env] + 0
    if chosen[env] == 0 or count == 0:
        return
    rows, n = 6 * count, robot.speed.shape[1]
    factorise(robot, work, env, n)
    place_contacts(robot, contacts, bodies, interval, work, env)
    find_mobility(robot, contacts, bodies, interval, work, env, rows)
    for i in range(rows):
        relative = wp.float64(0.0)
        for d in range(n):
            relative += work.jacobian[env, i, d] * (robot.speed[env, d] + h * robot.free[env, d])
        work.shift[env, i] = work.shift[env, i] + h * relative
    for s in range(bodies.mass.shape[1]):
        if bodies.mass[env, s] == _0:
            continue
        interval.velocity[env, s] = interval.velocity[env, s] + h / bodies.mass[env, s] * bodies.force[env, s]
        interval.spin[env, s] = interval.spin[env, s] + h * (wp.inverse(bodies.inertia[env, s]) * bodies.torque[env, s])
        for k in range(count):
            sign = sign_of(contacts, env, k, -2 - s)
            if sign != _0:
                arm = work.points[env, k] - bodies.centre[env, s] - interval.shift[env, s]
                v = interval.velocity[env, s] + wp.cross(interval.spin[env, s], arm)
                for i in range(3):
                    work.shift[env, 6 * k + i] = work.shift[env, 6 * k + i] + h * sign * v[i]
                    work.shift[env, 6 * k + 3 + i] = work.shift[env, 6 * k + 3 + i] + h * sign * interval.spin[env, s][i]
    opened = wp.int32(1)
    while opened != 0:
        for i in range(rows):
            k = i // 6
            work.c[env, i] = work.fixed[env, i]
            for j in range(rows):
                work.matrix[env, i, j] = wp.where(i == j, _1, _0)
            if work.closed[env, k] != 0:
                for a in range(6):
                    stiff = contacts.stiffness[env, k, i - 6 * k, a]
                    if stiff != _0:
                        work.c[env, i] = work.c[env, i] - stiff * work.shift[env, 6 * k + a]
                        for j in range(rows):
                            work.matrix[env, i, j] = work.matrix[env, i, j] + h * h * stiff * work.mobility[env, 6 * k + a, j]
        solve_law(work, env, rows)
        opened = wp.int32(0)
        for k in range(count):
            if work.closed[env, k] != 0 and contacts.opens[env, k] != 0:
                change = wp.vec3d(work.c[env, 6 * k], work.c[env, 6 * k + 1], work.c[env, 6 * k + 2])
                if wp.dot(change + contacts.normal[env, k], contacts.normal[env, k]) < _0:
                    work.closed[env, k] = 0
                    opened = wp.int32(1)
                    for i in range(3):
                        work.fixed[env, 6 * k + i] = -contacts.force[env, k][i]
                        work.fixed[env, 6 * k + 3 + i] = -contacts.torque[env, k][i]
    for k in range(count):
        force = wp.vec3d(work.c[env, 6 * k], work.c[env, 6 * k + 1], work.c[env, 6 * k + 2])
        torque = wp.vec3d(work.c[env, 6 * k + 3], work.c[env, 6 * k + 4], work.c[env, 6 * k + 5])
        for end in range(2):
            side = contacts.side[env, k, end] + 0
            sign = wp.where(end == 0, _1, -_1)
            if side >= 0:
                arm = work.points[env, k] - robot.centre[env, side]
                add_wrench(interval.applied, env, side, sign * force, sign * (torque + wp.cross(arm, force)))
            if side <= -2:
                s = -2 - side
                arm = work.points[env, k] - bodies.centre[env, s] - interval.shift[env, s]
                pull = sign * h * (wp.inverse(bodies.inertia[env, s]) * (torque + wp.cross(arm, force)))
                interval.velocity[env, s] = interval.velocity[env, s] + sign * h / bodies.mass[env, s] * force
                interval.spin[env, s] = interval.spin[env, s] + pull
    for s in range(bodies.mass.shape[1]):
        interval.shift[env, s] = interval.shift[env, s] + h * interval.velocity[env, s]
        interval.swing[env, s] = interval.swing[env, s] + h * interval.spin[env, s]
