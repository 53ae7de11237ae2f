"""Rows of contacts from the nodes of a window, in Warp: moments of the overlap, load law.

The centroid of the overlap is the place of a contact. A body that does not touch yet has that of a body a little deeper.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import LAST, Rows
from raytac.physics.rigid.cover_kernels import add_outline
from raytac.physics.rigid.law_kernels import NODE, Bins, add_node, clear_bins, crossings_at, deepest_of, tabulate
from raytac.physics.rigid.node_kernels import between_nodes, least_of, total_of
from raytac.physics.rigid.placed_kernels import Pads, Placed, across, larger, rest_of
from raytac.physics.rigid.shape_kernels import Shapes, infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

_LAST = wp.constant(wp.int32(LAST))
_JUST_TOUCHING = wp.constant(wp.float64(50e-6))
"""Added depth [m] whose overlap's centroid is the place of a gap."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Window:
    """Nodes of one grid of a pad."""

    level: wp.int32
    x: wp.int32
    """First node along x."""
    y: wp.int32
    nx: wp.int32
    """Nodes along x."""
    ny: wp.int32


@wp.struct
class Touch:
    """Depth of a contact, or a gap; lengths [m]."""

    touching: wp.bool
    depth: wp.float64
    """Negative of a gap."""
    deepest: wp.float64
    """Up to which the law is tabulated."""
    x: wp.float64
    """Place of the greatest depth."""
    y: wp.float64
    lowest: wp.float64
    """z of the body's lowest point."""
    least: wp.float64
    """Least gap of the window's nodes."""


@wp.func
def touch_at(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, pad: wp.int32, level: wp.int32, i: wp.int32, j: wp.int32,
    least: wp.float64, reach: wp.float64, ahead: wp.float64,
) -> Touch:  # fmt: skip
    """Depth and its place between the nodes around i, j, where the gap is ``least`` [m].

    ``reach``, ``ahead``: as of ``deepest_of``. The body's lowest point is not filled in.
    """
    first_x, first_y = pads.first_x[pad, level], pads.first_y[pad, level]
    drop = between_nodes(shapes, pads, placed, block, pad, level, i, j, least, 1)
    touch = Touch()
    touch.touching = least < _0
    touch.depth = drop[0] - least
    touch.deepest = deepest_of(touch.depth, reach, ahead, pads.thickness[pad])
    touch.x = pads.lines[first_x + i][0] + drop[1] * (pads.lines[first_x + 1][0] - pads.lines[first_x][0])
    touch.y = pads.lines[first_y + j][0] + drop[2] * (pads.lines[first_y + 1][0] - pads.lines[first_y][0])
    return touch


@wp.func
def place_of_gap(pads: Pads, pad: wp.int32, touch: Touch, row: wp.int32, rows: Rows):
    """Place and normal of the least gap of a body too sharp to have nodes of its own there."""
    x, y = touch.x, touch.y
    fx, fy = pads.first_x[pad, _LAST], pads.first_y[pad, _LAST]
    i = wp.int32(wp.round((x - pads.lines[fx][0]) / (pads.lines[fx + 1][0] - pads.lines[fx][0])))
    j = wp.int32(wp.round((y - pads.lines[fy][0]) / (pads.lines[fy + 1][0] - pads.lines[fy][0])))
    p = pads.lines[fx + wp.clamp(i, 0, pads.nx[pad, _LAST] - 1)]
    q = pads.lines[fy + wp.clamp(j, 0, pads.ny[pad, _LAST] - 1)]
    node = rest_of(pads.maps, pad, p, q)
    rest = node[0] + node[1] * (x - p[0]) + node[2] * (y - q[0])
    rows.centre[row] = wp.vec3d(x, y, rest - touch.depth)
    rows.normal[row] = wp.normalize(wp.vec3d(-node[1], -node[2], wp.float64(1.0)))


@wp.func
def fill_row(
    shapes: Shapes, pads: Pads, placed: Placed, bins: Bins, gaps: wp.array(dtype=wp.float64), ends: wp.array(dtype=wp.vec2f),
    block: wp.int32, lane: wp.int32, lanes: wp.int32, pad: wp.int32, window: Window, touch: Touch, row: wp.int32,
    # outputs
    rows: Rows,
):  # fmt: skip
    """Fill the row of a contact, or of one to come, from the ``gaps`` of its window's nodes.

    ``ends``: memory as of ``add_outline``.
    """
    level, i0, j0, nx, ny = window.level, window.x, window.y, window.nx, window.ny
    first_x, first_y = pads.first_x[pad, level], pads.first_y[pad, level]
    step_x = pads.lines[first_x + 1][0] - pads.lines[first_x][0]
    step_y = pads.lines[first_y + 1][0] - pads.lines[first_y][0]
    shift, half = wp.float64(0.0), _HALF * touch.deepest
    if not touch.touching:
        shift = wp.min(half, _JUST_TOUCHING) - touch.depth
    s, szz, su, sv = wp.float64(0.0), wp.float64(0.0), wp.vec3d(), wp.vec3d()
    first, second = wp.vec3d(), wp.vec3d()  # number of nodes and first moments, second moments of the overlap's area
    clear_bins(bins, block, lane, lanes)
    total_of(_0)
    last_x, last_y = pads.nx[pad, level] - 1, pads.ny[pad, level] - 1
    mapped = pads.maps.first[pad] >= 0
    flat, below, sums = step_y / step_x, half - touch.depth, bins.sums[block]
    inverse, most = _1 / half, -infinity()
    j = lane // across()
    while j < ny:
        v = pads.lines[first_y + j0 + j] + wp.vec3d()
        cells = wp.where(j0 + j == 0 or j0 + j == last_y, _HALF, _1) * NODE  # a node on an edge of the pad is half of one
        row_s, row_n, row_x, row_xx = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        i = lane % across()
        while i < nx:
            gap = gaps[j * nx + i] + _0
            most = larger(most, gap)
            overlap = shift - gap
            if overlap > _0:
                u = pads.lines[first_x + i0 + i] + wp.vec3d()
                row_s += overlap
                szz += overlap * overlap
                if mapped:
                    rest = rest_of(pads.maps, pad, u, v)
                    u = wp.vec3d(u[0], rest[0], rest[1])
                    sv += wp.vec3d(_0, _0, overlap * rest[2])
                su += overlap * u
                row_n += wp.float64(1.0)
                row_x += u[0]
                row_xx += u[0] * u[0]
            if gap < below:
                parts = wp.where(i0 + i == 0 or i0 + i == last_x, _HALF * cells, cells)
                crossings = crossings_at(gaps, i, j, nx, ny)
                add_node(sums, larger(gap + touch.depth, _0) * inverse, i0 + i, j0 + j, parts, crossings)
            i += across()
        s += row_s
        sv += row_s * v
        first += wp.vec3d(row_n, row_x, row_n * v[0])
        second += wp.vec3d(row_xx, row_x * v[0], row_n * v[0] * v[0])
        j += wp.block_dim() // across()
    area, rise = wp.vec4i(i0, j0, nx, ny), -least_of(-most) - touch.least
    add_outline(shapes, pads, placed, block, lane, lanes, pad, level, area, gaps, ends, below, touch.depth, inverse, rise, sums)
    s, szz = total_of(s), total_of(szz)
    sx, sz, slope_x = total_of(su[0]), total_of(su[1] + sv[1]), total_of(su[2])
    sy, slope_y = total_of(sv[0]), total_of(sv[2])
    n1, nx1, ny1 = total_of(first[0]), total_of(first[1]), total_of(first[2])
    nxx, nxy, nyy = total_of(second[0]), total_of(second[1]), total_of(second[2])
    if lane == 0:
        rows.valid[row] = 1
        rows.depth[row] = touch.depth
        rows.deepest[row] = touch.deepest
        rows.clearance[row] = touch.lowest + pads.thickness[pad]
        rows.spread[row] = wp.vec3d(_0, _0, _0)
        if touch.touching and s > _0:
            x, y = sx / s, sy / s
            rows.spread[row] = wp.vec3d(
                (nxx - _2 * x * nx1 + n1 * x * x) / s,
                (nxy - x * ny1 - y * nx1 + n1 * x * y) / s,
                (nyy - _2 * y * ny1 + n1 * y * y) / s,
            )
        if s > _0:
            rows.centre[row] = wp.vec3d(sx / s, sy / s, sz / s - szz / s + shift)
            rows.normal[row] = wp.normalize(wp.vec3d(-slope_x / s, -slope_y / s, wp.float64(1.0)))
        else:
            place_of_gap(pads, pad, touch, row, rows)
        tabulate(bins, block, touch.deepest, flat, pads.cell[pad, level], pads.law[pad], row, rows.force, rows.radius)
