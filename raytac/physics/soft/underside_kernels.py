"""Kernels of ``Undersides``: lowest points of parts and triangles over a pad's nodes."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.shape_kernels import Shapes, first_hit, infinity
from raytac.physics.rigid.underside_kernels import Before, Nodes

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_INF = wp.constant(wp.float64(float("inf")))
_NAN = wp.constant(wp.float64(float("nan")))
_BEHIND = wp.constant(wp.float64(1e-3))
"""Overlap [m] beyond that of any contact: the object is beside or behind the pad."""
_BARELY_FLAT = wp.constant(wp.float64(1e-12))
"""Projected area over squared size below which a triangle counts as vertical."""
_SLACK = wp.constant(wp.float64(1e-9))
"""Share of a spacing that closes the seam between triangles that rounding could open."""


@wp.kernel
def lower_poses(
    sound: wp.array(dtype=wp.int32),
    touching: wp.array2d(dtype=wp.bool),
    first: wp.int32,
    poses: wp.array2d(dtype=wp.mat44d),
    lowered: wp.array(dtype=wp.float64),
    # outputs
    out: wp.array2d(dtype=wp.mat44d),
):
    """Poses ``first`` and further lowered along z [m], by (environment, object).

    They are NaN where an object does not touch, which shows nothing. A distance that is not finite lowers nothing.
    """
    env, body = wp.tid()
    pose = poses[env, first + body]
    down = lowered[env]
    if wp.isfinite(down):
        pose[2, 3] = pose[2, 3] - down
    if sound[env] == 0 or not touching[env, first + body]:
        pose[0, 0] = _NAN
        pose[2, 3] = _NAN
    out[env, body] = pose


@wp.kernel
def underside_of_parts(shapes: Shapes, nodes: Nodes, before: Before, under: wp.array3d(dtype=wp.float64)):
    """Lowest z [m] of all parts along one row of nodes, by (environment, row); inf for none."""
    env, row = wp.tid()
    y = nodes.y[row]
    i, end = wp.int32(0), under.shape[2]
    while i < end:
        under[env, row, i] = infinity()
        i += 1
    for part in range(before.window.shape[1]):
        window = before.window[env, part]
        if row >= window[2] and row < window[3]:
            rotation, at = before.rotation[env, part], before.at[env, part]
            i, end = wp.max(window[0], 0), window[1]
            while i < end:
                z = first_hit(shapes, part, rotation, at, nodes.x[i], y)
                under[env, row, i] = wp.min(under[env, row, i], z)
                i += 1


@wp.func
def cross(a: wp.vec3d, b: wp.vec3d) -> wp.float64:
    return a[0] * b[1] - a[1] * b[0]


@wp.kernel
def underside_of_triangles(
    sound: wp.array(dtype=wp.int32),
    touching: wp.array2d(dtype=wp.bool),
    body: wp.int32,
    vertices: wp.array2d(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    lowered: wp.array(dtype=wp.float64),
    nodes: Nodes,
    # outputs
    under: wp.array3d(dtype=wp.float64),
):
    """Lower ``under`` to a triangle's plane over its nodes, by (environment, face)."""
    env, face = wp.tid()
    if sound[env] == 0 or not touching[env, body]:
        return
    corner = faces[face]
    a, b, c = vertices[env, corner[0]], vertices[env, corner[1]], vertices[env, corner[2]]
    down = lowered[env]
    if not wp.isfinite(down):
        down = wp.float64(0.0)
    edge_a, edge_b = b - a, c - a
    area = cross(edge_a, edge_b)
    if not (wp.abs(area) > _BARELY_FLAT * (wp.length_sq(edge_a) + wp.length_sq(edge_b))):
        return
    low, high = wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c))
    nx, ny = nodes.x.shape[0], nodes.y.shape[0]
    x0, y0 = nodes.x[0], nodes.y[0]
    step_x, step_y = (nodes.x[nx - 1] - x0) / wp.float64(nx - 1), (nodes.y[ny - 1] - y0) / wp.float64(ny - 1)
    if not (high[0] >= x0 - step_x and low[0] <= nodes.x[nx - 1] + step_x):
        return
    row_0 = wp.int32(wp.max(wp.ceil((low[1] - y0) / step_y - _SLACK), _0))
    row_1 = wp.int32(wp.min(wp.floor((high[1] - y0) / step_y + _SLACK), wp.float64(ny - 1)))
    column_0 = wp.int32(wp.max(wp.ceil((low[0] - x0) / step_x - _SLACK), _0))
    column_1 = wp.int32(wp.min(wp.floor((high[0] - x0) / step_x + _SLACK), wp.float64(nx - 1)))
    slope_x = (edge_a[2] * edge_b[1] - edge_b[2] * edge_a[1]) / area
    slope_y = (edge_b[2] * edge_a[0] - edge_a[2] * edge_b[0]) / area
    # A node is in if no edge has it more than the slack outside: twice a triangle's area is edge times distance.
    slack_a = _SLACK * (step_x + step_y) * wp.length(edge_b - edge_a)
    slack_b = _SLACK * (step_x + step_y) * wp.length(edge_b)
    slack_c = _SLACK * (step_x + step_y) * wp.length(edge_a)
    sign = wp.sign(area)
    for j in range(row_0, row_1 + 1):
        for i in range(column_0, column_1 + 1):
            p = wp.vec3d(nodes.x[i], nodes.y[j], _0)
            u, v, w = cross(b - p, c - p) * sign, cross(c - p, a - p) * sign, cross(a - p, b - p) * sign
            if u >= -slack_a and v >= -slack_b and w >= -slack_c:
                z = a[2] + slope_x * (p[0] - a[0]) + slope_y * (p[1] - a[1])
                wp.atomic_min(under, env, j, i, wp.clamp(z, low[2], high[2]) - down)


@wp.kernel
def remove_behind(
    touching: wp.array2d(dtype=wp.bool),
    clearance: wp.array(dtype=wp.float64),
    rest: wp.array2d(dtype=wp.float64),
    rise: wp.array3d(dtype=wp.float32),
    # outputs
    under: wp.array3d(dtype=wp.float64),
):
    """Remove what is far below the smooth coat if several objects touch, along a row."""
    env, row = wp.tid()
    count = wp.int32(0)
    for body in range(touching.shape[1]):
        if touching[env, body]:
            count += 1
    if count < 2 or not wp.isfinite(clearance[env]):
        return
    i, end = wp.int32(0), under.shape[2]
    while i < end:
        if under[env, row, i] < rest[row, i] + wp.float64(rise[env, row, i]) - _BEHIND:
            under[env, row, i] = infinity()
        i += 1
