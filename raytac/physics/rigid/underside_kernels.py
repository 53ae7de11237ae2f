"""Kernels of ``PressedGel``: parts placed before a pad, undersides by rows, overlaps."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.motion_kernels import place_of, turn_of
from raytac.physics.rigid.shape_kernels import Shapes, direction_of, first_hit, infinity, line_through, part_box

wp.set_module_options({"enable_backward": False, "fast_math": False})

_PLANE, _BOX = wp.constant(wp.int32(0)), wp.constant(wp.int32(5))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_INF = wp.constant(wp.float64(float("inf")))
_SLACK = wp.constant(wp.float64(1e-9))
"""Boxes are widened by this [m], so that rounding leaves out no node on an edge."""
_PARALLEL = wp.constant(wp.float64(1e-14))
"""Component of d below which a line is parallel to a slab."""


@wp.struct
class Nodes:
    """Nodes of a pad's surface; lengths [m]."""

    x: wp.array(dtype=wp.float64)
    y: wp.array(dtype=wp.float64)
    rest: wp.array2d(dtype=wp.float64)
    """(Ny, Nx)."""
    highest: wp.float64
    share: wp.array(dtype=wp.float64)
    """Share of the overlap with each body by which it presses the gel in, (bodies,)."""
    bond: wp.array(dtype=wp.float64)
    """z of the face that the gel is bonded to, below which a body is not shown, (bodies,)."""


@wp.struct
class Before:
    """Parts of all bodies before each pad, (B, parts)."""

    rotation: wp.array2d(dtype=wp.mat33d)
    at: wp.array2d(dtype=wp.vec3d)
    bottom: wp.array2d(dtype=wp.float64)
    """Lower bound of z over the pad."""
    window: wp.array2d(dtype=wp.vec4i)
    """Columns from, to and rows from, to where the part may be lower than the gel."""


@wp.func
def nodes_between(line: wp.array(dtype=wp.float64), low: wp.float64, high: wp.float64) -> wp.vec2i:
    """First and one beyond the last of evenly spaced nodes from ``low`` to ``high``."""
    count = line.shape[0]
    start, top = line[0], wp.float64(count)
    step = (line[count - 1] - start) / (top - _1)
    return wp.vec2i(
        wp.int32(wp.clamp(wp.ceil((low - start) / step), _0, top)),
        wp.int32(wp.clamp(wp.floor((high - start) / step) + _1, _0, top)),
    )


@wp.kernel
def place(
    poses: wp.array2d(dtype=wp.mat44d), sound: wp.array(dtype=wp.bool), shapes: Shapes, nodes: Nodes,
    # outputs
    before: Before,
):  # fmt: skip
    """Place the parts of a body before a pad, by (pad, body)."""
    env, body = wp.tid()
    pose = poses[env, body]
    turn, origin = turn_of(pose), place_of(pose)
    half_x, half_y = nodes.x[nodes.x.shape[0] - 1], nodes.y[nodes.y.shape[0] - 1]
    for part in range(shapes.first_part[body], shapes.first_part[body + 1]):
        rotation = turn * shapes.rotation[part]
        at = turn * shapes.offset[part] + origin
        window, bottom = wp.vec4i(0, 0, 0, 0), infinity()
        if sound[env] and nodes.share[body] > _0:
            if shapes.kind[part] == _PLANE:
                n = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
                if n[2] < _0:
                    bottom = at[2] + (n[0] * at[0] + n[1] * at[1] + wp.abs(n[0]) * half_x + wp.abs(n[1]) * half_y) / n[2]
                    if bottom < nodes.highest:
                        window = wp.vec4i(0, nodes.x.shape[0], 0, nodes.y.shape[0])
            else:
                c, h = rotation * shapes.centre[part] + at, part_box(shapes, part, rotation, at)
                bottom = c[2] - h[2] - _SLACK
                if bottom < nodes.highest:
                    # In a ball, what is lower than a plane beneath its centre lies in a disc.
                    radius, above = shapes.radius[part], c[2] - nodes.highest
                    disc = infinity()
                    if above > _0:
                        disc = wp.sqrt(wp.max(radius * radius - above * above, _0))
                    reach_x, reach_y = wp.min(h[0], disc) + _SLACK, wp.min(h[1], disc) + _SLACK
                    columns = nodes_between(nodes.x, c[0] - reach_x, c[0] + reach_x)
                    rows = nodes_between(nodes.y, c[1] - reach_y, c[1] + reach_y)
                    window = wp.vec4i(columns[0], columns[1], rows[0], rows[1])
        before.rotation[env, part] = rotation
        before.at[env, part] = at
        before.bottom[env, part] = bottom
        before.window[env, part] = window


@wp.func
def inverse_of(d: wp.float64) -> wp.float64:
    """1 / d, finite: a line parallel to a slab is inside from far below to far above, or never."""
    if wp.abs(d) < _PARALLEL:
        return _1 / _PARALLEL
    return _1 / d


@wp.func
def steepest(d: wp.vec3d) -> wp.vec3i:
    """The axes, first that of the largest component."""
    a = wp.vec3d(wp.abs(d[0]), wp.abs(d[1]), wp.abs(d[2]))
    if a[1] >= a[0] and a[1] >= a[2]:
        return wp.vec3i(1, 2, 0)
    if a[2] >= a[0]:
        return wp.vec3i(2, 0, 1)
    return wp.vec3i(0, 1, 2)


@wp.kernel
def lower(
    shapes: Shapes, nodes: Nodes, before: Before,
    # outputs
    overlap: wp.array3d(dtype=wp.float32),
    written: wp.array2d(dtype=wp.vec2i),
    depth: wp.array3d(dtype=wp.float64),
    behind: wp.array3d(dtype=wp.int32),
):  # fmt: skip
    """Overlap of all bodies with the gel along one row of nodes, by (pad, row).

    ``overlap`` is 0 before; ``written``: columns that it is raised in. ``depth`` (B, Ny, bodies): greatest overlap of each, −inf without;
    ``behind``: 1 where a body is beyond the bonded face.
    """
    env, row = wp.tid()
    from_, to = nodes.x.shape[0], wp.int32(0)
    y = nodes.y[row]
    for body in range(depth.shape[2]):
        most, beyond, share = -infinity(), wp.int32(0), nodes.share[body]
        for part in range(shapes.first_part[body], shapes.first_part[body + 1]):
            window = before.window[env, part]
            if row >= window[2] and row < window[3]:
                bottom = before.bottom[env, part]
                rotation, at = before.rotation[env, part], before.at[env, part]
                is_box, size = shapes.kind[part] == _BOX, shapes.size[part]
                # A vertical line is in slab k of a box from the middle − reach to the middle + reach, the middle being linear in x.
                d, o = direction_of(rotation), line_through(rotation, at, _0, y)
                turn = steepest(d)
                a, b, c = turn[0], turn[1], turn[2]
                inverse = wp.vec3d(inverse_of(d[a]), inverse_of(d[b]), inverse_of(d[c]))
                reach = wp.cw_mul(
                    wp.vec3d(size[a], size[b], size[c]), wp.vec3d(wp.abs(inverse[0]), wp.abs(inverse[1]), wp.abs(inverse[2]))
                )
                middle = -wp.cw_mul(wp.vec3d(o[a], o[b], o[c]), inverse)
                slope = -wp.cw_mul(wp.vec3d(rotation[0, a], rotation[0, b], rotation[0, c]), inverse)
                for i in range(window[0], window[1]):
                    rest, x = nodes.rest[row, i], nodes.x[i]
                    if rest > bottom:
                        z = infinity()
                        if is_box:
                            p = middle[0] + slope[0] * x
                            start = p - reach[0]
                            if at[2] + start < rest:
                                q, r = middle[1] + slope[1] * x, middle[2] + slope[2] * x
                                start = wp.max(start, wp.max(q - reach[1], r - reach[2]))
                                if start <= wp.min(p + reach[0], wp.min(q + reach[1], r + reach[2])):
                                    z = at[2] + start
                        else:
                            z = first_hit(shapes, part, rotation, at, x, y)
                        if z < rest:
                            if z < nodes.bond[body]:
                                beyond = wp.int32(1)
                            else:
                                u = share * (rest - z)
                                most = wp.max(most, u)
                                overlap[env, row, i] = wp.max(overlap[env, row, i], wp.float32(u))
                                from_, to = wp.min(from_, i), wp.max(to, i + 1)
        depth[env, row, body] = most
        behind[env, row, body] = beyond
    written[env, row] = wp.vec2i(from_, to)


@wp.kernel
def join_rows(
    written: wp.array2d(dtype=wp.vec2i), depth: wp.array3d(dtype=wp.float64), behind: wp.array3d(dtype=wp.int32),
    # outputs
    window: wp.array(dtype=wp.vec4i),
    deepest: wp.array(dtype=wp.float32),
    depths: wp.array2d(dtype=wp.float64),
    beyond: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Join the findings of a pad's rows, by pad.

    ``window``: columns from, to and rows from, to of the nodes where a body is lower than the gel; zeros for none. ``deepest``: greatest
    overlap, 0 for none; ``depths``: of each body.
    """
    env = wp.tid()
    rows, greatest = written.shape[1], wp.float64(0.0)
    for body in range(depth.shape[2]):
        most, any_ = -infinity(), wp.int32(0)
        for row in range(rows):
            most, any_ = wp.max(most, depth[env, row, body]), wp.max(any_, behind[env, row, body])
        depths[env, body] = most
        greatest = wp.max(greatest, most)
        beyond[env, body] = any_
    deepest[env] = wp.float32(greatest)
    span = wp.vec4i(2147483647, 0, rows, 0)
    for row in range(rows):
        line = written[env, row]
        if line[1] > line[0]:
            span = wp.vec4i(wp.min(span[0], line[0]), wp.max(span[1], line[1]), wp.min(span[2], row), row + 1)
    if span[1] == 0:
        span = wp.vec4i(0, 0, 0, 0)
    window[env] = span
