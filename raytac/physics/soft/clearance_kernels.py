"""Kernels of ``BarrierClearance``: mean gap under pressure of a coat."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.shape_kernels import infinity
from raytac.physics.soft.coat_kernels import Coat

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_NAN = wp.constant(wp.float64(float("nan")))
_SAG = wp.constant(wp.float64(3.0))
"""Allowance for a facet's sag on a convex object, over its depth below its mean over a cell.

For curvature κ that depth is κ cell²/6, and vertices lie up to 0.35 κ cell² below the facets around them (ball of 3.2 mm, cells of
1 mm)."""
_CUT = wp.constant(wp.float64(0.5e-3))
"""Height above the object's lowest point [m] at which its underside is cut off in that mean."""


@wp.struct
class Hats:
    """Linear interpolation from a coat's lines to the nodes of a grid."""

    cell_x: wp.array(dtype=wp.int32)
    """Cell of each column of nodes."""
    cell_y: wp.array(dtype=wp.int32)
    share_x: wp.array(dtype=wp.float64)
    """Place in it, from 0 to 1."""
    share_y: wp.array(dtype=wp.float64)
    around_x: wp.array(dtype=wp.vec2i)
    """Columns of nodes, from and to, around each line of the coat."""
    around_y: wp.array(dtype=wp.vec2i)
    area_x: wp.array(dtype=wp.float64)
    """Length of the grid's own cell around each column of nodes [m], half of one at the ends."""
    area_y: wp.array(dtype=wp.float64)


@wp.func
def hat(cell: wp.int32, share: wp.float64, line: wp.int32) -> wp.float64:
    """Weight of a line's hat function at a node."""
    if line == cell:
        return _1 - share
    if line == cell + 1:
        return share
    return wp.float64(0.0)


@wp.func
def between_vertices(
    hats: Hats, columns: wp.int32, values: wp.array2d(dtype=wp.float64), env: wp.int32, row: wp.int32, i: wp.int32
) -> wp.float64:
    """Values of vertices (B, V), interpolated at a node."""
    corner = hats.cell_y[row] * columns + hats.cell_x[i]
    a, b = hats.share_x[i], hats.share_y[row]
    below = (_1 - a) * values[env, corner] + a * values[env, corner + 1]
    above = (_1 - a) * values[env, corner + columns] + a * values[env, corner + columns + 1]
    return (_1 - b) * below + b * above


@wp.kernel
def pressures(coat: Coat, sound: wp.array(dtype=wp.int32), forces: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.float64)):
    """Normal pressure on the vertices [Pa], (B, V), >= 0."""
    env, v = wp.tid()
    out[env, v] = _0
    if sound[env] != 0:
        out[env, v] = wp.max(-forces[env, v][2], _0) / coat.area[v]


@wp.kernel
def lowest_in_rows(under: wp.array3d(dtype=wp.float64), lowest: wp.array2d(dtype=wp.float64)):
    env, row = wp.tid()
    least = infinity()
    i, end = wp.int32(0), under.shape[2]
    while i < end:
        least = wp.min(least, under[env, row, i])
        i += 1
    lowest[env, row] = least


@wp.kernel
def lowest_of_rows(rows: wp.array2d(dtype=wp.float64), lowest: wp.array(dtype=wp.float64)):
    env = wp.tid()
    least = infinity()
    for row in range(rows.shape[1]):
        least = wp.min(least, rows[env, row])
    lowest[env] = least


@wp.kernel
def mean_over_cells(
    hats: Hats, columns: wp.int32, under: wp.array3d(dtype=wp.float64), lowest: wp.array(dtype=wp.float64),
    # outputs
    mean: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Mean of the underside, cut off above, over the cells around each vertex, (B, V) [m]."""
    env, v = wp.tid()
    highest = lowest[env] + _CUT
    if not wp.isfinite(highest):
        mean[env, v] = _0
        return
    rows, nodes = hats.around_y[v // columns], hats.around_x[v % columns]
    total, weight = wp.float64(0.0), wp.float64(0.0)
    for row in range(rows[0], rows[1]):
        i, end = wp.max(nodes[0], 0), nodes[1]
        while i < end:
            w = hat(hats.cell_y[row], hats.share_y[row], v // columns) * hat(hats.cell_x[i], hats.share_x[i], v % columns)
            total += w * wp.min(under[env, row, i], highest)
            weight += w
            i += 1
    mean[env, v] = total / wp.max(weight, wp.float64(1e-6))


@wp.kernel
def gaps_in_rows(
    hats: Hats, columns: wp.int32,
    pressure: wp.array2d(dtype=wp.float64), mean: wp.array2d(dtype=wp.float64), lowest: wp.array(dtype=wp.float64),
    rest: wp.array2d(dtype=wp.float64), reach: wp.array2d(dtype=wp.float64), rise: wp.array3d(dtype=wp.float32),
    under: wp.array3d(dtype=wp.float64),
    # outputs
    sums: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Sums of pressure × gap and pressure over a row's nodes that touch, and greatest overlap.

    By (environment, row); the overlap is of object and resting coat [m].
    """
    env, row = wp.tid()
    total, weight, overlap = wp.float64(0.0), wp.float64(0.0), -infinity()
    highest = lowest[env] + _CUT
    i, end = wp.int32(0), under.shape[2]
    while i < end:
        z = under[env, row, i]
        overlap = wp.max(overlap, rest[row, i] - z)
        p = between_vertices(hats, columns, pressure, env, row, i)
        if wp.isfinite(z) and p > _0:
            gap = z - (rest[row, i] + wp.float64(rise[env, row, i]))
            bulge = wp.max(between_vertices(hats, columns, mean, env, row, i) - wp.min(z, highest), _0)
            if gap < reach[row, i] + _SAG * bulge:
                total += p * gap
                weight += p
        i += 1
    sums[env, row] = wp.vec3d(total, weight, overlap)


@wp.kernel
def mean_gaps(sums: wp.array2d(dtype=wp.vec3d), d_hat: wp.float64, clearance: wp.array(dtype=wp.float64)):
    """Mean gap [m] of each environment, at most 2 d̂ + overlap; NaN without pressure."""
    env = wp.tid()
    gap, pressure, overlap = wp.float64(0.0), wp.float64(0.0), -infinity()
    for row in range(sums.shape[1]):
        one = sums[env, row]
        gap, pressure, overlap = gap + one[0], pressure + one[1], wp.max(overlap, one[2])
    clearance[env] = wp.where(pressure > _0, wp.min(gap / pressure, wp.float64(2.0) * d_hat + overlap), _NAN)
