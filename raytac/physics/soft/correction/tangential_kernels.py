"""Kernels of ``TangentialCorrection``: the share of the spread that friction has let happen."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.soft.correction.plane_kernels import Lines, Moments, displaced, fit, moments, sampled

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def vector(values: wp.array2d(dtype=wp.float64), env: wp.int32, v: wp.int32, vertices: wp.int32) -> wp.vec2d:
    """Entries of a vertex in numbers along x and then y, (B, 2 V)."""
    return wp.vec2d(values[env, v], values[env, vertices + v])


@wp.func
def moved(values: wp.array3d(dtype=wp.float64), env: wp.int32, v: wp.int32) -> wp.vec2d:
    return wp.vec2d(values[env, 0, v], values[env, 1, v])


@wp.kernel
def find_shares(
    touched: wp.array(dtype=wp.int32), touching: wp.array2d(dtype=wp.int32), rest: wp.array(dtype=wp.vec3d),
    displacement: wp.array3d(dtype=wp.float64), pattern: wp.array2d(dtype=wp.float64),
    # outputs
    share: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Share in [0, 1] of a ``pattern`` (B, 2 V) in the displacement of what touches, besides rigid motions."""
    env = wp.tid()
    share[env] = _0
    if touched[env] == 0:
        return
    vertices, total = len(rest), Moments()
    for v in range(vertices):
        if touching[env, v] != 0:
            total += moments(_1, wp.vec2d(rest[v][0], rest[v][1]), moved(displacement, env, v))
    count = total[0]
    if not (count > _0):
        share[env] = _1
        return
    motion, middle = fit(total), wp.vec2d(total[1] / count, total[2] / count)
    mean_u, mean_p, size, turn_u, turn_p = wp.vec2d(), wp.vec2d(), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            place = wp.vec2d(rest[v][0], rest[v][1])
            u, p, arm = moved(displacement, env, v) - displaced(motion, place), vector(pattern, env, v, vertices), place - middle
            mean_u += u / count
            mean_p += p / count
            size += wp.length_sq(arm)
            # The arms sum to 0, so means have no part in these.
            turn_u += arm[0] * u[1] - arm[1] * u[0]
            turn_p += arm[0] * p[1] - arm[1] * p[0]
    size = wp.max(size, wp.float64(1e-24))
    pu, pp = wp.float64(0.0), wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            place = wp.vec2d(rest[v][0], rest[v][1])
            arm = place - middle
            turn = wp.vec2d(-arm[1], arm[0])
            u = moved(displacement, env, v) - displaced(motion, place) - mean_u - (turn_u / size) * turn
            p = vector(pattern, env, v, vertices) - mean_p - (turn_p / size) * turn
            pu += wp.dot(p, u)
            pp += wp.dot(p, p)
    share[env] = wp.where(pp > _0, wp.clamp(pu / pp, _0, _1), _1)


@wp.kernel
def spread_waves(
    active: wp.array(dtype=wp.int32), spread_x: wp.array3d(dtype=wp.float32), spread_y: wp.array3d(dtype=wp.float32),
    waves: wp.array3d(dtype=wp.float32),
    # outputs
    x: wp.array3d(dtype=wp.float32),
    y: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Amplitudes of the layer's displacement sideways under normal pressure, by (environment, row)."""
    env, row = wp.tid()
    if active[env] == 0:
        return
    for i in range(x.shape[2]):
        x[env, row, i] = spread_x[0, row, i] * waves[env, row, i]
        y[env, row, i] = spread_y[0, row, i] * waves[env, row, i]


@wp.kernel
def correct_spread(
    touched: wp.array(dtype=wp.int32), corrects: wp.int32, rest: wp.array(dtype=wp.vec3d), lines: Lines,
    field_x: wp.array3d(dtype=wp.float32), field_y: wp.array3d(dtype=wp.float32), sides: wp.array3d(dtype=wp.float32),
    displacement: wp.array3d(dtype=wp.float64), mesh: wp.array2d(dtype=wp.float64), share: wp.array(dtype=wp.float64),
    # outputs
    sideways: wp.array2d(dtype=wp.float64),
    dragged: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Displacement u − θ (E − L) and what friction has dragged, u − θ E, (B, 2 V) [m], by (environment, vertex)."""
    env, v = wp.tid()
    vertices = len(rest)
    u = moved(displacement, env, v)
    result, drag = wp.vec2d(u[0], u[1]), wp.vec2d(u[0], u[1])
    if touched[env] != 0:
        θ = share[env]
        E = vector(mesh, env, v, vertices)
        drag = u - θ * E
        if corrects != 0:
            place = wp.vec2d(rest[v][0], rest[v][1]) + u
            L = wp.vec2d(
                sampled(field_x, env, lines, place) - wp.float64(sides[0, env, v]),
                sampled(field_y, env, lines, place) - wp.float64(sides[0, env, vertices + v]),
            )
            result = u - θ * (E - L)
    sideways[env, v] = result[0]
    sideways[env, vertices + v] = result[1]
    dragged[env, v] = drag[0]
    dragged[env, vertices + v] = drag[1]
