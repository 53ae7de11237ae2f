"""Additive continuous collision detection: the largest step that keeps every pair apart.

Li, Kaufman, Jiang 2021, "Codimensional Incremental Potential Contact", algorithm 1. After the mean displacement is taken out, no
distance can shrink faster than l = max‖δ_A‖ + max‖δ_B‖ per unit of t, so t may always advance by d/l times a safety factor. The
advance stops when the distance has fallen to ``slack`` of the one at the start.

What slides or turns far in a narrow gap would creep in advances of a gap each. Two more bounds know directions; the longest of the
three advances counts.

- *A plane between them.* Whatever the unit vector n, the distance is at least the least n·(a − b) of a vertex a of A and b of B, which
  are linear in t. n is that of the shortest connection.
- *Lines, and plane, that turn.* With the edges u and v, and w from a point of one to one of the other, all linear in t, the distance of
  the lines is |w·(u × v)| / ‖u × v‖, and that of the edges no less. It stays above a gap while the cubic w·(u × v) exceeds the gap times
  ‖n0‖ + ‖n1‖ t + ‖n2‖ t², the n_k being the coefficients of u × v. The same holds for a point and a triangle with two of its edges.

Distances are known to a few units in the last place of the coordinates (:mod:`ipc.contact.distance`), and positions are rounded once more
when a step is taken. A step therefore never ends with a distance below ``RESOLUTION`` of the largest coordinate, where rounding could put
surfaces through each other; a pair that is closer already may not come closer.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, IntArray, MatArray2d, VecArray2d
from ipc.broad_phase.lists import Candidates, Surface, bounds_of, gap_bounds, listed, listed_at, only_near, pair_at, pair_vertices
from ipc.contact.distance import box_gap, pair_coefficients, separation

wp.set_module_options({"enable_backward": False})

SAFETY = wp.constant(wp.float64(0.9))
MAX_ADVANCES = wp.constant(500)
ROOT_STEPS = wp.constant(8)
ROUNDING = wp.constant(wp.float64(1.0e-15))
"""Error of a cross product over the lengths of its factors, some times what it can be."""
RESOLUTION = wp.constant(wp.float64(1.0e-13))
"""Least distance after a step over the largest coordinate; some hundred times rounding."""


@wp.func
def time_to_gap(n: wp.vec3d, x: wp.vec3d, dx: wp.vec3d, gap: wp.float64) -> wp.float64:
    """Time t up to which n·(x + t dx) is no less than the gap.

    It is 0 where it is less at the start, infinite where it never is.
    """
    height, rate = wp.dot(n, x), wp.dot(n, dx)
    if height < gap:
        return wp.float64(0.0)
    if rate < wp.float64(0.0):
        return (gap - height) / rate
    return wp.float64(wp.inf)


@wp.func
def time_to_plane(
    ee: wp.bool,
    n: wp.vec3d,
    x0: wp.vec3d,
    x1: wp.vec3d,
    x2: wp.vec3d,
    x3: wp.vec3d,
    d0: wp.vec3d,
    d1: wp.vec3d,
    d2: wp.vec3d,
    d3: wp.vec3d,
    gap: wp.float64,
) -> wp.float64:
    """Time t until which two primitives stay a ``gap`` apart along the unit vector n."""
    t = wp.min(time_to_gap(n, x0 - x2, d0 - d2, gap), time_to_gap(n, x0 - x3, d0 - d3, gap))
    if ee:
        return wp.min(t, wp.min(time_to_gap(n, x1 - x2, d1 - d2, gap), time_to_gap(n, x1 - x3, d1 - d3, gap)))
    return wp.min(t, time_to_gap(n, x0 - x1, d0 - d1, gap))


@wp.func
def first_root(g0: wp.float64, g1: wp.float64, g2: wp.float64, g3: wp.float64, t_max: wp.float64) -> wp.float64:
    """Time t in [0, t_max] up to which g0 + g1 t + g2 t² + g3 t³ is not negative.

    It is near the first root, and 0 where g0 is not positive.

    From each t to the root of a parabola below the cubic: that with its value and slope there, and its least second derivative.
    """
    zero, two, six = wp.float64(0.0), wp.float64(2.0), wp.float64(6.0)
    t = wp.float64(0.0)
    for _ in range(ROOT_STEPS):
        value = g0 + t * (g1 + t * (g2 + t * g3))
        slope = g1 + t * (two * g2 + wp.float64(3.0) * t * g3)
        curvature = two * g2 + six * g3 * wp.where(g3 < zero, t_max, t)
        square = slope * slope - two * curvature * value
        if value <= zero:
            return t
        if square < zero or (slope >= zero and curvature >= zero):
            return t_max
        t += two * value / (wp.sqrt(square) - slope)
        if t >= t_max:
            return t_max
    return t


@wp.func
def time_to_meet(
    w0: wp.vec3d,
    w1: wp.vec3d,
    u0: wp.vec3d,
    u1: wp.vec3d,
    v0: wp.vec3d,
    v1: wp.vec3d,
    gap: wp.float64,
    t_max: wp.float64,
) -> wp.float64:
    """Time t, at most t_max, until which two lines stay a ``gap`` from each other.

    They run along u0 + t u1 and v0 + t v1, and w0 + t w1 joins them.

    A point and a plane likewise, with u and v in the plane. What rounding of u × v can make of the distance is taken off.
    """
    n0, n1, n2 = wp.cross(u0, v0), wp.cross(u0, v1) + wp.cross(u1, v0), wp.cross(u1, v1)
    n0_error = ROUNDING * (wp.length(u0) + t_max * wp.length(u1)) * (wp.length(v0) + t_max * wp.length(v1))
    f0, f1, f2, f3 = wp.dot(w0, n0), wp.dot(w1, n0) + wp.dot(w0, n1), wp.dot(w1, n1) + wp.dot(w0, n2), wp.dot(w1, n2)
    side = wp.float64(1.0)
    if f0 < wp.float64(0.0):
        side = wp.float64(-1.0)
    g0 = side * f0 - gap * wp.length(n0) - n0_error * wp.length(w0)
    g1 = side * f1 - gap * wp.length(n1) - n0_error * wp.length(w1)
    return first_root(g0, g1, side * f2 - gap * wp.length(n2), side * f3, t_max)


@wp.func
def allowed_gap(start: wp.float64, slack: wp.float64, floor: wp.float64, least: wp.float64) -> wp.float64:
    """Distance [m] at which :func:`additive_ccd` stops for a pair at the distance ``start``."""
    most = wp.float64(0.999)
    return wp.max(wp.max(slack * start, wp.min(floor, most * start)), most * wp.min(least, start))


@wp.func
def allowed_end(start: wp.float64, slack: wp.float64, floor: wp.float64, least: wp.float64) -> wp.float64:
    """Least distance [m] at the end of the advance."""
    return wp.max(allowed_gap(start, slack, floor, least), wp.min(least, start))


@wp.func
def additive_ccd(
    ee: wp.bool,
    x0: wp.vec3d,
    x1: wp.vec3d,
    x2: wp.vec3d,
    x3: wp.vec3d,
    d0: wp.vec3d,
    d1: wp.vec3d,
    d2: wp.vec3d,
    d3: wp.vec3d,
    slack: wp.float64,
    floor: wp.float64,
    least: wp.float64,
    t_max: wp.float64,
) -> wp.float64:
    """The largest t in [0, t_max] that keeps ``slack`` of the distance of the pair.

    Nor may it fall below ``floor`` [m]; a pair that is already there may hardly come closer. At t it is not below ``least`` [m]; a pair
    that is already there is no closer than it was.
    """
    zero = wp.float64(0.0)
    mean = wp.float64(0.25) * (d0 + d1 + d2 + d3)
    s0, s1, s2, s3 = wp.length(d0 - mean), wp.length(d1 - mean), wp.length(d2 - mean), wp.length(d3 - mean)
    speed = s0 + wp.max(wp.max(s1, s2), s3)
    if ee:
        speed = wp.max(s0, s1) + wp.max(s2, s3)
    if speed == zero:
        return t_max
    # What remains of a distance grows with it, so that of the boxes may say that there is enough.
    apart = box_gap(ee, x0, x1, x2, x3)
    if apart > zero and apart - allowed_end(apart, slack, floor, least) > speed * t_max:
        return t_max
    coef = pair_coefficients(ee, x0, x1, x2, x3)
    along = separation(coef, x0, x1, x2, x3)
    start = wp.length(along)
    if start == zero:
        return zero
    gap = allowed_gap(start, slack, floor, least)
    end = allowed_end(start, slack, floor, least)
    if start - end > speed * t_max:
        return t_max
    t, safe, d = zero, zero, start
    y0, y1, y2, y3 = x0 + wp.vec3d(), x1 + wp.vec3d(), x2 + wp.vec3d(), x3 + wp.vec3d()
    for _ in range(MAX_ADVANCES):
        # The next time at which the distance could have fallen to the gap; the safety factor covers rounding.
        ahead = wp.max((d - gap) / speed, time_to_plane(ee, along / d, y0, y1, y2, y3, d0, d1, d2, d3, gap))
        if ahead < t_max - t:
            turning = separation(coef, d0, d1, d2, d3)
            u, du = y2 - y1, d2 - d1
            v, dv = y3 - y1, d3 - d1
            if ee:
                u, du = y1 - y0, d1 - d0
                v, dv = y3 - y2, d3 - d2
            ahead = wp.max(ahead, time_to_meet(along, turning, u, du, v, dv, gap, t_max - t))
        t_next = t + SAFETY * ahead + wp.float64(1.0e-15)
        if t_next >= t_max:
            if end == gap:
                return t_max
            t_next = t_max
        before = d
        y0, y1, y2, y3 = x0 + t_next * d0, x1 + t_next * d1, x2 + t_next * d2, x3 + t_next * d3
        coef = pair_coefficients(ee, y0, y1, y2, y3)
        along = separation(coef, y0, y1, y2, y3)
        d = wp.length(along)
        if d > gap and d >= end:
            safe = t_next
        # A pair that parts goes on however small its advances are: they grow with the distance.
        if t_next == t_max or d <= gap * wp.float64(1.001) or (t_next - t < wp.float64(1.0e-6) and d <= before):
            return safe
        t = t_next
    return safe


@wp.kernel
def ccd_pairs(
    x: VecArray2d,
    dx: VecArray2d,
    surface: Surface,
    candidates: Candidates,
    ee: wp.bool,
    slack: FloatArray,
    floor: FloatArray,
    reach: FloatArray,
    active: IntArray,
    threads: wp.int32,
    # outputs
    alpha: FloatArray,
):
    """Lower alpha[env] to what the edge-edge (``ee``) or point-triangle pairs allow.

    By (environment, thread).
    """
    env, first = wp.tid()
    if active[env] == 0:
        return
    least = RESOLUTION * reach[env]
    # What limits no pair measured at the distance ``near`` limits none measured farther apart.
    _near, most = bounds_of(candidates, env, candidates.near)
    only = only_near(candidates, env, wp.float64(2.0) * allowed_end(most, slack[env], floor[env], least))
    for k in range(first, listed(candidates, ee, env, only), threads):
        i = listed_at(candidates, ee, env, only, k)
        # What remains of a distance grows with it, so that a lower bound of it may say that there is enough.
        near, most = gap_bounds(candidates, ee, env, i)
        if near > wp.float64(2.0) * allowed_end(most, slack[env], floor[env], least):
            continue
        v = pair_vertices(surface, ee, pair_at(candidates, ee, env, i))
        bound = alpha[env] + wp.float64(0.0)
        t = additive_ccd(
            ee,
            x[env, v[0]],
            x[env, v[1]],
            x[env, v[2]],
            x[env, v[3]],
            dx[env, v[0]],
            dx[env, v[1]],
            dx[env, v[2]],
            dx[env, v[3]],
            slack[env],
            floor[env],
            least,
            bound,
        )
        if t < bound:
            wp.atomic_min(alpha, env, t)


@wp.kernel
def ccd_plane(
    x: VecArray2d,
    dx: VecArray2d,
    surface: Surface,
    R0: MatArray2d,
    t0: VecArray2d,
    R1: MatArray2d,
    t1: VecArray2d,
    slack: FloatArray,
    floor: FloatArray,
    reach: FloatArray,
    active: IntArray,
    # outputs
    alpha: FloatArray,
):
    """Lower alpha[env] to what half-spaces allow, which move from frame 0 to frame 1."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    v, body = surface.plane_vert[i], surface.plane_body[i]
    A, B = R0[env, body], R1[env, body]
    d0 = wp.dot(wp.vec3d(A[0, 2], A[1, 2], A[2, 2]), x[env, v] - t0[env, body])
    d1 = wp.dot(wp.vec3d(B[0, 2], B[1, 2], B[2, 2]), x[env, v] + dx[env, v] - t1[env, body])
    gap = wp.max(slack[env] * d0, wp.min(floor[env], wp.float64(0.999) * d0))
    gap = wp.max(gap, wp.min(RESOLUTION * reach[env], d0))
    if d1 < gap:
        wp.atomic_min(alpha, env, (d0 - gap) / (d0 - d1))
