"""Load law of a contact from its table, with the gel's hard back, smooth once; in Warp.

Between entries the force is a cubic Hermite spline, and the radius a straight line, over the root of the depth, in which a table is
evenly spaced. The slopes are bounded, so that a spline of rising entries rises everywhere (F. N. Fritsch, R. E. Carlson, SIAM J. Numer.
Anal. 17, 1980). Beyond the last entry the law goes on straight. It is that of ``LoadTables``.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import Rows
from raytac.physics.rigid.contacts import LAW_POINTS
from raytac.physics.rigid.load_law import HARD_FROM, HARD_RISE

wp.set_module_options({"enable_backward": False, "fast_math": False})

_LAST = wp.constant(wp.int32(LAW_POINTS - 1))
_ENTRIES = wp.constant(wp.float64(LAW_POINTS - 1))
_FIRST = wp.constant(wp.float64((0.3 / (LAW_POINTS - 1)) ** 2))
"""Share of the table's depth below which only the stiffness of the first touch counts."""
_HARD_FROM = wp.constant(wp.float64(HARD_FROM))
_HARD_RISE = wp.constant(wp.float64(HARD_RISE))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_3 = wp.constant(wp.float64(3.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Law:
    """Law of one contact."""

    row: wp.int32
    factor: wp.float64
    """Of the modulus, to which the force is proportional."""
    limit: wp.float64
    """Depth [m] at which the body's lowest point would be at the bonded face."""
    thickness: wp.float64
    """Of all gel [m]."""


@wp.func
def slope_between(before: wp.float64, after: wp.float64) -> wp.float64:
    """Slope at an inner entry from the rises on both sides of it."""
    return wp.min(_HALF * (before + after), _3 * wp.min(before, after))


@wp.func
def hard_back(depth: wp.float64, limit: wp.float64, thickness: wp.float64) -> wp.vec2d:
    """Factor of the law near the bonded face, and its derivative [1/m]; ``load_law.hard_back``."""
    remaining = wp.max((limit - depth) / thickness, wp.float64(1e-6))
    above = wp.max(_HARD_FROM / remaining - _1, _0)
    return wp.vec2d(_1 + _HARD_RISE * above * above, _2 * _HARD_RISE * above * _HARD_FROM / (remaining * remaining * thickness))


@wp.func
def force_at(rows: Rows, law: Law, depth: wp.float64) -> wp.vec2d:
    """Force [N] and stiffness [N/m]; at depths <= 0 no force, and that of the first touch."""
    row, deepest = law.row, rows.deepest[law.row]
    deep = wp.max(depth, deepest * _FIRST)
    at = wp.sqrt(deep / deepest) * _ENTRIES
    k = wp.min(wp.int32(at), _LAST - 1)
    t = wp.min(at - wp.float64(k), _1)
    f0, f1 = law.factor * rows.force[row, k], law.factor * rows.force[row, k + 1]
    rise = f1 - f0
    s0 = wp.float64(0.0)
    if k > 0:
        s0 = slope_between(f0 - law.factor * rows.force[row, k - 1], rise)
    s1 = wp.float64(0.0)
    if k + 1 < _LAST:
        s1 = slope_between(rise, law.factor * rows.force[row, k + 2] - f1)
    else:
        s1 = wp.min(wp.max(_2 * rise - s0, _0), _3 * rise)
    bend, twist = _3 * rise - _2 * s0 - s1, s0 + s1 - _2 * rise
    force = f0 + t * (s0 + t * (bend + t * twist))
    stiffness = (s0 + t * (_2 * bend + _3 * t * twist)) * (_HALF * _ENTRIES) / wp.sqrt(wp.min(deep, deepest) * deepest)
    force += stiffness * wp.max(deep - deepest, _0)
    if deep > depth:  # down to no depth at all along the chord
        force *= wp.max(depth, _0) / deep
    hard = hard_back(depth, law.limit, law.thickness)
    return wp.vec2d(force * hard[0], stiffness * hard[0] + force * hard[1])


@wp.func
def radius_at(rows: Rows, law: Law, depth: wp.float64) -> wp.float64:
    """Radius of contact [m]; 0 out of contact."""
    if depth <= _0:
        return _0
    at = wp.sqrt(wp.min(depth / rows.deepest[law.row], _1)) * _ENTRIES
    k = wp.min(wp.int32(at), _LAST - 1)
    low, high = rows.radius[law.row, k], rows.radius[law.row, k + 1]
    return low + (at - wp.float64(k)) * (high - low)
