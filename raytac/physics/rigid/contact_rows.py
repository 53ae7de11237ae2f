"""Rows of contacts, one for each pair of pad and body that is near, in Warp."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.placed_kernels import Pads

wp.set_module_options({"enable_backward": False, "fast_math": False})

LAST = 3
"""Grid of a pad that gives the gel's height and normal at a place."""
_LAST = wp.constant(wp.int32(LAST))
_NAN = wp.constant(wp.float64(float("nan")))


@wp.struct
class Rows:
    """Results, one row for each pair that is near; see ``PadContacts``."""

    valid: wp.array(dtype=wp.int32)
    """1 where the pair touches, is within reach or has gone through."""
    env: wp.array(dtype=wp.int32)
    pad: wp.array(dtype=wp.int32)
    body: wp.array(dtype=wp.int32)
    depth: wp.array(dtype=wp.float64)
    centre: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    clearance: wp.array(dtype=wp.float64)
    spread: wp.array(dtype=wp.vec3d)
    deepest: wp.array(dtype=wp.float64)
    force: wp.array2d(dtype=wp.float64)
    radius: wp.array2d(dtype=wp.float64)


@wp.func
def place_of_gap(pads: Pads, pad: wp.int32, x: wp.float64, y: wp.float64, depth: wp.float64, row: wp.int32, rows: Rows):
    """Place and normal of the least gap of a body too sharp to have nodes of its own there."""
    fx, fy = pads.first_x[pad, _LAST], pads.first_y[pad, _LAST]
    i = wp.int32(wp.round((x - pads.lines[fx][0]) / (pads.lines[fx + 1][0] - pads.lines[fx][0])))
    j = wp.int32(wp.round((y - pads.lines[fy][0]) / (pads.lines[fy + 1][0] - pads.lines[fy][0])))
    p = pads.lines[fx + wp.clamp(i, 0, pads.nx[pad, _LAST] - 1)]
    q = pads.lines[fy + wp.clamp(j, 0, pads.ny[pad, _LAST] - 1)]
    rest = p[1] + p[2] * (x - p[0]) + q[1] + q[2] * (y - q[0])
    rows.centre[row] = wp.vec3d(x, y, rest - depth)
    rows.normal[row] = wp.normalize(wp.vec3d(-p[2], -q[2], wp.float64(1.0)))


@wp.func
def missing_row(rows: Rows, row: wp.int32, depth: wp.float64, clearance: wp.float64):
    """Row without a law: a body through the gel, or (NaN) a pose that is not finite."""
    rows.valid[row] = 1
    rows.depth[row] = depth
    rows.clearance[row] = clearance
    rows.spread[row] = wp.vec3d(_NAN, _NAN, _NAN)
    rows.deepest[row] = _NAN
    rows.centre[row] = wp.vec3d(_NAN, _NAN, _NAN)
    rows.normal[row] = wp.vec3d(_NAN, _NAN, _NAN)
    for k in range(rows.force.shape[1]):
        rows.force[row, k] = _NAN
        rows.radius[row, k] = _NAN
