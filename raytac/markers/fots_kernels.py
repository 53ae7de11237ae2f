"""Kernels of FOTS: what each contact keeps, and the markers' displacements.

Formulas and sources are those of ``raytac.markers.fots``.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import math

import warp as wp

from raytac.markers.contact_kernels import kept_shares
from raytac.markers.contacts import TWIST_SLIP

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TWIST_SLIP = wp.constant(wp.float32(TWIST_SLIP))
_2_PI = wp.constant(wp.float32(2.0 / math.pi))
_LIMIT_STEPS = 3
"""Newton steps of ``kept_shares``: to float32's rounding (a test compares bisection)."""
_NEGLIGIBLE = wp.constant(wp.float32(16.0))
"""Exponent of a Gaussian beyond which it is neglected: float32 cannot add e⁻¹⁶ to 1."""


@wp.struct
class Cells:
    """Cells of the samples [m]: centre of the first, and pitch, along x and y."""

    origin: wp.vec2f
    pitch: wp.vec2f


@wp.struct
class Constants:
    """Constants of one marker motion, as ``MarkerMotionSpec`` names them."""

    dilate_gain: wp.float32
    dilate_lambda: wp.float32
    """Both are the punch's own where there is one."""
    is_punch: wp.int32
    anisotropy: wp.float32
    reach: wp.float32
    slip: wp.float32
    shear_lambda: wp.float32
    shear_max: wp.float32
    twist_lambda: wp.float32
    twist_max: wp.float32


@wp.struct
class Drag:
    """Shear and twist that one contact gives to the skin."""

    active: wp.float32
    """0 or 1."""
    centre: wp.vec2f
    """Place at rest of the skin under the contact's centre [m]."""
    shear: wp.vec2f
    """That the skin keeps [m]."""
    turn: wp.vec2f
    """cos − 1 and sin of the twist that it keeps."""
    ellipse: wp.vec3f
    """T_xx, T_xy, T_yy [m²]."""
    radius: wp.float32
    """Of the disc with the ellipse's area [m]."""


@wp.kernel
def limit(table: wp.array3d(dtype=wp.float64), motion: Constants, drags: wp.array2d(dtype=Drag)):
    """Shear and twist that each contact (B, K) gives to the coat; see ``Contacts.table``."""
    b, k = wp.tid()
    m = motion
    drag = Drag()
    drag.active = wp.float32(table[b, k, 0])
    shear, twist = wp.vec2f(wp.float32(table[b, k, 3]), wp.float32(table[b, k, 4])), wp.float32(table[b, k, 5])
    length = wp.length(shear)
    xx, xy, yy = wp.float32(table[b, k, 6]), wp.float32(table[b, k, 7]), wp.float32(table[b, k, 8])
    depth = wp.float32(table[b, k, 9])
    drag.ellipse = wp.vec3f(xx, xy, yy)
    drag.radius = wp.sqrt(wp.sqrt(wp.max(xx * yy - xy * xy, 1e-24)))
    if m.is_punch == 1:
        shear_max, twist_max = m.slip * depth * drag.radius, _TWIST_SLIP * m.slip * depth
        sheared, turned = kept_shares(length / wp.max(shear_max, 1e-12), wp.abs(twist) / wp.max(twist_max, 1e-12), _LIMIT_STEPS)
        shear, twist = sheared * shear, turned * twist
    else:
        shear = shear * wp.min(1.0, m.shear_max / wp.max(length, 1e-12))
        twist = wp.clamp(twist, -m.twist_max, m.twist_max)
    half = wp.sin(0.5 * twist)
    drag.shear = shear
    drag.turn = wp.vec2f(-2.0 * half * half, wp.sin(twist))  # cos − 1 without cancellation
    drag.centre = wp.vec2f(wp.float32(table[b, k, 1]), wp.float32(table[b, k, 2])) - shear
    drags[b, k] = drag


@wp.func
def beyond_ellipse(x: wp.vec2f, t: wp.vec3f) -> wp.float32:
    """r² − A² of a point ``x`` from the centre of xᵀ T⁻¹ x = 1, A² = √det T; 0 inside.

    The λ > 0 of the confocal ellipse xᵀ (T + λ)⁻¹ x = 1 through the point; these are the equipotentials of an elliptic disc, and
    λ = ‖x‖² − A² for a disc. λ² − b λ + c = 0 with b = ‖x‖² − tr T, c = det T − xᵀ adj(T) x.
    """
    xx, xy, yy = t[0], t[1], t[2]
    b = wp.dot(x, x) - xx - yy
    c = xx * yy - xy * xy - (yy * x[0] * x[0] - 2.0 * xy * x[0] * x[1] + xx * x[1] * x[1])
    beyond = wp.float32(0.0)
    if c < 0.0:
        root = wp.sqrt(wp.max(b * b - 4.0 * c, 0.0))
        # The same root twice, without cancellation on either side of b = 0.
        if b > 0.0:
            beyond = 0.5 * (b + root)
        else:
            beyond = -2.0 * c / wp.max(root - b, 1e-18)
    return beyond


@wp.func
def dragged(place: wp.vec2f, b: wp.int32, drags: wp.array2d(dtype=Drag), m: Constants):
    """Shear and twist of a marker by all contacts of pad ``b``, and its share of dilation.

    ``place``: of the marker at rest [m]. The share is what contacts that stick do not take away, 1 without a punch.
    """
    shear, twist = wp.vec2f(), wp.vec2f()
    shear_sum, twist_sum = wp.float32(0.0), wp.float32(0.0)
    for k in range(drags.shape[1]):
        drag = drags[b, k]
        if drag.active == 0.0:
            continue
        x = place - drag.centre
        turned = wp.vec2f(drag.turn[0] * x[0] - drag.turn[1] * x[1], drag.turn[1] * x[0] + drag.turn[0] * x[1])
        if m.is_punch == 1:
            radius = drag.radius
            beyond = beyond_ellipse(x, drag.ellipse)
            r2, root = radius * radius + beyond, wp.sqrt(beyond)
            asin, g = wp.atan2(radius, root), radius * root / r2
            fade = wp.exp(-beyond / ((wp.sqrt(r2) + radius) * m.reach))
            along = wp.dot(x, drag.shear) / wp.max(wp.dot(x, x), 1e-18) * x
            kg = m.anisotropy * g
            shear += _2_PI * ((fade * asin - kg) * drag.shear + 2.0 * kg * along)
            twist += _2_PI * (asin - g) * turned
            shear_sum += _2_PI * fade * asin
            twist_sum += _2_PI * (asin - g)
        else:
            r2 = wp.dot(x, x)
            ws, wt = wp.exp(-m.shear_lambda * r2), wp.exp(-m.twist_lambda * r2)
            shear += ws * drag.shear
            twist += wt * turned
            shear_sum += ws
            twist_sum += wt
    free = wp.where(m.is_punch == 1, wp.max(1.0 - twist_sum, 0.0), 1.0)
    return shear / wp.max(1.0, shear_sum) + twist / wp.max(1.0, twist_sum), free


@wp.func
def first_cell(x: wp.float32, low: wp.int32, high: wp.int32) -> wp.int32:
    """First cell from ``low`` that is not before ``x`` [cells]; at most ``high``."""
    return wp.int32(wp.clamp(wp.ceil(x), wp.float32(low), wp.float32(high)))


@wp.func
def within_reach(place: wp.vec2f, box: wp.vec4i, cells: Cells, lam: wp.float32):
    """Place of a marker [cells]; columns from, to and rows from, to of the box within its reach."""
    reach = wp.sqrt(_NEGLIGIBLE / lam)
    dx, dy = cells.pitch[0], cells.pitch[1]
    at_x, at_y = (place[0] - cells.origin[0]) / dx, (place[1] - cells.origin[1]) / dy
    c0, c1 = first_cell(at_x - reach / dx, box[0], box[1]), first_cell(at_x + reach / dx, box[0], box[1])
    r0, r1 = first_cell(at_y - reach / dy, box[2], box[3]), first_cell(at_y + reach / dy, box[2], box[3])
    return at_x, at_y, c0, c1, r0, r1


@wp.func
def dilated(
    place: wp.vec2f, b: wp.int32, box: wp.vec4i, depth: wp.array3d(dtype=wp.float32), cells: Cells, lam: wp.float32
) -> wp.vec2f:
    """Σ Δh (M − C) exp(−λ ‖M − C‖²) over cells of the contact's box within a marker's reach.

    ``box``: columns from, to and rows from, to; a cell that nothing touches has a negative depth.
    """
    dx, dy = cells.pitch[0], cells.pitch[1]
    at_x, at_y, c0, c1, r0, r1 = within_reach(place, box, cells, lam)
    x, y = wp.float32(0.0), wp.float32(0.0)
    for r in range(r0, r1):
        ey = (at_y - wp.float32(r)) * dy
        along, total = wp.float32(0.0), wp.float32(0.0)
        for c in range(c0, c1):
            ex = (at_x - wp.float32(c)) * dx
            w = wp.max(depth[b, r, c], wp.float32(0.0)) * wp.exp(-lam * ex * ex)
            total += w
            along += w * ex
        across = wp.exp(-lam * ey * ey)
        x += along * across
        y += total * ey * across
    return wp.vec2f(x, y)


@wp.kernel
def displace(
    xy: wp.array(dtype=wp.vec2f),
    drags: wp.array2d(dtype=Drag),
    boxes: wp.array(dtype=wp.vec4i),
    depth: wp.array3d(dtype=wp.float32),
    cells: Cells,
    motion: Constants,
    # outputs
    moved: wp.array2d(dtype=wp.vec2f),
):
    """Displacements (B, M) [m] of markers at ``xy`` (M,) at rest."""
    b, i = wp.tid()
    box = boxes[b]
    if box[1] <= box[0]:
        moved[b, i] = wp.vec2f()
        return
    place = xy[i]
    drag, free = dragged(place, b, drags, motion)
    gain = free * motion.dilate_gain * cells.pitch[0] * cells.pitch[1]
    if gain > 0.0:
        drag += gain * dilated(place + drag, b, box, depth, cells, motion.dilate_lambda)
    moved[b, i] = drag
