"""Shear of the gel under contacts: rings that stretch, slip and remember (``shear``)."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.shear import LEAST_RINGS, MOST_RINGS
from raytac.physics.rigid.world_kernels import Shear

wp.set_module_options({"enable_backward": False, "fast_math": False})

_RINGS = wp.constant(wp.int32(MOST_RINGS))
_MOST = wp.constant(wp.float64(MOST_RINGS))
_LEAST = wp.constant(wp.float64(LEAST_RINGS))
"""Least rings of a contact: from these to the most, loads differ by a factor of 2.4.

Within it a contact may vibrate while its rings keep their width."""
_FRESH = wp.constant(wp.float64(0.01))
"""Squared stretch of a ring's outer part over the inner's from which both join."""
_PLAY = wp.constant(wp.float64(0.125))
"""Share of the radius that a centroid may jitter over gel and body without rolling."""
_TINY = wp.constant(wp.float64(1e-30))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.func
def begin_shear(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, stiffness: wp.vec2d, centre: wp.vec3d) -> wp.vec3d:
    """Elastic force along two tangents and torque about the normal of a contact.

    Args:
        stiffness: against shear and twist.
        centre: where a new contact starts [m].

    What a contact has grown by since the last step is without stretch; what it has shrunk by leaves with its own.
    """
    before = shear.stiffness[env, pad, body]
    if before[0] > _0:
        width = shear.width[env, pad, body]
        size = stiffness[0] / width
        if stiffness[0] < before[0]:
            shrink(shear, env, pad, body, size)
            while size < _LEAST:
                width *= _HALF
                size *= _2
                halve_width(shear, env, pad, body, size)
        elif stiffness[0] > before[0]:
            old = before[0] / width
            while size > _MOST and width < stiffness[0]:
                double_width(shear, env, pad, body, old)
                width *= _2
                size *= _HALF
                old *= _HALF
            grow(shear, env, pad, body, old, size, stiffness[1] / stiffness[0])
        shear.width[env, pad, body] = width
    else:
        shear.centre[env, pad, body] = centre
        shear.width[env, pad, body] = _2 * stiffness[0] / _MOST
    shear.stiffness[env, pad, body] = stiffness
    size = stiffness[0] / shear.width[env, pad, body]
    total = wp.vec3d()
    k = wp.int32(0)
    while k < _RINGS and wp.float64(k) < size:
        low = wp.float64(k)
        if low + _1 <= size:  # not the outermost: where the load vibrates, its halves would join and slip in every cycle
            halve_whole(shear, env, pad, body, k)
        edge, high = low + shear.inner[env, pad, body, k], wp.min(low + _1, size)
        total += wp.cw_mul(weight(low, edge), shear.stretch[env, pad, body, 2 * k])
        total += wp.cw_mul(weight(edge, high), shear.stretch[env, pad, body, 2 * k + 1])
        k += 1
    return wp.cw_mul(wp.vec3d(stiffness[0], stiffness[0], stiffness[1]), wp.cw_div(total, weight(_0, size)))


@wp.func
def weight(low: wp.float64, high: wp.float64) -> wp.vec3d:
    """Ring's share of stiffness along two tangents and about the normal: radius and its cube."""
    along = high - low
    return wp.vec3d(along, along, along * (low * low + low * high + high * high))


@wp.func
def mean(low: wp.float64, edge: wp.float64, high: wp.float64, inner: wp.vec3d, outer: wp.vec3d) -> wp.vec3d:
    """Stretch of a ring from ``low`` to ``high`` that carries as much as its two parts."""
    total = wp.cw_mul(weight(low, edge), inner) + wp.cw_mul(weight(edge, high), outer)
    return wp.cw_div(total, weight(low, high))


@wp.func
def shrink(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, size: wp.float64):
    """Drop what lies beyond ``size`` [widths of rings]."""
    k = wp.int32(0)
    while k < _RINGS:
        covered = wp.max(size - wp.float64(k), _0)
        if covered < _1:
            if covered <= shear.inner[env, pad, body, k]:
                shear.inner[env, pad, body, k] = covered
                shear.stretch[env, pad, body, 2 * k + 1] = wp.vec3d()
            if covered == _0:
                shear.stretch[env, pad, body, 2 * k] = wp.vec3d()
        k += 1


@wp.func
def grow(
    shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, old: wp.float64, size: wp.float64, twist: wp.float64
):  # fmt: skip
    """Add rings without stretch from ``old`` to ``size`` [widths of rings].

    ``twist``: twist over shear stiffness [m²]. New area of a ring that has some joins the outer part. Before it does, the outer part
    joins the inner one, so that the same area leaves again when the contact shrinks. An outer part that is next to without stretch stays:
    of minima of the load the deepest counts.
    """
    k = wp.int32(old)
    low, inner, part = wp.float64(k), shear.inner[env, pad, body, k], old - wp.float64(k)
    if part > _0 and part < _1 and size > old:  # a stiffness that grows by its last digit may not change the size
        first, second = shear.stretch[env, pad, body, 2 * k], shear.stretch[env, pad, body, 2 * k + 1]
        scale = wp.vec3d(_1, _1, twist)
        if wp.dot(wp.cw_mul(second, scale), second) >= _FRESH * wp.dot(wp.cw_mul(first, scale), first):
            shear.stretch[env, pad, body, 2 * k] = mean(low, low + inner, old, first, second)
            shear.stretch[env, pad, body, 2 * k + 1] = wp.vec3d()
            shear.inner[env, pad, body, k] = part
        else:
            high = wp.min(low + _1, size)
            shear.stretch[env, pad, body, 2 * k + 1] = mean(low + inner, old, high, second, wp.vec3d())


@wp.func
def double_width(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, size: wp.float64):
    """Rings of twice the width, each from two of a contact of ``size`` [widths of rings]."""
    k = wp.int32(0)
    while k < _RINGS:
        one, two = 2 * k, 2 * k + 1
        inner, first, second = wp.float64(0.0), wp.vec3d(), wp.vec3d()
        low = wp.float64(one)
        if low < size:
            inner = _HALF * shear.inner[env, pad, body, one]
            first += shear.stretch[env, pad, body, 2 * one]
            second += shear.stretch[env, pad, body, 2 * one + 1]
            middle, high = low + _1, wp.min(low + _2, size)
            if high > middle:
                first = mean(low, low + _2 * inner, middle, first, second)
                edge, third = middle + shear.inner[env, pad, body, two], shear.stretch[env, pad, body, 2 * two]
                second = mean(middle, edge, high, third, shear.stretch[env, pad, body, 2 * two + 1])
                inner = _HALF
        shear.inner[env, pad, body, k] = inner
        shear.stretch[env, pad, body, 2 * k] = first
        shear.stretch[env, pad, body, 2 * k + 1] = second
        k += 1


@wp.func
def halve_width(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, size: wp.float64):
    """Rings of half the width, two of each inner one, for a contact of ``size`` [new widths]."""
    k = _RINGS // 2 - 1
    while k >= 0:
        inner = _2 * shear.inner[env, pad, body, k]
        # Products are copies: an element by itself would be read where it is used, after it has been written.
        first, second = _1 * shear.stretch[env, pad, body, 2 * k], _1 * shear.stretch[env, pad, body, 2 * k + 1]
        one, two = 2 * k, 2 * k + 1
        shear.inner[env, pad, body, one] = wp.min(inner, _1)
        shear.inner[env, pad, body, two] = wp.max(inner - _1, _0)
        shear.stretch[env, pad, body, 2 * one] = first
        shear.stretch[env, pad, body, 2 * one + 1] = wp.where(inner < _1, second, wp.vec3d())
        shear.stretch[env, pad, body, 2 * two] = wp.where(inner > _1, first, wp.vec3d())
        shear.stretch[env, pad, body, 2 * two + 1] = wp.where(wp.float64(two) < size, second, wp.vec3d())
        k -= 1


@wp.func
def halve_whole(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, k: wp.int32):
    """Let both halves of a ring slip by themselves, if one part is all of it."""
    inner = shear.inner[env, pad, body, k]
    if inner <= _0:
        shear.stretch[env, pad, body, 2 * k] = shear.stretch[env, pad, body, 2 * k + 1]
        shear.inner[env, pad, body, k] = _HALF
    elif inner >= _1:
        shear.stretch[env, pad, body, 2 * k + 1] = shear.stretch[env, pad, body, 2 * k]
        shear.inner[env, pad, body, k] = _HALF


@wp.func
def limits_of(stiffness: wp.vec2d, limit: wp.vec2d) -> wp.vec2d:
    """Stretch [m] and rotation [rad] at which the centre slips: rings carry ``limit``."""
    return wp.vec2d(
        wp.float64(1.5) * limit[0] / wp.max(stiffness[0], _TINY), wp.float64(2.5) * limit[1] / wp.max(stiffness[1], _TINY)
    )


@wp.func
def share_that_sticks(
    shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, displacement: wp.vec3d, limit: wp.vec2d
) -> wp.float64:
    """Stiffness against a displacement over that without slip; 0 if all would slip.

    The displacement is one that may come in the step, ``limit`` as in ``move_shear``.
    """
    stiffness = shear.stiffness[env, pad, body]
    centre = limits_of(stiffness, limit)
    size = stiffness[0] / shear.width[env, pad, body]
    total, slips = wp.vec3d(), wp.bool(True)
    k = wp.int32(0)
    while k < 2 * _RINGS and wp.float64(k // 2) < size:
        ring = wp.float64(k // 2)
        edge, high = ring + shear.inner[env, pad, body, k // 2], wp.min(ring + _1, size)
        low = edge
        if k % 2 == 0:
            low, high = ring, edge
        if high > low:
            before = shear.stretch[env, pad, body, k]
            ahead = before + displacement
            after = slipped(ahead, centre[0], centre[1], low / size, high / size)
            if after == ahead:
                slips = wp.bool(False)
            total += wp.cw_mul(weight(low, high), after - before)
        k += 1
    if slips:
        return _0
    scale = wp.vec3d(stiffness[0], stiffness[0], stiffness[1])
    full = wp.dot(wp.cw_mul(scale, displacement), displacement)
    taken = wp.dot(wp.cw_mul(scale, displacement), wp.cw_div(total, weight(_0, size)))
    if full > _0:
        return wp.clamp(taken / full, _TINY, _1)
    return _1


@wp.func
def move_shear(
    shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, displacement: wp.vec3d, limit: wp.vec2d, centre: wp.vec3d,
    radius: wp.float64,
):  # fmt: skip
    """Add a step's displacement and let rings slip.

    ``limit``: force and torque of slip [N, N m] at the load of the step; ``centre`` of the contact at the start of the step and its
    ``radius`` [m]. Gel that leaves the contact as it rolls on takes its stretch with it: over the contact's diameter.
    """
    stiffness, reach = shear.stiffness[env, pad, body], wp.max(radius, wp.float64(0.5e-9))
    largest = limits_of(stiffness, limit)
    along, about = largest[0], largest[1]
    kept = wp.exp(-rolled(shear, env, pad, body, centre, reach) / (_2 * reach))
    size = stiffness[0] / shear.width[env, pad, body]
    total = wp.vec3d()
    k = wp.int32(0)
    while k < _RINGS and wp.float64(k) < size:
        low = wp.float64(k)
        edge, high = low + shear.inner[env, pad, body, k], wp.min(low + _1, size)
        if edge > low:
            stretch = kept * slipped(shear.stretch[env, pad, body, 2 * k] + displacement, along, about, low / size, edge / size)
            shear.stretch[env, pad, body, 2 * k] = stretch
            total += wp.cw_mul(weight(low, edge), stretch)
        if high > edge:
            stretch = kept * slipped(
                shear.stretch[env, pad, body, 2 * k + 1] + displacement, along, about, edge / size, high / size
            )
            shear.stretch[env, pad, body, 2 * k + 1] = stretch
            total += wp.cw_mul(weight(edge, high), stretch)
        k += 1
    shear.mean[env, pad, body] = wp.cw_div(total, weight(_0, size))
    shear.load[env, pad, body] = limit
    shear.centre[env, pad, body] = centre
    shear.moved[env, pad, body] = wp.vec2d(displacement[0], displacement[1])


@wp.func
def slipped(stretch: wp.vec3d, along: wp.float64, about: wp.float64, low: wp.float64, high: wp.float64) -> wp.vec3d:
    """Stretch of a ring between two radii over the contact's, within its limits.

    These are those of the centre times the ring's mean of 1 − y². The mean is over its stiffness, which is as y along the tangents and as
    y³ about the normal.
    """
    square = low * low + low * high + high * high
    fourth = low * low * low * (low + high) + high * high * (low * low + low * high + high * high)
    one = wp.max(along * (_1 - square / wp.float64(3.0)), _TINY)
    two = wp.max(about * (_1 - wp.float64(0.6) * fourth / square), _TINY)
    return stretch / wp.max(wp.length(wp.vec3d(stretch[0] / one, stretch[1] / one, stretch[2] / two)), _1)


@wp.func
def rolled(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, centre: wp.vec3d, radius: wp.float64) -> wp.float64:
    """Distance [m] rolled in the last step: what the centre travels over gel and body alike.

    A body that shears the gel, or slides, takes the centre with it or leaves it where it is on the gel: one of both is zero. Between
    two gels the centre goes half as far as the body, and back over it.
    """
    travel = centre - shear.centre[env, pad, body]
    over_gel = wp.vec2d(travel[0], travel[1])
    over_body = over_gel - shear.moved[env, pad, body]
    one, two = shear.play[env, pad, body, 0] + over_gel, shear.play[env, pad, body, 1] + over_body
    first, second = wp.max(wp.length(one) - _PLAY * radius, _0), wp.max(wp.length(two) - _PLAY * radius, _0)
    shear.play[env, pad, body, 0] = (_1 - first / wp.max(wp.length(one), _TINY)) * one
    shear.play[env, pad, body, 1] = (_1 - second / wp.max(wp.length(two), _TINY)) * two
    if wp.dot(one, two) > _0:
        return wp.min(first, second)
    return _0


@wp.func
def clear_shear(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32):
    """Forget a contact."""
    k = wp.int32(0)
    while k < _RINGS:
        shear.stretch[env, pad, body, 2 * k] = wp.vec3d()
        shear.stretch[env, pad, body, 2 * k + 1] = wp.vec3d()
        shear.inner[env, pad, body, k] = _0
        k += 1
    shear.width[env, pad, body] = _0
    shear.mean[env, pad, body] = wp.vec3d()
    shear.stiffness[env, pad, body] = wp.vec2d()
    shear.load[env, pad, body] = wp.vec2d()
    shear.centre[env, pad, body] = wp.vec3d()
    shear.play[env, pad, body, 0] = wp.vec2d()
    shear.play[env, pad, body, 1] = wp.vec2d()
    shear.moved[env, pad, body] = wp.vec2d()
