"""Closest points of a point and a triangle and of two edges, as vertex coefficients.

Every distance is that of t = Σ_i c_i x_i. Near a closest point the coefficients do not change the distance to first order (the envelope
theorem), so ∂D/∂x_i = 2 c_i t for D = ‖t‖², whichever features are closest.
"""

# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def point_segment_parameter(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """s in [0, 1] of the point a + s (b − a) closest to p."""
    ab = b - a
    return wp.clamp(wp.dot(p - a, ab) / wp.dot(ab, ab), wp.float64(0.0), wp.float64(1.0))


@wp.func
def point_triangle_coefficients(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4d:
    """(1, −w_a, −w_b, −w_c) with the barycentric weights w of the triangle's point closest to p.

    The least of the distances to the three edges and, above the triangle, to its plane. The weight of c is a triple product, so it keeps
    its digits in a thin triangle; the weight of b is then a projection, which makes up for the rounding of the first.
    """
    zero, one = wp.float64(0.0), wp.float64(1.0)
    ab, ac, ap = b - a, c - a, p - a
    wb, wc = point_segment_parameter(p, a, b), zero
    best = wp.length_sq(ap - wb * ab)
    s = point_segment_parameter(p, a, c)
    d = wp.length_sq(ap - s * ac)
    if d < best:
        wb, wc, best = zero, s, d
    s = point_segment_parameter(p, b, c)
    d = wp.length_sq(ap - (one - s) * ab - s * ac)
    if d < best:
        wb, wc, best = one - s, s, d
    n = wp.cross(ab, ac)
    n2 = wp.length_sq(n)
    if n2 > zero:
        sc = wp.dot(wp.cross(ab, ap), n) / n2
        sb = wp.dot(ap - sc * ac, ab) / wp.dot(ab, ab)
        if sc > zero and sb > zero and sb + sc < one:
            d = wp.length_sq(ap - sb * ab - sc * ac)
            if d < best:
                wb, wc = sb, sc
    return wp.vec4d(one, wb + wc - one, -wb, -wc)


@wp.func
def edge_edge_coefficients(a0: wp.vec3d, a1: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d) -> wp.vec4d:
    """(1 − s, s, t − 1, −t) with the closest points a0 + s (a1 − a0) and b0 + t (b1 − b0).

    The least of the four point-edge distances and of the distance between the lines. With n = u × v, that one's s is (v × w)·n / n²:
    the products of dot products u² v² − (u·v)², equal to n² on paper, lose all digits below an angle of 1e-6 rad. At the angle θ rounding
    moves s by about 1e-16/θ along the edge, which alone would be more than a small gap; t is therefore a projection on the other edge,
    and what is left of the error is θ times that, 1e-16 of the edges' length at every angle.
    """
    zero, one = wp.float64(0.0), wp.float64(1.0)
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    s, t = zero, point_segment_parameter(a0, b0, b1)
    best = wp.length_sq(w - t * v)
    tt = point_segment_parameter(a1, b0, b1)
    d = wp.length_sq(w + u - tt * v)
    if d < best:
        s, t, best = one, tt, d
    ss = point_segment_parameter(b0, a0, a1)
    d = wp.length_sq(w + ss * u)
    if d < best:
        s, t, best = ss, zero, d
    ss = point_segment_parameter(b1, a0, a1)
    d = wp.length_sq(w + ss * u - v)
    if d < best:
        s, t, best = ss, one, d
    n = wp.cross(u, v)
    n2 = wp.length_sq(n)
    if n2 > zero:
        ss = wp.clamp(wp.dot(wp.cross(v, w), n) / n2, zero, one)
        tt = wp.clamp(wp.dot(w + ss * u, v) / wp.dot(v, v), zero, one)
        ss = wp.clamp(wp.dot(tt * v - w, u) / wp.dot(u, u), zero, one)
        d = wp.length_sq(w + ss * u - tt * v)
        if d < best:
            s, t = ss, tt
    return wp.vec4d(one - s, s, t - one, -t)


@wp.func
def pair_coefficients(ee: wp.bool, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.vec4d:
    """Coefficients of two edges (``ee``) or of a point and a triangle."""
    if ee:
        return edge_edge_coefficients(x0, x1, x2, x3)
    return point_triangle_coefficients(x0, x1, x2, x3)


@wp.func
def separation(c: wp.vec4d, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.vec3d:
    """t = Σ c_i x_i [m], from differences to x0, which keep digits far from the origin."""
    return c[1] * (x1 - x0) + c[2] * (x2 - x0) + c[3] * (x3 - x0)


@wp.func
def box_gap(ee: wp.bool, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.float64:
    """Gap [m] between the boxes of two edges (``ee``) or of a point and a triangle.

    Negative where they overlap on every axis. The pair is no closer than that; it is less by a share of 1e-9 for rounding.
    """
    low, high, low2, high2 = x0, x0, wp.min(x2, x3), wp.max(x2, x3)
    if ee:
        low, high = wp.min(x0, x1), wp.max(x0, x1)
    else:
        low2, high2 = wp.min(low2, x1), wp.max(high2, x1)
    gap = wp.max(low2 - high, low - high2)
    return wp.float64(1.0 - 1.0e-9) * wp.max(wp.max(gap[0], gap[1]), gap[2])
