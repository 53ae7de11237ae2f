"""Rows of contacts, one for each pair of pad and body that is near, in Warp."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

LAST = 3
"""Grid of a pad that gives the gel's height and normal at a place."""
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
