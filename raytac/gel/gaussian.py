"""Gaussian smoothing of grids: exact discrete Gaussians as matrix products."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from raytac.gel.matmul import product, stacked_product

_LOW_RANK_FROM = 6.0
"""Width [nodes] from which the cosine basis beats the banded product (399 × 328, two cores)."""
_TAIL = 1e-6
"""Weight, relative to the peak, below which matrix entries and basis vectors are dropped."""


def gaussian_matrix(nodes: int, width: float) -> np.ndarray:
    """Discrete Gaussian of standard deviation ``width`` [nodes], (nodes, nodes), float64.

    Its rows sum to 1.
    exp(½ width² L) with L the second difference, mirrored about the end nodes (OpenCV's BORDER_REFLECT_101). This is Lindeberg's
    discrete Gaussian (T. Lindeberg, Scale-space for discrete signals, PAMI 1990): its variance is exactly width² nodes² at any
    width, also far below one node, so that results do not depend on the pitch as a sampled Gaussian's do.
    L is diagonal in the cosines cos(π j k / (nodes − 1)) with eigenvalues 2 cos(π k / (nodes − 1)) − 2.
    """
    synthesis, analysis = _cosine_basis(nodes, width)
    return synthesis @ analysis


def fast_gaussian_matrix(nodes: int, width: float) -> np.ndarray:
    """``gaussian_matrix`` as ``GaussianBlur`` applies it: float32, tails cut off."""
    if width < _LOW_RANK_FROM:
        return _band(nodes, width)[0].astype(np.float32)
    synthesis, analysis = _cosine_basis(nodes, width, tail=_TAIL)
    return (synthesis @ analysis).astype(np.float32)


class GaussianBlur:
    """Separable Gaussian of a standard deviation in metres on (Ny, Nx) float32 arrays."""

    def __init__(self, shape: tuple[int, int], pitch: tuple[float, float], sigma: float) -> None:
        """``shape`` (Ny, Nx); ``pitch`` (x, y) [m]; ``sigma`` [m] > 0."""
        self.sigma = sigma
        self._along_y = _operator(shape[0], sigma / pitch[1])
        self._along_x = _operator(shape[1], sigma / pitch[0])

    def __call__(self, field: np.ndarray, window: tuple[slice, slice] | None = None) -> np.ndarray:
        """Smoothed copy of ``field``, (Ny, Nx) float32.

        ``window`` (rows, columns), with plain starts and stops: ``field`` is that piece of a field that is 0 elsewhere, and so is the
        result.
        """
        rows, columns = self._along_y, self._along_x
        if window is not None:
            rows, columns = _piece(rows, window[0]), _piece(columns, window[1])
        if isinstance(rows, tuple) and isinstance(columns, tuple):
            core = product(product(rows[1], field), columns[1].T)
            return product(rows[0], product(core, columns[0].T))
        return _apply_right(_apply_left(rows, field), columns)

    def of_stack(self, fields: np.ndarray, spare: np.ndarray) -> np.ndarray:
        """Smooth fields (B, Ny, Nx) float32 in place, each as if it were alone, to the last bit.

        ``spare`` is an array like ``fields``: getting memory for a new one takes longer than the products.
        """
        return _along_rows(_down_columns(self._along_y, fields, spare), self._turned_x, fields)

    @cached_property
    def _turned_x(self) -> _Operator:
        """``_along_x`` transposed, in the memory order that halves a product from the right."""
        if isinstance(self._along_x, tuple):
            return np.ascontiguousarray(self._along_x[0].T), np.ascontiguousarray(self._along_x[1].T)
        return [(rows, columns, np.ascontiguousarray(weights.T)) for rows, columns, weights in self._along_x]


_Operator = tuple[np.ndarray, np.ndarray] | list[tuple[slice, slice, np.ndarray]]


def _operator(nodes: int, width: float) -> _Operator:
    """Low-rank factors (synthesis, analysis) or dense blocks (rows, columns, weights) of a band."""
    if width >= _LOW_RANK_FROM:
        synthesis, analysis = _cosine_basis(nodes, width, tail=_TAIL)
        return synthesis.astype(np.float32), analysis.astype(np.float32)
    matrix, reach = _band(nodes, width)
    step = min(max(2 * reach, 24), nodes)
    blocks: _Operator = []
    for start in range(0, nodes, step):
        rows = slice(start, min(start + step, nodes))
        columns = slice(max(start - reach, 0), min(rows.stop + reach, nodes))
        blocks.append((rows, columns, matrix[rows, columns].astype(np.float32)))
    return blocks


def _band(nodes: int, width: float) -> tuple[np.ndarray, int]:
    """The matrix (nodes, nodes), and its half bandwidth."""
    kernel = _kernel(width)
    reach = min(len(kernel) // 2, nodes - 1)
    kernel = kernel[len(kernel) // 2 - reach : len(kernel) // 2 + reach + 1]
    matrix = np.zeros((nodes, nodes))
    row = np.arange(nodes)
    for offset, weight in zip(range(-reach, reach + 1), kernel / kernel.sum(), strict=True):
        mirrored = np.abs(row + offset)
        np.add.at(matrix, (row, np.where(mirrored > nodes - 1, 2 * (nodes - 1) - mirrored, mirrored)), weight)
    return matrix, reach


def _piece(operator: _Operator, kept: slice) -> _Operator:
    """Restriction of an operator to the nodes ``kept``."""
    if isinstance(operator, tuple):
        return operator[0][kept], operator[1][:, kept]
    pieces: _Operator = []
    for rows, columns, weights in operator:
        first, last = max(rows.start, kept.start), min(rows.stop, kept.stop)
        begin, end = max(columns.start, kept.start), min(columns.stop, kept.stop)
        if first < last and begin < end:
            part = weights[first - rows.start : last - rows.start, begin - columns.start : end - columns.start]
            pieces.append((slice(first - kept.start, last - kept.start), slice(begin - kept.start, end - kept.start), part))
    return pieces


def _cosine_basis(nodes: int, width: float, tail: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Synthesis (nodes, rank) with gain, and analysis (rank, nodes), for gains >= ``tail``."""
    k = np.arange(nodes)
    gain = np.exp(width**2 * (np.cos(np.pi * k / (nodes - 1)) - 1.0))
    kept = k[gain >= tail]
    cosines = np.cos(np.pi / (nodes - 1) * np.outer(k, kept))
    weight = np.where((k == 0) | (k == nodes - 1), 0.5, 1.0)
    analysis = 2.0 / (nodes - 1) * weight[kept][:, None] * cosines.T * weight[None, :]
    return cosines * gain[kept], analysis


def _kernel(width: float) -> np.ndarray:
    """Centred weights of the discrete Gaussian on an infinite line, tails cut off."""
    half = int(np.ceil(8.0 * width)) + 12
    period = 2 * half + 1
    frequency = 2.0 * np.pi * np.arange(period) / period
    gain = np.exp(width**2 * (np.cos(frequency) - 1.0))
    offset = np.arange(-half, half + 1)
    kernel = np.cos(np.outer(offset, frequency)) @ gain / period
    return kernel[kernel > _TAIL * kernel.max()]


def _apply_left(operator: _Operator, field: np.ndarray) -> np.ndarray:
    if isinstance(operator, tuple):
        return product(operator[0], product(operator[1], field))
    out = np.empty_like(field)
    for rows, columns, weights in operator:
        product(weights, field[columns], out[rows])
    return out


def _apply_right(field: np.ndarray, operator: _Operator) -> np.ndarray:
    if isinstance(operator, tuple):
        return product(product(field, operator[1].T), operator[0].T)
    out = np.empty_like(field)
    for rows, columns, weights in operator:
        product(field[:, columns], weights.T, out[:, rows])
    return out


def _down_columns(operator: _Operator, fields: np.ndarray, out: np.ndarray) -> np.ndarray:
    if isinstance(operator, tuple):
        return stacked_product(operator[0], stacked_product(operator[1], fields), out)
    for rows, columns, weights in operator:
        stacked_product(weights, fields[:, columns], out[:, rows])
    return out


def _along_rows(fields: np.ndarray, turned: _Operator, out: np.ndarray) -> np.ndarray:
    """``turned``: transposed."""
    if isinstance(turned, tuple):
        return stacked_product(stacked_product(fields, turned[1]), turned[0], out)
    for rows, columns, weights in turned:
        stacked_product(fields[:, :, columns], weights, out[:, :, rows])
    return out
