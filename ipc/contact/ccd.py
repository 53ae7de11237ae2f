"""Additive continuous collision detection: the largest step that keeps every pair apart.

Li, Kaufman, Jiang 2021, "Codimensional Incremental Potential Contact", algorithm 1. After the mean displacement is taken out, no
distance can shrink faster than l = max‖δ_A‖ + max‖δ_B‖ per unit of t, so t may always advance by d/l times a safety factor. The
advance stops when the distance has fallen to ``slack`` of the one at the start.

Distances are known to a few units in the last place of the coordinates (:mod:`ipc.contact.distance`), and positions are rounded once more
when a step is taken. A step therefore never ends with a distance below ``RESOLUTION`` of the largest coordinate, where rounding could put
surfaces through each other; a pair that is closer already may not come closer.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, IntArray, MatArray2d, VecArray2d
from ipc.broad_phase.lists import Candidates, Surface, gap_bounds, pair_at, pair_vertices, pairs_of
from ipc.contact.distance import box_gap, pair_coefficients, separation

wp.set_module_options({"enable_backward": False})

SAFETY = wp.constant(wp.float64(0.9))
MAX_ADVANCES = wp.constant(500)
RESOLUTION = wp.constant(wp.float64(1.0e-13))
"""Least distance after a step over the largest coordinate; some hundred times rounding."""


@wp.func
def pair_distance(ee: wp.bool, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.float64:
    return wp.length(separation(pair_coefficients(ee, x0, x1, x2, x3), x0, x1, x2, x3))


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
    start = pair_distance(ee, x0, x1, x2, x3)
    gap = allowed_gap(start, slack, floor, least)
    end = allowed_end(start, slack, floor, least)
    if start - end > speed * t_max:
        return t_max
    t, safe, d = zero, zero, start
    for _ in range(MAX_ADVANCES):
        # The next time at which the distance could have fallen to the gap; the safety factor covers rounding.
        t_next = t + SAFETY * (d - gap) / speed + wp.float64(1.0e-15)
        if t_next >= t_max:
            if end == gap:
                return t_max
            t_next = t_max
        before = d
        d = pair_distance(ee, x0 + t_next * d0, x1 + t_next * d1, x2 + t_next * d2, x3 + t_next * d3)
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
    # outputs
    alpha: FloatArray,
):
    """Lowers alpha[env] to what the edge-edge (``ee``) or point-triangle pairs allow."""
    env, i = wp.tid()
    if active[env] == 0 or i >= pairs_of(candidates, ee, env):
        return
    near, most = gap_bounds(candidates, ee, env, i)
    if near > wp.float64(2.0) * allowed_end(most, slack[env], floor[env], RESOLUTION * reach[env]):
        return
    v = pair_vertices(surface, ee, pair_at(candidates, ee, env, i))
    bound = alpha[env]
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
        RESOLUTION * reach[env],
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
    """Lowers alpha[env] to what half-spaces allow, which move from frame 0 to frame 1."""
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
