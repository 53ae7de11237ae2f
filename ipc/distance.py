"""Closest points of a point and a triangle and of two edges, in float64, as coefficients of the four vertices.

Every distance is that of t = Σ_i c_i x_i. Near a closest point the coefficients do not change the distance to first order (the envelope
theorem), so ∂D/∂x_i = 2 c_i t for D = ‖t‖², whichever features are closest.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

__all__ = ["edge_edge_coefficients", "point_triangle_coefficients", "separation"]

wp.set_module_options({"enable_backward": False})


@wp.func
def point_segment_parameter(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """s in [0, 1] of the point a + s (b − a) closest to p."""
    ab = b - a
    return wp.clamp(wp.dot(p - a, ab) / wp.dot(ab, ab), wp.float64(0.0), wp.float64(1.0))


@wp.func
def point_triangle_coefficients(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4d:
    """(1, −w_a, −w_b, −w_c) with the barycentric weights w of the triangle's point closest to p.

    Voronoi regions of a triangle, after Ericson 2004, "Real-Time Collision Detection", section 5.1.5.
    """
    zero, one = wp.float64(0.0), wp.float64(1.0)
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= zero and d2 <= zero:
        return wp.vec4d(one, -one, zero, zero)
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= zero and d4 <= d3:
        return wp.vec4d(one, zero, -one, zero)
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        s = d1 / (d1 - d3)
        return wp.vec4d(one, s - one, -s, zero)
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= zero and d5 <= d6:
        return wp.vec4d(one, zero, zero, -one)
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero:
        s = d2 / (d2 - d6)
        return wp.vec4d(one, s - one, zero, -s)
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 >= d3 and d5 >= d6:
        s = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec4d(one, zero, s - one, -s)
    scale = one / (va + vb + vc)
    wb, wc = vb * scale, vc * scale
    return wp.vec4d(one, wb + wc - one, -wb, -wc)


@wp.func
def edge_edge_coefficients(a0: wp.vec3d, a1: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d) -> wp.vec4d:
    """(1 − s, s, t − 1, −t) with the closest points a0 + s (a1 − a0) and b0 + t (b1 − b0).

    The least of the four point-edge distances and, unless the edges are parallel, of the distance of the two lines: no branch depends
    on how nearly parallel they are.
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
    uu, vv, uv = wp.dot(u, u), wp.dot(v, v), wp.dot(u, v)
    uw, vw = wp.dot(u, w), wp.dot(v, w)
    normal2 = uu * vv - uv * uv
    if normal2 > wp.float64(0.0):
        ss = (uv * vw - vv * uw) / normal2
        tt = (uu * vw - uv * uw) / normal2
        if ss > zero and ss < one and tt > zero and tt < one:
            d = wp.length_sq(w + ss * u - tt * v)
            if d < best:
                s, t = ss, tt
    return wp.vec4d(one - s, s, t - one, -t)


@wp.func
def separation(c: wp.vec4d, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.vec3d:
    """t = Σ c_i x_i [m]; the coefficients sum to zero, so differences to x0 keep the digits far from the origin."""
    return c[1] * (x1 - x0) + c[2] * (x2 - x0) + c[3] * (x3 - x0)
