"""Area for which the nodes at an outline stand, in Warp.

With it a body's force does not jump where its outline passes nodes.

A node amid others that count stands for a quarter of each of its four cells. Of a cell through which the outline runs, the part that the
body covers is shared by those corners that count (marching squares): straight between the places where the outline crosses the edges of
the cell, with a corner where one corner of the cell alone is in. Where the gap rises gently to one that does not count, there is no
outline.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rest_map import RestMaps
from raytac.physics.rigid.law_kernels import NODE, Sums, add_node
from raytac.physics.rigid.node_kernels import total_of
from raytac.physics.rigid.placed_kernels import Pads, Placed, across, entries_of, larger, rest_of, smaller, under
from raytac.physics.rigid.shape_kernels import BOX, CYLINDER, Shapes, infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ON_EDGE, _IN_CELL = wp.constant(wp.int32(5)), wp.constant(wp.int32(2))
"""Halvings of an edge, and of a cell's diagonal, on which an outline is searched for.

Not if all parts are boxes. A side of ten nodes of 150 is off by 0.1 % of them."""
_GENTLE = wp.constant(wp.float64(2.0))
"""Rise of the gap over the spacing up to which there is no outline; twice as much is one."""
_SLACK = wp.constant(wp.float64(1e-9))
"""By this [m] rounding leaves out no box that begins where another ends."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))
_QUARTER = wp.constant(wp.float64(0.25))
_INF = wp.constant(wp.float64(float("inf")))


@wp.struct
class Outline:
    """Outline of where the gap of a body is below what counts, on a window of nodes."""

    lines: wp.array(dtype=wp.vec3d)
    """Of ``Pads``."""
    maps: RestMaps
    pad: wp.int32
    x: wp.int32
    """Index of the window's first node in ``lines``."""
    y: wp.int32
    below: wp.float64
    """Gap up to which nodes count [m]."""
    bond: wp.float64
    """z of the bonded face [m]: nodes at which the body is beneath it do not count."""
    boxes: wp.int32
    """1 if all parts are boxes, 2 if there is one part: a box."""
    entry: wp.mat33d
    """Of that box, as of ``entries_of``."""
    length: wp.vec3d


@wp.func
def place_of(outline: Outline, i: wp.int32, j: wp.int32) -> wp.vec3d:
    """x, y and height of the resting gel at a node of the window [m]."""
    x, y = outline.lines[outline.x + i], outline.lines[outline.y + j]
    return wp.vec3d(x[0], y[0], rest_of(outline.maps, outline.pad, x, y)[0])


@wp.func
def corner_of(outline: Outline, i: wp.int32, j: wp.int32, corner: wp.int32) -> wp.vec3d:
    """``place_of`` corners 0 to 3 of the cell that begins at a node."""
    return place_of(outline, i + wp.where(corner == 1 or corner == 2, 1, 0), j + corner / 2)


@wp.func
def end_in_box(entry: wp.mat33d, length: wp.vec3d, below: wp.float64, start: wp.vec3d, step: wp.vec3d) -> wp.float64:
    """``end_of`` one box from ``entries_of`` it: its entries are below its exits and the top."""
    share = wp.float64(1.0)
    at, rise = entry * wp.vec3d(start[0], start[1], _1), entry * wp.vec3d(step[0], step[1], _0)
    top = start[2] + below
    for m in range(3):
        if rise[m] > step[2]:
            share = smaller(share, (top - at[m]) / (rise[m] - step[2]))
        for n in range(3):
            if m != n and rise[m] > rise[n]:
                share = smaller(share, (at[n] + length[n] - at[m]) / (rise[m] - rise[n]))
    return share


@wp.func
def end_in_boxes(
    shapes: Shapes, placed: Placed, block: wp.int32, below: wp.float64, start: wp.vec3d, step: wp.vec3d
) -> wp.float64:  # fmt: skip
    """``end_of`` a body of boxes: that of the last one that the line reaches from box to box."""
    share = wp.float64(0.0)
    for _ in range(placed.count[block]):
        before = wp.float64(share)
        for k in range(placed.count[block]):
            part = placed.part[block, k]
            if part >= 0:
                entry, length = entries_of(shapes.size[part], placed.rotation[block, k], placed.at[block, k])
                at = start + before * step
                z = entry * wp.vec3d(at[0], at[1], _1)
                exits = z + length
                low = larger(larger(z[0], z[1]), z[2])
                if low <= smaller(smaller(exits[0], exits[1]), exits[2]) + _SLACK and low - at[2] < below + _SLACK:
                    share = larger(share, end_in_box(entry, length, below, start, step))
        if share == before:
            break
    return share


@wp.func
def end_of(
    shapes: Shapes, placed: Placed, block: wp.int32, outline: Outline, start: wp.vec3d, step: wp.vec3d, halvings: wp.int32
) -> wp.float64:  # fmt: skip
    """Share of a ``step`` from ``start``, which counts, at which the outline is crossed."""
    if outline.boxes == 2:
        return end_in_box(outline.entry, outline.length, outline.below, start, step)
    if outline.boxes == 1:
        return end_in_boxes(shapes, placed, block, outline.below, start, step)
    low, high, k = wp.float64(0.0), wp.float64(1.0), wp.int32(0)
    while k < halvings:
        share = _HALF * (low + high)
        at = start + share * step
        z = under(shapes, placed, block, at[0], at[1], False)
        if z >= outline.bond and z - at[2] < outline.below:
            low = share
        else:
            high = share
        k += 1
    return _HALF * (low + high)


@wp.func
def crossing(
    shapes: Shapes, placed: Placed, block: wp.int32, outline: Outline, i: wp.int32, j: wp.int32, to_x: wp.int32, to_y: wp.int32,
    near: wp.float64, steep: wp.float64,
) -> wp.float64:  # fmt: skip
    """``end_of`` the edge from a node that counts, with a gap ``near``, to the next one.

    It is half of the edge where the gap is gentle.
    """
    if steep == _0:
        return _HALF
    one, two = place_of(outline, i, j), place_of(outline, i + to_x, j + to_y)
    if near >= outline.below:
        one, two = place_of(outline, i + to_x, j + to_y), place_of(outline, i, j)
    return _HALF + steep * (end_of(shapes, placed, block, outline, one, two - one, _ON_EDGE) - _HALF)


@wp.func
def covered(
    shapes: Shapes, placed: Placed, block: wp.int32, outline: Outline, i: wp.int32, j: wp.int32, gap: wp.vec4d, steep: wp.vec4d,
    share: wp.vec4d, inside: wp.int32,
) -> wp.float64:  # fmt: skip
    """Covered part of a cell of which 1 to 3 corners count.

    ``steep`` and ``share``: of the edges from each corner to the next.
    """
    area, crossed = wp.float64(0.0), wp.int32(0)
    for k in range(4):
        if (gap[k] < outline.below) != (gap[(k + 1) % 4] < outline.below):
            area += _HALF * share[k]
            crossed += 1
    if inside == 2 and crossed == 2:
        return area
    area = wp.where(inside == 3, _1, _0)
    k = wp.int32(0)
    while k < 4:  # a loop that is not unrolled: the compiler's time goes by the code
        m = (k + 3) % 4
        p, q, sharp = share[k], share[m], larger(steep[k], steep[m])
        if gap[k] < outline.below:
            if inside < 3:
                part = wp.float64(1.0)
                if sharp > _0:
                    place = corner_of(outline, i, j, k)
                    along, beside = corner_of(outline, i, j, (k + 1) % 4) - place, corner_of(outline, i, j, m) - place
                    part += sharp * (end_of(shapes, placed, block, outline, place, p * along + q * beside, _IN_CELL) - _1)
                area += part * p * q
        elif inside == 3:
            area -= (_1 - _HALF * sharp) * (_1 - p) * (_1 - q)
        k += 1
    return area


@wp.func
def kinds_of(shapes: Shapes, placed: Placed, block: wp.int32) -> wp.vec2i:
    """1 and 1 if no placed part has an edge, and if all are boxes; else 0."""
    round, boxes = wp.int32(1), wp.int32(1)
    for k in range(placed.count[block]):
        if placed.part[block, k] >= 0:
            kind = wp.int32(shapes.kind[placed.part[block, k]])
            round = wp.where(kind >= CYLINDER, 0, round)
            boxes = wp.where(kind != BOX, 0, boxes)
    return wp.vec2i(round, boxes)


@wp.func
def may_have_outline(
    pads: Pads, lane: wp.int32, lanes: wp.int32, pad: wp.int32, level: wp.int32, window: wp.vec4i, gap: wp.array(dtype=wp.float64),
    below: wp.float64, rise: wp.float64,
) -> wp.bool:  # fmt: skip
    """False if no outline runs through a window; arguments as of ``add_outline``."""
    if rise > _GENTLE * pads.pitch[level]:
        return True
    i0, j0, nx, ny = window[0], window[1], window[2], window[3]
    lower, upper = j0 > 0, j0 + ny < pads.ny[pad, level]
    before, after = i0 > 0, i0 + nx < pads.nx[pad, level]
    outer, k = wp.int32(0), wp.int32(lane)  # nodes that count and have a neighbour beyond the window
    while k < nx:
        if (lower and gap[k] < below) or (upper and gap[(ny - 1) * nx + k] < below):
            outer += 1
        k += lanes
    k = wp.int32(lane)
    while k < ny:
        if (before and gap[k * nx] < below) or (after and gap[k * nx + nx - 1] < below):
            outer += 1
        k += lanes
    return total_of(outer) > 0


@wp.func
def add_outline(
    shapes: Shapes, pads: Pads, placed: Placed, block: wp.int32, lane: wp.int32, lanes: wp.int32, pad: wp.int32, level: wp.int32,
    window: wp.vec4i, gap: wp.array(dtype=wp.float64), ends: wp.array(dtype=wp.vec2f), below: wp.float64, depth: wp.float64,
    inverse: wp.float64, rise: wp.float64,
    # outputs
    sums: wp.array(dtype=Sums),
):  # fmt: skip
    """Add to the bins the excess of a window's nodes over a quarter of each of their cells.

    ``window``: first node along x and y and nodes along each, of a pad's grid. ``gap`` [m]: of each, which counts ``below`` one [m].
    ``ends``: memory for one more node than there are along x and y. ``rise``: of the greatest gap over the least [m]. Others as of
    ``add_node``.
    """
    kinds = kinds_of(shapes, placed, block)
    if kinds[0] == 1:
        return
    if not may_have_outline(pads, lane, lanes, pad, level, window, gap, below, rise):
        return
    i0, j0, nx, ny = window[0], window[1], window[2], window[3]
    last_x, last_y = pads.nx[pad, level] - 1, pads.ny[pad, level] - 1
    outline = Outline()
    outline.lines = pads.lines
    outline.maps = pads.maps
    outline.pad = pad
    outline.x = pads.first_x[pad, level] + i0
    outline.y = pads.first_y[pad, level] + j0
    outline.below = below
    outline.bond = -pads.thickness[pad]
    outline.boxes = kinds[1]
    if kinds[1] == 1 and placed.count[block] == 1:
        outline.boxes = 2
        entry, length = entries_of(shapes.size[placed.part[block, 0]], placed.rotation[block, 0], placed.at[block, 0])
        outline.entry = entry
        outline.length = length
    gentle, edges = _1 / (_GENTLE * pads.pitch[level]), wp.int32(0)
    j = lane // across() - 1
    while j < ny:
        i = lane % across() - 1
        while i < nx:
            k = j * nx + i
            here, right, up = infinity(), infinity(), infinity()
            if j >= 0:
                if i >= 0:
                    here = gap[k]
                if i + 1 < nx:
                    right = gap[k + 1]
            if i >= 0 and j + 1 < ny:
                up = gap[k + nx]
            along, beside = wp.float64(0.0), wp.float64(0.0)
            if (here < below) != (right < below) and i0 + i >= 0 and i0 + i < last_x:
                along = wp.clamp(wp.abs(right - here) * gentle - _1, _0, _1)
            if (here < below) != (up < below) and j0 + j >= 0 and j0 + j < last_y:
                beside = wp.clamp(wp.abs(up - here) * gentle - _1, _0, _1)
            if along > _0 or beside > _0:
                edges += 1
                ends[(j + 1) * (nx + 1) + i + 1] = wp.vec2f(
                    wp.float32(crossing(shapes, placed, block, outline, i, j, 1, 0, here, along)),
                    wp.float32(crossing(shapes, placed, block, outline, i, j, 0, 1, here, beside)),
                )
            i += across()
        j += wp.block_dim() // across()
    if total_of(edges) == 0:
        return
    j = lane // across() - 1
    while j < wp.min(ny, last_y - j0):
        i = lane % across() - 1
        while i < nx:
            k = j * nx + i
            corners = wp.vec4d(_INF, _INF, _INF, _INF)
            if j >= 0:
                if i >= 0:
                    corners[0] = gap[k]
                if i + 1 < nx:
                    corners[1] = gap[k + 1]
            if j + 1 < ny:
                if i + 1 < nx:
                    corners[2] = gap[k + nx + 1]
                if i >= 0:
                    corners[3] = gap[k + nx]
            inside = wp.int32(0)
            for m in range(4):
                inside += wp.where(corners[m] < below, 1, 0)
            if inside > 0 and inside < 4 and i0 + i >= 0 and i0 + i < last_x and j0 + j >= 0:
                steep, share, sharp = wp.vec4d(), wp.vec4d(_HALF, _HALF, _HALF, _HALF), wp.int32(0)
                for m in range(4):
                    one, two = corners[m], corners[(m + 1) % 4]
                    if (one < below) != (two < below):
                        steep[m] = wp.clamp(wp.abs(one - two) * gentle - _1, _0, _1)
                        if steep[m] > _0:
                            end = ends[(j + 1 + wp.where(m == 2, 1, 0)) * (nx + 1) + i + 1 + wp.where(m == 1, 1, 0)]
                            share[m] = wp.float64(end[m % 2])
                            sharp += 1
                if sharp > 0:
                    more = (
                        covered(shapes, placed, block, outline, i, j, corners, steep, share, inside) / wp.float64(inside)
                        - _QUARTER
                    )
                    parts = wp.floor(NODE * more + _HALF)
                    for m in range(4):
                        if corners[m] < below:
                            x, y = i0 + i + wp.where(m == 1 or m == 2, 1, 0), j0 + j + m / 2
                            add_node(sums, larger(corners[m] + depth, _0) * inverse, x, y, parts, 0)
            i += across()
        j += wp.block_dim() // across()
