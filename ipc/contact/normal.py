"""Contact energy, forces and Hessian of point-triangle, edge-edge and point-plane pairs.

Weights follow ipctk's area weighting: A_v/4 for a point-triangle pair, (A_e + A_f)/4 for two edges, A_v for a point above a plane,
with a third of the adjacent triangles' area for each vertex and edge. Surfaces that are flat over a d̂ carry a pressure near
κ (−∂/∂d)[d̂ b/D̂²], whatever the mesh.

The Hessian is a sum of *rows*, q qᵀ with q of four vertices: already the low-rank form that a Woodbury update needs. An unmollified
pair gives one row, the Gauss-Newton term with k = max(0, 2b' + 4D b''), and two more for each unit tangent e along which its closest
points are free to move. If the edge that is e by the vertices Σ h_i x_i turns, they slide, and the force F = −∂E/∂d has the curvature

    F (2 τ ρ + d ρ²),     τ = e·Σ c_i δx_i,     ρ = n·Σ h_i δx_i,

one positive and one negative eigenvalue. The negative one's row is *concave*: it is subtracted, and left out where the matrix must be
definite. At a rim this curvature, of the order of F over an edge's length, is far above the gel's own. What is left out is F/d across
an edge or a corner, which is negative. A mollified pair gives five rows: two for the 2×2 Hessian in (distance, c), clamped, and three
for the curvature of c.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, IntArray, MatArray2d, VecArray2d
from ipc.broad_phase.lists import Candidates, Surface, gap_bounds, listed, listed_at, only_near, pair_at, pair_vertices
from ipc.contact.barrier import barrier, barrier_first, barrier_second, mollifier, mollifier_first, mollifier_second
from ipc.contact.contacts import Contacts, push_contact, push_matrix, push_row
from ipc.contact.distance import box_gap, pair_coefficients, separation

wp.set_module_options({"enable_backward": False})


@wp.func
def cross_squared(a0: wp.vec3d, a1: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d) -> wp.float64:
    """c = ‖(a1 − a0) × (b1 − b0)‖² [m⁴]."""
    return wp.length_sq(wp.cross(a1 - a0, b1 - b0))


@wp.func
def mollifier_threshold(surface: Surface, a: wp.int32, b: wp.int32) -> wp.float64:
    """eps = 1e-3 ‖a‖² ‖b‖² of the rest edges [m⁴] (Li et al. 2020, supplement, section 5)."""
    return wp.float64(1.0e-3) * surface.edge_rest2[a] * surface.edge_rest2[b]


@wp.func
def pair_weight(surface: Surface, ee: wp.bool, pair: wp.vec3i) -> wp.float64:
    """Area A [m²] of two edges (``ee``) or of a vertex and a face."""
    if ee:
        return wp.float64(0.25) * (surface.edge_area[pair[0]] + surface.edge_area[pair[1]])
    return wp.float64(0.25) * surface.vert_area[pair[0]]


@wp.func
def scale_of(surface: Surface, kappa: wp.float64) -> wp.float64:
    """κ d̂ / D̂² = κ / d̂³ [Pa/m³]."""
    return kappa / (surface.d_hat * surface.d_hat * surface.d_hat)


@wp.func
def push_simple(
    out: Contacts,
    gradient: VecArray2d,
    energy: FloatArray,
    env: wp.int32,
    verts: wp.vec4i,
    coef: wp.vec4d,
    t: wp.vec3d,
    D: wp.float64,
    Dh: wp.float64,
    scale: wp.float64,
    pair: wp.int32,
):
    """Force, contact and row of a pair without mollifier; ``scale`` is A κ/d̂³."""
    d = wp.sqrt(D)
    n = t / d
    first, second = barrier_first(D, Dh), barrier_second(D, Dh)
    slope = scale * wp.float64(2.0) * d * first
    k = wp.sqrt(scale * wp.max(wp.float64(0.0), wp.float64(2.0) * first + wp.float64(4.0) * D * second))
    for i in range(4):
        if verts[i] >= 0:
            wp.atomic_add(gradient, env, verts[i], (slope * coef[i]) * n)
    wp.atomic_add(energy, env, scale * barrier(D, Dh))
    push_contact(out, env, verts, coef, n, d, -slope, pair)
    push_row(out, env, verts, (k * coef[0]) * n, (k * coef[1]) * n, (k * coef[2]) * n, (k * coef[3]) * n)


@wp.func
def push_mollified(
    out: Contacts,
    gradient: VecArray2d,
    energy: FloatArray,
    env: wp.int32,
    verts: wp.vec4i,
    coef: wp.vec4d,
    t: wp.vec3d,
    D: wp.float64,
    Dh: wp.float64,
    scale: wp.float64,
    u: wp.vec3d,
    v: wp.vec3d,
    c: wp.float64,
    eps: wp.float64,
    pair: wp.int32,
):
    """Force, contact and rows of nearly parallel edges along u and v; ``scale`` is A κ/d̂³."""
    zero, two = wp.float64(0.0), wp.float64(2.0)
    d = wp.sqrt(D)
    n = t / d
    first, second = barrier_first(D, Dh), barrier_second(D, Dh)
    f = scale * barrier(D, Dh)
    f_d = scale * two * d * first
    f_dd = scale * (two * first + wp.float64(4.0) * D * second)
    m, m1, m2 = mollifier(c, eps), mollifier_first(c, eps), mollifier_second(c, eps)
    w = wp.cross(u, v)
    ga, gb = two * wp.cross(v, w), two * wp.cross(w, u)  # ∂c/∂a1, ∂c/∂b1
    slope = m * f_d
    wp.atomic_add(gradient, env, verts[0], (slope * coef[0]) * n - (f * m1) * ga)
    wp.atomic_add(gradient, env, verts[1], (slope * coef[1]) * n + (f * m1) * ga)
    wp.atomic_add(gradient, env, verts[2], (slope * coef[2]) * n - (f * m1) * gb)
    wp.atomic_add(gradient, env, verts[3], (slope * coef[3]) * n + (f * m1) * gb)
    wp.atomic_add(energy, env, m * f)
    push_contact(out, env, verts, coef, n, d, -slope, pair)
    # As a function of d and c alone, m f has the Hessian [h00 h01; h01 h11] over their gradients. It is clamped as the matrix that it is
    # in the space of the four vertices, over the orthonormal e1, e2 that span the gradients: ∇d = g e1, ∇c = s e1 + rest e2.
    h00, h01, h11 = m * f_dd, f_d * m1, f * m2
    g = wp.length(coef)
    e1 = wp.matrix_from_cols((coef[0] / g) * n, (coef[1] / g) * n, (coef[2] / g) * n, (coef[3] / g) * n)
    e2 = wp.matrix_from_cols(-ga, ga, -gb, gb)
    s = wp.ddot(e1, e2)
    e2 = e2 - s * e1
    rest = wp.sqrt(wp.ddot(e2, e2))
    if rest > zero:
        e2 = e2 / rest
    k00, k01, k11 = g * g * h00 + two * g * s * h01 + s * s * h11, rest * (g * h01 + s * h11), rest * rest * h11
    mean, half = (k00 + k11) / two, (k00 - k11) / two
    radius = wp.sqrt(half * half + k01 * k01)
    ex, ey = half + radius, k01  # eigenvector of mean + radius
    if half < zero:
        ex, ey = k01, radius - half
    size = wp.sqrt(ex * ex + ey * ey)
    if size > zero:
        ex, ey = ex / size, ey / size
    else:
        ex, ey = wp.float64(1.0), zero
    for k in range(2):
        value = mean + radius
        px, py = ex, ey
        if k == 1:
            value = mean - radius
            px, py = -ey, ex
        if value > zero:
            push_matrix(out, env, verts, wp.sqrt(value) * (px * e1 + py * e2), 0)
    r = wp.sqrt(two * f * m1)
    for k in range(3):
        axis = wp.vec3d(zero, zero, zero)
        axis[k] = r
        ra, rb = wp.cross(v, axis), wp.cross(axis, u)
        push_row(out, env, verts, -ra, ra, -rb, rb)


@wp.func
def push_turn(
    out: Contacts,
    env: wp.int32,
    verts: wp.vec4i,
    coef: wp.vec4d,
    n: wp.vec3d,
    d: wp.float64,
    force: wp.float64,
    along: wp.vec3d,
    turn: wp.vec4d,
):
    """Rows of force (2 τ ρ + d ρ²) for one unit tangent ``along``; ``turn`` are the h [1/m]."""
    half, one = wp.float64(0.5), wp.float64(1.0)
    # τ and ρ scaled to the same length are τ √g and ρ / √g; the form has the matrix [0 1; 1 ratio] in them, and eigenvectors (1, value).
    g = wp.length(turn) / wp.length(coef)
    ratio = d * g
    root = wp.sqrt(ratio * ratio + wp.float64(4.0))
    for k in range(2):
        value = half * (ratio + root)
        if k == 1:
            value = half * (ratio - root)
        size = wp.sqrt(force * wp.abs(value) / (one + value * value))
        a, b = size * wp.sqrt(g), size * value / wp.sqrt(g)
        row = wp.matrix_from_cols(
            (a * coef[0]) * along + (b * turn[0]) * n,
            (a * coef[1]) * along + (b * turn[1]) * n,
            (a * coef[2]) * along + (b * turn[2]) * n,
            (a * coef[3]) * along + (b * turn[3]) * n,
        )
        push_matrix(out, env, verts, row, k)


@wp.func
def push_turns(
    out: Contacts,
    env: wp.int32,
    ee: wp.bool,
    verts: wp.vec4i,
    coef: wp.vec4d,
    t: wp.vec3d,
    force: wp.float64,
    x0: wp.vec3d,
    x1: wp.vec3d,
    x2: wp.vec3d,
    x3: wp.vec3d,
):
    """Rows of a pair that turns, for each edge along which its closest points may move."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    e, f, h, j = wp.vec3d(), wp.vec3d(), wp.vec4d(), wp.vec4d()
    if ee:
        if coef[0] != zero and coef[1] != zero:
            e, h = x1 - x0, wp.vec4d(-one, one, zero, zero)
        if coef[2] != zero and coef[3] != zero:
            f, j = x2 - x3, wp.vec4d(zero, zero, one, -one)
    else:
        if coef[1] != zero and coef[2] != zero:
            e, h = x1 - x2, wp.vec4d(zero, one, -one, zero)
        if coef[1] != zero and coef[3] != zero:
            f, j = x1 - x3, wp.vec4d(zero, one, zero, -one)
        if coef[1] == zero and coef[2] != zero and coef[3] != zero:
            e, h = x2 - x3, wp.vec4d(zero, zero, one, -one)
    d = wp.length(t)
    n = t / d
    length = wp.length(e)
    if length > zero:
        e, h = e / length, h / length
        push_turn(out, env, verts, coef, n, d, force, e, h)
    across = wp.dot(e, f)
    f, j = f - across * e, j - across * h
    length = wp.length(f)
    if length > zero:
        push_turn(out, env, verts, coef, n, d, force, f / length, j / length)


@wp.kernel
def contact_pairs(
    x: VecArray2d,
    surface: Surface,
    candidates: Candidates,
    ee: wp.bool,
    kappa: FloatArray,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    gradient: VecArray2d,
    energy: FloatArray,
    out: Contacts,
):
    """Point-triangle or edge-edge (``ee``) pairs; edges are mollified where nearly parallel."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    only = only_near(candidates, env, surface.d_hat)
    for k in range(lane, listed(candidates, ee, env, only), lanes):
        i = listed_at(candidates, ee, env, only, k)
        near, _most = gap_bounds(candidates, ee, env, i)
        if near >= surface.d_hat:
            continue
        item = pair_at(candidates, ee, env, i)
        verts = pair_vertices(surface, ee, item)
        x0, x1, x2, x3 = x[env, verts[0]], x[env, verts[1]], x[env, verts[2]], x[env, verts[3]]
        if box_gap(ee, x0, x1, x2, x3) >= surface.d_hat:
            continue
        Dh = surface.d_hat * surface.d_hat
        coef = pair_coefficients(ee, x0, x1, x2, x3)
        t = separation(coef, x0, x1, x2, x3)
        D = wp.length_sq(t)
        if Dh <= D:
            continue
        scale = pair_weight(surface, ee, item) * scale_of(surface, kappa[env])
        c, eps = wp.float64(0.0), wp.float64(0.0)
        if ee:
            c, eps = cross_squared(x0, x1, x2, x3), mollifier_threshold(surface, item[0], item[1])
        if c >= eps:
            push_simple(out, gradient, energy, env, verts, coef, t, D, Dh, scale, item[2])
            force = -wp.float64(2.0) * scale * wp.sqrt(D) * barrier_first(D, Dh)
            push_turns(out, env, ee, verts, coef, t, force, x0, x1, x2, x3)
        else:
            push_mollified(out, gradient, energy, env, verts, coef, t, D, Dh, scale, x1 - x0, x3 - x2, c, eps, item[2])


@wp.kernel
def contact_plane(
    x: VecArray2d,
    surface: Surface,
    frame_R: MatArray2d,
    frame_t: VecArray2d,
    kappa: FloatArray,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    gradient: VecArray2d,
    energy: FloatArray,
    out: Contacts,
):
    """Points above half-spaces."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, surface.plane_vert.shape[0], lanes):
        v, body = surface.plane_vert[i], surface.plane_body[i]
        R = frame_R[env, body]
        n = wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        d = wp.dot(n, x[env, v] - frame_t[env, body])
        if d < surface.d_hat:
            scale = surface.vert_area[v] * scale_of(surface, kappa[env])
            zero, Dh, verts = wp.float64(0.0), surface.d_hat * surface.d_hat, wp.vec4i(v, -1, -1, -1)
            coef = wp.vec4d(wp.float64(1.0), zero, zero, zero)
            push_simple(out, gradient, energy, env, verts, coef, d * n, d * d, Dh, scale, surface.plane_pair[i])


@wp.func
def pair_energy(x: VecArray2d, surface: Surface, env: wp.int32, ee: wp.bool, pair: wp.vec3i) -> wp.float64:
    """Energy of two edges (``ee``) or of a vertex and a face, over κ/d̂³ [m⁶]."""
    v = pair_vertices(surface, ee, pair)
    x0, x1, x2, x3 = x[env, v[0]], x[env, v[1]], x[env, v[2]], x[env, v[3]]
    if box_gap(ee, x0, x1, x2, x3) >= surface.d_hat:
        return wp.float64(0.0)
    b = barrier(wp.length_sq(separation(pair_coefficients(ee, x0, x1, x2, x3), x0, x1, x2, x3)), surface.d_hat * surface.d_hat)
    if b == wp.float64(0.0):
        return b
    energy = pair_weight(surface, ee, pair) * b
    if ee:
        energy = energy * mollifier(cross_squared(x0, x1, x2, x3), mollifier_threshold(surface, pair[0], pair[1]))
    return energy


@wp.kernel
def energy_pairs(
    x0: VecArray2d,
    x1: VecArray2d,
    surface: Surface,
    candidates: Candidates,
    ee: wp.bool,
    kappa: FloatArray,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    change: FloatArray,
):
    """Add the energy change of edge-edge (``ee``) or point-triangle pairs [J]."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    only = only_near(candidates, env, surface.d_hat)
    for k in range(lane, listed(candidates, ee, env, only), lanes):
        i = listed_at(candidates, ee, env, only, k)
        near, _most = gap_bounds(candidates, ee, env, i)
        if near >= surface.d_hat:
            continue
        pair = pair_at(candidates, ee, env, i)
        e = pair_energy(x1, surface, env, ee, pair) - pair_energy(x0, surface, env, ee, pair)
        if e != wp.float64(0.0):
            wp.atomic_add(change, env, scale_of(surface, kappa[env]) * e)


@wp.kernel
def energy_plane(
    x0: VecArray2d,
    x1: VecArray2d,
    surface: Surface,
    frame_R: MatArray2d,
    frame_t: VecArray2d,
    kappa: FloatArray,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    change: FloatArray,
):
    """Add the change of the point-plane energy from x0 to x1 [J]."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, surface.plane_vert.shape[0], lanes):
        v, body = surface.plane_vert[i], surface.plane_body[i]
        R = frame_R[env, body]
        n = wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        d0 = wp.dot(n, x0[env, v] - frame_t[env, body])
        d1 = wp.dot(n, x1[env, v] - frame_t[env, body])
        if d0 < surface.d_hat or d1 < surface.d_hat:
            Dh = surface.d_hat * surface.d_hat
            e = surface.vert_area[v] * (barrier(d1 * d1, Dh) - barrier(d0 * d0, Dh))
            wp.atomic_add(change, env, scale_of(surface, kappa[env]) * e)
