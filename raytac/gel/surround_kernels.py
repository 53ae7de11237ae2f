"""Kernels of ``ElasticSurround``: Gaussians along columns and rows, contact, height.

Fields are rows of packets, vectors of neighbouring nodes as long as the arrays say. A thread of a Gaussian computes one packet in each of
``ROWS`` rows, so that what it reads is used as often. Fields are 0 where the Gaussians so far do not reach from the overlap's window, and
neither computed nor read there. ``first`` is the environment of the working arrays' first row.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

ROWS = 4
"""Rows that a thread smooths together."""
_0 = wp.constant(wp.float32(0.0))
_TINY = wp.constant(wp.float32(1.1754944e-38))
_INF = wp.constant(wp.float32(float("inf")))
_NAN = wp.constant(wp.float64(float("nan")))


@wp.func
def packets(first: wp.int32, last: wp.int32, reach: wp.int32, lanes: wp.int32, count: wp.int32) -> wp.vec2i:
    """Packets, from and to, of the columns from ``first`` to ``last`` and ``reach`` around."""
    return wp.vec2i(wp.max(first - reach, 0) // lanes, wp.min((last + reach - 1) // lanes + 1, count))


@wp.func
def is_reached(j: wp.int32, box: wp.vec4i, reach: wp.int32):
    """True if one of ``ROWS`` rows from j on is in the box or ``reach`` around it."""
    return box[1] > 0 and j + ROWS > box[2] - reach and j < box[3] + reach


@wp.kernel
def along_columns(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    before: wp.vec2i,
    after: wp.vec2i,
    weights: wp.array2d(dtype=wp.vec4f),
    band: wp.array(dtype=wp.vec2i),
    threads: wp.int32,
    source_first: wp.int32,
    source: wp.array3d(dtype=Any),
    # outputs
    out: wp.array3d(dtype=Any),
):
    """Σ_k weights[j, k] source[k, i] of ``ROWS`` rows j, over the ``band`` that is not 0.

    ``window``: columns from, to and rows from, to of the overlap; ``before``: nodes along x and y to which ``source`` reaches around it,
    and ``after`` this Gaussian; ``threads``: that share the packets of a row.
    """
    row, block, thread = wp.tid()
    box, j = window[first + row], block * ROWS
    if is_reached(j, box, after[1]):
        none = out.dtype()
        columns = packets(box[0], box[1], before[0], len(none), out.shape[2])
        low, high = wp.max(band[block][0], box[2] - before[1]), wp.min(band[block][1], box[3] + before[1])
        for p in range(columns[0] + thread, columns[1], threads):
            a, b, c, d = out.dtype(), out.dtype(), out.dtype(), out.dtype()
            for k in range(low, high):
                f, w = source[source_first + row, k, p], weights[block, k]
                a += w[0] * f
                b += w[1] * f
                c += w[2] * f
                d += w[3] * f
            out[row, j, p] = a
            out[row, j + 1, p] = b
            out[row, j + 2, p] = c
            out[row, j + 3, p] = d


@wp.kernel
def along_rows(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    before: wp.vec2i,
    after: wp.vec2i,
    weights: wp.array2d(dtype=Any),
    band: wp.array(dtype=wp.vec2i),
    threads: wp.int32,
    source: wp.array3d(dtype=wp.float32),
    overlap: wp.array3d(dtype=Any),
    imposes: wp.int32,
    # outputs
    out: wp.array3d(dtype=Any),
):
    """Σ_k weights[k, i] source[j, k] of ``ROWS`` rows j.

    With ``imposes`` it is the overlap if that is more.

    The others are as of ``along_columns``.
    """
    row, block, thread = wp.tid()
    env, j = first + row, block * ROWS
    box = window[env]
    if is_reached(j, box, after[1]):
        none = out.dtype()
        columns = packets(box[0], box[1], after[0], len(none), out.shape[2])
        touched = packets(box[0], box[1], 0, len(none), out.shape[2])
        is_touched = imposes != 0 and is_reached(j, box, 0)
        for p in range(columns[0] + thread, columns[1], threads):
            a, b, c, d = out.dtype(), out.dtype(), out.dtype(), out.dtype()
            for k in range(wp.max(band[p][0], box[0] - before[0]), wp.min(band[p][1], box[1] + before[0])):
                w = weights[k, p]
                a += source[row, j, k] * w
                b += source[row, j + 1, k] * w
                c += source[row, j + 2, k] * w
                d += source[row, j + 3, k] * w
            if is_touched and p >= touched[0] and p < touched[1]:
                a = wp.max(a, overlap[env, j, p])
                b = wp.max(b, overlap[env, j + 1, p])
                c = wp.max(c, overlap[env, j + 2, p])
                d = wp.max(d, overlap[env, j + 3, p])
            out[row, j, p] = a
            out[row, j + 1, p] = b
            out[row, j + 2, p] = c
            out[row, j + 3, p] = d


@wp.kernel
def impose(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    overlap: wp.array3d(dtype=Any),
    deepest: wp.array(dtype=wp.float32),
    scale: wp.float32,
    # outputs
    field: wp.array3d(dtype=Any),
):
    """Set one row of the field to the overlap where that is above ``scale`` of the deepest."""
    row, j = wp.tid()
    env = first + row
    box, least = window[env], scale * deepest[env]
    if j >= box[2] and j < box[3]:
        w = field[row, j, 0]
        columns = packets(box[0], box[1], 0, len(w), field.shape[2])
        for p in range(columns[0], columns[1]):
            u = overlap[env, j, p]
            w = field[row, j, p]
            for n in range(len(w)):
                w[n] = wp.where(u[n] > least, u[n], w[n])
            field[row, j, p] = w


@wp.kernel
def touch(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    overlap: wp.array3d(dtype=Any),
    field: wp.array3d(dtype=Any),
    deepest: wp.array(dtype=wp.float32),
    scale: wp.float32,
    rounding: wp.float32,
    x: wp.array(dtype=wp.float64),
    # outputs
    contact: wp.array3d(dtype=Any),
    moments: wp.array2d(dtype=wp.vec2d),
):
    """1 in contact along one row, and the sums there of the overlap and of its moment along x.

    Contact is where the overlap is above ``scale`` of the deepest; with a negative one where the displacement is the overlap, up to
    ``rounding`` of the deepest.
    """
    row, j = wp.tid()
    env = first + row
    box, total = window[env], wp.vec2d()
    touched, none = contact.dtype(), contact.dtype()
    lanes, columns = len(touched), wp.vec2i(0, 0)
    if j >= box[2] and j < box[3]:
        columns = packets(box[0], box[1], 0, lanes, overlap.shape[2])
    least = wp.max(scale * deepest[env], _0)
    slack = wp.where(scale >= _0, _INF, wp.max(rounding * deepest[env], _TINY))
    for p in range(contact.shape[2]):
        if p < columns[0] or p >= columns[1]:
            contact[env, j, p] = none
        else:
            u, w = overlap[env, j, p], field[row, j, p]
            for n in range(lanes):
                is_touched = u[n] > least and w[n] <= u[n] + slack
                touched[n] = wp.where(is_touched, wp.uint8(1), wp.uint8(0))
                if is_touched:
                    weight = wp.float64(u[n])
                    total += wp.vec2d(weight, weight * x[p * lanes + n])
            contact[env, j, p] = touched
    moments[row, j] = total


@wp.kernel
def find_centre(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    moments: wp.array2d(dtype=wp.vec2d),
    y: wp.array(dtype=wp.float64),
    # outputs
    centre: wp.array(dtype=wp.vec2d),
    lost: wp.array(dtype=wp.int32),
):
    """Overlap-weighted centre of each contact [m], NaN for none; none is ``lost`` so far."""
    row = wp.tid()
    box, weight, at = window[first + row], wp.float64(0.0), wp.vec2d()
    for j in range(box[2], box[3]):
        m = moments[row, j]
        weight += m[0]
        at += wp.vec2d(m[1], m[0] * y[j])
    centre[first + row] = wp.vec2d(_NAN, _NAN)
    if weight > wp.float64(0.0):
        centre[first + row] = at / weight
    lost[first + row] = 0


@wp.kernel
def lift_off(
    first: wp.int32,
    window: wp.array(dtype=wp.vec4i),
    before: wp.vec2i,
    rest: wp.array2d(dtype=Any),
    field: wp.array3d(dtype=Any),
    deepest: wp.array(dtype=wp.float32),
    shallow: wp.float32,
    lowest: wp.float32,
    # outputs
    height: wp.array3d(dtype=Any),
    lost: wp.array(dtype=wp.int32),
):
    """Heights rest − w along one row.

    Environments in which one is below ``lowest`` are ``lost``.

    ``before``: nodes along x and y to which the field reaches around the ``window``; none is too low if the deepest overlap is
    ``shallow``, since the gel moves by no more.
    """
    row, j = wp.tid()
    env, none = first + row, rest.dtype()
    box, columns = window[env], wp.vec2i(0, 0)
    if box[1] > 0 and j >= box[2] - before[1] and j < box[3] + before[1]:
        columns = packets(box[0], box[1], before[0], len(none), rest.shape[1])
    for p in range(rest.shape[1]):
        if p < columns[0] or p >= columns[1]:
            height[env, j, p] = rest[j, p]
        else:
            height[env, j, p] = rest[j, p] - field[row, j, p]
    if deepest[env] > shallow:
        for p in range(columns[0], columns[1]):
            if wp.min(height[env, j, p]) < lowest:
                lost[env] = 1


@wp.kernel
def without_lost(
    first: wp.int32,
    lost: wp.array(dtype=wp.int32),
    rest: wp.array2d(dtype=Any),
    # outputs
    height: wp.array3d(dtype=Any),
    contact: wp.array3d(dtype=Any),
    centre: wp.array(dtype=wp.vec2d),
):
    """Environments that are ``lost`` are at rest, without contact."""
    row, j = wp.tid()
    env = first + row
    if lost[env] != 0:
        none = contact.dtype()
        for p in range(rest.shape[1]):
            height[env, j, p] = rest[j, p]
            contact[env, j, p] = none
        if j == 0:
            centre[env] = wp.vec2d(_NAN, _NAN)


@cache
def packet_types(lanes: int) -> tuple[Any, Any]:
    """Types of packets of heights and of contacts; the kernels for them are compiled together."""
    packet, mask = (wp.types.vector(length=lanes, dtype=dtype) for dtype in (wp.float32, wp.uint8))
    lines, fields, masks = wp.array2d(dtype=packet), wp.array3d(dtype=packet), wp.array3d(dtype=mask)
    wp.overload(along_columns, {"source": fields, "out": fields})
    wp.overload(along_rows, {"weights": lines, "overlap": fields, "out": fields})
    wp.overload(impose, {"overlap": fields, "field": fields})
    wp.overload(touch, {"overlap": fields, "field": fields, "contact": masks})
    wp.overload(lift_off, {"rest": lines, "field": fields, "height": fields})
    wp.overload(without_lost, {"rest": lines, "height": fields, "contact": masks})
    return packet, mask
