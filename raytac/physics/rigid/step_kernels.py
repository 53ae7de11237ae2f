"""Environments that take a step or begin again, and the length of their steps.

Steps are Δt = T / 2^k of the scene's step T, halved until nothing near a pad moves too far. One of 2^k ticks starts at a multiple of
itself only, so that all end together at T.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import Rows
from raytac.physics.rigid.shear_kernels import clear_shear
from raytac.physics.rigid.table_kernels import Law, force_at, radius_at
from raytac.physics.rigid.world_kernels import (
    Differences,
    Gels,
    Motion,
    Shear,
    Slots,
    Steps,
    Touched,
    compliance_of,
    softening,
    total_thickness,
)

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TRAVEL = wp.constant(wp.float64(0.05))
"""Most closing or opening of any place of a contact in a step, over the gel's thickness."""
_SWING = wp.constant(wp.float64(0.02))
"""Share of the thickness from which a contact that swings on its own stiffness is resolved …"""
_PHASE = wp.constant(wp.float64(0.1))
"""… with this phase angle a step [rad]."""
_SLACK = wp.constant(wp.float64(1.0 + 1e-9))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_INF = wp.constant(wp.float64(float("inf")))
_NAN = wp.constant(wp.float64(float("nan")))


@wp.func
def law_of(
    rows: Rows, row: wp.int32, vary: Differences, gels: Gels, touched: Touched, env: wp.int32, pad: wp.int32, body: wp.int32
) -> Law:
    """Load law of a row of the search: two gels may both be squeezed."""
    result = Law()
    result.row = row
    result.factor = softening(vary, gels, touched, env, pad, body)
    result.thickness = total_thickness(gels, touched, pad, body)
    result.limit = rows.depth[row] + rows.clearance[row] + result.thickness - gels.thickness[pad]
    return result


@wp.func
def longest_step(
    depth: wp.float64, speed: wp.float64, tilting: wp.float64, rate: wp.float64, acceleration: wp.float64, thickness: wp.float64
) -> wp.float64:
    """Longest step [s] of one contact.

    Args:
        depth: δ [m], negative is a gap.
        speed: at which it closes [m/s].
        tilting: speed at which its rim closes on one side and opens on the other, as the body tilts [m/s].
        rate: angular frequency [1/s] of the bodies on the spring between them, as deep as it goes in the scene's step.
        acceleration: of closing in the last step [m/s²].
        thickness: of the gel [m].
    """
    quick = wp.max(wp.abs(speed), wp.float64(1e-12))
    inside = _TRAVEL * thickness / (quick + tilting)
    if wp.length(wp.vec2d(speed, acceleration / rate)) / rate > _SWING * thickness:
        inside = wp.min(inside, _PHASE / rate)
    if depth > _0:
        return inside
    if speed > _0:  # up to the gel in one step, into it in short ones
        return wp.max(wp.max(-depth, _0) / quick, inside)
    return _INF


@wp.kernel
def approach(
    rows: Rows,
    near: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    pads: wp.int32,
    bodies: wp.int32,
    first_pad: wp.int32,
    first_body: wp.int32,
    motion: Motion,
    vary: Differences,
    gels: Gels,
    touched: Touched,
    acceleration: wp.array3d(dtype=wp.float64),
    timestep: wp.float64,
    scene_ticks: wp.int32,
    # outputs
    steps: Steps,
    slots: Slots,
):
    """Slots of one search's results: the closing speed of each, and the step it allows.

    ``pads``, ``bodies``: of the search, which begin with ``first_pad``, ``first_body`` of the slots. What has no law has gone through the
    gel, as two gels that overlap by more than one of them: its environment is lost. Where the compliance is 0 neither body moves.
    """
    i, p, q = wp.tid()
    pair = (i * pads + p) * bodies + q
    if near[pair] == 0:
        return
    row = ends[pair] - 1
    if rows.valid[row] == 0:
        return
    if wp.isnan(rows.deepest[row]):
        steps.lost[i] = 1
        return
    env, pad, body = steps.envs[i], first_pad + p, first_body + q
    compliance = compliance_of(vary, gels, env, pad, body)
    if compliance <= _0:
        return
    pose, spin, thickness = motion.pose[i, pad, body], motion.spin[i, pad, body], total_thickness(gels, touched, pad, body)
    arm = rows.centre[row] - wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])
    speed = -wp.dot(motion.velocity[i, pad, body] + wp.cross(spin, arm), rows.normal[row])
    left = timestep * (_1 - wp.float64(steps.done[i]) / wp.float64(scene_ticks))
    depth = rows.depth[row]
    deeper = depth + wp.min(wp.max(speed, _0) * left, _TRAVEL * thickness)
    law = law_of(rows, row, vary, gels, touched, env, pad, body)
    stiffness = force_at(rows, law, deeper)[1]
    tilting = wp.length(wp.cross(spin, rows.normal[row])) * radius_at(rows, law, deeper)
    slots.row[i, pad, body] = row
    slots.speed[i, pad, body] = speed
    slots.longest[i, pad, body] = longest_step(
        depth, speed, tilting, wp.sqrt(stiffness * compliance), acceleration[env, pad, body], thickness
    )


@wp.func
def least_steps(ticks: wp.int32) -> wp.int32:
    """Least number of steps in which so many ticks at the end of the scene's step can be done."""
    result, rest = wp.int32(0), ticks
    while rest > 0:
        rest = rest & (rest - 1)
        result += 1
    return result


@wp.kernel
def choose_steps(motion: Motion, slots: Slots, timestep: wp.float64, scene_ticks: wp.int32, whole: wp.int32, steps: Steps):
    """Ticks and length of each environment's next step; ``whole``: all of the scene's."""
    i = wp.tid()
    most = steps.most[i] + 0
    if whole != 0:
        most = 1
    longest = wp.float64(timestep)
    for pad in range(slots.row.shape[1]):
        longest = wp.min(longest, motion.case_step[i, pad])
        for body in range(slots.row.shape[2]):
            if slots.row[i, pad, body] >= 0:
                longest = wp.min(longest, slots.longest[i, pad, body])
    done, ticks = steps.done[i] + 0, wp.int32(scene_ticks)
    if done > 0 and whole == 0:
        ticks = done & -done
    wanted = wp.max(longest / timestep * wp.float64(scene_ticks) * _SLACK, _1)
    while wp.float64(ticks) > wanted and (most == 0 or least_steps(scene_ticks - done - ticks // 2) < most):
        ticks = ticks // 2
    steps.ticks[i] = ticks
    steps.length[i] = timestep * wp.float64(ticks) / wp.float64(scene_ticks)
    steps.contacts[i] = 0
    steps.slides[i] = 0
    steps.solves[i] = 0


@wp.kernel
def choose_active(active: wp.array(dtype=wp.bool), steps: Steps):
    """Let row i of the next step be environment i where ``active``, else none, at tick 0."""
    i = wp.tid()
    steps.envs[i] = wp.where(active[i], i, -1)
    steps.done[i] = 0


@wp.kernel
def clear_environments(
    mask: wp.array(dtype=wp.bool),
    # outputs
    shear: Shear,
    before: wp.array3d(dtype=wp.mat44d),
    acceleration: wp.array3d(dtype=wp.float64),
    rolling: wp.array3d(dtype=wp.vec2d),
    wrenches: wp.array2d(dtype=wp.spatial_vectord),
):
    """Forget contacts, poses of the last step and wrenches of the environments of a mask (B,)."""
    env, pad, body = wp.tid()
    if not mask[env]:
        return
    clear_shear(shear, env, pad, body)
    acceleration[env, pad, body] = _0
    rolling[env, pad, body] = wp.vec2d()
    if body < before.shape[2]:
        pose = wp.mat44d()
        for k in range(4):
            for m in range(4):
                pose[k, m] = _NAN
        before[env, pad, body] = pose
    if body == 0:
        wrenches[env, pad] = wp.spatial_vectord()
