"""Discrete Gaussians as matrices, and the widths of the two pyramids that are made of them."""

from __future__ import annotations

import numpy as np

_TAXIM_PIXEL = 0.0295e-3
PYRAMID_SIGMAS = tuple(s * _TAXIM_PIXEL for s in (30.5, 15.5, 8.0, 3.5, 2.0, 1.1))
"""Standard deviations of Taxim's pyramid [m].

OpenCV's automatic σ for kernels 201, 101, 51, 21, 11, 5 at 0.0295 mm a pixel."""
LAYER_STEPS = (
    (0.1067, 1.0),
    (0.1206, 1.0),
    (0.0875, 1.0),
    (0.0660, 0.9423),
    (0.0361, 0.9475),
    (0.0192, 0.9561),
    (0.0118, 0.9640),
)
"""Standard deviation over the gel's thickness, and gain, of each Gaussian of a layer.

Fitted to contacts of a linear elastic layer bonded at its back (``experiments/fit_surround.py``)."""
FINAL_SIGMA = 1.1 * _TAXIM_PIXEL
"""Standard deviation of the last smoothing [m]."""
CONTACT_SCALE = 0.4
"""Share of the deepest overlap from which a node counts as in full contact."""
_TAIL = 1e-6
"""Weight, relative to the peak, below which a Gaussian is cut off."""


def gaussian_matrix(nodes: int, width: float, *, tail: float = _TAIL) -> tuple[np.ndarray, int]:
    """Discrete Gaussian of standard deviation ``width`` [nodes], and its half bandwidth.

    The matrix is (nodes, nodes), float64; its rows sum to 1.
    exp(½ width² L) with L the second difference, mirrored about the end nodes (OpenCV's BORDER_REFLECT_101). This is Lindeberg's
    discrete Gaussian (T. Lindeberg, Scale-space for discrete signals, PAMI 1990): its variance is exactly width² nodes² at any
    width, also far below one node, so that results do not depend on the pitch as a sampled Gaussian's do. Weights below ``tail`` of the
    peak are left out.
    """
    kernel = _kernel(width, tail)
    reach = len(kernel) // 2
    matrix, row, period = np.zeros((nodes, nodes)), np.arange(nodes), 2 * (nodes - 1)
    for offset, weight in zip(range(-reach, reach + 1), kernel / kernel.sum(), strict=True):
        around = (row + offset) % period
        np.add.at(matrix, (row, np.minimum(around, period - around)), weight)
    return matrix, reach


def _kernel(width: float, tail: float) -> np.ndarray:
    """Centred weights of the discrete Gaussian on an infinite line, tails cut off."""
    half = int(np.ceil(8.0 * width)) + 12
    period = 2 * half + 1
    frequency = 2.0 * np.pi * np.arange(period) / period
    gain = np.exp(width**2 * (np.cos(frequency) - 1.0))
    offset = np.arange(-half, half + 1)
    kernel = np.cos(np.outer(offset, frequency)) @ gain / period
    return kernel[kernel > tail * kernel.max()]
