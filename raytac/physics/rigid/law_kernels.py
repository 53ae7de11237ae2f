"""Load law of a contact from its nodes' gaps: ``LoadLaw`` at a few depths, in Warp.

Nodes are sorted into bins by their gap. All that is added up is whole numbers of less than 2^53, so that the sums do not depend on the
order. Of the nodes of a bin it is not known which has which gap: a bin's mean counts.

Constants of a gel's law: 2 E*, radius of the widest contact, then stiffening, moment and bend of each entry of its ``LayerResponse``.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contacts import LAW_POINTS
from raytac.physics.rigid.layer_response import ENTRIES
from raytac.physics.rigid.load_law import SMOOTH
from raytac.physics.rigid.placed_kernels import larger, smaller

wp.set_module_options({"enable_backward": False, "fast_math": False})

BINS = 4 * (LAW_POINTS - 1)
"""Bins of gaps: regions below so many levels are tried for the contact."""
Sums = wp.types.vector(length=5, dtype=wp.float64)
"""Of a bin: nodes in parts; sums of their x, y numbers, squared distances and gaps.

Distances are from the pad's first node."""
_BINS = wp.constant(wp.int32(BINS))
_SCALE = wp.constant(wp.float64(BINS))
_POINTS = wp.constant(wp.int32(LAW_POINTS))
_ENTRIES = wp.constant(wp.float64(ENTRIES - 1))
_LAST_ENTRY = wp.constant(wp.int32(ENTRIES - 2))
_FIRST_ENTRY, _ENTRY = wp.constant(wp.int32(2)), wp.constant(wp.int32(3))
"""Of the response in a gel's constants: its place and the numbers of one entry."""
_GAP_UNIT = wp.constant(wp.float64(2.0**27))
"""Of a bin's sum of gaps, over the greatest gap: 6·10^4 nodes fit into a sum."""
_SQUARE_UNIT = wp.constant(wp.float64(2.0**9))
"""Of a bin's sum of squares, over the spacing's square."""
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
_PI = wp.constant(wp.float64(3.141592653589793))


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
    sums: wp.array(dtype=Sums), share: wp.float64, i: wp.int32, j: wp.int32, flat: wp.float64, parts: wp.float64
):  # fmt: skip
    """Add node ``i``, ``j`` of a pad to the bins of a block, in any order.

    ``share``: its gap at touch over the farthest that counts, in [0, 1). ``flat``: spacing along y over that along x. ``parts``: of a
    ``NODE``, for whose cells the node stands, a whole number; what is added to one node may be negative, and not their sum.
    """
    k = wp.min(wp.int32(wp.sqrt(share) * _SCALE), _BINS - 1)
    x, y = wp.float64(i), wp.float64(j)
    square = wp.floor((x * x + y * y * flat * flat) * _SQUARE_UNIT + _HALF)
    wp.atomic_add(sums, k, parts * Sums(_1, x, y, square, wp.floor(share * _GAP_UNIT)))


@wp.func
def response_at(radius: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.vec3d:
    """Stiffening, moment and bend of ``LayerResponse`` for a contact of a radius [m]."""
    at = smaller(wp.sqrt(radius / law[1]), _1) * _ENTRIES
    k = wp.min(wp.int32(at), _LAST_ENTRY)
    t = at - wp.float64(k)
    n = _FIRST_ENTRY + _ENTRY * k
    before = wp.vec3d(law[n], law[n + 1], law[n + 2])
    n += _ENTRY
    return before + t * (wp.vec3d(law[n], law[n + 1], law[n + 2]) - before)


@wp.func
def regions(
    bins: Bins, block: wp.int32, deepest: wp.float64, flat: wp.float64, cell: wp.float64, law: wp.array(dtype=wp.float64),
) -> wp.int32:  # fmt: skip
    """Write the regions that are the contact into ``bins.lines``, by depth; how many.

    Of a region the force is a straight line over the depth; the force of the contact is the envelope of all these lines.
    """
    # Half a node stands for a tip between nodes.
    disc = wp.sqrt(cell / _PI)  # radius of a disc with the area of one node
    radius = wp.sqrt(_HALF) * disc
    bins.lines[block, 0] = wp.vec3d(law[0] * radius * response_at(radius, law)[0], _0, _0)
    count = wp.int32(1)
    # Sums over all bins so far: nodes; x, y and squares; gaps; gaps with x, y and squares; gaps with powers of the nodes before.
    nodes, x, y, square = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    gaps, gap_x, gap_y, gap_square = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    ranked, twice = wp.float64(0.0), wp.float64(0.0)
    of_cell, of_gap = (_1 + flat * flat) / _12, _HALF * deepest / _GAP_UNIT
    for k in range(_BINS):
        if bins.sums[block, k][0] == _0:
            continue
        sums = bins.sums[block, k] / NODE
        more, dx, dy, dsquare = sums[0], sums[1], sums[2] * flat, sums[3] / _SQUARE_UNIT
        gap = sums[4] / more * of_gap
        before = wp.float64(nodes + _0)
        nodes, x, y, square = nodes + more, x + dx, y + dy, square + dsquare
        gaps, gap_x, gap_y, gap_square = gaps + gap * more, gap_x + gap * dx, gap_y + gap * dy, gap_square + gap * dsquare
        ranked += gap * (nodes * nodes - before * before)
        twice += gap * (nodes * nodes * nodes - before * before * before)
        each = _1 / nodes  # divisions take most of the time
        cx, cy, mean = x * each, y * each, gaps * each
        from_origin = cx * cx + cy * cy
        about = (gap_square - _2 * (cx * gap_x + cy * gap_y)) * each + (from_origin + of_cell) * mean
        spread = _1 / (square * each - from_origin + of_cell)
        tilted = _HALF * about * spread
        radius = wp.sqrt(nodes) * disc
        response = response_at(radius, law)
        bent = (_2 * twice * each - _3 * ranked) * each * each + mean
        mean += (
            _3 * of_cell * spread * (_2 * tilted - mean) + (_12 * response[1] - _6) * (tilted - _HALF * mean) + response[2] * bent
        )
        slope = law[0] * radius * response[0]
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
def entry_below(at: wp.int32, stiffness: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.int32:
    """The last entry that is not stiffer than that [N/m], searched for from one on."""
    k = wp.int32(at)
    while k > 0 and stiffness_of_entry(k, law) > stiffness:
        k -= 1
    while k < _LAST_ENTRY and stiffness_of_entry(k + 1, law) <= stiffness:
        k += 1
    return k


@wp.func
def punch_radius(low: wp.int32, stiffness: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.float64:
    """Radius [m] of the flat punch of a stiffness [N/m], between an entry and the next one."""
    below, above = stiffness_of_entry(low, law), stiffness_of_entry(low + 1, law)
    a, b = radius_of_entry(low, law), radius_of_entry(low + 1, law)
    return a + (b - a) * wp.clamp((stiffness - below) / (above - below), _0, _1)


@wp.func
def radius_of_entry(k: wp.int32, law: wp.array(dtype=wp.float64)) -> wp.float64:
    root = wp.float64(k) / _ENTRIES
    return law[1] * root * root


@wp.func
def stiffness_of_entry(k: wp.int32, law: wp.array(dtype=wp.float64)) -> wp.float64:
    return law[0] * radius_of_entry(k, law) * law[_FIRST_ENTRY + _ENTRY * k]


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
        entry = entry_below(entry, slope, law)
        radius[row, point] = punch_radius(entry, slope, law)
