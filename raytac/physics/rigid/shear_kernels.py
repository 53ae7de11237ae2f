"""Shear of the gel under contacts in Warp: elements in parallel that stretch, slip and remember (see ``shear``)."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.shear import ELEMENTS, element_limits
from raytac.physics.rigid.world_kernels import Shear

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ELEMENTS = wp.constant(wp.int32(ELEMENTS))
_COUNT = wp.constant(wp.float64(ELEMENTS))
_STRENGTH = wp.constant(wp.float64(float(element_limits()[-1] / (1.0 - (0.5 / ELEMENTS) ** 2))))
"""Displacement over u₀ at which the last element would slip, if none of it stuck."""
_PLAY = wp.constant(wp.float64(0.125))
"""Share of the contact's radius that its centre may go to and fro over gel and body without rolling: the centroid of nodes jitters."""
_TINY = wp.constant(wp.float64(1e-30))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.func
def begin_shear(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, stiffness: wp.vec2d, centre: wp.vec3d) -> wp.vec3d:
    """Elastic force along two tangents and torque about the normal of a contact of shear and twist stiffness.

    ``centre`` [m] is where a new one starts. A contact that has grown since keeps its force, since new area comes without stress; one
    that has shrunk keeps its stretch.
    """
    before = shear.stiffness[env, pad, body]
    if not before[0] > _0:
        shear.centre[env, pad, body] = centre
    sheared, twisted = wp.min(before[0] / stiffness[0], _1), wp.min(before[1] / stiffness[1], _1)
    total = wp.vec3d()
    k = wp.int32(0)
    while k < _ELEMENTS:
        stretch = wp.cw_mul(shear.stretch[env, pad, body, k], wp.vec3d(sheared, sheared, twisted))
        shear.stretch[env, pad, body, k] = stretch
        total += stretch
        k += 1
    shear.stiffness[env, pad, body] = stiffness
    return wp.cw_mul(wp.vec3d(stiffness[0], stiffness[0], stiffness[1]), total / _COUNT)


@wp.func
def move_shear(
    shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, displacement: wp.vec3d, limit: wp.vec2d, centre: wp.vec3d,
    radius: wp.float64,
):  # fmt: skip
    """Add a step's displacement and let elements slip.

    ``limit``: force and torque of slip [N, N m] at the load of the step; ``centre`` of the contact at the start of the step and its
    ``radius`` [m]. Gel that leaves the contact as it rolls on takes its stretch with it: over the contact's diameter.
    """
    stiffness, size = shear.stiffness[env, pad, body], wp.max(radius, wp.float64(0.5e-9))
    along = wp.float64(1.5) * limit[0] / wp.max(stiffness[0], _TINY)
    about = wp.float64(1.5) * limit[1] / wp.max(stiffness[1], _TINY)
    kept = wp.exp(-rolled(shear, env, pad, body, centre, size) / (wp.float64(2.0) * size))
    k = wp.int32(0)
    while k < _ELEMENTS:
        stuck = _1 - (wp.float64(k) + _HALF) / _COUNT
        share = _STRENGTH * (_1 - stuck * stuck)
        stretch = shear.stretch[env, pad, body, k] + displacement
        one, two = wp.max(along * share, _TINY), wp.max(about * share, _TINY)
        part = wp.vec3d(stretch[0] / one, stretch[1] / one, stretch[2] / two)
        shear.stretch[env, pad, body, k] = (kept / wp.max(wp.length(part), _1)) * stretch
        k += 1
    shear.load[env, pad, body] = limit
    shear.centre[env, pad, body] = centre
    shear.moved[env, pad, body] = wp.vec2d(displacement[0], displacement[1])


@wp.func
def rolled(shear: Shear, env: wp.int32, pad: wp.int32, body: wp.int32, centre: wp.vec3d, radius: wp.float64) -> wp.float64:
    """Distance [m] that a contact has rolled on in the last step: what its centre travels over gel and body alike.

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
    while k < _ELEMENTS:
        shear.stretch[env, pad, body, k] = wp.vec3d()
        k += 1
    shear.stiffness[env, pad, body] = wp.vec2d()
    shear.load[env, pad, body] = wp.vec2d()
    shear.centre[env, pad, body] = wp.vec3d()
    shear.play[env, pad, body, 0] = wp.vec2d()
    shear.play[env, pad, body, 1] = wp.vec2d()
    shear.moved[env, pad, body] = wp.vec2d()
