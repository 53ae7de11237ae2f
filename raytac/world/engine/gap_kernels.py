"""Gaps between hard geoms, in the kernels of both engines and the precision of each."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

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
