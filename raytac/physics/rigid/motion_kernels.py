"""Motion of bodies and other gels in the frames of pads, and how far it may reach.

All points of a body stay in a ball about its origin, which for a half-space is taken as 1 m. From the greatest speed of such a point
follow the reach of the search, and the step in which a body beside a case comes no farther than MuJoCo's own margin there. A gap that
cannot close in the step needs no load law: how fast a body closes it over the pad follows from its motion there, along the normal.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.world_kernels import Gels, Motion, Slots, Steps, Touched

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))
_ROUNDING = wp.constant(wp.float64(1e-6))
"""Share by which a gap that cannot close is more than it is by rounding."""


@wp.struct
class Frames:
    """Frames of n environments: of the pads, then of the bodies; world frame."""

    place: wp.array2d(dtype=wp.vec3d)
    turn: wp.array2d(dtype=wp.mat33d)
    velocity: wp.array2d(dtype=wp.vec3d)
    """Of the origin [m/s]."""
    spin: wp.array2d(dtype=wp.vec3d)
    """[rad/s]."""
    push: wp.array2d(dtype=wp.vec3d)
    """Acceleration of the origin [m/s²] without contacts and other constraints."""
    swing: wp.array2d(dtype=wp.vec3d)
    """Angular acceleration of the same kind [rad/s²]."""


@wp.func
def push_at(frames: Frames, row: wp.int32, frame: wp.int32, point: wp.vec3d) -> wp.vec3d:
    """Free acceleration [m/s²] of a point of a body, which is given in the world frame."""
    return frames.push[row, frame] + wp.cross(frames.swing[row, frame], point - frames.place[row, frame])


@wp.func
def frame_of(frames: Frames, touched: Touched, body: wp.int32) -> wp.int32:
    """Frame of what is touched: those of the pads come first."""
    if body < touched.bodies:
        return frames.place.shape[1] - touched.bodies + body
    return body - touched.bodies


@wp.func
def closing_push(
    frames: Frames, touched: Touched, row: wp.int32, pad: wp.int32, body: wp.int32, point: wp.vec3d, normal: wp.vec3d
) -> wp.float64:
    """Acceleration [m/s²] by which a contact may close faster, at a point along the normal.

    ``point`` and ``normal`` of the gel are in the world frame. Either side may rest on other contacts, so that one that goes away does
    not make up for the other.
    """
    of_pad = wp.dot(push_at(frames, row, pad, point), normal)
    of_body = wp.dot(push_at(frames, row, frame_of(frames, touched, body), point), normal)
    return wp.max(of_pad, _0) + wp.max(-of_body, _0)


@wp.func
def closing_of(
    frames: Frames, gels: Gels, row: wp.int32, pad: wp.int32, frame: wp.int32, place: wp.vec3d, velocity: wp.vec3d, spin: wp.vec3d,
    left: wp.float64,
) -> wp.float64:  # fmt: skip
    """Least gap [m] that a body cannot close within a time ``left`` [s].

    At any place over the gel. ``place``, ``velocity``, ``spin``: of the body in the pad's frame. A point at a gap g is at most R + g from
    the pad's origin, so that what closes there is at most A + B g.
    """
    slope, far = gels.rest[pad][0], gels.rest[pad][1] + gels.thickness[pad]
    back = wp.transpose(frames.turn[row, pad])
    swing = back * frames.swing[row, frame]
    own = back * frames.push[row, pad]
    other = wp.cross(swing, place) - back * frames.push[row, frame]
    turning = wp.length(swing) + wp.length(frames.swing[row, pad])
    per_gap = left * (wp.length(spin) + left * turning)
    if per_gap > _HALF:
        return _INF
    speed = along_normals(wp.cross(spin, place) - velocity, slope)
    push = along_normals(own, slope) + along_normals(other, slope)
    return (left * (speed + left * push) + per_gap * far) / (_1 - per_gap) * (_1 + _ROUNDING) + _ROUNDING * gels.thickness[pad]


@wp.func
def along_normals(vector: wp.vec3d, slope: wp.float64) -> wp.float64:
    """Most of a vector along any normal of a gel whose slope is at most ``slope``; >= 0."""
    return wp.max(vector[2], _0) + slope * wp.length(wp.vec2d(vector[0], vector[1]))


@wp.func
def pose_of(turn: wp.mat33d, place: wp.vec3d) -> wp.mat44d:
    return wp.mat44d(
        turn[0, 0], turn[0, 1], turn[0, 2], place[0],
        turn[1, 0], turn[1, 1], turn[1, 2], place[1],
        turn[2, 0], turn[2, 1], turn[2, 2], place[2],
        _0, _0, _0, _1,
    )  # fmt: skip


@wp.func
def turn_of(pose: wp.mat44d) -> wp.mat33d:
    return wp.mat33d(pose[0, 0], pose[0, 1], pose[0, 2], pose[1, 0], pose[1, 1], pose[1, 2], pose[2, 0], pose[2, 1], pose[2, 2])


@wp.func
def place_of(pose: wp.mat44d) -> wp.vec3d:
    return wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])


@wp.func
def is_finite(pose: wp.mat44d) -> wp.bool:
    total = wp.float64(0.0)
    for i in range(3):
        for j in range(4):
            total += wp.abs(pose[i, j])
    return wp.isfinite(total)


@wp.func
def turned_by(one: wp.mat33d, other: wp.mat33d) -> wp.float64:
    """Angle [rad] between two rotations, of which it is an upper bound by rounding."""
    apart = one - other
    # ‖R − S‖ = √8 sin(θ/2) by Frobenius.
    return _2 * wp.asin(wp.min(wp.sqrt(wp.ddot(apart, apart) / wp.float64(8.0)), _1)) + wp.float64(1e-9)


@wp.func
def may_pierce(gels: Gels, touched: Touched, pad: wp.int32, body: wp.int32, pose: wp.mat44d) -> wp.bool:
    """True where a part's box reaches into the layer of one thickness behind the bonded face."""
    thickness, half = gels.thickness[pad], gels.half[pad]
    turn, origin, result = turn_of(pose), place_of(pose), wp.bool(False)
    for k in range(touched.first_box[body], touched.first_box[body + 1]):
        rotation, at = turn * touched.box_turn[k], turn * touched.box_centre[k] + origin
        edge = touched.box_half[k]
        if edge[0] == _INF:
            # A half-space: where the corner of the pad that is deepest in it lies below, if that is not above the face.
            n = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
            across = wp.abs(n[0]) * half[0] + wp.abs(n[1]) * half[1]
            inside = -across - wp.max(-n[2], _0) * thickness < wp.dot(n, at)
            if inside and (n[2] >= _0 or at[2] + (n[0] * at[0] + n[1] * at[1] + across) / n[2] < -thickness):
                result = wp.bool(True)
        else:
            h = wp.vec3d(
                wp.abs(rotation[0, 0]) * edge[0] + wp.abs(rotation[0, 1]) * edge[1] + wp.abs(rotation[0, 2]) * edge[2],
                wp.abs(rotation[1, 0]) * edge[0] + wp.abs(rotation[1, 1]) * edge[1] + wp.abs(rotation[1, 2]) * edge[2],
                wp.abs(rotation[2, 0]) * edge[0] + wp.abs(rotation[2, 1]) * edge[1] + wp.abs(rotation[2, 2]) * edge[2],
            )
            over = wp.abs(at[0]) < half[0] + h[0] and wp.abs(at[1]) < half[1] + h[1]
            if over and at[2] - h[2] < -thickness and at[2] + h[2] > -_2 * thickness:
                result = wp.bool(True)
    return result


@wp.func
def went_far(gels: Gels, touched: Touched, pad: wp.int32, body: wp.int32, before: wp.mat44d, pose: wp.mat44d) -> wp.bool:
    """True where a point of a body went farther than the gel's thickness; False from NaN."""
    angle = turned_by(turn_of(before), turn_of(pose))
    travel = wp.length(place_of(pose) - place_of(before)) + angle * wp.min(touched.radius[body], wp.float64(1e9))
    if touched.radius[body] == _INF:  # a half-space moves along its normal
        k = touched.first_box[body]
        normal, centre = touched.box_turn[k] * wp.vec3d(_0, _0, _1), touched.box_centre[k]
        was, now = turn_of(before) * normal, turn_of(pose) * normal
        one = wp.dot(was, turn_of(before) * centre + place_of(before))
        two = wp.dot(now, turn_of(pose) * centre + place_of(pose))
        travel = wp.abs(two - one) + angle * wp.length(gels.half[pad])
    return travel > gels.thickness[pad]


@wp.kernel
def move_bodies(
    frames: Frames,
    steps: Steps,
    gels: Gels,
    touched: Touched,
    before: wp.array3d(dtype=wp.mat44d),
    timestep: wp.float64,
    scene_ticks: wp.int32,
    case_travel: wp.float64,
    # outputs
    motion: Motion,
    slots: Slots,
    poses: wp.array3d(dtype=wp.mat44d),
    reach: wp.array2d(dtype=wp.float64),
    closing: wp.array3d(dtype=wp.float64),
):
    """Motion of everything relative to one pad, poses and reach of the search, empty slots.

    ``before`` (B, pads, bodies): poses of the last step, NaN where unknown; it becomes the present ones. ``timestep``: the scene's [s],
    of ``scene_ticks`` ticks. ``case_travel``: greatest travel of a body beside a case in a step [m], less than the gap from which their
    contact is known. ``reach``, ``closing``: as of ``PadSearch``.
    """
    row, pad = wp.tid()
    pads, bodies, env = frames.place.shape[1] - touched.bodies, touched.bodies, steps.envs[row]
    if pad == 0:
        steps.lost[row] = wp.where(env < 0, 1, 0)
    if env < 0:
        for body in range(bodies):
            poses[row, pad, body] = wp.mat44d()
        reach[row, pad] = -_INF
        return
    origin, back = frames.place[row, pad], wp.transpose(frames.turn[row, pad])
    pad_velocity, pad_spin = frames.velocity[row, pad], frames.spin[row, pad]
    motion.world_from_pad[row, pad] = pose_of(frames.turn[row, pad], origin)
    left = timestep * (_1 - wp.float64(steps.done[row]) / wp.float64(scene_ticks))
    own_push, own_swing = frames.push[row, pad], wp.length(frames.swing[row, pad])
    fastest, quickest, case_step = wp.float64(0.0), wp.float64(0.0), wp.float64(_INF)
    for body in range(bodies + pads):
        frame = pads + body
        if body >= bodies:
            frame = body - bodies
        apart = frames.place[row, frame] - origin
        velocity = back * (frames.velocity[row, frame] - pad_velocity - wp.cross(pad_spin, apart))
        spin = back * (frames.spin[row, frame] - pad_spin)
        place = back * apart
        pose = pose_of(back * frames.turn[row, frame], place)
        motion.pose[row, pad, body] = pose
        motion.velocity[row, pad, body] = velocity
        motion.spin[row, pad, body] = spin
        slots.row[row, pad, body] = -1
        slots.held[row, pad, body] = 0
        size = _1
        if body < bodies:
            size = wp.min(touched.radius[body], _1)
        push = wp.length(frames.push[row, frame]) + wp.length(own_push) + own_swing * wp.length(apart)
        push += (wp.length(frames.swing[row, frame]) + own_swing) * size
        motion.push[row, pad, body] = push
        if body < bodies:
            radius = touched.radius[body]
            speed = wp.length(velocity) + wp.length(spin) * wp.min(radius, _1)
            fastest, quickest = wp.max(fastest, speed), wp.max(quickest, push)
            if radius < _INF:
                outside = wp.vec3d(
                    wp.max(wp.abs(place[0] - gels.case_centre[pad][0]) - gels.case_half[pad][0], _0),
                    wp.max(wp.abs(place[1] - gels.case_centre[pad][1]) - gels.case_half[pad][1], _0),
                    wp.max(wp.abs(place[2] - gels.case_centre[pad][2]) - gels.case_half[pad][2], _0),
                )
                gap = wp.length(outside) - radius
                # Up to the case in one step, along it in short ones.
                case_step = wp.min(case_step, wp.max(gap, case_travel) / wp.max(speed, wp.float64(1e-12)))
            poses[row, pad, body] = pose
            closing[row, pad, body] = closing_of(frames, gels, row, pad, frame, place, velocity, spin, left)
            suspect = wp.int32(0)
            if may_pierce(gels, touched, pad, body, pose) or went_far(gels, touched, pad, body, before[env, pad, body], pose):
                suspect = wp.int32(1)
            motion.before[row, pad, body] = before[env, pad, body]
            before[env, pad, body] = pose
            motion.suspect[row, pad, body] = suspect
        else:
            other = body - bodies
            both = wp.length(gels.half[pad]) + gels.thickness[pad] + wp.length(gels.half[other]) + gels.thickness[other]
            near = wp.int32(0)
            if other > pad and gels.carrier[pad] != gels.carrier[other]:
                if wp.length(place) < both + wp.length(velocity) * left + push * left * left:
                    near = wp.int32(1)
            motion.near_gel[row, pad, other] = near
    motion.case_step[row, pad] = case_step
    reach[row, pad] = wp.where(bodies > 0, fastest * left + quickest * left * left, _0)


@wp.kernel
def pair_of_gels(
    motion: Motion,
    steps: Steps,
    pad: wp.int32,
    body: wp.int32,
    timestep: wp.float64,
    scene_ticks: wp.int32,
    # outputs
    poses: wp.array3d(dtype=wp.mat44d),
    reach: wp.array2d(dtype=wp.float64),
):
    """Poses and reach of the search for another gel, ``body``; reach −inf if not near."""
    row = wp.tid()
    if steps.envs[row] < 0 or motion.near_gel[row, pad, body - (motion.pose.shape[2] - motion.near_gel.shape[2])] == 0:
        poses[row, 0, 0] = wp.mat44d()
        reach[row, 0] = -_INF
        return
    left = timestep * (_1 - wp.float64(steps.done[row]) / wp.float64(scene_ticks))
    poses[row, 0, 0] = motion.pose[row, pad, body]
    reach[row, 0] = (wp.length(motion.velocity[row, pad, body]) + motion.push[row, pad, body] * left) * left
