"""Heights of one body on the nodes of a pad's grids, in Warp: single nodes, between them, and bounds around them; sums over a block."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.placed_kernels import Pads, Placed, under, window
from raytac.physics.rigid.shape_kernels import Shapes, infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TORUS = wp.constant(wp.int32(7))
"""First of the kinds of parts that may not be convex."""
NOWHERE = wp.constant(wp.int32(0x3FFFFFFF))
_0 = wp.constant(wp.float64(0.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))


@wp.func
def total_of(value: wp.float64) -> wp.float64:
    """Sum over the block; also a barrier."""
    return wp.tile_sum(wp.tile(value))[0]


@wp.func
def count_of(value: wp.int32) -> wp.int32:
    return wp.tile_sum(wp.tile(value))[0]


@wp.func
def least_of(value: wp.float64) -> wp.float64:
    return wp.tile_min(wp.tile(value))[0]


@wp.func
def first_of(value: wp.int32) -> wp.int32:
    return wp.tile_min(wp.tile(value))[0]


@wp.func
def pierced_at(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, lane: wp.int32, lanes: wp.int32, pad: wp.int32, level: wp.int32
) -> wp.float64:
    """Lowest z [m] of the body on lines on which it lies in the layer of one thickness behind the bonded face; inf if on none.

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
    """z [m] of the body over node i, j, and its gap to the gel; inf where there is none or it is below the bonded face."""
    if i < 0 or j < 0 or i >= pads.nx[pad, level] or j >= pads.ny[pad, level]:
        return wp.vec2d(_INF, _INF)
    x, y = pads.lines[pads.first_x[pad, level] + i], pads.lines[pads.first_y[pad, level] + j]
    z = under(shapes, placed, block, x[0], y[0], False)
    if z < -pads.thickness[pad]:
        return wp.vec2d(_INF, _INF)
    return wp.vec2d(z, z - x[1] - y[1])


@wp.func
def vertex_of(before: wp.float64, middle: wp.float64, after: wp.float64, pitch: wp.float64) -> wp.vec2d:
    """Drop below the middle of a parabola through three values at −1, 0, 1, and where; (0, 0) if it is none.

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
    """Drop [m] below ``middle``, the z (``of`` 0) or gap (1) at node i, j, and the place of the least along x and y [nodes].

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
def least_around(
    gap: wp.array2d(dtype=wp.float64), block: wp.int32, k: wp.int32, i: wp.int32, j: wp.int32, nx: wp.int32, ny: wp.int32,
    steep: wp.float64,
) -> wp.vec2d:  # fmt: skip
    """Lower bound of a convex gap [m] around node k of a window, its i-th along x and its j-th along y; and for how many half spacings
    around it holds: 1, 2 of a node at the outline of body or window, 4 where a neighbour is beside the body, whose outline may end in a
    tip that has no node on the next line.

    A convex function falls on one side of a node by no more than it rises on the other. ``steep``: fall [m] where both neighbours along
    an axis are missing.
    """
    middle, fall, around = gap[block, k] + wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)
    m = wp.int32(0)
    while m < 2:
        step, at, count = wp.where(m == 0, 1, nx), wp.where(m == 0, i, j), wp.where(m == 0, nx, ny)
        rise = -infinity()
        if at < 2 or at >= count - 2 or gap[block, k - 2 * step] == _INF or gap[block, k + 2 * step] == _INF:
            around = wp.max(around, _2)
        if at > 0:
            if gap[block, k - step] < _INF:
                rise = gap[block, k - step] - middle
            else:
                around = wp.float64(4.0)
        if at < count - 1:
            if gap[block, k + step] < _INF:
                rise = wp.max(rise, gap[block, k + step] - middle)
            else:
                around = wp.float64(4.0)
        if rise == -_INF:
            rise = steep
        fall += wp.max(rise, _0)
        m += 1
    return wp.vec2d(middle - _HALF * wp.min(around, _2) * fall, around)


@wp.func
def nodes_below(
    gap: wp.array2d(dtype=wp.float64), block: wp.int32, lane: wp.int32, lanes: wp.int32, n: wp.int32, nx: wp.int32, below: wp.float64,
    steep: wp.float64,
):  # fmt: skip
    """Least bound of ``least_around``, and where in a window of n nodes, rows of ``nx``, a convex gap may be at ``below`` or lower [m]:
    x from, to, y from, to in half spacings from the window's first node; the first is ``NOWHERE`` if it is nowhere."""
    least = infinity()
    x0, x1, y0, y1 = wp.int32(NOWHERE), wp.int32(NOWHERE), wp.int32(NOWHERE), wp.int32(NOWHERE)
    i, j = wp.int32(lane), wp.int32(0)
    k = wp.int32(lane)
    while k < n:
        while i >= nx:
            i -= nx
            j += 1
        if gap[block, k] < _INF:
            bound = least_around(gap, block, k, i, j, nx, n // nx, steep)
            least = wp.min(least, bound[0])
            if bound[0] <= below:
                around = wp.int32(bound[1]) + 1  # so that the law knows the node after the last that counts
                x0, x1 = wp.min(x0, 2 * i - around), wp.min(x1, -2 * i - around)
                y0, y1 = wp.min(y0, 2 * j - around), wp.min(y1, -2 * j - around)
        i += lanes
        k += lanes
    return least_of(least), wp.vec4i(first_of(x0), -first_of(x1), first_of(y0), -first_of(y1))


@wp.func
def box_around(
    pads: Pads, fx: wp.int32, fy: wp.int32, i0: wp.int32, j0: wp.int32, halves: wp.vec4i, step_x: wp.float64, step_y: wp.float64
) -> wp.vec4d:
    """x from, to, y from, to [m] of half spacings from node ``i0``, ``j0`` of a grid."""
    x, y = pads.lines[fx][0] + wp.float64(i0) * step_x, pads.lines[fy][0] + wp.float64(j0) * step_y
    return wp.vec4d(
        x + _HALF * wp.float64(halves[0]) * step_x,
        x + _HALF * wp.float64(halves[1]) * step_x,
        y + _HALF * wp.float64(halves[2]) * step_y,
        y + _HALF * wp.float64(halves[3]) * step_y,
    )


@wp.func
def is_convex(shapes: Shapes, placed: Placed, block: wp.int32) -> wp.bool:
    """True if one part alone is near and is convex: its gap to the resting gel, which is a cap, is convex over the line of sight."""
    parts, convex = wp.int32(0), wp.int32(1)
    for k in range(placed.count[block]):
        if placed.part[block, k] >= 0:
            parts += 1
            convex = wp.where(shapes.kind[placed.part[block, k]] < _TORUS, convex, 0)
    return parts == 1 and convex == 1
