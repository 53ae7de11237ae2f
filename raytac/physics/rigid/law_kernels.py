"""Load law of a contact from its nodes' gaps, in Warp: ``LoadLaw`` at a few depths up to one that is given.

Nodes are sorted into bins by the depth at which they count as in contact. Of each bin the number and the least and greatest gap are kept,
so that the smoothing by half a node is that of ``LoadLaw`` at the edges of the bins, and exact.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contacts import LAW_POINTS
from raytac.physics.rigid.shape_kernels import infinity

wp.set_module_options({"enable_backward": False, "fast_math": False})

_FINER = 4
"""Bins between two depths of the table: where the area jumps, the force is known to a quarter of the table's spacing."""
BINS = (LAW_POINTS - 1) * _FINER
_BINS = wp.constant(wp.int32(BINS))
_SCALE = wp.constant(wp.float64(BINS))
_STEP = wp.constant(wp.int32(_FINER))
_0 = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))
_STEPS = wp.constant(wp.float64(LAW_POINTS - 1.0))
DEEPER = wp.constant(wp.float64(((LAW_POINTS - 1.0) / 22.0) ** 2))
"""Depth up to which a law is tabulated at least, of the present one: some 2, so that this is one of the table's own."""
_FEWEST = wp.constant(wp.float64(6.0))
"""Steps of the table up to the present depth at least, for which it is stretched."""
_SHALLOWEST = wp.constant(wp.float64(10e-6))
"""Least depth up to which a law is tabulated [m]."""
_PI = wp.constant(wp.float64(3.141592653589793))


@wp.struct
class Bins:
    """Nodes of one contact by gap at touch, a row for each block of threads."""

    count: wp.array2d(dtype=wp.int32)
    low: wp.array2d(dtype=wp.float64)
    """Least gap [m]; inf in an empty bin."""
    high: wp.array2d(dtype=wp.float64)


@wp.func
def reached_by(depth: wp.float64, reach: wp.float64, ahead: wp.float64) -> wp.float64:
    """Depth [m] up to which a law is wanted: what a body may reach, but no more than ``ahead`` into the gel or deeper than it is."""
    return wp.max(DEEPER * depth, wp.min(depth + reach, wp.max(depth, _0) + ahead))


@wp.func
def deepest_of(depth: wp.float64, reach: wp.float64, ahead: wp.float64, thickness: wp.float64) -> wp.float64:
    """Depth [m] up to which the law is tabulated: as ``reached_by``, but so that the present depth is one of the table's own, and the gel's
    thickness at most."""
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
        bins.count[block, k] = 0
        bins.low[block, k] = _INF
        bins.high[block, k] = -_INF
        k += lanes


@wp.func
def add_node(
    count: wp.array(dtype=wp.int32), low: wp.array(dtype=wp.float64), high: wp.array(dtype=wp.float64), gap: wp.float64,
    share: wp.float64,
):  # fmt: skip
    """Add a node with a gap at touch [m], ``share`` in [0, 1) of the farthest that counts; the result does not depend on the order."""
    k = wp.min(wp.int32(wp.sqrt(share) * _SCALE), _BINS - 1)
    wp.atomic_add(count, k, 1)
    wp.atomic_min(low, k, gap)
    wp.atomic_max(high, k, gap)


@wp.func
def incremental_stiffness(radius: wp.float64, law: wp.array2d(dtype=wp.float64), pad: wp.int32) -> wp.float64:
    """dF/dδ [N/m] of a contact of a radius [m] on the bonded layer; ``law``: see ``law_constants``."""
    ratio = radius / law[pad, 1]
    stiffening = law[pad, 7]
    for n in range(4):  # Horner's scheme
        stiffening = stiffening * ratio + law[pad, 6 - n]
    return law[pad, 0] * radius * wp.min(stiffening, wp.float64(1.0) + law[pad, 2] * ratio)


@wp.func
def radius_of(nodes: wp.float64, cell: wp.float64) -> wp.float64:
    """Radius [m] of a disc with the area of so many nodes, each of ``cell`` [m²]."""
    return wp.sqrt(nodes * cell / _PI)


@wp.func
def stiffness_of(nodes: wp.float64, cell: wp.float64, law: wp.array2d(dtype=wp.float64), pad: wp.int32) -> wp.float64:
    """dF/dδ [N/m] of a contact that covers so many nodes."""
    return incremental_stiffness(radius_of(nodes, cell), law, pad)


@wp.func
def tabulate(
    bins: Bins,
    block: wp.int32,
    beyond: wp.float64,
    deepest: wp.float64,
    cell: wp.float64,
    law: wp.array2d(dtype=wp.float64),
    pad: wp.int32,
    row: wp.int32,
    # outputs
    force: wp.array2d(dtype=wp.float64),
    radius: wp.array2d(dtype=wp.float64),
):
    """Force and contact radius of one row at all depths of the table, by one thread; ``beyond``: least gap that is in no bin [m]."""
    later = wp.float64(beyond + _0)
    for back in range(_BINS):  # the least gap in this bin or a later one
        k = _BINS - 1 - back
        later = wp.min(later, bins.low[block, k])
        bins.low[block, k] = later
    nodes = wp.int32(0)
    before = -infinity()
    depth_before, total = wp.float64(0.0), wp.float64(0.0)
    stiffness_before = stiffness_of(_HALF, cell, law, pad)
    for k in range(_BINS + 1):
        share = wp.float64(k) / _SCALE
        depth = deepest * share * share
        if k > 0 and bins.count[block, k - 1] > 0:
            # The stiffness is integrated from kink to kink, so that the force does not jump as nodes pass from bin to bin.
            first = wp.clamp(wp.float64(2.0) * bins.low[block, k - 1], depth_before, depth)
            stiffness = stiffness_of(wp.float64(nodes) + _HALF, cell, law, pad)
            total += _HALF * (stiffness + stiffness_before) * (first - depth_before)
            nodes += bins.count[block, k - 1]
            before = wp.max(before, bins.high[block, k - 1])
            depth_before = wp.clamp(wp.float64(2.0) * before, first, depth)
            stiffness_before = stiffness_of(wp.float64(nodes) - _HALF, cell, law, pad)
            total += _HALF * (stiffness + stiffness_before) * (depth_before - first)
        counted = wp.float64(0.5)
        if nodes > 0:
            # Half a node at its own gap, so that the area grows continuously from node to node.
            counted = wp.float64(nodes) - _HALF
            after = wp.float64(beyond + _0)
            if k < _BINS:
                after = bins.low[block, k]
            if after < _INF and after > before:
                counted += wp.clamp((_HALF * depth - before) / (after - before), _0, wp.float64(1.0))
        stiffness = stiffness_of(counted, cell, law, pad)
        total += _HALF * (stiffness + stiffness_before) * (depth - depth_before)
        depth_before, stiffness_before = depth, stiffness
        if k % _STEP == 0:
            force[row, k // _STEP] = total
            radius[row, k // _STEP] = radius_of(counted, cell)
