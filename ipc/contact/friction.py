"""Coulomb friction with an elastic slip that contacts remember.

A pair of primitives has an anchor and an elastic slip w: the tangential displacement of the closest points since the anchor. Its
tangential force is μ λ f1(‖w‖) ŵ, with the normal force λ, the normal n and the closest points c_i of an earlier iterate held fixed
(lagged; Li et al. 2020, section 5) and their mollifier as the law of a spring that yields at ‖w‖ = ε:

    w = z + (1 − n nᵀ) Σ c_i (x_i − x_i^start),    E = μ λ f0(‖w‖),
    f0(y) = y²/ε − y³/(3 ε²) + ε/3 for y < ε, else y;    f1 = f0' = 2y/ε − y²/ε² or 1.

z is the elastic slip at the start of the step. At its end the return mapping z ← w min(1, ε/‖w‖) moves the anchor of the pairs that slip,
and of no others. This is plasticity with the yield surface ‖force‖ = μ λ (Simo, Laursen 1992, "An augmented Lagrangian treatment of
contact problems involving friction", section 3); that E is linear beyond ε makes its gradient that mapping's force. While nothing
moves, nothing is forgotten, in any number of steps. The Hessian μ λ [(f1/y)(1 − ŵ ŵᵀ) + f1' ŵ ŵᵀ] has no negative eigenvalue: two rows,
along ŵ and across it.

*Memory.* Slip is kept by pair: of point and triangle, two edges, or point and plane. A pair is known by its vertices. Pairs within d̂ come
and go with the barrier's force, so a new one begins with no slip and hardly a force, and one that has parted is forgotten. Slip kept at
vertices would have to be averaged from the pairs and back in each step, which smooths the tractions away; pairs keep it to the last bit.
Where a contact slides or rolls on to other primitives, a slip of at most ε is lost. A hash of the vertices gives a pair's entry. Where
several pairs share a slot, the lowest index counts, so nothing depends on scheduling.

*Landing.* A pair that was farther apart than d̂ at the start of the step slides only from where it lands. The sliding that its frames make
before is subtracted: with their relative displacement d in the step, and the gap g0 at its start, the pair lands after the share
(g0 − d̂)/(−d·n) of d. Otherwise a ball that is driven down in steps of 0.1 mm would drag gel along that it has not touched yet. Where that
share is above 1, the gap was closed by a body without a frame or by gel that rises, and all of the sliding counts. All of it counts on a
plane too, and where frames slide rather than land.

*Frames.* z turns with one of the two bodies, the one that a frame carries if there is one, so that bodies which turn together keep their
stress. The same turn Q moves the closest points, a gap d apart, by d (n − Qᵀ n) without any slip; that is subtracted. During the step Q is
the turn that the frame is to make in all of it, so that all lags agree. Turns of bodies without a frame count at the end of the step.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, MatArray2d, QuatArray2d, VecArray2d
from ipc.blocks import block_sum
from ipc.contact.contacts import Contacts, push_row

wp.set_module_options({"enable_backward": False})

GUARD_DECAY = wp.constant(wp.float64(0.3))
"""Share of a pair's guard that a Newton step leaves which is shorter than its slip."""


@wp.struct
class Lagged:
    """The pairs whose normal force is held fixed.

    ``fresh`` ones are from the contacts, the others such as an average with older ones kept.

    ``limit`` is μ λ [N], ``slip`` the part of w that the step does not change [m], ``turn`` Q over the step as it was known at the lag,
    and ``swing`` what the gap turned by it [m]. ``guard`` is the share of the majoriser in the curvature (:func:`guard_slips`).
    """

    verts: wp.array2d(dtype=wp.vec4i)
    coef: wp.array2d(dtype=wp.vec4d)
    normal: VecArray2d
    limit: FloatArray2d
    pair: IntArray2d
    slip: VecArray2d
    guard: FloatArray2d
    turn: MatArray2d
    swing: VecArray2d
    count: IntArray
    fresh: IntArray


@wp.struct
class Memory:
    """Elastic slips z [m] at the start of the step, world frame, by pair."""

    verts: wp.array2d(dtype=wp.vec4i)
    pair: IntArray2d
    slip: VecArray2d
    count: IntArray


@wp.struct
class Index:
    """A hash of pairs by their vertices.

    The first entry of each slot and the next of each entry, −1 for none.
    """

    first: IntArray2d
    next: IntArray2d


@wp.struct
class Turning:
    """Turns of bodies since the start of the step.

    Attributes:
        x, y: vertices (B, V) and nodes (B, N) at the start [m].    frame_q, goal_q: frames at the start and at the end (B, frames).
        framed: 1 where a body's frame carries it (bodies,).    node_start: first node of each body and the total.
        frame_p, goal_p: their places [m].    vert_body: body of each vertex (V,).
        body: the body that each body pair's slips turn with (P,).    turn: Q of each body (B, bodies).
    """

    x: VecArray2d
    y: VecArray2d
    frame_q: QuatArray2d
    goal_q: QuatArray2d
    frame_p: VecArray2d
    goal_p: VecArray2d
    framed: IntArray
    node_start: IntArray
    vert_body: IntArray
    body: IntArray
    turn: MatArray2d


@wp.func
def friction_potential(y: wp.float64, eps: wp.float64) -> wp.float64:
    """f0 [m]."""
    if y >= eps:
        return y
    return y * y / eps - y * y * y / (wp.float64(3.0) * eps * eps) + eps / wp.float64(3.0)


@wp.func
def friction_slope_ratio(y: wp.float64, eps: wp.float64) -> wp.float64:
    """f1(y)/y [1/m], finite at 0."""
    if y >= eps:
        return wp.float64(1.0) / y
    return (wp.float64(2.0) - y / eps) / eps


@wp.func
def friction_curvature(y: wp.float64, eps: wp.float64) -> wp.float64:
    """f1'(y) [1/m]."""
    if y >= eps:
        return wp.float64(0.0)
    return wp.float64(2.0) * (wp.float64(1.0) - y / eps) / eps


@wp.func
def sliding(x: VecArray2d, start: VecArray2d, env: wp.int32, verts: wp.vec4i, c: wp.vec4d, n: wp.vec3d) -> wp.vec3d:
    """u, the tangential part of Σ c_i (x_i − start_i) [m]."""
    u = wp.vec3d()
    for i in range(4):
        if verts[i] >= 0:
            u += c[i] * (x[env, verts[i]] - start[env, verts[i]])
    return u - wp.dot(u, n) * n


@wp.func
def rotation_in(A: wp.mat33d) -> wp.mat33d:
    """The rotation nearest to A, by iteration from the identity.

    Müller et al. 2016, "A Robust Method to Extract the Rotational Part of Deformations".
    """
    R = wp.identity(n=3, dtype=wp.float64)
    for _ in range(30):
        turn, size = wp.vec3d(), wp.float64(0.0)
        for k in range(3):
            r, a = wp.vec3d(R[0, k], R[1, k], R[2, k]), wp.vec3d(A[0, k], A[1, k], A[2, k])
            turn += wp.cross(r, a)
            size += wp.dot(r, a)
        angle = wp.length(turn)
        if angle <= wp.float64(1.0e-15) * wp.abs(size) or size == wp.float64(0.0):
            break
        R = wp.quat_to_matrix(wp.quat_from_axis_angle(turn / angle, angle / wp.abs(size))) * R
    return R


@wp.kernel
def turns_ahead(turning: Turning, active: IntArray, turn: MatArray2d):
    """Q of every body over the whole step as its frame is to move; 1 where no frame carries it."""
    env, body = wp.tid()
    if active[env] == 0:
        return
    turn[env, body] = wp.identity(n=3, dtype=wp.float64)
    if turning.framed[body] != 0:
        end, start = turning.goal_q[env, body], turning.frame_q[env, body]
        turn[env, body] = wp.quat_to_matrix(end) * wp.transpose(wp.quat_to_matrix(start))


@wp.kernel
def turns(turning: Turning, y: VecArray2d, R: MatArray2d, active: IntArray, turn: MatArray2d):
    """Q of every body from the start of the step to nodes y and frames R.

    Where no frame carries the body, it is the rotation that fits some of its nodes best, at most about 256.
    """
    env, body = wp.tid()
    if active[env] == 0:
        return
    if turning.framed[body] != 0:
        turn[env, body] = R[env, body] * wp.transpose(wp.quat_to_matrix(turning.frame_q[env, body]))
        return
    first, last = turning.node_start[body], turning.node_start[body + 1]
    step = wp.max((last - first) / 256, 1)
    centre, before, count = wp.vec3d(), wp.vec3d(), wp.float64(0.0)
    for i in range(first, last, step):
        centre += y[env, i]
        before += turning.y[env, i]
        count += wp.float64(1.0)
    A = wp.mat33d()
    for i in range(first, last, step):
        A += wp.outer(y[env, i] - centre / count, turning.y[env, i] - before / count)
    turn[env, body] = rotation_in(A)


@wp.func
def in_tangent_plane(z: wp.vec3d, n: wp.vec3d) -> wp.vec3d:
    """z turned into the plane across n; its length is kept."""
    flat = z - wp.dot(z, n) * n
    length = wp.length(flat)
    if length > wp.float64(0.0):
        return (wp.length(z) / length) * flat
    return flat


@wp.func
def slot_of(verts: wp.vec4i, slots: wp.int32) -> wp.int32:
    """Slot of a pair in the hash."""
    key = wp.uint32(0)
    for k in range(4):
        key = wp.uint32(1000003) * key + wp.uint32(verts[k])
    return wp.int32(key % wp.uint32(slots))


@wp.func
def find_pair(
    index: Index, verts: wp.array2d(dtype=wp.vec4i), pairs: IntArray2d, env: wp.int32, v: wp.vec4i, pair: wp.int32
) -> wp.int32:
    """Entry of a pair, −1 without one.

    Two edges of a body may have the same four vertices as a point and a triangle: the lowest entry counts.
    """
    entry = wp.int32(-1)
    k = index.first[env, slot_of(v, index.first.shape[1])]
    while k >= 0:
        u = verts[env, k]
        if u[0] == v[0] and u[1] == v[1] and u[2] == v[2] and u[3] == v[3] and pairs[env, k] == pair:
            if entry < 0 or k < entry:
                entry = k
        k = index.next[env, k]
    return entry


@wp.kernel
def clear_index(active: IntArray, index: Index):
    """Empty the hash."""
    env, i = wp.tid()
    if active[env] != 0:
        index.first[env, i] = -1


@wp.kernel
def fill_index(verts: wp.array2d(dtype=wp.vec4i), count: IntArray, active: IntArray, index: Index):
    """Enter all pairs into the hash."""
    env, i = wp.tid()
    if active[env] != 0 and i < count[env]:
        index.next[env, i] = wp.atomic_exch(index.first, env, slot_of(verts[env, i], index.first.shape[1]), i)


@wp.func
def copy_pair(pairs: Lagged, env: wp.int32, i: wp.int32, out: Lagged, k: wp.int32):
    """Copy entry i of ``pairs`` to entry k of ``out``."""
    out.verts[env, k] = pairs.verts[env, i]
    out.coef[env, k] = pairs.coef[env, i]
    out.normal[env, k] = pairs.normal[env, i]
    out.limit[env, k] = pairs.limit[env, i]
    out.pair[env, k] = pairs.pair[env, i]
    out.slip[env, k] = pairs.slip[env, i]
    out.guard[env, k] = pairs.guard[env, i]
    out.turn[env, k] = pairs.turn[env, i]
    out.swing[env, k] = pairs.swing[env, i]


@wp.kernel
def keep_lagged(lagged: Lagged, active: IntArray, out: Lagged):
    """Copy the lagged pairs of the active environments."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i == 0:
        out.count[env] = lagged.count[env]
        out.fresh[env] = lagged.fresh[env]
    if i < lagged.count[env]:
        copy_pair(lagged, env, i, out, i)


@wp.kernel
def weigh_fresh(share: FloatArray, active: IntArray, out: Lagged):
    """Multiply the limits of the fresh pairs by their share."""
    env, i = wp.tid()
    if active[env] != 0 and i < out.fresh[env]:
        out.limit[env, i] = share[env] * out.limit[env, i]


@wp.kernel
def add_old(old: Lagged, share: FloatArray, index: Index, active: IntArray, lanes: wp.int32, out: Lagged):
    """Add what the average has of the fresh pairs of the lag before.

    A limit is added to the same pair of the new lag; where that pair has gone, the old one is appended. No pair is kept beyond two lags, so
    there are never more than twice as many as contacts.
    """
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, old.fresh[env], lanes):
        limit = (wp.float64(1.0) - share[env]) * old.limit[env, i]
        entry = find_pair(index, out.verts, out.pair, env, old.verts[env, i], old.pair[env, i])
        if entry >= 0:
            out.limit[env, entry] = out.limit[env, entry] + limit
        elif limit > wp.float64(0.0):
            entry = wp.atomic_add(out.count, env, 1)
            copy_pair(old, env, i, out, entry)
            out.limit[env, entry] = limit


@wp.func
def carried(turning: Turning, env: wp.int32, v: wp.int32) -> wp.vec3d:
    """Displacement [m] of a vertex by its body's frame in the whole step; 0 without one."""
    x, body = turning.x[env, v] + wp.vec3d(), turning.vert_body[v] + 0
    if turning.framed[body] == 0:
        return wp.vec3d()
    local = wp.quat_rotate_inv(turning.frame_q[env, body], x - turning.frame_p[env, body])
    return wp.quat_rotate(turning.goal_q[env, body], local) + turning.goal_p[env, body] - x


@wp.func
def slid_before_contact(
    turning: Turning, env: wp.int32, verts: wp.vec4i, c: wp.vec4d, n: wp.vec3d, turn: wp.mat33d, d_hat: wp.float64
) -> wp.vec3d:
    """Sliding [m] that the frames of a new pair make in the step before it comes within d̂."""
    if verts[1] < 0:  # a plane
        return wp.vec3d()
    gap, d, n_start = wp.float64(0.0), wp.vec3d(), wp.transpose(turn) * n
    for i in range(4):
        gap += c[i] * wp.dot(turning.x[env, verts[i]], n_start)
        d += c[i] * carried(turning, env, verts[i])
    approach = -wp.dot(d, n)
    # What slides, within 1 % of flat, comes near by the tilt of its facets alone.
    if gap <= d_hat or approach <= gap - d_hat or approach <= wp.float64(0.01) * wp.length(d):
        return wp.vec3d()
    return ((gap - d_hat) / approach) * (d - wp.dot(d, n) * n)


@wp.kernel
def lag_contacts(
    turning: Turning,
    contacts: Contacts,
    memory: Memory,
    index: Index,
    mu: FloatArray,
    d_hat: wp.float64,
    relags: IntArray,
    active: IntArray,
    # outputs
    out: Lagged,
):
    """Hold fixed the contacts of the active environments, with what they remember.

    ``relags`` is −1 at the start of the step.
    """
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i == 0:
        out.count[env] = wp.min(contacts.count[env], contacts.force.shape[1])
        out.fresh[env] = out.count[env]
    if i < wp.min(contacts.count[env], contacts.force.shape[1]):
        verts, coef, n, pair = contacts.verts[env, i], contacts.coef[env, i], contacts.normal[env, i], contacts.pair[env, i]
        turn = turning.turn[env, turning.body[pair]]
        swing = contacts.gap[env, i] * (n - wp.transpose(turn) * n)
        if relags[env] < 0:
            swing = contacts.gap[env, i] * (turn * n - n)
        slip = wp.dot(swing, n) * n - swing
        entry = find_pair(index, memory.verts, memory.pair, env, verts, pair)
        if entry >= 0:
            slip += in_tangent_plane(turn * memory.slip[env, entry], n)
        else:
            slip -= slid_before_contact(turning, env, verts, coef, n, turn, d_hat)
        out.verts[env, i] = verts
        out.coef[env, i] = coef
        out.normal[env, i] = n
        out.limit[env, i] = mu[pair] * contacts.force[env, i]
        out.pair[env, i] = pair
        out.slip[env, i] = slip
        out.guard[env, i] = wp.float64(0.0)
        out.turn[env, i] = turn
        out.swing[env, i] = swing


@wp.kernel
def carry_guards(old: Lagged, index: Index, relags: IntArray, active: IntArray, out: Lagged):
    """Let pairs keep their guard where friction is renewed.

    A step begins without, ``relags`` being −1.
    """
    env, i = wp.tid()
    if active[env] == 0 or relags[env] < 0 or i >= out.count[env]:
        return
    entry = find_pair(index, old.verts, old.pair, env, out.verts[env, i], out.pair[env, i])
    if entry >= 0:
        out.guard[env, i] = old.guard[env, entry]


@wp.kernel
def remember(
    x: VecArray2d,
    turning: Turning,
    contacts: Contacts,
    lagged: Lagged,
    index: Index,
    eps: wp.float64,
    active: IntArray,
    # outputs
    memory: Memory,
):
    """Elastic slips of the contacts at the end x of the step, by return mapping.

    They are zero of a pair that had no friction in it.
    """
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i == 0:
        memory.count[env] = wp.min(contacts.count[env], contacts.force.shape[1])
    if i < wp.min(contacts.count[env], contacts.force.shape[1]):
        verts, pair = contacts.verts[env, i], contacts.pair[env, i]
        entry, z = find_pair(index, lagged.verts, lagged.pair, env, verts, pair), wp.vec3d()
        if entry >= 0:
            c, n = lagged.coef[env, entry], lagged.normal[env, entry]
            turn, now = turning.turn[env, turning.body[pair]], contacts.normal[env, i]
            swing = contacts.gap[env, i] * (now - wp.transpose(turn) * now) - lagged.swing[env, entry]
            w = lagged.slip[env, entry] + sliding(x, turning.x, env, verts, c, n) - (swing - wp.dot(swing, n) * n)
            y = wp.length(w)
            if y > eps:
                w = (eps / y) * w
            z = in_tangent_plane(turn * (wp.transpose(lagged.turn[env, entry]) * w), now)
        memory.verts[env, i] = verts
        memory.pair[env, i] = pair
        memory.slip[env, i] = z


@wp.kernel
def friction_rows(
    x: VecArray2d,
    start: VecArray2d,
    lagged: Lagged,
    eps: wp.float64,
    last: FloatArray,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    gradient: VecArray2d,
    out: Contacts,
):
    """Friction forces and rows."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        limit = lagged.limit[env, i]
        if limit <= wp.float64(0.0):
            continue
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        u = lagged.slip[env, i] + sliding(x, start, env, verts, c, n)
        y = wp.length(u)
        ratio = friction_slope_ratio(y, eps)
        for k in range(4):
            if verts[k] >= 0:
                wp.atomic_add(gradient, env, verts[k], (limit * ratio * c[k]) * u)
        along = wp.vec3d()
        if y > wp.float64(0.0):
            along = u / y
        else:
            axis = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
            if wp.abs(n[0]) > wp.float64(0.7):
                axis = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
            along = wp.normalize(axis - wp.dot(axis, n) * n)
        across = wp.cross(n, along)
        # Where Newton's steps are longer than the slip, the law's curvature says nothing of where they lead. The paraboloid that touches
        # the law at y lies above it everywhere (a majoriser: Hunter and Lange, A tutorial on MM algorithms, Am. Stat. 58, 2004).
        share = wp.where(y < last[env], wp.float64(1.0), lagged.guard[env, i])
        curvature = wp.max(share * ratio, friction_curvature(y, eps))
        p, q = wp.sqrt(limit * curvature), wp.sqrt(limit * ratio)
        if p > wp.float64(0.0):
            push_row(out, env, verts, (p * c[0]) * along, (p * c[1]) * along, (p * c[2]) * along, (p * c[3]) * along)
        push_row(out, env, verts, (q * c[0]) * across, (q * c[1]) * across, (q * c[2]) * across, (q * c[3]) * across)


@wp.kernel
def guard_slips(
    x: VecArray2d,
    dx: VecArray2d,
    start: VecArray2d,
    active: IntArray,
    halt: IntArray,
    lanes: wp.int32,
    # outputs
    lagged: Lagged,
):
    """Choose the next Newton step's curvature for pairs whose slip the step dx from x reverses.

    Beyond ε the law has no curvature along the slip, and a pair may jump to and fro across the law's kink. One that would has all of the
    majoriser's curvature in the next step, and less and less in those after, since that converges slowly; it has none where the step
    lengthens the slip beyond twice of what it is, as a body does that begins to slide. Nothing happens while ``halt`` is set, since the
    step is then repeated.
    """
    env, lane = wp.tid()
    if active[env] == 0 or halt[0] != 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        u, s = lagged.slip[env, i] + sliding(x, start, env, verts, c, n), wp.vec3d()
        for k in range(4):
            if verts[k] >= 0:
                s += c[k] * dx[env, verts[k]]
        if wp.dot(u, u + s) < wp.float64(0.0):
            lagged.guard[env, i] = wp.float64(1.0)
        elif wp.dot(u, s) > wp.dot(u, u):
            lagged.guard[env, i] = wp.float64(0.0)
        else:
            lagged.guard[env, i] = GUARD_DECAY * lagged.guard[env, i]


@wp.kernel
def friction_change(
    x0: VecArray2d,
    x1: VecArray2d,
    start: VecArray2d,
    lagged: Lagged,
    eps: wp.float64,
    active: IntArray,
    lanes: wp.int32,
    # outputs
    change: FloatArray,
):
    """Add the change of the friction potential from x0 to x1 [J]."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        y0 = wp.length(lagged.slip[env, i] + sliding(x0, start, env, verts, c, n))
        y1 = wp.length(lagged.slip[env, i] + sliding(x1, start, env, verts, c, n))
        wp.atomic_add(change, env, lagged.limit[env, i] * (friction_potential(y1, eps) - friction_potential(y0, eps)))


@wp.kernel
def lag_difference(lagged: Lagged, sign: wp.float64, active: IntArray, lanes: wp.int32, force: VecArray2d, size: FloatArray2d):
    """Add sign · μ λ c_i n of every lagged pair to its vertices [N], and μ λ to ``size`` [N].

    Called with + for the new and − for the old pairs, it gives the change of the normal forces *and* of where they act. ``size`` has one
    sum for either sign, (B, 2).
    """
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        for k in range(4):
            if verts[k] >= 0:
                wp.atomic_add(force, env, verts[k], (sign * lagged.limit[env, i] * c[k]) * n)
        wp.atomic_add(size, env, wp.int32(sign > wp.float64(0.0)), lagged.limit[env, i])


@wp.kernel
def clear_change(active: IntArray, change: VecArray2d, force: FloatArray2d, changed: FloatArray, worst: FloatArray):
    """Set the sums of ``lag_difference``, and what is made of them, to 0."""
    env, v = wp.tid()
    if active[env] == 0:
        return
    change[env, v] = wp.vec3d()
    if v == 0:
        force[env, 0] = wp.float64(0.0)
        force[env, 1] = wp.float64(0.0)
        changed[env] = wp.float64(0.0)
        worst[env] = wp.float64(0.0)


@wp.kernel
def size_of_change(change: VecArray2d, active: IntArray, size: FloatArray2d):
    """Length of the change at every vertex [N]."""
    env, v = wp.tid()
    if active[env] != 0:
        size[env, v] = wp.length(change[env, v])


@wp.kernel
def share_of_change(force: FloatArray2d, active: IntArray, changed: FloatArray, sum_changed: FloatArray):
    """changed ← changed / Σ μ λ, and sum_changed ← the relative change of Σ μ λ."""
    env = wp.tid()
    if active[env] != 0:
        total = wp.max(force[env, 1], wp.float64(1.0e-300))
        changed[env] = changed[env] / total
        sum_changed[env] = wp.abs(force[env, 1] - force[env, 0]) / total


@wp.kernel
def worst_share(
    lagged: Lagged,
    change: FloatArray2d,
    vert_start: IntArray,
    vert_body: IntArray,
    active: IntArray,
    threads: wp.int32,
    # outputs
    worst: FloatArray,
):
    """Raise ``worst`` to the largest relative change of the forces on one body.

    One block of threads a body.
    ``change`` has the lengths of the changes at vertices [N] (``size_of_change``); a body's vertices begin at ``vert_start``.
    """
    env, body, lane = wp.tid()
    if active[env] == 0:
        return
    part = wp.float64(0.0)
    for v in range(vert_start[body] + lane, vert_start[body + 1], threads):
        part += change[env, v]
    size = block_sum(part)
    if size == wp.float64(0.0):
        return
    part = wp.float64(0.0)
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), threads):
        first, last = lagged.verts[env, i][0], lagged.verts[env, i][3]
        if vert_body[first] == body or vert_body[wp.max(last, 0)] == wp.where(last < 0, -1, body):
            part += lagged.limit[env, i]
    total = block_sum(part)
    if lane == 0:
        wp.atomic_max(worst, env, size / wp.max(total, wp.float64(1.0e-300)))
