"""Search for contacts in Warp: broad phase, grid of nodes, depth, centroid, load law.

One block of threads measures one pair after the other, so that nothing depends on how many pairs there are. Threads share the nodes of a
window; sums are those of a tile, in a fixed order. On a CPU a block is one thread.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import LAST, Rows, missing_row
from raytac.physics.rigid.law_kernels import DEEPER, Bins, most_deepest
from raytac.physics.rigid.motion_kernels import is_finite
from raytac.physics.rigid.node_kernels import (
    between_nodes,
    box_around,
    is_convex,
    least_of,
    look_at_nodes,
    nodes_below,
    nodes_in,
    nodes_near,
    pierced_at,
    total_of,
)
from raytac.physics.rigid.overlap_kernels import Touch, Window, fill_row, touch_at
from raytac.physics.rigid.placed_kernels import Pads, Placed, bottom_of, lowest_of, place_parts, under_nodes, width_of
from raytac.physics.rigid.shape_kernels import Shapes, infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

PITCHES = 1.6e-3, 0.8e-3, 0.4e-3, 0.2e-3, 0.1e-3, 0.05e-3
"""Spacings of the nodes [m]; a contact is measured on the first that has enough nodes.

The coarsest only says where a convex body may touch. The last two are for bodies that are narrow there: 20 cells of the one before if
they are convex, else two."""
ENOUGH = 150
"""Nodes: 96 mm² of the second grid, 24 mm² of the third."""
_ENOUGH = wp.constant(wp.int32(ENOUGH))
_FIRST, _LAST = wp.constant(wp.int32(1)), wp.constant(wp.int32(LAST))
"""First and last grid on which bodies that are not narrow are measured."""
_FINEST = wp.constant(wp.int32(len(PITCHES) - 1))
_NARROW = wp.constant(wp.float64(0.05))
"""Greatest spacing of a grid over a convex body's least width: a pin's area is known."""
_NEAR = wp.constant(wp.float64(0.75))
"""Gap of all nodes, over the spacing, from which a body does not touch between them.

A cone of 45° would reach 0.71 further."""
_CLOSE = wp.constant(wp.float64(1e-6))
"""Tolerance of a least gap [m] against its lower bound; parabolas come nearer by far."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))
_NAN = wp.constant(wp.float64(float("nan")))
_MANY = wp.constant(wp.int32(0x7FFFFFFF))
_SEARCH, _ZOOM, _LAW = (wp.constant(wp.int32(k)) for k in range(3))
"""Purpose of a pass over nodes: overlap, least gap about one node, gaps for the law."""


@wp.struct
class Work:
    """Memory of the blocks."""

    placed: Placed
    bins: Bins
    gap: wp.array2d(dtype=wp.float64)
    """Gaps of a window's nodes [m], (blocks, most nodes)."""
    ends: wp.array2d(dtype=wp.vec2f)
    """Crossings of the outline with the edges from each node along x and y, of their length."""
    ahead: wp.float64
    """See ``PadSearch``."""


@wp.kernel
def find_near(
    poses: wp.array3d(dtype=wp.mat44d),
    reach: wp.array2d(dtype=wp.float64),
    closing: wp.array3d(dtype=wp.float64),
    shapes: Shapes,
    pads: Pads,
    # outputs
    near: wp.array(dtype=wp.int32),
):
    """1 for pairs whose boxes come within reach of the pad's, and for poses that are not finite."""
    env, pad, body = wp.tid()
    pose = poses[env, pad, body]
    result, closer = wp.int32(0), wp.min(reach[env, pad], closing[env, pad, body])
    if not is_finite(pose):
        result = 1
    else:
        radius = shapes.ball[body] + closer
        if pose[2, 3] - radius < pads.highest[pad] and pose[2, 3] + radius > -_2 * pads.thickness[pad]:
            for part in range(shapes.first_part[body], shapes.first_part[body + 1]):
                if lowest_of(shapes, part, pose, pads, pad, closer) < _INF:
                    result = 1
    near[(env * poses.shape[1] + pad) * poses.shape[2] + body] = result


@wp.func
def next_level(level: wp.int32, last: wp.int32, count: wp.int32) -> wp.int32:
    """The next grid, on which there may be enough nodes if there are so many on this one.

    With half the spacing there are four times as many: a grid with fewer than half of enough is left out.
    """
    following, expected = level + 1, 4 * count
    while following < wp.min(last, _LAST) and expected < _ENOUGH // 2:
        following += 1
        expected *= 4
    return following


@wp.func
def measure_pair(
    pose: wp.mat44d, reach: wp.float64, closing: wp.float64, shapes: Shapes, pads: Pads, work: Work, block: wp.int32, lane: wp.int32,
    lanes: wp.int32, pad: wp.int32, body: wp.int32, row: wp.int32, rows: Rows,
):  # fmt: skip
    """Fill one row: find depth and place, then a grid with enough nodes for the law.

    A gap from ``reach`` or ``closing`` [m] on is no row.
    """
    placed, gaps = work.placed, work.gap[block]
    place_parts(shapes, pads, placed, block, lane, lanes, pose, pad, body, reach)
    total_of(_0)
    bond, thickness, highest = -pads.thickness[pad], pads.thickness[pad], pads.highest[pad]
    bottom, width = bottom_of(placed, block), width_of(placed, block)
    # Nodes up to there are counted by the law.
    deeper = (_HALF * DEEPER - wp.float64(1.0)) * wp.min(highest - bottom, thickness)
    clear = wp.max(reach, deeper)
    convex = is_convex(shapes, pads, placed, block, pad)
    last = wp.int32(_LAST)
    while last < _FINEST and pads.pitch[last] > wp.where(convex, _NARROW, _HALF) * width[0]:
        last += 1
    lowest = infinity()  # of the body over the pad
    if bottom < bond:
        lowest = pierced_at(shapes, pads, placed, block, lane, lanes, pad, _LAST)
    pierced = lowest < _INF
    closer = wp.where(pierced, reach, wp.min(reach, closing))

    mode, level = wp.int32(_SEARCH), wp.int32(_FIRST)
    if convex and pads.pitch[0] <= _HALF * wp.min(width[0], width[1]):
        level = 0
    everywhere = wp.vec4d(-_INF, _INF, -_INF, _INF)  # x from, to, y from, to
    outer, box = wp.vec4d(everywhere), wp.vec4d(everywhere)  # where the gap may be below ``clear``; where nodes are looked at
    zero = wp.float64(0.0)  # gap below which nodes count
    low, low_level, low_i, low_j = infinity(), wp.int32(0), wp.int32(0), wp.int32(0)  # lowest node of the body, on any grid
    touch, least = Touch(), infinity()
    i0, j0, nx, ny = wp.int32(0), wp.int32(0), wp.int32(0), wp.int32(0)
    fx, fy = wp.int32(0), wp.int32(0)
    may_zoom, busy = wp.int32(1), wp.int32(1)
    while busy == 1:
        pitch = pads.pitch[level]
        wide = pitch <= _HALF * wp.min(width[0], width[1])  # so that nothing of the body fits between nodes
        near = wp.where(level < last, _NEAR * pitch, _0)
        below = highest + wp.max(zero, wp.max(near, clear))
        nodes = nodes_in(pads, placed, block, pad, level, below, box)
        fx, fy = wp.int32(pads.first_x[pad, level]), wp.int32(pads.first_y[pad, level])
        step_x = pads.lines[fx + 1][0] - pads.lines[fx][0]
        step_y = pads.lines[fy + 1][0] - pads.lines[fy][0]
        i0, j0, nx, ny = nodes[0], nodes[1], nodes[2], nodes[3]
        if level < last and nx * ny < _ENOUGH and not (mode == _ZOOM and convex):  # so few cannot be enough
            level += 1
            continue
        if nx * ny > work.gap.shape[1]:  # narrow bodies are looked at on finer grids as far as the memory goes
            level -= 1
            last = wp.int32(level)
            continue
        under_nodes(shapes, placed, block, lane, pads.lines, fx + i0, fy + j0, nx, ny, gaps)
        count, own_least, near_node, own_low, low_node = look_at_nodes(
            gaps, pads.lines, fx + i0, fy + j0, lane, nx, ny, bond, zero, pads.maps, pad
        )
        count = total_of(count)
        if mode == _LAW:
            if (count >= _ENOUGH and level >= _FIRST) or level >= last:
                busy = 0
            elif convex and count > 0:
                bound, around = nodes_below(gaps, lane, nx, ny, zero, _NEAR * pitch)
                box = box_around(pads, fx, fy, i0, j0, around, step_x, step_y)
            level += 1
            continue
        if mode == _ZOOM and count > 0:  # it does touch, between the nodes that were looked at
            mode, may_zoom = wp.int32(_SEARCH), wp.int32(0)
            box = wp.vec4d(outer)
            continue
        lower = least_of(own_low)
        if lower < low:
            low_node = least_of(wp.where(own_low == lower, low_node, _MANY))
            low, low_level, low_i, low_j = lower, wp.int32(level), i0 + low_node % nx, j0 + low_node // nx
        least = least_of(own_least)
        i, j = wp.int32(0), wp.int32(0)  # of the least gap
        if least < _INF:
            near_node = least_of(wp.where(own_least == least, near_node, _MANY))
            i, j = near_node % nx, near_node // nx
        done = level >= last or (count >= _ENOUGH and level >= _FIRST)
        beyond = wp.bool(False)
        if not done and wide and convex:
            # Where the gap may be below what the law counts, and where it may be least.
            counted = wp.max(deeper, _HALF * most_deepest(-least, reach, work.ahead) + least)
            if mode == _SEARCH:
                bound, around = nodes_below(gaps, lane, nx, ny, counted, _NEAR * pitch)
                if around[0] < _INF:
                    outer = box_around(pads, fx, fy, i0, j0, around, step_x, step_y)
                    box = wp.vec4d(outer)
            if count == 0:
                bound, around = nodes_below(gaps, lane, nx, ny, least, _NEAR * pitch)
                beyond = bound >= closer
                done = beyond or (level >= _FIRST and least - bound < _CLOSE)
                if not done and may_zoom == 1:
                    mode = wp.int32(_ZOOM)
                    box = box_around(pads, fx, fy, i0, j0, around, step_x, step_y)
        elif not done and wide and least >= near:
            beyond = least >= closer + near
            done = beyond
            if not done and may_zoom == 1:
                mode = wp.int32(_ZOOM)
                box = box_around(pads, fx, fy, i0 + i, j0 + j, wp.vec4d(-_1, _1, -_1, _1), step_x, step_y)
        if not done:
            if mode == _ZOOM:
                level += 1
            else:
                level = next_level(level, last, count)
                if wide and not convex and width[1] == _INF:
                    around = nodes_near(gaps, lane, nx, ny, _NEAR * pitch + clear)
                    if around[0] < _INF:
                        outer = box_around(pads, fx, fy, i0, j0, around, step_x, step_y)
                        box = wp.vec4d(outer)
            continue
        busy = 0
        # The body's lowest point, and its least gap, between the nodes.
        if not pierced and low < _INF:
            drop = between_nodes(shapes, pads, placed, block, pad, low_level, low_i, low_j, low, 0)
            lowest = wp.max(low - drop[0], bond)
        if beyond or least == _INF:
            least = _INF
            continue
        touch = touch_at(shapes, pads, placed, block, pad, level, i0 + i, j0 + j, least, reach, work.ahead)
        if touch.touching:
            level += 1  # as after the law's nodes
        elif -touch.depth >= closer:
            least = _INF
        else:
            mode, level, busy = wp.int32(_LAW), wp.int32(_FIRST), wp.int32(1)
            zero = _HALF * touch.deepest - touch.depth
            box = wp.vec4d(outer)
    level -= 1

    if least == _INF:
        total_of(_0)  # a thread that goes on to the next pair places its parts where others still look at this one's
        if lane == 0:
            rows.valid[row] = 0
            if pierced:
                missing_row(rows, row, thickness + bond - lowest, lowest - bond)
        return

    touch.lowest = lowest
    touch.least = least_of(own_least)
    area = Window()
    area.level = level
    area.x = i0
    area.y = j0
    area.nx = nx
    area.ny = ny
    fill_row(shapes, pads, placed, work.bins, gaps, work.ends[block], block, lane, lanes, pad, area, touch, row, rows)


@wp.kernel
def measure(
    poses: wp.array3d(dtype=wp.mat44d),
    reach: wp.array2d(dtype=wp.float64),
    closing: wp.array3d(dtype=wp.float64),
    shapes: Shapes,
    pads: Pads,
    near: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    blocks: wp.int32,
    pairs: wp.int32,
    work: Work,
    rows: Rows,
):
    """Rows of all near pairs, in order, as far as memory goes; ``ends``: their running number."""
    block, lane = wp.tid()
    lanes = wp.block_dim()
    pair = wp.int32(block)
    while pair < pairs:
        row = ends[pair] - 1
        if near[pair] != 0 and row < rows.depth.shape[0]:
            body = pair % poses.shape[2]
            rest = pair // poses.shape[2]
            pad = rest % poses.shape[1]
            env = rest // poses.shape[1]
            pose = poses[env, pad, body]
            if lane == 0:
                rows.env[row] = env
                rows.pad[row] = pad
                rows.body[row] = body
            if is_finite(pose):
                measure_pair(
                    pose, reach[env, pad], closing[env, pad, body], shapes, pads, work, block, lane, lanes, pad, body, row, rows
                )
            elif lane == 0:
                missing_row(rows, row, _NAN, _NAN)
        pair += blocks
