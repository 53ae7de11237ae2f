"""Bodies beyond the bonded faces of pads, at a pose or on the path to it, in Warp.

The bonded face and the case behind it are a layer one thickness of the gel deep. A body with a point in that layer, under the gel, has gone
through the gel or the case. A body that lies wholly behind the layer, on the other side of the sensor, has not. A motion through the layer
is detected since it is checked at every thickness.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import LAST
from raytac.physics.rigid.motion_kernels import is_finite, place_of, pose_of, turn_of
from raytac.physics.rigid.placed_kernels import Pads, nodes_within
from raytac.physics.rigid.shape_kernels import Shapes, first_hit, infinity, part_box
from raytac.physics.rigid.world_kernels import Motion, Steps

wp.set_module_options({"enable_backward": False, "fast_math": False})

_PLANE = wp.constant(wp.int32(0))
_LAST = wp.constant(wp.int32(LAST))
_MOST_PIECES = wp.constant(wp.float64(100_000.0))
"""Pieces of one motion: 400 m, far more than the greatest speed allows in a step."""
_SLACK = wp.constant(wp.float64(1e-9))
"""Boxes are widened by this [m], so that rounding leaves out no line on an edge."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_INF = wp.constant(wp.float64(float("inf")))


@wp.func
def lines_below(shapes: Shapes, pads: Pads, pad: wp.int32, body: wp.int32, pose: wp.mat44d) -> wp.vec4i:
    """Lines of the pad on which parts of a body may be lower than the bonded face.

    x from, to, y from, to; none if the body lies behind it as a whole.
    Without the outermost lines: MuJoCo lets bodies some hundredths of a millimetre into walls, and a case may be as wide as its gel.
    """
    low_x, high_x, low_y, high_y = infinity(), -infinity(), infinity(), -infinity()
    turn, origin, highest = turn_of(pose), place_of(pose), -infinity()
    for part in range(shapes.first_part[body], shapes.first_part[body + 1]):
        rotation, at = turn * shapes.rotation[part], turn * shapes.offset[part] + origin
        if shapes.kind[part] == _PLANE:
            highest = infinity()
            n = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
            across = wp.abs(n[0]) * pads.half[pad][0] + wp.abs(n[1]) * pads.half[pad][1]
            # Only one that looks down has an underside.
            if n[2] < _0 and at[2] + (n[0] * at[0] + n[1] * at[1] + across) / n[2] < _SLACK - pads.thickness[pad]:
                low_x, high_x, low_y, high_y = -infinity(), infinity(), -infinity(), infinity()
        else:
            centre, half = rotation * shapes.centre[part] + at, part_box(shapes, part, rotation, at)
            highest = wp.max(highest, centre[2] + half[2] + _SLACK)
            if centre[2] - half[2] - _SLACK < -pads.thickness[pad]:
                low_x, high_x = wp.min(low_x, centre[0] - half[0] - _SLACK), wp.max(high_x, centre[0] + half[0] + _SLACK)
                low_y, high_y = wp.min(low_y, centre[1] - half[1] - _SLACK), wp.max(high_y, centre[1] + half[1] + _SLACK)
    if highest <= -_2 * pads.thickness[pad]:
        return wp.vec4i(0, 0, 0, 0)
    columns = nodes_within(pads.first_x[pad, _LAST], pads.nx[pad, _LAST], low_x, high_x, pads)
    rows = nodes_within(pads.first_y[pad, _LAST], pads.ny[pad, _LAST], low_y, high_y, pads)
    return wp.vec4i(
        wp.max(columns[0], 1),
        wp.min(columns[1], pads.nx[pad, _LAST] - 1),
        wp.max(rows[0], 1),
        wp.min(rows[1], pads.ny[pad, _LAST] - 1),
    )


@wp.func
def end_on_line(shapes: Shapes, body: wp.int32, pose: wp.mat44d, x: wp.float64, y: wp.float64, side: wp.float64) -> wp.float64:
    """Lowest z [m] of a body on the line at x, y (``side`` 1), or minus the highest (−1).

    It is inf where the line misses the body.
    The top of a body is the underside of the body turned over about x.
    """
    result = infinity()
    over = wp.diag(wp.vec3d(_1, side, side))
    turn, origin = over * turn_of(pose), over * place_of(pose)
    for part in range(shapes.first_part[body], shapes.first_part[body + 1]):
        rotation, at = turn * shapes.rotation[part], turn * shapes.offset[part] + origin
        result = wp.min(result, first_hit(shapes, part, rotation, at, x, side * y))
    return result


@wp.func
def is_beyond(
    shapes: Shapes, pads: Pads, pad: wp.int32, body: wp.int32, pose: wp.mat44d, lane: wp.int32, lanes: wp.int32
) -> wp.bool:
    """True where a finite pose is beyond the bonded face on a line of this thread."""
    if not is_finite(pose):
        return False
    bond = -pads.thickness[pad]
    area = lines_below(shapes, pads, pad, body, pose)
    nx = wp.max(area[1] - area[0], 0)
    n = nx * wp.max(area[3] - area[2], 0)
    k = wp.int32(lane)
    while k < n:
        x = pads.lines[pads.first_x[pad, _LAST] + area[0] + k % nx][0]
        y = pads.lines[pads.first_y[pad, _LAST] + area[2] + k // nx][0]
        if end_on_line(shapes, body, pose, x, y, _1) < bond:
            top = -end_on_line(shapes, body, pose, x, y, -_1)
            # A half-space that faces down is unbounded above.
            if top == -_INF or top > bond - pads.thickness[pad]:
                return True
        k += lanes
    return False


@wp.func
def pieces_of(shapes: Shapes, pads: Pads, pad: wp.int32, body: wp.int32, before: wp.mat44d, pose: wp.mat44d, angle: wp.float64):
    """Pieces of a motion that turns by ``angle`` [rad]; in each no point exceeds a thickness."""
    travel = wp.length(place_of(pose) - place_of(before)) + angle * shapes.ball[body]
    if shapes.ball[body] == _INF:  # a half-space moves along its normal
        part = shapes.first_part[body]
        normal, offset = shapes.rotation[part] * wp.vec3d(_0, _0, _1), shapes.offset[part]
        was = wp.dot(turn_of(before) * normal, turn_of(before) * offset + place_of(before))
        now = wp.dot(turn_of(pose) * normal, turn_of(pose) * offset + place_of(pose))
        travel = wp.abs(now - was) + angle * wp.length(pads.half[pad])
    return wp.int32(wp.clamp(wp.ceil(travel / pads.thickness[pad]), _1, _MOST_PIECES))


@wp.func
def went_beyond(
    shapes: Shapes, pads: Pads, pad: wp.int32, body: wp.int32, before: wp.mat44d, pose: wp.mat44d, lane: wp.int32, lanes: wp.int32
) -> wp.bool:
    """``is_beyond`` at a pose or on the straight path there from ``before``.

    Place and rotation vector change linearly on it. A pose before that is not known is NaN.
    """
    if is_beyond(shapes, pads, pad, body, pose, lane, lanes):
        return True
    if not is_finite(before) or not is_finite(pose):
        return False
    q = wp.quat_from_matrix(wp.transpose(turn_of(before)) * turn_of(pose))
    if q[3] < _0:
        q = -q
    axis = wp.vec3d(q[0], q[1], q[2])
    angle = _2 * wp.atan2(wp.length(axis), q[3])
    axis = wp.normalize(axis)
    pieces = pieces_of(shapes, pads, pad, body, before, pose, angle)
    start, travel = place_of(before), place_of(pose) - place_of(before)
    k = wp.int32(1)
    while k < pieces:
        share = wp.float64(k) / wp.float64(pieces)
        turn = turn_of(before) * wp.quat_to_matrix(wp.quat_from_axis_angle(axis, share * angle))
        if is_beyond(shapes, pads, pad, body, pose_of(turn, start + share * travel), lane, lanes):
            return True
        k += 1
    return False


@wp.kernel
def lose_pierced(shapes: Shapes, pads: Pads, motion: Motion, lanes: wp.int32, steps: Steps):
    """Lose environments in which a suspected body is or went beyond a bonded face."""
    row, pad, body, lane = wp.tid()
    if steps.envs[row] >= 0 and motion.suspect[row, pad, body] != 0:
        pose, before = motion.pose[row, pad, body], motion.before[row, pad, body]
        if went_beyond(shapes, pads, pad, body, before, pose, lane, lanes):
            steps.lost[row] = 1


@wp.kernel
def find_pierced(
    shapes: Shapes, pads: Pads, before: wp.array3d(dtype=wp.mat44d), poses: wp.array3d(dtype=wp.mat44d), lanes: wp.int32,
    # outputs
    pierced: wp.array3d(dtype=wp.int32),
):  # fmt: skip
    """Set 1 (n, pads, bodies) where a body is or, since ``before``, went beyond a bonded face."""
    row, pad, body, lane = wp.tid()
    if went_beyond(shapes, pads, pad, body, before[row, pad, body], poses[row, pad, body], lane, lanes):
        pierced[row, pad, body] = 1
