"""Parts of one body placed in a pad's frame, and the pad's grids of nodes, in Warp."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rest_map import RestMaps, rest_on_map
from raytac.physics.rigid.motion_kernels import place_of, turn_of
from raytac.physics.rigid.shape_kernels import Shapes, first_hit, infinity, part_box, under_primitive, under_surface

wp.set_module_options({"enable_backward": False, "fast_math": False})

_PLANE, _BOX, _MESH = wp.constant(wp.int32(0)), wp.constant(wp.int32(5)), wp.constant(wp.int32(8))
_PARALLEL = wp.constant(wp.float64(1e-14))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_INF = wp.constant(wp.float64(float("inf")))
_SLACK = wp.constant(wp.float64(1e-9))
"""Boxes are widened by this [m], so that rounding leaves out no node on an edge."""


@wp.struct
class Pads:
    """All pads with their grids, coarse to fine; lengths [m]."""

    half: wp.array(dtype=wp.vec2d)
    """Half edges along x and y."""
    thickness: wp.array(dtype=wp.float64)
    highest: wp.array(dtype=wp.float64)
    """Highest node of the resting gel."""
    pitch: wp.array(dtype=wp.float64)
    """Nominal spacing of each grid."""
    nx: wp.array2d(dtype=wp.int32)
    """Nodes along x, (pads, grids)."""
    ny: wp.array2d(dtype=wp.int32)
    first_x: wp.array2d(dtype=wp.int32)
    """Index in ``lines`` of the first node along x."""
    first_y: wp.array2d(dtype=wp.int32)
    cell: wp.array2d(dtype=wp.float64)
    """Area of one node [m²]."""
    lines: wp.array(dtype=wp.vec3d)
    """Place, height and slope of the resting gel, a function of x plus one of y (``sag``).
    Of a pad with a map of heights they are 0: ``maps`` has them."""
    maps: RestMaps
    law: wp.array2d(dtype=wp.float64)
    """Constants of the load law (pads, n), see ``law_kernels``."""


@wp.struct
class Placed:
    """Parts of the body that each block of threads measures, (blocks, most parts)."""

    count: wp.array(dtype=wp.int32)
    """Parts of the body."""
    part: wp.array2d(dtype=wp.int32)
    """Index of the part; −1 where it is not near the pad."""
    rotation: wp.array2d(dtype=wp.mat33d)
    at: wp.array2d(dtype=wp.vec3d)
    centre: wp.array2d(dtype=wp.vec3d)
    half: wp.array2d(dtype=wp.vec3d)
    """Half edges of the box about ``centre`` that holds the part."""
    radius: wp.array2d(dtype=wp.float64)
    bottom: wp.array2d(dtype=wp.float64)
    """Lower bound of z over the pad."""
    width: wp.array2d(dtype=wp.float64)
    """Least width of the part as seen along z."""
    blunt: wp.array2d(dtype=wp.float64)
    """See ``Shapes``."""


@wp.func
def rest_of(maps: RestMaps, pad: wp.int32, x: wp.vec3d, y: wp.vec3d) -> wp.vec3d:
    """z [m] and slopes along x and y of the resting gel at a node of two ``lines``."""
    if maps.first[pad] >= 0:
        return rest_on_map(maps, pad, x[0], y[0])
    return wp.vec3d(x[1] + y[1], x[2], y[2])


@wp.func
def across() -> wp.int32:
    """Threads of a block that are side by side along x."""
    return wp.min(wp.block_dim(), 32)


@wp.func
def bottom_near(
    shapes: Shapes, part: wp.int32, rotation: wp.mat33d, at: wp.vec3d, pads: Pads, pad: wp.int32, reach: wp.float64
) -> wp.float64:
    """Lower bound of z [m] of a part over the pad; inf if out of reach of gel and layer behind."""
    half_x, half_y, highest = pads.half[pad][0], pads.half[pad][1], pads.highest[pad] + reach
    bottom = infinity()
    if shapes.kind[part] == _PLANE:
        n = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
        if n[2] < _0:
            bottom = at[2] + (n[0] * at[0] + n[1] * at[1] + wp.abs(n[0]) * half_x + wp.abs(n[1]) * half_y) / n[2]
    else:
        c, h = rotation * shapes.centre[part] + at, part_box(shapes, part, rotation, at)
        beside = wp.abs(c[0]) > half_x + h[0] or wp.abs(c[1]) > half_y + h[1]
        if not beside and c[2] + h[2] > -_2 * pads.thickness[pad]:
            bottom = c[2] - h[2]
    if bottom < highest:
        return bottom
    return _INF


@wp.func
def lowest_of(shapes: Shapes, part: wp.int32, pose: wp.mat44d, pads: Pads, pad: wp.int32, reach: wp.float64) -> wp.float64:
    """``bottom_near`` of a part of a body at a pose."""
    rotation = turn_of(pose)
    at = rotation * shapes.offset[part] + place_of(pose)
    return bottom_near(shapes, part, rotation * shapes.rotation[part], at, pads, pad, reach)


@wp.func
def width_along_z(shapes: Shapes, part: wp.int32, rotation: wp.mat33d) -> wp.float64:
    """Least width [m] of the outline of a part's box seen along z, square to an edge."""
    result, half = wp.float64(shapes.width[part]), shapes.half[part]
    for k in range(3):
        x, y = half[k] * rotation[0, k], half[k] * rotation[1, k]
        length = wp.sqrt(x * x + y * y)
        if length > wp.float64(1e-9):
            across = wp.float64(0.0)
            for m in range(3):
                across += _2 * half[m] * wp.abs(x * rotation[1, m] - y * rotation[0, m]) / length
            result = wp.min(result, across)
    return result


@wp.func
def place_parts(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, lane: wp.int32, lanes: wp.int32, pose: wp.mat44d, pad: wp.int32,
    body: wp.int32, reach: wp.float64,
):  # fmt: skip
    """Place the parts of a body; a barrier must follow."""
    first = shapes.first_part[body]
    count = shapes.first_part[body + 1] - first
    if lane == 0:
        placed.count[block] = count
    turn, origin = turn_of(pose), place_of(pose)
    k = wp.int32(lane)
    while k < count:
        part = first + k
        rotation, at = turn * shapes.rotation[part], turn * shapes.offset[part] + origin
        bottom = bottom_near(shapes, part, rotation, at, pads, pad, reach)
        placed.part[block, k] = wp.where(bottom < _INF, part, -1)
        placed.rotation[block, k] = rotation
        placed.at[block, k] = at
        placed.centre[block, k] = rotation * shapes.centre[part] + at
        placed.half[block, k] = part_box(shapes, part, rotation, at) + wp.vec3d(_SLACK, _SLACK, _SLACK)
        placed.radius[block, k] = shapes.radius[part] + _SLACK
        placed.bottom[block, k] = bottom
        width = infinity()
        if shapes.kind[part] != _PLANE:
            width = width_along_z(shapes, part, rotation)
        placed.width[block, k] = width
        placed.blunt[block, k] = shapes.blunt[part]
        k += lanes


@wp.func
def bottom_of(placed: Placed, block: wp.int32) -> wp.float64:
    """Lower bound of z of the placed parts."""
    result = infinity()
    for k in range(placed.count[block]):
        result = wp.min(result, placed.bottom[block, k])
    return result


@wp.func
def width_of(placed: Placed, block: wp.int32) -> wp.vec2d:
    """Least ``width`` and ``blunt`` of the placed parts."""
    width, blunt = infinity(), infinity()
    for k in range(placed.count[block]):
        if placed.part[block, k] >= 0:
            width, blunt = wp.min(width, placed.width[block, k]), wp.min(blunt, placed.blunt[block, k])
    return wp.vec2d(width, blunt)


@wp.func
def nodes_within(first: wp.int32, count: wp.int32, low: wp.float64, high: wp.float64, pads: Pads) -> wp.vec2i:
    """First and one beyond the last of a line's nodes from ``low`` to ``high``."""
    start = pads.lines[first][0]
    step = pads.lines[first + 1][0] - start
    top = wp.float64(count)
    return wp.vec2i(
        wp.int32(wp.clamp(wp.ceil((low - start) / step), _0, top)),
        wp.int32(wp.clamp(wp.floor((high - start) / step) + _1, _0, top)),
    )


@wp.func
def window(pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32, level: wp.int32, below: wp.float64) -> wp.vec4i:
    """Nodes where a placed part may be lower than ``below`` [m]: x from, to, y from, to."""
    low_x, high_x, low_y, high_y = infinity(), -infinity(), infinity(), -infinity()
    for k in range(placed.count[block]):
        if placed.part[block, k] >= 0 and placed.bottom[block, k] <= below:
            c, h = placed.centre[block, k], placed.half[block, k]
            # In a ball, what is lower than a plane beneath its centre lies in a disc.
            radius, above = placed.radius[block, k], c[2] - below
            disc = infinity()
            if above > _0 and radius < _INF:
                disc = wp.sqrt(wp.max(radius * radius - above * above, _0)) + _SLACK
            reach_x, reach_y = wp.min(h[0], disc), wp.min(h[1], disc)
            low_x, high_x = wp.min(low_x, c[0] - reach_x), wp.max(high_x, c[0] + reach_x)
            low_y, high_y = wp.min(low_y, c[1] - reach_y), wp.max(high_y, c[1] + reach_y)
    columns = nodes_within(pads.first_x[pad, level], pads.nx[pad, level], low_x, high_x, pads)
    rows = nodes_within(pads.first_y[pad, level], pads.ny[pad, level], low_y, high_y, pads)
    return wp.vec4i(columns[0], columns[1], rows[0], rows[1])


@wp.func
def larger(a: wp.float64, b: wp.float64) -> wp.float64:
    """``wp.max`` without its care for NaN, which takes longer than all else at a node."""
    return wp.where(a > b, a, b)


@wp.func
def smaller(a: wp.float64, b: wp.float64) -> wp.float64:
    return wp.where(a < b, a, b)


@wp.func
def under(shapes: Shapes, placed: Placed, block: wp.int32, x: wp.float64, y: wp.float64, top: wp.bool) -> wp.float64:
    """Lowest z [m] of the placed parts on the line at x, y; inf if it misses all.

    With ``top`` the highest, inf of a half-space.
    The top of a body is the underside of the body turned over about x.
    """
    result = infinity()
    for k in range(placed.count[block]):
        part = placed.part[block, k]
        if part >= 0:
            c, h = placed.centre[block, k], placed.half[block, k]
            if wp.abs(x - c[0]) <= h[0] and wp.abs(y - c[1]) <= h[1]:
                turn, at, across_y = wp.mat33d(placed.rotation[block, k]), wp.vec3d(placed.at[block, k]), wp.float64(y)
                if top:
                    if shapes.kind[part] == _PLANE:
                        return _INF
                    over = wp.diag(wp.vec3d(_1, -_1, -_1))
                    turn = over * turn
                    at = over * at
                    across_y = -y
                result = smaller(result, first_hit(shapes, part, turn, at, x, across_y))
    if top:
        return -result
    return result


@wp.func
def entries_of(size: wp.vec3d, rotation: wp.mat33d, at: wp.vec3d):
    """Heights at which vertical lines enter the slabs of a box, and lengths inside [m].

    The three heights are rows of factors of x, y and 1.
    Of a slab that is parallel to the lines both ends are far away, on one side of the line or on both.
    """
    entry, length = wp.mat33d(), wp.vec3d()
    k = wp.int32(0)
    while k < 3:
        d = rotation[2, k]
        inverse = _1 / wp.where(d < _0, wp.min(d, -_PARALLEL), wp.max(d, _PARALLEL))
        a, b = -rotation[0, k] * inverse, -rotation[1, k] * inverse
        entry[k, 0] = a
        entry[k, 1] = b
        entry[k, 2] = at[2] - size[k] * wp.abs(inverse) - a * at[0] - b * at[1]
        length[k] = _2 * size[k] * wp.abs(inverse)
        k += 1
    return entry, length


@wp.func
def under_nodes(
    shapes: Shapes, placed: Placed, block: wp.int32, lane: wp.int32, lines: wp.array(dtype=wp.vec3d), first_x: wp.int32,
    first_y: wp.int32, nx: wp.int32, ny: wp.int32,
    # outputs
    height: wp.array(dtype=wp.float64),
):  # fmt: skip
    """``under`` on ny rows of nx nodes from ``first_x``, ``first_y`` on, each thread its own."""
    others = wp.bool(False)
    for m in range(placed.count[block]):
        part = placed.part[block, m]
        if part >= 0:
            c, h = placed.centre[block, m], placed.half[block, m]
            rotation, at = placed.rotation[block, m], placed.at[block, m]
            kind, size = wp.int32(shapes.kind[part]), shapes.size[part]
            entry, length = entries_of(size, rotation, at)
            low, high = c - h, c + h
            j = lane // across()
            while j < ny:
                y = lines[first_y + j][0] + _0
                over = y >= low[1] and y <= high[1]
                start = entry * wp.vec3d(_0, y, _1)
                i = lane % across()
                while i < nx:
                    x, k = lines[first_x + i][0] + _0, j * nx + i
                    z = infinity()
                    if over and x >= low[0] and x <= high[0]:
                        if kind == _BOX:
                            a, b, d = start[0] + entry[0, 0] * x, start[1] + entry[1, 0] * x, start[2] + entry[2, 0] * x
                            z = larger(larger(a, b), d)
                            if z > smaller(smaller(a + length[0], b + length[1]), d + length[2]):
                                z = _INF
                        elif kind < _MESH:
                            z = under_primitive(kind, size, rotation, at, x, y)
                        else:
                            z = under_surface(shapes, part, rotation, at, x, y)
                    if others:
                        z = wp.min(z, height[k])
                    height[k] = z
                    i += across()
                j += wp.block_dim() // across()
            others = True
