"""Rows of MuJoCo's constraint for gels: normal spring, shear, spin, tilt and friction.

MuJoCo minimises over accelerations a of constraint rows ½ Σ (a − a*)² / R within an elliptic friction cone: a row that is not cut by the
cone carries f = (a* − a) / R. With R = 1 / (G Δt) and a* = −v / Δt + f₀ / (G Δt) that is f = f₀ − G v₁, v₁ = v + Δt a the speed at the
end of the step. So every row is a given force and a viscous one at the end of the step:

| row | f₀ | G |
|---|---|---|
| normal | F(δ) | c K (``normal_spring``) |
| tangents | −k s, the shear's | k Δt; less of what slips |
| spin | −k s, the shear's | as of the tangents on the lever of the cone |
| rolling | −b | N m Δt, m the metacentric height |

The convex cone lifts what slips, which the normal row's f₀ is less by: at the speed at the start of the step, unless a slide begins or
ends in it. ``Steps.slides`` says where that may be, and MuJoCo's own solution for the end of the step decides then (``lift_kernels``).

The last row replaces what a single contact point lacks. A flat face that tilts moves the centre of pressure by its spread m per radian,
so the normal load turns it back with the stiffness N m, taken at the start of a step. That is stable with as much at its end, which the
viscous row gives. Of a ball m is 0.

b is the friction of rolling, 3/16 α a N with α the gel's hysteresis. It builds up while the body rolls on by an eighth of the contact's
radius a, by the law of P. R. Dahl (A solid friction model, 1968), which takes energy from the smallest rocking: a body whose contact
moves by r per radian has db = (b_max u − b) 8 r / a |dφ| with u the direction of the angle dφ. r is the lesser of the spread s and the
height of the centre of mass: R of a ball. A flat face, which tilts rather than rolls, has only r / s of the torque.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import Rows
from raytac.physics.rigid.load_law import TWIST_STIFFENING
from raytac.physics.rigid.motion_kernels import Frames, closing_push, frame_of, place_of, push_at, turn_of
from raytac.physics.rigid.shear_kernels import begin_shear, clear_shear, move_shear, share_that_sticks
from raytac.physics.rigid.spring_kernels import normal_spring
from raytac.physics.rigid.step_kernels import law_of
from raytac.physics.rigid.table_kernels import force_at, radius_at
from raytac.physics.rigid.world_kernels import (
    ROWS,
    Differences,
    Gels,
    Motion,
    Shear,
    Slots,
    Steps,
    Touched,
    compliance_of,
    friction_of,
    softening,
)

wp.set_module_options({"enable_backward": False, "fast_math": False})

_EDGE = wp.constant(wp.float64(0.7))
"""Greatest offset of a flat contact's centre of pressure over its radius, in the tilt row."""
_LEAST = wp.constant(wp.float64(1e-6))
"""Least coefficient of friction, which MuJoCo wants positive."""
_LEVER = wp.constant(wp.float64(3.0 * 3.141592653589793 / 16.0))
"""Lever of the torque of spin over the radius: Hertz's contact that slips as a whole."""
_TWIST = wp.constant(wp.vec4d(*TWIST_STIFFENING))
_ROLLING = wp.constant(wp.float64(3.0 / 16.0))
"""Bound of the friction of rolling, over radius and hysteresis."""
_GIVE = wp.constant(wp.float64(8.0))
"""Radius of the contact over the distance on which the friction of rolling builds up."""
_ROOM = wp.constant(wp.float64(4.0))
"""Cone's bound of rolling over that of friction, to cost sliding at most 3 %."""
_CHANGE = wp.constant(wp.float64(0.01))
"""Change of a lift over the normal force from which a slide begins or ends."""
_ROWS = wp.constant(wp.int32(ROWS))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.func
def first_tangent(normal: wp.vec3d) -> wp.vec3d:
    """Unit tangent of a gel nearest to the pad's x; the second is 90° on about the normal."""
    return wp.normalize(wp.vec3d(_1, _0, _0) - normal[0] * normal)


@wp.func
def lever_of(radius: wp.float64) -> wp.float64:
    """Torque over force [m] at which a contact slips."""
    return _LEVER * wp.max(radius, _LEAST)


@wp.func
def twist_stiffening(ratio: wp.float64) -> wp.float64:
    """As ``load_law.twist_stiffening``."""
    square = ratio * ratio
    return _1 + _TWIST[0] * ratio * square / (_1 + square * (_TWIST[1] + _TWIST[2] / (_1 + _TWIST[3] * ratio)))


@wp.func
def rolled_on(share: wp.vec2d, angle: wp.vec2d) -> wp.vec2d:
    """Torque of rolling over its bound after a rotation, over the angle in which it builds up."""
    size = wp.length(angle)
    along = angle / wp.max(size, wp.float64(1e-30))
    return along + wp.exp(-size) * (share - along)


@wp.func
def wrench_of(force: wp.vec3d, torque: wp.vec3d) -> wp.spatial_vectord:
    return wp.spatial_vectord(force[0], force[1], force[2], torque[0], torque[1], torque[2])


@wp.kernel
def set_rows(
    rows: Rows,
    pads: wp.int32,
    bodies: wp.int32,
    first_pad: wp.int32,
    first_body: wp.int32,
    frames: Frames,
    motion: Motion,
    vary: Differences,
    gels: Gels,
    touched: Touched,
    rolling: wp.array3d(dtype=wp.vec2d),
    # outputs
    steps: Steps,
    shear: Shear,
    slots: Slots,
):
    """Fill the slots of one search's results with the step's rows; see ``approach``.

    ``rolling``: torques of rolling over their bounds, about the pad's tangents.
    """
    i, p, q = wp.tid()
    pad, body = first_pad + p, first_body + q
    row = slots.row[i, pad, body]
    if row < 0 or steps.lost[i] != 0:
        return
    env, step = steps.envs[i], steps.length[i]
    law = law_of(rows, row, vary, gels, touched, env, pad, body)
    centre, normal, spread = rows.centre[row], rows.normal[row], rows.spread[row]
    rotation = turn_of(motion.world_from_pad[i, pad])
    at = rotation * centre + place_of(motion.world_from_pad[i, pad])
    push = closing_push(frames, touched, i, pad, body, at, rotation * normal)
    compliance = compliance_of(vary, gels, env, pad, body)
    spring = normal_spring(rows, law, rows.depth[row], slots.speed[i, pad, body], compliance, step, gels.relaxation[pad], push)
    if not spring.damping > _0:
        return
    deepest = wp.max(spring.deepest, _0)
    radius, load = radius_at(rows, law, deepest), force_at(rows, law, deepest)[0]
    factor, square = softening(vary, gels, touched, env, pad, body), radius * radius
    stiffness = wp.vec2d(
        wp.max((gels.shear[pad][0] * radius + gels.shear[pad][1] * square) * factor, wp.float64(1e-12)),
        wp.max(gels.twist[pad] * radius * square * twist_stiffening(radius / gels.thickness[pad]) * factor, wp.float64(1e-12)),
    )
    friction, pull = friction_of(vary, touched, env, pad, body), begin_shear(shear, env, pad, body, stiffness, centre)

    # As it moves at the start of the step, what slips by its end does not resist. From half of the stiffness on a step takes no less from
    # the bodies than the gel stores, of shear and spin alike if the cone's lever is the ratio of both. Where all slips, the cone bounds
    # shear and spin by the lever of friction, and there is more damping, so that both are stable should that slide end.
    pose = motion.pose[i, pad, body]
    first = first_tangent(normal)
    second = wp.cross(normal, first)
    spin = motion.spin[i, pad, body]
    velocity = motion.velocity[i, pad, body] + wp.cross(spin, centre - place_of(pose))
    slip = wp.vec3d(wp.dot(velocity, first), wp.dot(velocity, second), wp.dot(spin, normal))
    normal_load = wp.max(spring.force + spring.damping * slots.speed[i, pad, body], _0)
    limit, slip_lever = friction * normal_load, lever_of(radius)
    sticks = share_that_sticks(shear, env, pad, body, step * slip, wp.vec2d(limit, limit * slip_lever))
    ratio = stiffness[1] / stiffness[0]
    lever, damping = wp.sqrt(ratio), step * stiffness[0] * wp.max(sticks, _HALF)
    if sticks == _0:
        lever, damping = slip_lever, step * stiffness[0] * wp.max(ratio / (slip_lever * slip_lever), _1)

    # A body that turns about its centre of mass moves the centre of pressure by the spread of the overlap per radian, less the height of
    # that centre over the gel: by nothing at all for a ball. Its principal tangents are those of the rows.
    arm = centre - turn_of(pose) * touched.mass_centre[body] - place_of(pose)
    height = -wp.dot(arm, normal)
    angle = _HALF * wp.atan2(_2 * spread[1], spread[0] - spread[2])
    mean, half = _HALF * (spread[0] + spread[2]), wp.length(wp.vec2d(_HALF * (spread[0] - spread[2]), spread[1]))
    cos, sin = wp.cos(angle), wp.sin(angle)
    one = cos * first + sin * second
    axes = wp.matrix_from_rows(normal, one, wp.cross(normal, one))

    # What MuJoCo's convex cone adds to the normal force of a contact that slips, at the speed at the start of the step. Beyond the cone,
    # the force without it, (F, T), is projected to F + μ r (T − μF) / (1 + μ² r) with r the ratio of the dampings. If the free
    # acceleration, and its friction, make a different speed at the end, a slide begins or ends.
    lift, elastic = wp.float64(0.0), wp.vec3d(pull[0], pull[1], pull[2] / lever)
    slip = wp.vec3d(slip[0], slip[1], slip[2] * lever)
    trial = wp.length(elastic + damping * slip)
    if spring.force > _0:
        back, frame = wp.transpose(rotation), frame_of(frames, touched, body)
        swing = back * (frames.swing[i, frame] - frames.swing[i, pad])
        gain = back * (push_at(frames, i, frame, at) - push_at(frames, i, pad, at))
        per_lift = friction * spring.damping / damping
        gained = wp.vec3d(wp.dot(gain, first), wp.dot(gain, second), wp.dot(swing, normal) * lever)
        lift = per_lift * wp.max(trial - limit, _0)
        free = wp.length(elastic + damping * (slip + step * gained)) - limit * (_1 + damping * step * compliance)
        if wp.abs(per_lift * wp.max(free, _0) - lift) > _CHANGE * spring.force:
            steps.slides[i] = 1

    slots.held[i, pad, body] = 1
    wp.atomic_add(steps.contacts, i, 1)
    slots.centre[i, pad, body] = centre
    slots.radius[i, pad, body] = radius
    slots.axes[i, pad, body] = axes
    slots.turn[i, pad, body] = wp.vec2d(cos, sin)
    slots.place[i, pad, body] = at
    slots.frame[i, pad, body] = axes * wp.transpose(rotation)
    slots.friction[i, pad, body, 0] = friction
    slots.friction[i, pad, body, 1] = friction
    slots.friction[i, pad, body, 2] = friction * lever
    # The cone of a contact that slips cuts tilt and rolling by the share by which it cuts friction, though the pressure, not friction, is
    # what turns a face back. So these rows are those of the load under which the contact would stick.
    held_load = wp.max(load, trial / wp.max(friction, _LEAST))
    # The friction of rolling at the end of the step, by the spin at its start; what damps it does not act on that spin.
    held, spins = rolling[env, pad, body], wp.vec2d(wp.dot(spin, axes[1]), wp.dot(spin, axes[2]))
    spreads, plastic = wp.vec2d(wp.max(mean - half, _0), mean + half), _ROLLING * gels.hysteresis[pad]
    arms = wp.vec2d(wp.min(spreads[0], wp.abs(height)), wp.min(spreads[1], wp.abs(height)))
    bend = _GIVE / wp.max(radius, _LEAST) * arms
    share = rolled_on(wp.vec2d(cos * held[0] + sin * held[1], cos * held[1] - sin * held[0]), step * wp.cw_mul(bend, spins))
    torque = plastic * radius * held_load * share
    slots.bend[i, pad, body] = bend
    per_square = damping / wp.pow(wp.max(friction, _LEAST), _2)
    k = wp.int32(0)
    while k < 2:  # a rotation about one tangent moves the centre along the other
        metacentric = wp.max(spreads[k] - height, _0)
        # The cone must not cut this row before the centre of pressure is near the edge.
        edge = _EDGE * radius * metacentric / (metacentric + wp.abs(height) + wp.float64(1e-9))
        tilt = wp.max(friction * wp.sqrt(held_load * step / damping * metacentric), edge)
        whole = friction * wp.sqrt(held_load * step / damping * (metacentric + _GIVE * plastic * arms[k]))
        whole = wp.max(wp.max(tilt, whole), _ROOM * plastic * radius)
        slots.friction[i, pad, body, 3 + k] = whole
        slots.force[i, pad, body, 4 + k] = per_square * (whole * whole - tilt * tilt) * spins[k] - torque[k] * arms[k] / wp.max(
            spreads[k], _LEAST
        )
        k += 1
    slots.lift[i, pad, body] = lift
    slots.force[i, pad, body, 0] = spring.force - lift
    slots.force[i, pad, body, 1] = -(cos * pull[0] + sin * pull[1])
    slots.force[i, pad, body, 2] = sin * pull[0] - cos * pull[1]
    slots.force[i, pad, body, 3] = -pull[2]
    # Those of spin and rolling follow from the cone's levers.
    slots.regularisation[i, pad, body, 0] = _1 / (spring.damping * step)
    k = wp.int32(0)
    while k < _ROWS - 1:
        ratio = wp.max(friction, _LEAST) / wp.max(slots.friction[i, pad, body, k], _LEAST)
        slots.regularisation[i, pad, body, 1 + k] = ratio * ratio / (damping * step)
        k += 1


@wp.kernel
def read_rows(
    force: wp.array4d(dtype=wp.float64),
    velocity: wp.array4d(dtype=wp.float64),
    motion: Motion,
    steps: Steps,
    touched: Touched,
    # outputs
    shear: Shear,
    rolling: wp.array3d(dtype=wp.vec2d),
    acceleration: wp.array3d(dtype=wp.float64),
    slots: Slots,
):
    """Let the gels shear by what bodies moved in the step; drop contacts that ended.

    ``force`` [N, N m] and ``velocity`` [m/s, rad/s] of rows at the end of the step, each (n, pads, bodies + pads, ROWS). MuJoCo's force
    is on the second body; the pad gets the opposite, and another gel the opposite of that, about its own origin.
    """
    i, pad, body = wp.tid()
    env, step = steps.envs[i], steps.length[i]
    slots.wrench[i, pad, body] = wp.spatial_vectord()
    slots.opposite[i, pad, body] = wp.spatial_vectord()
    if steps.lost[i] != 0:
        return
    if slots.held[i, pad, body] == 0:
        if shear.stiffness[env, pad, body][0] > _0:
            clear_shear(shear, env, pad, body)
            acceleration[env, pad, body] = _0
            rolling[env, pad, body] = wp.vec2d()
        return
    turn, centre, axes = slots.turn[i, pad, body], slots.centre[i, pad, body], slots.axes[i, pad, body]
    one, two = velocity[i, pad, body, 1] * step, velocity[i, pad, body, 2] * step
    displacement = wp.vec3d(turn[0] * one - turn[1] * two, turn[1] * one + turn[0] * two, velocity[i, pad, body, 3] * step)
    normal_load = force[i, pad, body, 0]
    radius, limit = slots.radius[i, pad, body], normal_load * slots.friction[i, pad, body, 0]
    move_shear(shear, env, pad, body, displacement, wp.vec2d(limit, limit * lever_of(radius)), centre, radius)
    bend = slots.bend[i, pad, body]
    one, two = velocity[i, pad, body, 4] * step * bend[0], velocity[i, pad, body, 5] * step * bend[1]
    angle = wp.vec2d(turn[0] * one - turn[1] * two, turn[1] * one + turn[0] * two)
    rolling[env, pad, body] = rolled_on(rolling[env, pad, body], angle)
    acceleration[env, pad, body] = (-velocity[i, pad, body, 0] - slots.speed[i, pad, body]) / step
    back = wp.transpose(axes)
    push = -(back * wp.vec3d(normal_load, force[i, pad, body, 1], force[i, pad, body, 2]))
    torque = -(back * wp.vec3d(force[i, pad, body, 3], force[i, pad, body, 4], force[i, pad, body, 5])) + wp.cross(centre, push)
    slots.wrench[i, pad, body] = wrench_of(push, torque)
    if body >= touched.bodies:
        pose = motion.pose[i, pad, body]
        to_gel = wp.transpose(turn_of(pose))
        slots.opposite[i, pad, body] = wrench_of(-(to_gel * push), to_gel * (wp.cross(place_of(pose), push) - torque))


@wp.kernel
def sum_wrenches(slots: Slots, steps: Steps, touched: Touched, wrench: wp.array2d(dtype=wp.spatial_vectord)):
    """Wrench on each pad, (B, pads), in the order of the slots; 0 where lost."""
    i, pad = wp.tid()
    if steps.envs[i] < 0:
        return
    total = wp.spatial_vectord()
    for body in range(slots.held.shape[2]):
        total += slots.wrench[i, pad, body]
    for other in range(slots.held.shape[1]):
        total += slots.opposite[i, other, touched.bodies + pad]
    wrench[steps.envs[i], pad] = total
