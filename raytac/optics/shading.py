"""Colour shading: a smooth gain of each channel over the image, as the exponential of a polynomial, and its fit to a measured gain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import chebyshev

from raytac.specs.sensor import shading_degree

__all__ = ["fit_log_gain", "shading_gain"]


def shading_gain(shading: Sequence[Sequence[float]], resolution: tuple[int, int]) -> np.ndarray:
    """Gain (H, W, C) of every pixel for the coefficients of C channels (``ResponseSpec.shading_red``; none is a gain of 1) at
    ``resolution`` (width, height)."""
    x, y = (_centres(n) for n in resolution)
    return np.exp(np.stack([chebyshev.chebgrid2d(x, y, _table(c)).T for c in shading], -1))


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
    x, y = (chebyshev.chebvander(_centres(n), degree) for n in resolution)
    return np.stack([np.multiply.outer(y[:, j], x[:, i]) for i in range(degree + 1) for j in range(degree + 1 - i)], -1)


def _centres(count: int) -> np.ndarray:
    """Those of ``count`` pixels, −1 and 1 at the image's edges."""
    return (np.arange(count) + 0.5) / count * 2 - 1


def _table(coefficients: Sequence[float]) -> np.ndarray:
    """c_ij as a square array, 0 where i + j > n."""
    orders = np.arange(max(shading_degree(len(coefficients)), 0) + 1)
    table = np.zeros((len(orders), len(orders)))
    if len(coefficients):
        table[np.add.outer(orders, orders) <= orders[-1]] = coefficients
    return table
