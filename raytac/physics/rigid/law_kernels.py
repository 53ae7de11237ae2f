"""Load law of a contact from its nodes' gaps: ``LoadLaw`` at a few depths, in Warp.

Nodes are sorted into bins by their gap. All that is added up is whole numbers of less than 2^53, so that the sums do not depend on the
order. Of the nodes of a bin it is not known which has which gap: a bin's mean counts. Regions and their lines are those of ``regions``.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contacts import LAW_POINTS
from raytac.physics.rigid.load_law import SMOOTH
from raytac.physics.rigid.placed_kernels import larger, smaller
from raytac.physics.rigid.punch_kernels import entry_of, flat_punch, punch_radius, radius_of, response_at
from raytac.physics.rigid.regions import CROSSING, PER_CORNER, PER_SIDE

wp.set_module_options({"enable_backward": False, "fast_math": False})

BINS = 2 * (LAW_POINTS - 1)
"""Bins of gaps: regions below so many levels are tried for the contact."""
Sums = wp.types.vector(length=8, dtype=wp.float64)
"""Of a bin: nodes in parts; sums of their numbers x, y, of xx, xy, yy, gaps and crossings.

Numbers are from the pad's first node. ``crossings_at`` says what crossings are."""
_BINS = wp.constant(wp.int32(BINS))
_SCALE = wp.constant(wp.float64(BINS))
_POINTS = wp.constant(wp.int32(LAW_POINTS))
PUNCH_BINS = 7
"""Bins from one region of which the stiffness is computed to the next.

In between it follows the root of the area."""
_PUNCH = wp.constant(wp.int32(PUNCH_BINS))
_PER_SIDE, _PER_CORNER = wp.constant(wp.int32(PER_SIDE)), wp.constant(wp.int32(PER_CORNER))
_CROSSING = wp.constant(wp.float64(CROSSING))
_GAP_UNIT = wp.constant(wp.float64(2.0**27))
"""Of a bin's sum of gaps, over the greatest gap: 6·10^4 nodes fit into a sum."""
_SMOOTH = wp.constant(wp.float64(SMOOTH))
_LEAST_STEP = wp.constant(wp.float64(1e-12))
NODE = wp.constant(wp.float64(1024.0))
"""Parts of a node that are counted."""
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_3 = wp.constant(wp.float64(3.0))
_6 = wp.constant(wp.float64(6.0))
_12 = wp.constant(wp.float64(12.0))
_0 = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_QUARTER = wp.constant(wp.float64(0.25))
_TWELFTH = wp.constant(wp.float64(1.0 / 12.0))
_LEAST_VARIANCE = wp.constant(wp.float64(1e-30))
_STEPS = wp.constant(wp.float64(LAW_POINTS - 1.0))
DEEPER = wp.constant(wp.float64(((LAW_POINTS - 1.0) / 22.0) ** 2))
"""Least depth up to which a law is tabulated, over the present one: some 2.

So the present depth is one of the table's own. Nodes with gaps up to half of it count, and at the present depth the contact has no
others. At twice that depth the contact on a layer may be wider: there a ball's force is 6 % too small if its radius of contact is half
the thickness, 17 % if it is the thickness."""
_FEWEST = wp.constant(wp.float64(6.0))
"""Steps of the table up to the present depth at least, for which it is stretched."""
_SHALLOWEST = wp.constant(wp.float64(10e-6))
"""Least depth up to which a law is tabulated [m]."""


@wp.struct
class Bins:
    """Nodes of one contact by gap at touch, for each block of threads."""

    sums: wp.array2d(dtype=Sums)
    """(blocks, BINS)."""
    lines: wp.array2d(dtype=wp.vec3d)
    """Slope, offset and first depth of regions that are the contact, (blocks, BINS + 1)."""


@wp.func
def reached_by(depth: wp.float64, reach: wp.float64, ahead: wp.float64) -> wp.float64:
    """Depth [m] that a body may reach; at most ``ahead`` deeper into the gel than it is."""
    return wp.max(DEEPER * depth, wp.min(depth + reach, wp.max(depth, _0) + ahead))


@wp.func
def deepest_of(depth: wp.float64, reach: wp.float64, ahead: wp.float64, thickness: wp.float64) -> wp.float64:
    """Depth [m] up to which the law is tabulated: ``reached_by``, at most the thickness.

    The present depth is one of the table's own.
    """
    deepest = reached_by(depth, reach, ahead)
    if depth > _0 and deepest < thickness:
        k = wp.floor(_STEPS * wp.sqrt(depth / deepest) + wp.float64(1e-9))
        if k >= _FEWEST:
            deepest = depth * (_STEPS / k) * (_STEPS / k)
    return wp.max(wp.min(deepest, thickness), wp.max(depth, _SHALLOWEST))


@wp.func
def most_deepest(depth: wp.float64, reach: wp.float64, ahead: wp.float64) -> wp.float64:
    """``deepest_of`` [m] at most, of a contact that is as deep as that or somewhat deeper."""
    deepest = reached_by(depth, reach, ahead)
    k = wp.floor(_STEPS * wp.sqrt(wp.max(depth, _0) / deepest))
    return wp.where(k < _FEWEST, deepest, deepest * (k + wp.float64(1.0)) * (k + wp.float64(1.0)) / (k * k))


@wp.func
def clear_bins(bins: Bins, block: wp.int32, lane: wp.int32, lanes: wp.int32):
    k = wp.int32(lane)
    while k < _BINS:
        bins.sums[block, k] = Sums(_0)
        k += lanes


@wp.func
def add_node(
    sums: wp.array(dtype=Sums), share: wp.float64, i: wp.int32, j: wp.int32, parts: wp.float64, crossings: wp.int32
):  # fmt: skip
    """Add node ``i``, ``j`` of a pad to the bins of a block, in any order.

    ``share``: its gap at touch over the farthest that counts, in [0, 1). ``parts``: of a ``NODE``, for whose cells the node stands, a
    whole number; what is added to one node may be negative, and not their sum. ``crossings``: of ``crossings_at`` it, once.
    """
    k = wp.min(wp.int32(wp.sqrt(share) * _SCALE), _BINS - 1)
    x, y = wp.float64(i), wp.float64(j)
    px, py = parts * x, parts * y
    wp.atomic_add(
        sums, k, Sums(parts, px, py, px * x, px * y, py * y, parts * wp.floor(share * _GAP_UNIT), wp.float64(crossings))
    )


@wp.func
def crossings_at(gap: wp.array(dtype=wp.float64), i: wp.int32, j: wp.int32, nx: wp.int32, ny: wp.int32) -> wp.int32:
    """By how much node ``i``, ``j`` of ny rows of nx adds to its region's perimeter.

    That is the weights of neighbours with a larger gap less those with a smaller one. There is no gap beyond the window.
    """
    k = j * nx + i
    here = gap[k] + _0
    if i > 0 and j > 0 and i < nx - 1 and j < ny - 1:
        side = rises(gap[k - 1], here) + rises(gap[k + 1], here) + rises(gap[k - nx], here) + rises(gap[k + nx], here)
        corner = rises(gap[k - nx - 1], here) + rises(gap[k - nx + 1], here)
        corner += rises(gap[k + nx - 1], here) + rises(gap[k + nx + 1], here)
        return _PER_SIDE * side + _PER_CORNER * corner
    result = wp.int32(0)
    m = wp.int32(0)
    while m < 9:
        p, q = m % 3 - 1, m / 3 - 1
        rise = wp.int32(1)
        if i + p >= 0 and i + p < nx and j + q >= 0 and j + q < ny:
            rise = rises(gap[k + q * nx + p], here)
        if m != 4:
            result += rise * wp.where(m % 2 == 1, _PER_SIDE, _PER_CORNER)
        m += 1
    return result


@wp.func
def rises(other: wp.float64, here: wp.float64) -> wp.int32:
    """1, 0 or −1 where the other gap is larger, the same or smaller."""
    return wp.int32(other > here) - wp.int32(other < here)


@wp.struct
class Area:
    """Sums over the nodes of a region, lengths in spacings of nodes along x."""

    nodes: wp.float64
    x: wp.float64
    y: wp.float64
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64
    crossings: wp.float64


@wp.func
def widened(area: Area, sums: Sums, flat: wp.float64) -> Area:
    """A region and one more bin; ``flat``: spacing along y over that along x."""
    result = Area()
    result.nodes = area.nodes + sums[0] / NODE
    result.x = area.x + sums[1] / NODE
    result.y = area.y + sums[2] / NODE * flat
    result.xx = area.xx + sums[3] / NODE
    result.xy = area.xy + sums[4] / NODE * flat
    result.yy = area.yy + sums[5] / NODE * flat * flat
    result.crossings = area.crossings + sums[7]
    return result


@wp.func
def moments_of(area: Area, each: wp.float64, flat: wp.float64) -> wp.vec3d:
    """Second moments xx, xy, yy about the centroid, of cells; ``each``: one over their number."""
    cx, cy = area.x * each, area.y * each
    return wp.vec3d(
        area.xx * each - cx * cx + _TWELFTH, area.xy * each - cx * cy, area.yy * each - cy * cy + flat * flat * _TWELFTH
    )


@wp.func
def punch_of(area: Area, flat: wp.float64, cell: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.vec4d:
    """``flat_punch`` of nodes of ``cell`` [m²] each; stiffness over the root of their number."""
    moments = cell / flat * moments_of(area, _1 / area.nodes, flat)
    result = flat_punch(area.nodes * cell, area.crossings * _CROSSING * wp.sqrt(cell), moments[0], moments[1], moments[2], law)
    result[0] = result[0] / wp.sqrt(area.nodes)
    return result


@wp.func
def regions(
    bins: Bins, block: wp.int32, deepest: wp.float64, flat: wp.float64, cell: wp.float64, law: wp.array(dtype=wp.float64),
) -> wp.int32:  # fmt: skip
    """Write the regions that are the contact into ``bins.lines``, by depth; how many.

    Of a region the force is a straight line over the depth; the force of the contact is the envelope of all these lines.
    """
    # Half a node stands for a tip between nodes.
    radius, response = radius_of(_HALF, cell), response_at(_0, law)
    tip = law[0] * radius * response_at(radius, law)[0]
    bins.lines[block, 0] = wp.vec3d(tip, _0, _0)
    count = wp.int32(1)
    area, wider = Area(), Area()
    # Sums over all bins so far of gaps, of their squares, of gaps with x, y and products, and with powers of the nodes before.
    gaps, square, gap_x, gap_y = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    gap_xx, gap_xy, gap_yy = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    ranked, twice = wp.float64(0.0), wp.float64(0.0)
    punch = wp.vec4d(tip / wp.sqrt(_HALF), _1, _12 * response[1] - _6, response[2])
    root_start, of_gap = wp.float64(0.0), _HALF * deepest / _GAP_UNIT
    per_root = wp.vec4d()
    for k in range(_BINS):
        if k % _PUNCH == 0:
            # The stiffness at the end of the next bins, and its change per root of the nodes.
            for m in range(_PUNCH):
                if k + m < _BINS:
                    wider = widened(wider, bins.sums[block, k + m], flat)
            punch = punch + (wp.sqrt(area.nodes) - root_start) * per_root
            root_start = wp.sqrt(area.nodes)
            per_root = wp.vec4d()
            if wider.nodes > area.nodes:
                per_root = (punch_of(wider, flat, cell, law) - punch) / (wp.sqrt(wider.nodes) - root_start)
        sums = bins.sums[block, k] + Sums(_0)
        if sums[0] == _0:
            continue
        before = wp.float64(area.nodes + _0)
        gap = sums[6] / sums[0] * of_gap
        area = widened(area, sums, flat)
        weight = gap / NODE
        gaps += weight * sums[0]
        square += gap * weight * sums[0]
        gap_x += weight * sums[1]
        gap_y += weight * sums[2] * flat
        gap_xx += weight * sums[3]
        gap_xy += weight * sums[4] * flat
        gap_yy += weight * sums[5] * flat * flat
        nodes = area.nodes
        ranked += gap * (nodes * nodes - before * before)
        twice += gap * (nodes * nodes * nodes - before * before * before)
        each = _1 / nodes  # divisions take most of the time
        cx, cy, mean = area.x * each, area.y * each, gaps * each
        moments = moments_of(area, each, flat)
        xx, xy, yy = moments[0], moments[1], moments[2]
        gx, gy = gap_x * each, gap_y * each
        gxx = gap_xx * each - _2 * cx * gx + (cx * cx + _TWELFTH) * mean
        gxy = gap_xy * each - cx * gy - cy * gx + cx * cy * mean
        gyy = gap_yy * each - _2 * cy * gy + (cy * cy + flat * flat * _TWELFTH) * mean
        gx -= cx * mean
        gy -= cy * mean
        inverse = _1 / (xx * yy - xy * xy)
        bowl = _QUARTER * (yy * gxx - _2 * xy * gxy + xx * gyy) * inverse - _HALF * mean
        spread = _1 / larger(square * each - mean * mean, _LEAST_VARIANCE)
        tilt = larger((yy * gx * gx - _2 * xy * gx * gy + xx * gy * gy) * inverse * spread, _0)
        round_share = _12 * bowl * bowl * spread
        smooth = smaller(tilt + round_share * round_share, _1)
        within = _QUARTER * (yy + flat * flat * xx) * inverse * bowl
        ranked_mean = ranked * each * each
        root = wp.sqrt(nodes)
        here = punch + (root - root_start) * per_root
        joint = here[1] + _0
        mean += (
            within
            + here[2] * (joint * bowl + (_1 - joint * joint) * (_1 - smooth) * _HALF * (ranked_mean - mean))
            + here[3] * (_2 * twice * each * each * each - _3 * ranked_mean + mean)
        )
        slope = here[0] * root
        offset = slope * larger(mean, _0)
        last = bins.lines[block, count - 1] + wp.vec3d(_0)
        if slope <= last[0]:
            continue
        start = (offset - last[1]) / (slope - last[0])
        while count > 0 and start <= last[2]:
            count -= 1
            start = _0
            if count > 0:
                last = bins.lines[block, count - 1] + wp.vec3d(_0)
                start = (offset - last[1]) / (slope - last[0])
        bins.lines[block, count] = wp.vec3d(slope, offset, start)
        count += 1
    return count


@wp.func
def region_at(bins: Bins, block: wp.int32, count: wp.int32, at: wp.int32, depth: wp.float64) -> wp.int32:
    """The region that is the contact at a depth [m], from one before it on."""
    n = wp.int32(at)
    while n + 1 < count and bins.lines[block, n + 1][2] <= depth:
        n += 1
    return n


@wp.func
def force_at(bins: Bins, block: wp.int32, n: wp.int32, depth: wp.float64) -> wp.float64:
    line = bins.lines[block, n]
    return line[0] * depth - line[1]


@wp.func
def tabulate(
    bins: Bins,
    block: wp.int32,
    deepest: wp.float64,
    flat: wp.float64,
    cell: wp.float64,
    law: wp.array(dtype=wp.float64),
    row: wp.int32,
    # outputs
    force: wp.array2d(dtype=wp.float64),
    radius: wp.array2d(dtype=wp.float64),
):
    """Force and radius of a row at all depths of the table, one thread; ``flat``: ``add_node``."""
    count = regions(bins, block, deepest, flat, cell, law)
    n, n_before, n_after, entry = wp.int32(0), wp.int32(0), wp.int32(0), wp.int32(0)
    for point in range(_POINTS):
        share = wp.float64(point) / _STEPS
        depth = deepest * share * share
        step = larger(_SMOOTH * depth, _LEAST_STEP)
        n = region_at(bins, block, count, n, depth)
        n_before = region_at(bins, block, count, n_before, depth - step)
        n_after = region_at(bins, block, count, n_after, depth + step)
        force[row, point] = force_at(bins, block, n, depth)
        slope = _HALF * (force_at(bins, block, n_after, depth + step) - force_at(bins, block, n_before, depth - step)) / step
        entry = entry_of(slope, law, entry)
        radius[row, point] = punch_radius(slope, law, entry)
