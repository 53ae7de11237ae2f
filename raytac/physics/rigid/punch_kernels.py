"""Stiffness of flat punches by area, perimeter and second moments, in Warp; see ``regions``.

Constants of a gel's law: 2 E*, radius of the widest contact, then stiffening, moment and bend of each entry of its ``LayerResponse``.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.layer_response import ENTRIES
from raytac.physics.rigid.placed_kernels import larger, smaller
from raytac.physics.rigid.regions import CROWDED, FULL, OVAL

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ENTRIES = wp.constant(wp.float64(ENTRIES - 1))
_LAST_ENTRY = wp.constant(wp.int32(ENTRIES - 2))
_FIRST_ENTRY, _ENTRY = wp.constant(wp.int32(2)), wp.constant(wp.int32(3))
"""Of the response in a gel's constants: its place and the numbers of one entry."""
_FULL, _CROWDED = wp.constant(wp.float64(FULL)), wp.constant(wp.float64(CROWDED))
_OVAL, _OVAL_STEP = wp.constant(wp.float64(OVAL[0])), wp.constant(wp.float64(OVAL[1] - OVAL[0]))
_ROUND = wp.constant(wp.float64(1.0 - 1e-6))
"""Ratio of half axes above which an ellipse is a disc."""
_THIN = wp.constant(wp.float64(1e-6))
"""Least second moment over the mean of both."""
_PI = wp.constant(wp.float64(3.141592653589793))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_4 = wp.constant(wp.float64(4.0))
_6 = wp.constant(wp.float64(6.0))
_12 = wp.constant(wp.float64(12.0))
_HALF = wp.constant(wp.float64(0.5))
_QUARTER = wp.constant(wp.float64(0.25))


@wp.func
def radius_of(nodes: wp.float64, cell: wp.float64) -> wp.float64:
    """Radius [m] of a disc with the area of so many nodes, each of ``cell`` [m²]."""
    return wp.sqrt(nodes * cell / _PI)


@wp.func
def response_at(radius: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.vec3d:
    """Stiffening, moment and bend of ``LayerResponse`` for a contact of a radius [m]."""
    at = smaller(wp.sqrt(radius / law[1]), _1) * _ENTRIES
    k = wp.min(wp.int32(at), _LAST_ENTRY)
    t = at - wp.float64(k)
    n = _FIRST_ENTRY + _ENTRY * k
    before = wp.vec3d(law[n], law[n + 1], law[n + 2])
    n += _ENTRY
    return before + t * (wp.vec3d(law[n], law[n + 1], law[n + 2]) - before)


@wp.func
def entry_of(stiffness: wp.float64, law: wp.array(dtype=wp.float64), near: wp.int32) -> wp.int32:
    """Last entry whose disc is not stiffer than a stiffness [N/m], sought from ``near`` on."""
    k = wp.int32(near)
    while k < _LAST_ENTRY and stiffness_of_entry(k + 1, law) <= stiffness:
        k += 1
    while k > 0 and stiffness_of_entry(k, law) > stiffness:
        k -= 1
    return k


@wp.func
def punch_radius(stiffness: wp.float64, law: wp.array(dtype=wp.float64), entry: wp.int32) -> wp.float64:
    """Radius [m] of the flat punch of a stiffness [N/m]; ``entry``: of ``entry_of`` it."""
    below, above = stiffness_of_entry(entry, law), stiffness_of_entry(entry + 1, law)
    a, b = radius_of_entry(entry, law), radius_of_entry(entry + 1, law)
    return a + (b - a) * wp.clamp((stiffness - below) / (above - below), _0, _1)


@wp.func
def radius_of_entry(k: wp.int32, law: wp.array(dtype=wp.float64)) -> wp.float64:
    root = wp.float64(k) / _ENTRIES
    return law[1] * root * root


@wp.func
def stiffness_of_entry(k: wp.int32, law: wp.array(dtype=wp.float64)) -> wp.float64:
    return law[0] * radius_of_entry(k, law) * law[_FIRST_ENTRY + _ENTRY * k]


@wp.func
def compliance_at(radius: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.float64:
    """Depth over force [m/N] of a disc of a radius [m]."""
    at = smaller(wp.sqrt(radius / law[1]), _1) * _ENTRIES
    k = wp.min(wp.int32(at), _LAST_ENTRY)
    n = _FIRST_ENTRY + _ENTRY * k
    before = law[n] + _0
    return _1 / (law[0] * radius * (before + (at - wp.float64(k)) * (law[n + _ENTRY] - before)))


@wp.func
def elliptic_compliance(long: wp.float64, short: wp.float64, law: wp.array(dtype=wp.float64)) -> wp.float64:
    """Depth over force [m/N] of an ellipse of half axes ``long`` >= ``short`` [m]; ``regions``."""
    at_long = compliance_at(long, law)
    ratio = short / long
    if ratio >= _ROUND:
        return at_long
    root = wp.sqrt(ratio)
    mean = _HALF * (_QUARTER * (_1 + ratio) + _HALF * root + wp.sqrt(_HALF * (_1 + ratio) * root))
    share = _HALF * (_1 / mean - _1) / (_1 - root) * root
    at_middle = compliance_at(root * long, law)
    return at_long + share * (at_middle - at_long + root * (compliance_at(short, law) - at_middle))


@wp.func
def flat_punch(
    area: wp.float64, perimeter: wp.float64, xx: wp.float64, xy: wp.float64, yy: wp.float64, law: wp.array(dtype=wp.float64),
) -> wp.vec4d:  # fmt: skip
    """Stiffness of a region [N/m], joint share, and 12 m − 6 and n of its pressure.

    As ``punches`` of ``regions``. Area [m²], perimeter [m] and second moments about the centroid [m²].
    """
    half, apart = _HALF * (xx + yy), wp.sqrt(_QUARTER * (xx - yy) * (xx - yy) + xy * xy)
    long, short = _2 * wp.sqrt(half + apart), _2 * wp.sqrt(larger(half - apart, _THIN * half))
    disc = wp.sqrt(area / _PI)
    filled = area / (_PI * long * short)
    share = smaller(filled / _FULL, _1)
    scale = wp.sqrt(_1 - wp.clamp((filled - _OVAL) / _OVAL_STEP, _0, _1) * (_1 - filled))
    long, short = scale * long, scale * short
    whole = elliptic_compliance(long, short, law)
    added, piece = wp.float64(0.0), wp.float64(disc)
    if share < _1:
        around = larger(perimeter, _2 * _PI * disc)
        piece = _2 * area / around
        cell = piece / wp.sqrt(share)
        narrow = smaller(cell, larger(short, piece))
        added = compliance_at(piece, law) - elliptic_compliance(cell * cell / narrow, narrow, law)
        added = (_1 - _CROWDED * share) * larger(added, _0) * _4 * _PI * area / (around * around)
    stiffness = _1 / (whole + added)
    joint = whole * stiffness
    response = response_at(joint * disc + (_1 - joint) * piece, law)
    return wp.vec4d(stiffness, joint, _12 * response[1] - _6, response[2])
