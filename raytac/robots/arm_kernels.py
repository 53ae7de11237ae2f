"""Kernels of an arm's control: numbers of states, springs, poses, servos."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_MANY = wp.constant(0x7FFFFFFF)
"""Length of an array that is known by its address alone."""


@wp.func
def rotation_vector(r: wp.mat33d) -> wp.vec3d:
    """log R [rad], at most π long, as ``se3.rotation_vector``."""
    xx, yy, zz = r[0, 0], r[1, 1], r[2, 2]
    # The root is taken of the greatest component of the quaternion, which is accurate for any angle (Shepperd 1978).
    w, x, y, z = _1 + xx + yy + zz, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    greatest = w
    if _1 + xx - yy - zz > greatest:
        greatest = _1 + xx - yy - zz
        w, x, y, z = r[2, 1] - r[1, 2], greatest, r[0, 1] + r[1, 0], r[2, 0] + r[0, 2]
    if _1 - xx + yy - zz > greatest:
        greatest = _1 - xx + yy - zz
        w, x, y, z = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], greatest, r[1, 2] + r[2, 1]
    if _1 - xx - yy + zz > greatest:
        greatest = _1 - xx - yy + zz
        w, x, y, z = r[1, 0] - r[0, 1], r[2, 0] + r[0, 2], r[1, 2] + r[2, 1], greatest
    q = wp.vec3d(x, y, z) / wp.sqrt(w * w + x * x + y * y + z * z)
    cosine = w / wp.sqrt(w * w + x * x + y * y + z * z)
    if cosine < _0:
        q = -q
        cosine = -cosine
    sine = wp.length(q)
    factor = wp.float64(2.0)
    if sine > _0:
        factor = _2 * wp.atan2(sine, cosine) / sine
    return factor * q


@wp.func
def turn_of(poses: wp.array3d(dtype=wp.float64), i: wp.int32) -> wp.mat33d:
    # fmt: off
    return wp.mat33d(
        poses[i, 0, 0], poses[i, 0, 1], poses[i, 0, 2],
        poses[i, 1, 0], poses[i, 1, 1], poses[i, 1, 2],
        poses[i, 2, 0], poses[i, 2, 1], poses[i, 2, 2],
    )
    # fmt: on


@wp.func
def place_of(poses: wp.array3d(dtype=wp.float64), i: wp.int32) -> wp.vec3d:
    return wp.vec3d(poses[i, 0, 3], poses[i, 1, 3], poses[i, 2, 3])


@wp.kernel
def pose_errors(
    a: wp.array3d(dtype=wp.float64),
    b: wp.array3d(dtype=wp.float64),
    # outputs
    error: wp.array2d(dtype=wp.float64),
):
    """Displacements (n, 6) from poses b to a, world axes, as ``se3.pose_error``."""
    i = wp.tid()
    shift = place_of(a, i) - place_of(b, i)
    turn = rotation_vector(turn_of(a, i) * wp.transpose(turn_of(b, i)))
    for k in range(3):
        error[i, k] = shift[k]
        error[i, k + 3] = turn[k]


@wp.struct
class Springs:
    """Springs in n joints of B environments, as one structure, which launches faster."""

    joints: wp.array2d(dtype=wp.float64)
    speed: wp.array2d(dtype=wp.float64)
    mass: wp.array3d(dtype=wp.float64)
    bias: wp.array2d(dtype=wp.float64)
    target: wp.array2d(dtype=wp.float64)
    target_speed: wp.array2d(dtype=wp.float64)
    time: wp.array(dtype=wp.float64)
    start: wp.array(dtype=wp.float64)
    """Time [s] at which the targets hold."""
    stiffness: wp.float64
    damping: wp.float64
    torque: wp.array2d(dtype=wp.float64)


@wp.kernel
def joint_springs(springs: Springs):
    """τ = M (k (q_d + q̇_d t − q) + d (q̇_d − q̇)) + bias, with t the time since the start."""
    env, i = wp.tid()
    value = springs.bias[env, i]
    for k in range(springs.joints.shape[1]):
        speed = springs.target_speed[env, k]
        ahead = springs.target[env, k] + (springs.time[env] - springs.start[env]) * speed - springs.joints[env, k]
        value += springs.mass[env, i, k] * (springs.stiffness * ahead + springs.damping * (speed - springs.speed[env, k]))
    springs.torque[env, i] = value


@wp.struct
class Servo:
    """Law of ``PoseServo`` for an arm of n joints."""

    joints: wp.array2d(dtype=wp.float64)
    anchor: wp.array3d(dtype=wp.float64)
    axis: wp.array3d(dtype=wp.float64)
    site: wp.array3d(dtype=wp.float64)
    target: wp.array3d(dtype=wp.float64)
    twist: wp.array2d(dtype=wp.float64)
    duration: wp.array(dtype=wp.float64)
    slides: wp.array(dtype=wp.int32)
    """1 of a slide, 0 of a hinge."""
    range: wp.array2d(dtype=wp.float64)
    fastest: wp.array(dtype=wp.float64)
    posture: wp.array(dtype=wp.float64)
    gain: wp.float64
    damping: wp.float64
    # Work, of every environment: Jacobian (n, 6), J Jᵀ + λ² 1 and its root (6, 6), two right sides (2, 6).
    jacobian: wp.array3d(dtype=wp.float64)
    gram: wp.array3d(dtype=wp.float64)
    side: wp.array3d(dtype=wp.float64)
    # Results.
    step: wp.array2d(dtype=wp.float64)
    velocity: wp.array2d(dtype=wp.float64)


@wp.func
def posture_step(servo: Servo, env: wp.int32, i: wp.int32) -> wp.float64:
    return servo.gain * (servo.posture[i] - servo.joints[env, i])


@wp.func
def along(servo: Servo, env: wp.int32, i: wp.int32, side: wp.int32) -> wp.float64:
    """Joint i of Jᵀ times the solution of one side."""
    value = wp.float64(0.0)
    for k in range(6):
        value += servo.jacobian[env, i, k] * servo.side[env, side, k]
    return value


@wp.kernel
def servo_step(servo: Servo):
    """Joint positions (B, n) without the pose's error, velocities (B, n) of the target's twist."""
    env = wp.tid()
    n = servo.joints.shape[1]
    place = place_of(servo.site, env)
    shift = place_of(servo.target, env) - place
    turn = rotation_vector(turn_of(servo.target, env) * wp.transpose(turn_of(servo.site, env)))
    for k in range(3):
        servo.side[env, 0, k] = shift[k]
        servo.side[env, 0, k + 3] = turn[k]
    for k in range(6):
        servo.side[env, 1, k] = servo.twist[env, k]
    for i in range(n):
        direction = wp.vec3d(servo.axis[env, i, 0], servo.axis[env, i, 1], servo.axis[env, i, 2])
        linear, angular = direction, wp.vec3d()
        if servo.slides[i] == 0:
            arm = place - wp.vec3d(servo.anchor[env, i, 0], servo.anchor[env, i, 1], servo.anchor[env, i, 2])
            linear, angular = wp.cross(direction, arm), direction
        for k in range(3):
            servo.jacobian[env, i, k] = linear[k]
            servo.jacobian[env, i, k + 3] = angular[k]
        # The motion of the site by the step towards the posture is subtracted.
        back = posture_step(servo, env, i)
        for k in range(6):
            servo.side[env, 0, k] = servo.side[env, 0, k] - servo.jacobian[env, i, k] * back
    # Cholesky's root of J Jᵀ + λ² 1, and both sides through it. (`while` loops are not unrolled.)
    row = wp.int32(0)
    while row < 6:
        column = wp.int32(0)
        while column <= row:
            value = wp.float64(0.0)
            if row == column:
                value = servo.damping * servo.damping
            for i in range(n):
                value += servo.jacobian[env, i, row] * servo.jacobian[env, i, column]
            for k in range(column):
                value -= servo.gram[env, row, k] * servo.gram[env, column, k]
            if row == column:
                servo.gram[env, row, row] = wp.sqrt(value)
            else:
                servo.gram[env, row, column] = value / servo.gram[env, column, column]
            column += 1
        row += 1
    for which in range(2):
        row = wp.int32(0)
        while row < 6:
            value = servo.side[env, which, row]
            for k in range(row):
                value -= servo.gram[env, row, k] * servo.side[env, which, k]
            servo.side[env, which, row] = value / servo.gram[env, row, row]
            row += 1
        row = wp.int32(5)
        while row >= 0:
            value = servo.side[env, which, row]
            for k in range(row + 1, 6):
                value -= servo.gram[env, k, row] * servo.side[env, which, k]
            servo.side[env, which, row] = value / servo.gram[env, row, row]
            row -= 1
    # A motion that is too fast is shortened as a whole.
    excess, speed_excess = wp.float64(1.0), wp.float64(1.0)
    for i in range(n):
        moved = along(servo, env, i, 0) + posture_step(servo, env, i)
        excess = wp.max(excess, wp.abs(moved) / (servo.fastest[i] * servo.duration[0]))
        speed_excess = wp.max(speed_excess, wp.abs(along(servo, env, i, 1)) / servo.fastest[i])
    for i in range(n):
        moved = along(servo, env, i, 0) + posture_step(servo, env, i)
        servo.step[env, i] = wp.clamp(servo.joints[env, i] + moved / excess, servo.range[i, 0], servo.range[i, 1])
        servo.velocity[env, i] = along(servo, env, i, 1) / speed_excess


@wp.struct
class Entries:
    """Places of numbers in B states, and in the result, as one structure, which launches faster."""

    places: wp.array2d(dtype=wp.uint64)
    """Addresses (B, members) of arrays of float64."""
    member: wp.array(dtype=wp.int32)
    """Of every entry; negative: the index itself is the number."""
    index: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.int32)
    stride: wp.array(dtype=wp.int32)
    """With ``start``, place of the entry of environment b: start + stride b."""
    values: wp.array(dtype=wp.float64)


@wp.kernel
def read_numbers(entries: Entries):
    """Copy entries of the members of B states to ``values``."""
    env = wp.tid()
    for k in range(entries.index.shape[0]):
        value = wp.float64(entries.index[k])
        if entries.member[k] >= 0:
            place = entries.places[env, entries.member[k]]
            value = wp.array(ptr=place, shape=(_MANY,), dtype=wp.float64)[entries.index[k]]
        entries.values[entries.start[k] + env * entries.stride[k]] = value


@wp.kernel
def write_numbers(
    places: wp.array(dtype=wp.uint64),
    index: wp.array(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
    chosen: wp.array(dtype=wp.int32),
):
    """Copy ``values`` (B, n) to entries of the arrays at ``places`` (B,) where ``chosen``."""
    env, k = wp.tid()
    if chosen[env] != 0:
        target = wp.array(ptr=places[env], shape=(_MANY,), dtype=wp.float64)
        target[index[k]] = values[env, k]
