"""Functions of the kernels of both engines.

They are for gaps between hard geoms, and for lifts of slides that begin or end.

Gaps are in the precision of the engine.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

from raytac.physics.rigid.world_kernels import Slots

wp.set_module_options({"enable_backward": False, "fast_math": False})

LEAST_FRICTION = wp.constant(wp.float64(1e-6))
"""Least coefficient of friction, which MuJoCo wants positive."""
_FITS = wp.constant(wp.float64(0.005))
"""Error of a lift over the normal force that is left."""
_BACK = wp.constant(wp.float64(0.1))
"""Share of a penetration that a step takes back."""
_BESIDE = wp.constant(wp.float64(1e-4))
"""Distance from a box from which a point of a gap is not on it [m]."""
_OPEN = wp.constant(wp.float64(2e-5))
"""Gap [m] of a contact without friction before and after a step; load closes it nearer."""
_FAR = wp.constant(wp.float64(1.0))
"""Gap that no step closes [m]."""
_HALF = wp.constant(wp.float64(0.5))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def is_among(geoms: wp.array(dtype=wp.int32), geom: wp.int32) -> wp.int32:
    """Entry of a geom; 0 of −1, which is a flex."""
    if geom < 0:
        return 0
    return geoms[geom]


@wp.func
def is_box(boxes: wp.array(dtype=Any), geom: wp.int32) -> wp.bool:
    """True if the half edges ``boxes`` of a geom are those of a box.

    False of −1, which is a flex.
    """
    if geom < 0:
        return False
    return wp.float64(boxes[geom][0]) > _0


@wp.func
def beside_box(turn: Any, place: Any, half: Any, point: Any):
    """Distance [m] of a point from a box, along the axis on which it is farthest out; 0 inside."""
    local = wp.transpose(turn) * (point - place)
    out = wp.max(wp.abs(local[0]) - half[0], wp.abs(local[1]) - half[1])
    return wp.max(out, wp.max(wp.abs(local[2]) - half[2], type(out)(_0)))


@wp.func
def passes(
    turn: Any, place: Any, half: Any, other_turn: Any, other_place: Any, other_half: Any, middle: Any, frame: Any, gap: Any,
    ahead: Any, time: Any,
) -> wp.bool:  # fmt: skip
    """True if two boxes pass each other, so that their gap is no contact once it is closed.

    The points of the gap are not on the boxes, or neither is on the other box once the second one has moved for a ``time`` [s] by the
    speeds ``ahead`` along the ``frame``.
    """
    shift = type(gap)(_HALF) * gap * frame[0]
    near, far = middle - shift, middle + shift
    moved = wp.transpose(frame) * type(ahead)(-gap, time * ahead[1], time * ahead[2])
    off = wp.max(beside_box(turn, place, half, near), beside_box(other_turn, other_place, other_half, far))
    by = wp.min(beside_box(turn, place, half, far + moved), beside_box(other_turn, other_place, other_half, near - moved))
    return wp.max(off, by) > type(gap)(_BESIDE)


@wp.func
def is_open(gap: Any, ahead: Any, step: Any) -> wp.bool:
    """True if a gap [m] is without friction before and after a step, at a speed ``ahead`` [m/s]."""
    return gap > type(gap)(_OPEN) and gap + step * ahead > type(gap)(_OPEN)


@wp.func
def closing(gap: Any, passed: wp.bool):
    """Gap [m] that a step closes: all of it, or a share of a penetration.

    If ``passed`` it is one that no step closes.
    """
    if passed:
        return type(gap)(_FAR)
    return wp.where(gap > type(gap)(_0), gap, type(gap)(_BACK) * gap)


@wp.func
def slide_force(
    slots: Slots, i: wp.int32, pad: wp.int32, body: wp.int32, m: wp.int32, ahead: wp.float64, step: wp.float64
) -> wp.float64:
    """Force [N] of row m of a contact, if it sticks, by the friction of row 1 over its own.

    ``ahead``: velocity of the row at the end of the step.
    """
    force = slots.force[i, pad, body, m] - ahead / (slots.regularisation[i, pad, body, m] * step)
    friction = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION)
    return force * (friction / wp.max(slots.friction[i, pad, body, m - 1], LEAST_FRICTION))


@wp.func
def correct_lift(
    slots: Slots, i: wp.int32, pad: wp.int32, body: wp.int32, ahead: wp.float64, slide: wp.float64, step: wp.float64
):
    """Set the lift of one contact.

    Returns whether it did not fit, and by how much the reference of its normal row falls.

    A slide that is faster by a lift that is larger asks for more: the first guess follows from the contact's own mass, the others by
    secants. ``ahead``: velocity of the normal row at the end of the step; ``slide``: root of the sum of squares of all ``slide_force``.
    """
    lift = slots.lift[i, pad, body]
    regular, sheared = slots.regularisation[i, pad, body, 0], slots.regularisation[i, pad, body, 1]
    friction, ratio = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION), sheared / regular
    normal = wp.max(slots.force[i, pad, body, 0] + lift - ahead / (regular * step), _0)
    lacks = friction * ratio * wp.max(slide - friction * normal, _0) - lift
    if wp.abs(lacks) <= _FITS * normal:
        return False, _0
    tried = slots.tried[i, pad, body]
    square = friction * friction * ratio
    more = lacks * (_1 + square * slots.compliance[i, pad, body] / sheared / (_1 + square))
    if not wp.isnan(tried[0]) and tried[1] != lacks:
        more = lacks * (lift - tried[0]) / (tried[1] - lacks)
    more = wp.max(more, -lift)
    slots.tried[i, pad, body] = wp.vec2d(lift, lacks)
    slots.lift[i, pad, body] = lift + more
    slots.force[i, pad, body, 0] = slots.force[i, pad, body, 0] - more
    return True, more * regular
