"""Kernels of ``NormalCorrection``: vertices in contact, remainder, search for the pressure.

A row of nodes is computed by one thread, and joined with the others of its pad by another, in their order.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

from raytac.gel.product_kernels import PACKETS, ROWS
from raytac.physics.soft.clearance_kernels import Hats
from raytac.physics.soft.correction.force_kernels import Unknowns

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_INF = wp.constant(wp.float64(wp.inf))
_ZERO = wp.constant(wp.float32(0.0))
_HUGE = wp.constant(wp.float64(1e300))


@wp.struct
class Search:
    """State of the search for the pressure in B pads."""

    active: wp.array(dtype=wp.int32)
    """1 while an environment is searched."""
    touched: wp.array(dtype=wp.int32)
    """1 where a pad is in contact."""
    rows: wp.array(dtype=wp.vec2i)
    """Window, from and to, outside which nothing can touch."""
    columns: wp.array(dtype=wp.vec2i)
    last: wp.array(dtype=wp.float64)
    """G of the step before."""
    beta: wp.array(dtype=wp.float32)
    tau: wp.array(dtype=wp.float32)
    best: wp.array(dtype=wp.float64)
    """Least residual so far [m]."""
    improved: wp.array(dtype=wp.int32)
    """1 if this step has it."""
    count: wp.array(dtype=wp.int32)
    stale: wp.array(dtype=wp.int32)
    """1 if the dent does not follow from that of the step before."""


@wp.kernel
def loads(
    sound: wp.array(dtype=wp.int32), forces: wp.array2d(dtype=wp.vec3d), clearance: wp.array(dtype=wp.float64),
    # outputs
    load: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Normal load on the vertices [N], (B, V), >= 0; 0 out of contact."""
    env, v = wp.tid()
    load[env, v] = _0
    if sound[env] != 0 and wp.isfinite(clearance[env]):
        load[env, v] = wp.max(-forces[env, v][2], _0)


@wp.kernel
def choose_touching(
    load: wp.array2d(dtype=wp.float64), least: wp.float64, free: wp.array(dtype=wp.int32),
    # outputs
    touching: wp.array2d(dtype=wp.int32),
    unknowns: Unknowns,
):  # fmt: skip
    """Vertices with more than the ``least`` share of the greatest load, and which can move."""
    env = wp.tid()
    most, count = wp.float64(0.0), wp.int32(0)
    for v in range(load.shape[1]):
        most = wp.max(most, load[env, v])
    for v in range(load.shape[1]):
        touching[env, v] = 0
        if load[env, v] > least * most:
            touching[env, v] = 1
            if free[v] != 0:
                unknowns.index[env, count] = v
                count += 1
    unknowns.count[env] = count


@wp.kernel
def smooth_remainder(
    rows: wp.array(dtype=wp.vec3d), columns: wp.array(dtype=wp.vec3d),
    moved: wp.array3d(dtype=wp.float64), response: wp.array2d(dtype=wp.float64),
    # outputs
    out: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """w − E w without waves of two cells, (B, 1, V), by (environment, vertex).

    ``rows``, ``columns``: weights of the line before, the line and the line after; ``moved``: displacements (B, 3, V).
    """
    env, v = wp.tid()
    wide, high = columns.shape[0], rows.shape[0]
    j, i = v // wide, v % wide
    total = wp.float64(0.0)
    for dj in range(-1, 2):
        for di in range(-1, 2):
            a, b = j + dj, i + di
            if a >= 0 and a < high and b >= 0 and b < wide:
                n = a * wide + b
                total += rows[j][dj + 1] * columns[i][di + 1] * (moved[env, 2, n] - response[env, n])
    out[env, 0, v] = total


@wp.kernel
def overlaps(
    open_gap: wp.float64, clear_gap: wp.float64, rest: wp.array2d(dtype=wp.float64), rise: wp.array3d(dtype=wp.float32),
    under: wp.array3d(dtype=wp.float64),
    # outputs
    overlap: wp.array3d(dtype=wp.float32),
    near: wp.array2d(dtype=wp.vec2i),
):  # fmt: skip
    """Overlap of the coat without normal contact [m], by (environment, row).

    ``under`` is finite, or inf where there is no object, as of ``Undersides``.
    ``near``: columns, from and to, of the row's nodes that may touch.
    """
    env, row = wp.tid()
    from_, to = rise.shape[2], wp.int32(0)
    above, at_rest, risen, overlapped = under[env, row], rest[row], rise[env, row], overlap[env, row]
    i, end = wp.int32(0), rise.shape[2]
    while i < end:
        clear = above[i] - at_rest[i]
        if not (clear < _INF):
            clear = open_gap
        u = wp.float64(risen[i]) - clear
        overlapped[i] = wp.float32(u)
        if u > -clear_gap:
            from_, to = wp.min(from_, i), wp.max(to, i + 1)
        i += 1
    near[env, row] = wp.vec2i(from_, to)


@wp.kernel
def choose_windows(
    sound: wp.array(dtype=wp.int32), clearance: wp.array(dtype=wp.float64), near: wp.array2d(dtype=wp.vec2i), s: Search
):
    """Window of each environment, and the state at the start of the search."""
    env = wp.tid()
    columns, rows = wp.vec2i(2147483647, 0), wp.vec2i(near.shape[1], 0)
    for row in range(near.shape[1]):
        line = near[env, row]
        if line[1] > line[0]:
            columns = wp.vec2i(wp.min(columns[0], line[0]), wp.max(columns[1], line[1]))
            rows = wp.vec2i(wp.min(rows[0], row), row + 1)
    touched, active = wp.int32(0), wp.int32(0)
    if sound[env] != 0 and wp.isfinite(clearance[env]):
        touched = wp.int32(1)
        if rows[1] > 0:
            active = wp.int32(1)
    if active == 0:
        columns, rows = wp.vec2i(0, 0), wp.vec2i(0, 0)
    s.active[env] = active
    s.touched[env] = touched
    s.rows[env] = rows
    s.columns[env] = columns
    s.last[env] = wp.float64(1.0)
    s.best[env] = _HUGE
    s.improved[env] = 0
    s.count[env] = 0
    s.stale[env] = active


@wp.kernel
def first_pressures(
    s: Search, hats: Hats, wide: wp.int32, load: wp.array2d(dtype=wp.float64),
    # outputs
    pressure: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Pressure to begin with in the window: that of the vertices' load between them.

    By (environment, row).
    """
    env, row = wp.tid()
    if row < s.rows[env][0] or row >= s.rows[env][1]:
        return
    i, end = wp.max(s.columns[env][0], 0), s.columns[env][1]
    while i < end:
        corner = hats.cell_y[row] * wide + hats.cell_x[i]
        a, b = hats.share_x[i], hats.share_y[row]
        one = wp.float64(1.0)
        p = (one - b) * ((one - a) * load[env, corner] + a * load[env, corner + 1])
        p += b * ((one - a) * load[env, corner + wide] + a * load[env, corner + wide + 1])
        pressure[env, row, i] = wp.float32(p * hats.area_x[i] * hats.area_y[row])
        i += 1


@wp.kernel
def greatest_in_window(s: Search, field: wp.array3d(dtype=wp.float32), greatest: wp.array(dtype=wp.float32)):
    """Greatest number of a field in each window, by environment."""
    env = wp.tid()
    most = wp.float32(0.0)
    for row in range(s.rows[env][0], s.rows[env][1]):
        for i in range(s.columns[env][0], s.columns[env][1]):
            most = wp.max(most, field[env, row, i])
    greatest[env] = most


@wp.kernel
def begin(
    s: Search, overlap: wp.array3d(dtype=wp.float32), greatest: wp.array(dtype=wp.float32), start: wp.array3d(dtype=wp.float32),
    # outputs
    p: wp.array3d(dtype=wp.float32),
    best: wp.array3d(dtype=wp.float32),
    overlapping: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Pressure to begin with where the coat overlaps the object, else 0 as before.

    By (environment, row).
    """
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    overlapping[env, row] = 1
    if row < rows[0] or row >= rows[1]:
        return
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        if overlap[env, row, i] > _ZERO:
            value = wp.max(start[env, row, i], greatest[env] * wp.float32(1e-3))
            p[env, row, i] = value
            best[env, row, i] = value
        i += 1


@wp.kernel
def gaps(
    s: Search, dent: wp.array3d(dtype=wp.float32), overlap: wp.array3d(dtype=wp.float32), p: wp.array3d(dtype=wp.float32),
    # outputs
    g: wp.array3d(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """g = A p − overlap along a row, its least, and the greatest |g| under pressure."""
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if s.active[env] == 0 or row < rows[0] or row >= rows[1]:
        return
    least, most = wp.float32(1e30), wp.float32(0.0)
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        gap = dent[env, row, i] - overlap[env, row, i]
        g[env, row, i] = gap
        least = wp.min(least, gap)
        if p[env, row, i] > _ZERO:
            most = wp.max(most, wp.abs(gap))
        i += 1
    sums[env, row] = wp.vec3d(wp.float64(least), wp.float64(most), _0)


@wp.func
def pressed(is_in: wp.bool, p: wp.array(dtype=wp.float32), g: wp.array(dtype=wp.float32), i: wp.int32):
    """g at a node of a row under pressure, 0 at others and outside of the window."""
    if is_in and p[i] > _ZERO:
        return g[i]
    return wp.float32(0.0)


@wp.kernel
def stiffen(
    s: Search, shortest: wp.float32, g: wp.array3d(dtype=wp.float32), p: wp.array3d(dtype=wp.float32),
    # outputs
    z: wp.array3d(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Preconditioned gap z along a row, and g·z.

    ``shortest`` − the five-point Laplacian, of g under pressure.
    """
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if s.active[env] == 0 or row < rows[0] or row >= rows[1]:
        return
    upper, lower = wp.max(row - 1, rows[0]), wp.min(row + 1, rows[1] - 1)
    p0, p1, p2, g0, g1, g2 = p[env, upper], p[env, row], p[env, lower], g[env, upper], g[env, row], g[env, lower]
    total = wp.float64(0.0)
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        if p1[i] > _ZERO:
            around = pressed(upper < row, p0, g0, i) + pressed(lower > row, p2, g2, i)
            around += pressed(i > columns[0], p1, g1, wp.max(i - 1, 0)) + pressed(i + 1 < end, p1, g1, wp.min(i + 1, end - 1))
            value = (wp.float32(4.0) + shortest) * g1[i] - around
            z[env, row, i] = value
            total += wp.float64(g1[i] * value)
        i += 1
    sums[env, row] = wp.vec3d(total, _0, _0)


@wp.kernel
def judge(
    s: Search, gaps: wp.array2d(dtype=wp.vec3d), sums: wp.array2d(dtype=wp.vec3d), overlapping: wp.array2d(dtype=wp.int32),
    tolerance: wp.float64,
):  # fmt: skip
    """Residual of each environment, whether it is solved, and β of the next direction."""
    env = wp.tid()
    s.improved[env] = 0
    if s.active[env] == 0:
        return
    square, least, most, added = wp.float64(0.0), wp.float64(1e30), wp.float64(0.0), wp.int32(0)
    for row in range(s.rows[env][0], s.rows[env][1]):
        least, most = wp.min(least, gaps[env, row][0]), wp.max(most, gaps[env, row][1])
        square += sums[env, row][0]
        added = wp.max(added, overlapping[env, row])
    residual = wp.max(-least, most)
    if residual < s.best[env]:
        s.best[env] = residual
        s.improved[env] = 1
    beta = wp.float64(0.0)
    if added == 0 and s.last[env] > _0:
        beta = square / s.last[env]
    s.beta[env] = wp.float32(beta)
    s.last[env] = square
    if residual < tolerance:
        s.active[env] = 0


@wp.kernel
def turn(
    s: Search, z: wp.array3d(dtype=wp.float32), p: wp.array3d(dtype=wp.float32),
    # outputs
    best: wp.array3d(dtype=wp.float32),
    t: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Direction t = z + β t under pressure, and the best pressure so far, by (environment, row)."""
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if row < rows[0] or row >= rows[1]:
        return
    if s.improved[env] != 0:
        i, end = wp.max(columns[0], 0), columns[1]
        while i < end:
            best[env, row, i] = p[env, row, i]
            i += 1
    if s.active[env] != 0:
        i, end = wp.max(columns[0], 0), columns[1]
        while i < end:
            if p[env, row, i] > _ZERO:
                t[env, row, i] = z[env, row, i] + s.beta[env] * t[env, row, i]
            else:
                t[env, row, i] = _ZERO
            i += 1


@wp.kernel
def curvatures(
    s: Search, r: wp.array3d(dtype=wp.float32), g: wp.array3d(dtype=wp.float32), p: wp.array3d(dtype=wp.float32),
    t: wp.array3d(dtype=wp.float32),
    # outputs
    sums: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Sums of r t and g t under pressure along a row."""
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if s.active[env] == 0 or row < rows[0] or row >= rows[1]:
        return
    rt, gt = wp.float64(0.0), wp.float64(0.0)
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        if p[env, row, i] > _ZERO:
            rt += wp.float64(r[env, row, i] * t[env, row, i])
            gt += wp.float64(g[env, row, i] * t[env, row, i])
        i += 1
    sums[env, row] = wp.vec3d(rt, gt, _0)


@wp.kernel
def put(value: wp.int32, flag: wp.array(dtype=wp.int32)):
    """Write one number; a recorded loop takes no copies."""
    flag[0] = value


@wp.kernel
def choose_length(s: Search, sums: wp.array2d(dtype=wp.vec3d), most: wp.int32, go: wp.array(dtype=wp.int32)):
    """Length τ of the step; ``go`` becomes 1 if any environment goes on."""
    env = wp.tid()
    if s.active[env] == 0:
        return
    rt, gt = wp.float64(0.0), wp.float64(0.0)
    for row in range(s.rows[env][0], s.rows[env][1]):
        rt += sums[env, row][0]
        gt += sums[env, row][1]
    s.count[env] = s.count[env] + 1
    if not (rt > _0) or s.count[env] >= most:
        s.active[env] = 0
        return
    s.tau[env] = wp.float32(gt / rt)
    go[0] = 1


@wp.kernel
def move(
    s: Search, shortest: wp.float32, g: wp.array3d(dtype=wp.float32), t: wp.array3d(dtype=wp.float32),
    # outputs
    p: wp.array3d(dtype=wp.float32),
    overlapping: wp.array2d(dtype=wp.int32),
    bent: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Step of the pressure along a row; 1 where a node without pressure overlaps the object.

    ``bent``: 1 where the step is not τ t at every node.
    """
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if s.active[env] == 0 or row < rows[0] or row >= rows[1]:
        return
    tau, added, cut = s.tau[env], wp.int32(0), wp.int32(0)
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        straight = p[env, row, i] - tau * t[env, row, i]  # without pressure t is 0
        value = wp.max(straight, _ZERO)
        if value <= _ZERO and g[env, row, i] < _ZERO:
            value = value - tau * shortest * g[env, row, i]
            added = wp.int32(1)
        if value != straight:
            cut = wp.int32(1)
        p[env, row, i] = value
        i += 1
    overlapping[env, row] = added
    bent[env, row] = cut


@wp.kernel
def choose_stale(s: Search, bent: wp.array2d(dtype=wp.int32)):
    """Environments whose dent is computed anew, as their last step was not τ t."""
    env = wp.tid()
    stale = wp.int32(0)
    if s.active[env] != 0:
        for row in range(s.rows[env][0], s.rows[env][1]):
            stale = wp.max(stale, bent[env, row])
    s.stale[env] = stale


@wp.kernel
def follow_step(s: Search, response: wp.array3d(dtype=wp.float32), dent: wp.array3d(dtype=wp.float32)):
    """Dent along a row after a step of τ t, whose ``response`` is A t."""
    env, row = wp.tid()
    columns, rows = s.columns[env], s.rows[env]
    if s.active[env] == 0 or s.stale[env] != 0 or row < rows[0] or row >= rows[1]:
        return
    tau = s.tau[env]
    i, end = wp.max(columns[0], 0), columns[1]
    while i < end:
        dent[env, row, i] = dent[env, row, i] - tau * response[env, row, i]
        i += 1


@wp.kernel
def flatten(field: wp.array3d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    """Matrices (B, n, m) row by row, (B, n·m)."""
    env, v = wp.tid()
    out[env, v] = field[env, v // field.shape[2], v % field.shape[2]]


@wp.kernel
def fold(values: wp.array2d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)):
    """Transposes of the matrices of ``flatten``, (B, m, n)."""
    env, v = wp.tid()
    out[env, v % out.shape[1], v // out.shape[1]] = values[env, v]


@wp.kernel
def convolve(
    active: wp.array(dtype=wp.int32), columns: wp.array(dtype=wp.vec2i), table: wp.array2d(dtype=Any),
    half: wp.array3d(dtype=Any), nodes: wp.int32, threads: wp.int32,
    # outputs
    out: wp.array3d(dtype=Any),
):  # fmt: skip
    """Response along x to waves along y, Σ_k (c[|i − k|] + c[i + k]) half[k].

    Of ``ROWS`` columns i, by (environment, block, thread). ``half``, ``out``: by column and packet of waves along y; ``table``: c (2
    nodes − 1, packets), the
    response at a distance to such a wave, which the mirror images at both edges have at the sum. The end nodes stand for half cells.
    """
    env, block, thread = wp.tid()
    i = block * ROWS
    span = columns[env]
    if active[env] == 0 or i + ROWS <= span[0] or i >= span[1]:
        return
    last = nodes - 1
    for p in range(thread, out.shape[2], threads):
        a, b, c, d = out.dtype(), out.dtype(), out.dtype(), out.dtype()
        k, end = wp.max(span[0], 0), span[1]
        while k < end:
            w = half[env, k, p]
            if k == 0 or k == last:
                w = wp.float32(0.5) * w
            # Beyond the last node there is only padding.
            i1, i2, i3 = wp.min(i + 1, last), wp.min(i + 2, last), wp.min(i + 3, last)
            a += wp.cw_mul(table[wp.abs(i - k), p] + table[i + k, p], w)
            b += wp.cw_mul(table[wp.abs(i1 - k), p] + table[i1 + k, p], w)
            c += wp.cw_mul(table[wp.abs(i2 - k), p] + table[i2 + k, p], w)
            d += wp.cw_mul(table[wp.abs(i3 - k), p] + table[i3 + k, p], w)
            k += 1
        out[env, i, p] = a
        out[env, i + 1, p] = b
        out[env, i + 2, p] = c
        out[env, i + 3, p] = d


for _packet in PACKETS.values():
    wp.overload(
        convolve, {"table": wp.array2d(dtype=_packet), "half": wp.array3d(dtype=_packet), "out": wp.array3d(dtype=_packet)}
    )


@wp.kernel
def lay(
    s: Search, is_laid: wp.int32, closed_gap: wp.float64, clearance: wp.array(dtype=wp.float64),
    near_y: wp.array(dtype=wp.int32), near_x: wp.array(dtype=wp.int32), p: wp.array3d(dtype=wp.float32),
    rest: wp.array2d(dtype=wp.float64), plain: wp.array3d(dtype=wp.float32), rise: wp.array3d(dtype=wp.float32),
    dent: wp.array3d(dtype=wp.float32), under: wp.array3d(dtype=wp.float64),
    # outputs
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
    sound: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Lay the coat on the object along a row of nodes.

    Overlaps are removed. Gaps under pressure are closed, g → g³/(1 + g²) with g = gap / ``closed_gap``. ``is_laid``: 0 shows the
    ``plain`` height. Out of contact that is shown, too. An environment with a height that is not finite is not ``sound``.
    """
    env, row = wp.tid()
    touched = wp.isfinite(clearance[env])
    at_rest, shown, marks, flat = rest[row], height[env, row], contact[env, row], plain[env, row]
    pressure, risen, dented, above = p[env, near_y[row]], rise[env, row], dent[env, row], under[env, row]
    # Rows beside the window have no pressure.
    bears = touched and near_y[row] >= s.rows[env][0] and near_y[row] < s.rows[env][1]
    i, end, error = wp.int32(0), height.shape[2], wp.float32(0.0)
    if touched and is_laid != 0:
        while i < end:
            z = at_rest[i] + wp.float64(risen[i]) - wp.float64(dented[i])
            gap, mark = above[i] - z, wp.uint8(0)
            if gap < _0:
                z += gap
            if bears:
                if pressure[near_x[i]] > _ZERO and gap < _INF:
                    mark = wp.uint8(1)
                    if gap >= _0:
                        g = gap / closed_gap
                        z += closed_gap * g / (wp.float64(1.0) + g * g)
            low = wp.float32(z)
            error += low - low
            shown[i] = low
            marks[i] = mark
            i += 1
    else:
        while i < end:
            low, mark = wp.float32(at_rest[i] + wp.float64(flat[i])), wp.uint8(0)
            if bears:
                if pressure[near_x[i]] > _ZERO:
                    mark = wp.uint8(1)
            error += low - low
            shown[i] = low
            marks[i] = mark
            i += 1
    if wp.isnan(error):
        sound[env] = 0
