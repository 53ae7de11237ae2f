"""Motions in the plane, and fields on evenly spaced nodes, for kernels."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


class Moments(wp.types.vector(length=8, dtype=wp.float64)):
    """Σ w (1, x, y, dx, dy, x² + y², x dy − y dx, 0) of displacements d of places (x, y)."""


@wp.struct
class PlaneMotion:
    """Rigid motion in the plane, of less than a quarter turn."""

    centre: wp.vec2d
    """[m]."""
    shift: wp.vec2d
    """Displacement of the centre [m]."""
    sine: wp.float64
    """Sine of the rotation about +z."""


@wp.struct
class Lines:
    """Evenly spaced nodes: first one, spacing [m] and number along x and y."""

    origin: wp.vec2d
    pitch: wp.vec2d
    count: wp.vec2i


@wp.func
def moments(w: wp.float64, place: wp.vec2d, d: wp.vec2d) -> Moments:
    x, y = place[0], place[1]
    return Moments(w, w * x, w * y, w * d[0], w * d[1], w * (x * x + y * y), w * (x * d[1] - y * d[0]), _0)


@wp.func
def fit(s: Moments) -> PlaneMotion:
    """The motion nearest to displacements, of their moments with positive weights."""
    centre, shift = wp.vec2d(s[1] / s[0], s[2] / s[0]), wp.vec2d(s[3] / s[0], s[4] / s[0])
    size = s[5] / s[0] - wp.dot(centre, centre)
    moment = s[6] / s[0] - (centre[0] * shift[1] - centre[1] * shift[0])
    result = PlaneMotion()
    result.centre = centre
    result.shift = shift
    result.sine = _0
    # Of a single place only rounding remains.
    if size > wp.float64(1e-12) * wp.dot(centre, centre):
        result.sine = moment / size
    return result


@wp.func
def displaced(motion: PlaneMotion, place: wp.vec2d) -> wp.vec2d:
    """Displacement of a place [m]."""
    arm = place - motion.centre
    shorter = wp.sqrt(wp.max(_1 - motion.sine * motion.sine, _0)) - _1
    return motion.shift + motion.sine * wp.vec2d(-arm[1], arm[0]) + shorter * arm


@wp.func
def follow(motion: PlaneMotion, goal: PlaneMotion, mean: PlaneMotion) -> PlaneMotion:
    """A motion plus the difference of ``goal`` and ``mean``, taken at its centre."""
    result = PlaneMotion()
    result.centre = motion.centre
    result.shift = motion.shift + displaced(goal, motion.centre) - displaced(mean, motion.centre)
    result.sine = motion.sine + goal.sine - mean.sine
    return result


@wp.func
def node_at(lines: Lines, row: wp.int32, i: wp.int32) -> wp.vec2d:
    return lines.origin + wp.vec2d(wp.float64(i) * lines.pitch[0], wp.float64(row) * lines.pitch[1])


@wp.func
def sampled(field: wp.array3d(dtype=wp.float32), env: wp.int32, lines: Lines, place: wp.vec2d) -> wp.float64:
    """Bilinear interpolation; beyond the edges the value at the edge is taken."""
    t = wp.cw_div(place - lines.origin, lines.pitch)
    a = wp.clamp(t[0], _0, wp.float64(lines.count[0] - 1))
    b = wp.clamp(t[1], _0, wp.float64(lines.count[1] - 1))
    i, j = wp.min(wp.int32(a), lines.count[0] - 2), wp.min(wp.int32(b), lines.count[1] - 2)
    a, b = a - wp.float64(i), b - wp.float64(j)
    near = (_1 - a) * wp.float64(field[env, j, i]) + a * wp.float64(field[env, j, i + 1])
    far = (_1 - a) * wp.float64(field[env, j + 1, i]) + a * wp.float64(field[env, j + 1, i + 1])
    return (_1 - b) * near + b * far


@wp.kernel
def sort_waves(
    active: wp.array(dtype=wp.int32), factor: wp.array3d(dtype=wp.float32), waves: wp.array3d(dtype=wp.float32),
    # outputs
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Amplitudes times a factor, even waves before odd ones along both axes.

    By (environment, row).
    """
    env, row = wp.tid()
    if active[env] == 0:
        return
    rows, count = (waves.shape[1] + 1) / 2, (waves.shape[2] + 1) / 2
    k = 2 * row
    if row >= rows:
        k = 2 * (row - rows) + 1
    into, source, share = out[env, row], waves[env, k], factor[0, k]
    i = wp.int32(0)
    while i < count:
        into[i] = source[2 * i] * share[2 * i]
        i += 1
    i, end = wp.int32(0), waves.shape[2] - count
    while i < end:
        into[count + i] = source[2 * i + 1] * share[2 * i + 1]
        i += 1


@wp.kernel
def unfold(
    active: wp.array(dtype=wp.int32), even: wp.array3d(dtype=wp.float32), odd_x: wp.array3d(dtype=wp.float32),
    odd_y: wp.array3d(dtype=wp.float32), odd: wp.array3d(dtype=wp.float32),
    # outputs
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Field at all nodes, from the sums of even and odd waves at those of a quarter.

    By (environment, row of the quarter).
    """
    env, j = wp.tid()
    if active[env] == 0:
        return
    count, last = even.shape[2], out.shape[2] - 1
    upper, lower = out[env, j], out[env, out.shape[1] - 1 - j]
    a, b, c, d = even[env, j], odd_x[env, j], odd_y[env, j], odd[env, j]
    i = wp.int32(0)
    while i < count:
        near, far = a[i] + b[i], c[i] + d[i]
        upper[i] = near + far
        lower[i] = near - far
        i += 1
    i = wp.int32(0)
    while i < count:
        near, far = a[i] - b[i], c[i] - d[i]
        upper[last - i] = near + far
        lower[last - i] = near - far
        i += 1
