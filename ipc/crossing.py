"""Exact test whether edges meet triangles. Plain NumPy, on the host.

Every answer is the sign of a determinant of the coordinates. Where float64 leaves no doubt about it, it is taken (after Shewchuk 1997,
"Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates"); the few others are found in whole numbers of any
length. Nothing depends on how thin a triangle or how small an angle is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["APART", "CROSSING", "TOUCHING", "meet", "orientation"]

Floats = NDArray[np.float64]
Signs = NDArray[np.int8]

APART, TOUCHING, CROSSING = 0, 1, 2

_ROUNDING = 16 * 2.0**-53
"""More than the relative error of either determinant against the sum of the sizes of its terms."""
_UNDERFLOW = 1e-280
"""Terms below this may have lost digits to underflow."""


def _whole(x: Floats) -> NDArray[np.object_]:
    """Coordinates (n, k, dim) as whole numbers, each of the n sets times a power of two of its own."""
    mantissa, exponent = np.frexp(x)
    digits = np.ldexp(mantissa, 53).astype(np.int64)
    exponent = np.where(digits == 0, np.iinfo(exponent.dtype).max, exponent)
    shift = np.where(digits == 0, 0, exponent - exponent.min(axis=(1, 2), keepdims=True))
    return np.left_shift(digits.astype(object), shift.astype(object))


def _terms(x: NDArray) -> tuple[NDArray, ...]:
    """Terms whose sum is the determinant of the last points (n, dim + 1, dim) less the first, each (n,)."""
    d = [x[:, k] - x[:, 0] for k in range(1, x.shape[1])]
    if len(d) == 2:
        return d[0][:, 0] * d[1][:, 1], -(d[0][:, 1] * d[1][:, 0])
    return tuple(
        sign * (d[0][:, i] * (d[1][:, j] * d[2][:, k]))
        for i, j, k, sign in ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (0, 2, 1, -1), (1, 0, 2, -1), (2, 1, 0, -1))
    )


def orientation(*points: Floats) -> Signs:
    """Exact sign of the area of triangles a, b, c in the plane, or of the volume (b − a) × (c − a) · (d − a) in space.

    Args:
        points: three arrays (n, 2), or four (n, 3), of finite float64.
    """
    x = np.stack(points, axis=1)
    terms = _terms(x)
    total, size = np.sum(terms, axis=0), np.sum(np.abs(terms), axis=0)
    signs = np.sign(total).astype(np.int8)
    doubtful = ~(np.abs(total) > _ROUNDING * size + _UNDERFLOW)
    if doubtful.any():
        exact = np.sum(_terms(_whole(x[doubtful])), axis=0)
        signs[doubtful] = np.sign(exact).astype(np.int8)
    return signs


def meet(p: Floats, q: Floats, a: Floats, b: Floats, c: Floats) -> NDArray[np.int8]:
    """``APART``, ``TOUCHING`` or ``CROSSING`` for the closed segments pq and triangles abc, exactly, shape (n,).

    Crossing is to pass from one side of the triangle to the other through its inside; all else that meets is touching. A triangle without
    area meets nothing: its edges are those of others.

    Args:
        p, q, a, b, c: float64 [m], shape (n, 3) each.
    """
    result = np.full(len(p), APART, np.int8)
    side_p, side_q = orientation(a, b, c, p), orientation(a, b, c, q)
    near = np.flatnonzero((side_p * side_q <= 0) & ((side_p != 0) | (side_q != 0)))
    if len(near):
        p_, q_, a_, b_, c_ = (x[near] for x in (p, q, a, b, c))
        turns = np.stack([orientation(p_, q_, a_, b_), orientation(p_, q_, b_, c_), orientation(p_, q_, c_, a_)])
        inside = (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
        through = inside & (turns != 0).all(axis=0) & (side_p[near] * side_q[near] < 0)
        result[near] = np.where(through, CROSSING, np.where(inside, TOUCHING, APART))
    flat = np.flatnonzero((side_p == 0) & (side_q == 0))
    if len(flat):
        result[flat] = np.where(_meet_in_plane(*(x[flat] for x in (p, q, a, b, c))), TOUCHING, APART)
    return result


def _meet_in_plane(p: Floats, q: Floats, a: Floats, b: Floats, c: Floats) -> NDArray[np.bool_]:
    """Whether segments meet triangles of the same plane: no line of a side of either has the other wholly beyond it."""
    found, done = np.zeros(len(p), bool), np.zeros(len(p), bool)
    for axes in ((0, 1), (1, 2), (2, 0)):  # a triangle with area has one in the projection on some coordinate plane
        rows = np.flatnonzero(~done)
        p_, q_, a_, b_, c_ = (x[rows][:, axes] for x in (p, q, a, b, c))
        turn = orientation(a_, b_, c_)
        rows, turn = rows[turn != 0], turn[turn != 0]
        p_, q_, a_, b_, c_ = (x[rows][:, axes] for x in (p, q, a, b, c))
        beyond = np.zeros(len(rows), bool)
        for u, v in ((a_, b_), (b_, c_), (c_, a_)):
            beyond |= (turn * orientation(u, v, p_) < 0) & (turn * orientation(u, v, q_) < 0)
        sides = np.stack([orientation(p_, q_, corner) for corner in (a_, b_, c_)])
        beyond |= (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
        found[rows], done[rows] = ~beyond, True
    return found
