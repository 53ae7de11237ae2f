"""Heights of one body on a pad's nodes and between them, their bounds, sums over a block."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

from raytac.physics.rest_map import RestMaps, rest_on_map
from raytac.physics.rigid.placed_kernels import Pads, Placed, across, larger, rest_of, smaller, under, window
from raytac.physics.rigid.shape_kernels import Shapes, infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TORUS = wp.constant(wp.int32(7))
"""First of the kinds of parts that may not be convex."""
_MANY = wp.constant(wp.int32(0x7FFFFFFF))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))


@wp.func
def total_of(value: Any):
    """Sum over the block; also a barrier."""
    if wp.block_dim() == 1:  # of a CPU, where a tile takes longer than a node
        return value
    return wp.tile_sum(wp.tile(value))[0]


@wp.func
def least_of(value: Any):
    if wp.block_dim() == 1:
        return value
    return wp.tile_min(wp.tile(value))[0]


@wp.func
def pierced_at(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, lane: wp.int32, lanes: wp.int32, pad: wp.int32, level: wp.int32
) -> wp.float64:
    """Lowest z [m] of the body on lines inside the layer behind the bonded face; else inf.

    That layer has one thickness.
    Lines on which it lies wholly behind that layer do not count, nor the pad's outermost lines: MuJoCo lets bodies some hundredths of a
    millimetre into walls, and a case may be as wide as its gel.
    """
    bond = -pads.thickness[pad]
    area = window(pads, placed, block, pad, level, bond)
    i0, j0 = wp.max(area[0], 1), wp.max(area[2], 1)
    nx = wp.min(area[1], pads.nx[pad, level] - 1) - i0
    n = wp.max(nx, 0) * wp.max(wp.min(area[3], pads.ny[pad, level] - 1) - j0, 0)
    lowest = infinity()
    k = wp.int32(lane)
    while k < n:
        x = pads.lines[pads.first_x[pad, level] + i0 + k % nx][0]
        y = pads.lines[pads.first_y[pad, level] + j0 + k // nx][0]
        z = under(shapes, placed, block, x, y, False)
        if z < bond and z < lowest:
            if under(shapes, placed, block, x, y, True) > bond - pads.thickness[pad]:
                lowest = z
        k += lanes
    return least_of(lowest)


@wp.func
def height_at(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32, level: wp.int32, i: wp.int32, j: wp.int32
) -> wp.vec2d:
    """z [m] of the body over node i, j, and its gap; inf without one or below the bonded face."""
    if i < 0 or j < 0 or i >= pads.nx[pad, level] or j >= pads.ny[pad, level]:
        return wp.vec2d(_INF, _INF)
    x, y = pads.lines[pads.first_x[pad, level] + i], pads.lines[pads.first_y[pad, level] + j]
    z = under(shapes, placed, block, x[0], y[0], False)
    if z < -pads.thickness[pad]:
        return wp.vec2d(_INF, _INF)
    if pads.maps.first[pad] >= 0:
        return wp.vec2d(z, z - rest_of(pads.maps, pad, x, y)[0])
    return wp.vec2d(z, z - x[1] - y[1])


@wp.func
def vertex_of(before: wp.float64, middle: wp.float64, after: wp.float64, pitch: wp.float64) -> wp.vec2d:
    """Drop of a parabola through values at −1, 0, 1 below the middle, and where; else (0, 0).

    Where a neighbour is higher by half the pitch, it lies beyond an edge, through which no parabola goes. Where one is lower, the least
    value is beyond the nodes that were looked at.
    """
    curve = before + after - _2 * middle
    if curve > _0 and wp.min(before, after) >= middle and wp.max(before, after) < middle + _HALF * pitch:
        rise = after - before
        return wp.vec2d(wp.float64(0.125) * rise * rise / curve, -_HALF * rise / curve)
    return wp.vec2d(_0, _0)


@wp.func
def between_nodes(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32, level: wp.int32, i: wp.int32, j: wp.int32,
    middle: wp.float64, of: wp.int32,
) -> wp.vec3d:  # fmt: skip
    """Drop [m] below ``middle`` at node i, j, and the place of the least along x, y [nodes].

    ``middle`` is the z (``of`` 0) or the gap (1) there.

    By parabolas through the neighbours along both axes.
    """
    beside = wp.vec4d()
    k = wp.int32(0)
    while k < 4:  # a loop that is not unrolled: the compiler's time goes by the code
        step = wp.where(k % 2 == 0, -1, 1)
        p, q = i + wp.where(k < 2, step, 0), j + wp.where(k < 2, 0, step)
        beside[k] = height_at(shapes, pads, placed, block, pad, level, p, q)[of]
        k += 1
    across = vertex_of(beside[0], middle, beside[1], pads.pitch[level])
    along = vertex_of(beside[2], middle, beside[3], pads.pitch[level])
    return wp.vec3d(across[0] + along[0], across[1], along[1])


@wp.func
def look_at_nodes(
    gap: wp.array(dtype=wp.float64), lines: wp.array(dtype=wp.vec3d), first_x: wp.int32, first_y: wp.int32, lane: wp.int32, nx: wp.int32,
    ny: wp.int32, bond: wp.float64, below: wp.float64, maps: RestMaps, pad: wp.int32,
):  # fmt: skip
    """Turn a thread's heights on ny rows of nx nodes into gaps to the gel.

    Gaps beneath the bonded face ``bond`` are inf. Returns how many are lower than ``below``, the least and its node, and the lowest
    height and its node [m].
    """
    count, near_node, low_node = wp.int32(0), wp.int32(_MANY), wp.int32(_MANY)
    least, low = infinity(), infinity()
    mapped = maps.first[pad] >= 0
    j = lane // across()
    while j < ny:
        rest = lines[first_y + j][1] + _0
        i = lane % across()
        while i < nx:
            k = j * nx + i
            z = gap[k] + _0
            if z < bond:
                z = _INF
            distance = z - lines[first_x + i][1] - rest
            if mapped:
                distance = z - rest_on_map(maps, pad, lines[first_x + i][0], lines[first_y + j][0])[0]
            if z < low:
                low = z
                low_node = k
            if distance < below:
                count += 1
            if distance < least:
                least = distance
                near_node = k
            gap[k] = distance
            i += across()
        j += wp.block_dim() // across()
    return count, least, near_node, low, low_node


@wp.func
def rises_at(
    gap: wp.array(dtype=wp.float64), k: wp.int32, step: wp.int32, at: wp.int32, count: wp.int32, here: wp.float64
) -> wp.vec2d:  # fmt: skip
    """Rises [m] from node k, with a gap ``here``, to those before and after on its line.

    Inf where there is none. It is the ``at``-th of ``count`` nodes that are ``step`` apart in the window.
    """
    before, after = infinity(), infinity()
    if at > 0:
        before = gap[k - step] - here
    if at < count - 1:
        after = gap[k + step] - here
    return wp.vec2d(before, after)


@wp.func
def fall_of(rises: wp.vec2d, steep: wp.float64) -> wp.float64:
    """Greatest fall [m] of a convex gap within a spacing of a node, by its ``rises_at``.

    A convex function falls on one side of a node by no more than it rises on the other. A neighbour that is higher by more than ``steep``
    bounds nothing. It counts as one beyond the outline: the node on the other side bounds what is between.
    """
    low, high = smaller(rises[0], rises[1]), larger(rises[0], rises[1])
    if high > steep and (low <= steep or high == _INF):
        high = wp.where(low < _INF, low, steep)
    return larger(high, _0)


@wp.func
def spacings_around(
    gap: wp.array(dtype=wp.float64), k: wp.int32, step: wp.int32, at: wp.int32, count: wp.int32, rises: wp.vec2d, steep: wp.float64
) -> wp.float64:  # fmt: skip
    """For how many spacings around node k ``fall_of`` must hold; arguments as of ``rises_at``.

    0.5, 1 beside the outline of body or window, 2 at the body's outline, which may end in a tip that has no node on the next line.
    """
    low, high, around = smaller(rises[0], rises[1]), larger(rises[0], rises[1]), wp.float64(1.0)
    if at > 1 and at < count - 2:
        if gap[k - 2 * step] - gap[k - step] <= steep and gap[k + 2 * step] - gap[k + step] <= steep:
            around = _HALF
    if high > steep and at > 0 and at < count - 1 and (high == _INF or low <= steep):
        around = _2
    return around


@wp.func
def extent(room: wp.float64, rise: wp.float64, around: wp.float64) -> wp.float64:
    """Spacings beyond a node up to which a convex gap may stay low enough.

    By its rise to the node before, and ``room`` [m], by which it is lower than enough.
    """
    if around < _2 and rise < _0:
        return smaller(around, -room / rise)
    return around


@wp.func
def nodes_near(gap: wp.array(dtype=wp.float64), lane: wp.int32, nx: wp.int32, ny: wp.int32, below: wp.float64) -> wp.vec4d:
    """``nodes_below`` of any gap, without a bound: nodes below ``below`` [m] and two more.

    An outline may end in a tip that has no node on the next line.
    """
    x0, x1, y0, y1 = wp.int32(_MANY), wp.int32(_MANY), wp.int32(_MANY), wp.int32(_MANY)
    j = lane // across()
    while j < ny:
        i = lane % across()
        while i < nx:
            if gap[j * nx + i] < below:
                x0, x1, y0, y1 = wp.min(x0, i), wp.min(x1, -i), wp.min(y0, j), wp.min(y1, -j)
            i += across()
        j += wp.block_dim() // across()
    x0, x1, y0, y1 = least_of(x0), -least_of(x1), least_of(y0), -least_of(y1)
    if x0 == _MANY:
        return wp.vec4d(_INF, _INF, _INF, _INF)
    return wp.vec4d(wp.float64(x0), wp.float64(x1), wp.float64(y0), wp.float64(y1)) + wp.vec4d(-_2, _2, -_2, _2)


@wp.func
def nodes_below(
    gap: wp.array(dtype=wp.float64), lane: wp.int32, nx: wp.int32, ny: wp.int32, below: wp.float64, steep: wp.float64
):
    """Lower bound of a convex gap [m], and where in a window it may be ``below`` or lower [m].

    The window has ny rows of nx nodes. The bound is for one in which no node is lower than ``below``. The part: x from, to, y from, to in
    spacings from the first node; the first is inf if it is nowhere.
    """
    least, x0, x1, y0, y1 = wp.float64(below), infinity(), -infinity(), infinity(), -infinity()
    j = lane // across()
    while j < ny:
        y = wp.float64(j)
        i = lane % across()
        while i < nx:
            k = j * nx + i
            here = gap[k] + _0
            room = below - here
            if room > -_INF:
                p, q = rises_at(gap, k, 1, i, nx, here), rises_at(gap, k, nx, j, ny, here)
                highest, fall_x, fall_y = larger(larger(p[0], p[1]), larger(q[0], q[1])), fall_of(p, steep), fall_of(q, steep)
                # A node amid others that are below tells nothing of where they end.
                if highest > room and room + fall_x + fall_y >= _0:
                    around = larger(spacings_around(gap, k, 1, i, nx, p, steep), spacings_around(gap, k, nx, j, ny, q, steep))
                    within = smaller(around, _1)
                    room_x, room_y = room + within * fall_y, room + within * fall_x
                    bound = below + room - room_x - room_y
                    least = smaller(least, bound)
                    if bound <= below:
                        x = wp.float64(i)  # an extent is at most ``around``, and takes a division
                        if x - around < x0:
                            x0 = smaller(x0, x - extent(room_x, p[1], around))
                        if x + around > x1:
                            x1 = larger(x1, x + extent(room_x, p[0], around))
                        if y - around < y0:
                            y0 = smaller(y0, y - extent(room_y, q[1], around))
                        if y + around > y1:
                            y1 = larger(y1, y + extent(room_y, q[0], around))
            i += across()
        j += wp.block_dim() // across()
    return least_of(least), wp.vec4d(least_of(x0), -least_of(-x1), least_of(y0), -least_of(-y1))


@wp.func
def box_around(
    pads: Pads, fx: wp.int32, fy: wp.int32, i0: wp.int32, j0: wp.int32, box: wp.vec4d, step_x: wp.float64, step_y: wp.float64
) -> wp.vec4d:
    """x from, to, y from, to [m] of spacings from node ``i0``, ``j0`` of a grid."""
    x, y = pads.lines[fx][0] + wp.float64(i0) * step_x, pads.lines[fy][0] + wp.float64(j0) * step_y
    return wp.vec4d(x + box[0] * step_x, x + box[1] * step_x, y + box[2] * step_y, y + box[3] * step_y)


@wp.func
def nodes_in(
    pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32, level: wp.int32, below: wp.float64, box: wp.vec4d
) -> wp.vec4i:
    """First node and number of nodes along x and y of the ``window`` within a box [m].

    ``box``: x from, to, y from, to; with one node beyond, for the law to know the node after the last that counts. From −inf: all.
    """
    area = window(pads, placed, block, pad, level, below)
    i0, i1, j0, j1 = area[0], area[1], area[2], area[3]
    if box[0] > -_INF:
        fx, fy = pads.first_x[pad, level], pads.first_y[pad, level]
        x0, y0 = pads.lines[fx][0], pads.lines[fy][0]
        step_x, step_y = pads.lines[fx + 1][0] - x0, pads.lines[fy + 1][0] - y0
        i0 = wp.max(i0, wp.int32(wp.floor((box[0] - x0) / step_x)))
        i1 = wp.min(i1, wp.int32(wp.ceil((box[1] - x0) / step_x)) + 1)
        j0 = wp.max(j0, wp.int32(wp.floor((box[2] - y0) / step_y)))
        j1 = wp.min(j1, wp.int32(wp.ceil((box[3] - y0) / step_y)) + 1)
    return wp.vec4i(i0, j0, wp.max(i1 - i0, 0), wp.max(j1 - j0, 0))


@wp.func
def is_convex(shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32) -> wp.bool:
    """True if one convex part alone is near: its gap to the resting gel, a cap, is convex.

    A map of heights may be of any shape.
    """
    if pads.maps.first[pad] >= 0:
        return False
    parts, convex = wp.int32(0), wp.int32(1)
    for k in range(placed.count[block]):
        if placed.part[block, k] >= 0:
            parts += 1
            convex = wp.where(shapes.kind[placed.part[block, k]] < _TORUS, convex, 0)
    return parts == 1 and convex == 1
