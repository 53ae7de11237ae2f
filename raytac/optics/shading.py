"""Colour shading: a smooth gain of each channel over the image, as the exponential of a polynomial, and its fit to a measured gain."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import chebyshev

__all__ = ["fit_log_gain", "shading_gain"]


def shading_gain(shading: Sequence[Sequence[float]], resolution: tuple[int, int]) -> np.ndarray:
    """Gain (H, W, C) of every pixel for the coefficients of C channels (``ResponseSpec.shading_red``; none is a gain of 1) at
    ``resolution`` (width, height)."""
    gains = [
        np.exp(_basis(resolution, _degree(len(c))) @ np.asarray(c, float)) if len(c) else np.ones(resolution[::-1])
        for c in shading
    ]
    return np.stack(gains, -1)


def fit_log_gain(gain: np.ndarray, weight: np.ndarray, degree: int, *, ridge: float = 0.0) -> tuple[float, ...]:
    """Coefficients of the polynomial of this degree that is nearest to log ``gain`` (H, W) > 0 with weights (H, W) on squared residuals.

    ``ridge`` pulls every coefficient to 0, relative to all weights together: it holds a fit where pixels without weight leave it free.
    """
    height, width = gain.shape
    root = np.sqrt(weight).ravel()
    basis = _basis((width, height), degree).reshape(gain.size, -1)
    pull = np.sqrt(ridge * weight.sum()) * np.eye(basis.shape[1])
    target = np.concatenate([np.log(gain).ravel() * root, np.zeros(len(pull))])
    found, *_ = np.linalg.lstsq(np.concatenate([basis * root[:, None], pull]), target, rcond=None)
    return tuple(map(float, found))


def _basis(resolution: tuple[int, int], degree: int) -> np.ndarray:
    """T_i(x) T_j(y) with i + j ≤ ``degree`` at the pixels' centres, (H, W, N)."""
    x, y = (chebyshev.chebvander((np.arange(n) + 0.5) / n * 2 - 1, degree) for n in resolution)
    return np.stack([np.multiply.outer(y[:, j], x[:, i]) for i in range(degree + 1) for j in range(degree + 1 - i)], -1)


def _degree(count: int) -> int:
    """n of (n + 1)(n + 2)/2 coefficients."""
    return (math.isqrt(8 * count + 1) - 3) // 2
