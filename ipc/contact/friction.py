"""Lagged Coulomb friction (Li et al. 2020, section 5).

With the normal force λ, the normal n and the closest points c_i of an earlier iterate held fixed, a pair stores μ λ f0(‖u‖), where
u = (1 − n nᵀ) Σ c_i (x_i − x_i^start) is its sliding since the start of the step and ε = ε_v h:

    f0(y) = y²/ε − y³/(3 ε²) + ε/3 for y < ε, else y;    f1 = f0' = 2y/ε − y²/ε² or 1.

The Hessian μ λ [(f1/y)(1 − û ûᵀ) + f1' û ûᵀ] has no negative eigenvalue: two rows, along û and across it. Below the threshold a pair
under the tangential load r μ λ creeps at ε_v (1 − √(1 − r)).
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, VecArray2d
from ipc.contact.contacts import Contacts, push_row

wp.set_module_options({"enable_backward": False})


@wp.struct
class Lagged:
    """The pairs whose normal force is held fixed; ``limit`` is μ λ [N]."""

    verts: wp.array2d(dtype=wp.vec4i)
    coef: wp.array2d(dtype=wp.vec4d)
    normal: VecArray2d
    limit: FloatArray2d
    pair: IntArray2d
    count: IntArray


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


@wp.kernel
def keep_lagged(lagged: Lagged, active: IntArray, out: Lagged):
    """Copies the lagged pairs of the active environments."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i == 0:
        out.count[env] = lagged.count[env]
    if i < lagged.count[env]:
        out.verts[env, i] = lagged.verts[env, i]
        out.coef[env, i] = lagged.coef[env, i]
        out.normal[env, i] = lagged.normal[env, i]
        out.limit[env, i] = lagged.limit[env, i]


@wp.kernel
def lag_contacts(contacts: Contacts, mu: FloatArray, active: IntArray, out: Lagged):
    """Freezes the contacts of the active environments."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i == 0:
        out.count[env] = wp.min(contacts.count[env], contacts.force.shape[1])
    if i < contacts.count[env]:
        out.verts[env, i] = contacts.verts[env, i]
        out.coef[env, i] = contacts.coef[env, i]
        out.normal[env, i] = contacts.normal[env, i]
        out.limit[env, i] = mu[contacts.pair[env, i]] * contacts.force[env, i]
        out.pair[env, i] = contacts.pair[env, i]


@wp.kernel
def friction_rows(
    x: VecArray2d,
    start: VecArray2d,
    lagged: Lagged,
    eps: wp.float64,
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
        u = sliding(x, start, env, verts, c, n)
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
        p, q = wp.sqrt(limit * friction_curvature(y, eps)), wp.sqrt(limit * ratio)
        if p > wp.float64(0.0):
            push_row(out, env, verts, (p * c[0]) * along, (p * c[1]) * along, (p * c[2]) * along, (p * c[3]) * along)
        push_row(out, env, verts, (q * c[0]) * across, (q * c[1]) * across, (q * c[2]) * across, (q * c[3]) * across)


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
    """Adds the change of the friction potential from x0 to x1 [J]."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        y0 = wp.length(sliding(x0, start, env, verts, c, n))
        y1 = wp.length(sliding(x1, start, env, verts, c, n))
        wp.atomic_add(change, env, lagged.limit[env, i] * (friction_potential(y1, eps) - friction_potential(y0, eps)))


@wp.kernel
def lag_difference(lagged: Lagged, sign: wp.float64, active: IntArray, lanes: wp.int32, force: VecArray2d, size: FloatArray):
    """Adds sign · μ λ c_i n of every lagged pair to its vertices [N], and μ λ to ``size`` [N].

    Called with + for the new and − for the old pairs, it leaves what changed of the normal forces *and* of where they act.
    """
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for i in range(lane, wp.min(lagged.count[env], lagged.limit.shape[1]), lanes):
        verts, c, n = lagged.verts[env, i], lagged.coef[env, i], lagged.normal[env, i]
        for k in range(4):
            if verts[k] >= 0:
                wp.atomic_add(force, env, verts[k], (sign * lagged.limit[env, i] * c[k]) * n)
        if sign > wp.float64(0.0):
            wp.atomic_add(size, env, lagged.limit[env, i])


@wp.kernel
def clear_change(active: IntArray, change: VecArray2d, force: FloatArray, changed: FloatArray):
    env, v = wp.tid()
    if active[env] == 0:
        return
    change[env, v] = wp.vec3d()
    if v == 0:
        force[env] = wp.float64(0.0)
        changed[env] = wp.float64(0.0)


@wp.kernel
def size_of_change(change: VecArray2d, active: IntArray, size: FloatArray2d):
    env, v = wp.tid()
    if active[env] != 0:
        size[env, v] = wp.length(change[env, v])


@wp.kernel
def share_of_change(force: FloatArray, active: IntArray, changed: FloatArray):
    """changed ← changed / Σ μ λ."""
    env = wp.tid()
    if active[env] != 0:
        changed[env] = changed[env] / wp.max(force[env], wp.float64(1.0e-300))
