"""Polynomials from samples: normal equations of every slope bin, summed over all presses.

A bin's model is dI(x, y) = g · [x², y², x y, x, y, 1] (Si and Yuan, RA-L 2022, section III). All bins' 6 × 6 normal equations
Σ a aᵀ g = Σ a dI are kept in float64, so a million samples cost no memory and their order hardly matters.
Positions are scaled to [−1, 1] inside and the coefficients rewritten for pixels at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.optics.taxim.table import polynomial_basis

_TERMS = [5], [3, 4, 5], [0, 1, 2, 3, 4, 5]
"""Monomials of a polynomial of degree 0, 1 and 2."""
_MIN_COUNT = {1: 15.0, 2: 60.0}
"""Least samples of a polynomial of degree 1 and 2: five and ten a coefficient."""
_MIN_SPREAD = 0.02
"""Least spread, relative to the whole image, that a degree needs; see ``_spread``."""
_PULL = 0.3
"""The ridge's floor, in samples: keeps a bin with few of them near a constant."""


@dataclass(frozen=True)
class BinFit:
    """The polynomials of all bins, as ``PolyTable`` wants them."""

    gradients: np.ndarray
    """Shape (3, n_bins, n_bins, 6), levels, for positions in pixels."""
    covered: np.ndarray
    """Bins with at least one sample of their own, shape (n_bins, n_bins), bool."""
    counts: np.ndarray
    """Samples of each bin, shape (n_bins, n_bins), int64."""
    degree: np.ndarray
    """Degree of each bin's polynomial, shape (n_bins, n_bins): 0, 1 or 2; −1 where it is a fill."""


class BinSums:
    """Normal equations of all slope bins; the last direction (exactly π) goes to the one before."""

    def __init__(self, n_bins: int, resolution: tuple[int, int]) -> None:
        self.n_bins, self.resolution = n_bins, resolution
        self._gram = np.zeros((n_bins * (n_bins - 1), 6, 6))
        self._moment = np.zeros((n_bins * (n_bins - 1), 6, 3))

    def add(self, i: np.ndarray, j: np.ndarray, column: np.ndarray, row: np.ndarray, difference: np.ndarray) -> None:
        """Add samples (N,): bins (``i``, ``j``), pixels, ``difference`` [levels] (N, 3)."""
        if not len(i):
            return
        key = i * (self.n_bins - 1) + np.minimum(j, self.n_bins - 2)
        order = np.argsort(key, kind="stable")
        key = key[order]
        first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        a = polynomial_basis(*self._scaled(column[order], row[order]))
        upper = np.triu_indices(6)
        gram = np.zeros((len(first), 6, 6))
        gram[:, upper[0], upper[1]] = np.add.reduceat(a[:, upper[0]] * a[:, upper[1]], first, axis=0)
        gram[:, upper[1], upper[0]] = gram[:, upper[0], upper[1]]
        products = a[:, :, None] * difference[order].astype(np.float64)[:, None, :]
        self._gram[key[first]] += gram
        self._moment[key[first]] += np.add.reduceat(products, first, axis=0)

    def plus(self, other: BinSums) -> BinSums:
        """Sums of the samples of both."""
        both = BinSums(self.n_bins, self.resolution)
        both._gram, both._moment = self._gram + other._gram, self._moment + other._moment
        return both

    def with_thin_bins_of(self, other: BinSums) -> BinSums:
        """Sums with the samples of ``other`` where there are too few for a polynomial of degree 2."""
        thin = (self._gram[:, 5, 5] < _MIN_COUNT[2])[:, None, None]
        both = BinSums(self.n_bins, self.resolution)
        both._gram, both._moment = self._gram + thin * other._gram, self._moment + thin * other._moment
        return both

    def solve(self, *, neighbours: float, ridge: float) -> BinFit:
        """The polynomials.

        Every bin also uses the samples of its eight neighbours, at the weight ``neighbours``: next to many samples of its own they change
        little, and without it bins with few would show the chance of a single press. Then the least-squares fit with a ridge on all terms
        but the constant. The degree falls where the samples cannot carry it: 2 needs 60 (weighted) samples and a spread of 0.02, 1 needs
        15 and the same spread, else the mean. Bins that no sample reached take the polynomial of the covered bin in the same direction
        whose magnitude is nearest (the gentler of two), or else that of the nearest direction.
        """
        n, m = self.n_bins, self.n_bins - 1
        counts = np.rint(self._gram[:, 5, 5]).astype(np.int64)
        gram, moment = (
            _with_neighbours(s.reshape(n, m, *s.shape[1:]), neighbours).reshape(s.shape) for s in (self._gram, self._moment)
        )
        degree = np.full(n * m, -1)
        solution = np.zeros((n * m, 6, 3))
        own = counts > 0
        degree[own] = 0
        for step in (1, 2):
            able = np.flatnonzero(own & (gram[:, 5, 5] >= _MIN_COUNT[step]))
            degree[able[_spread(gram[able], _TERMS[step], self._uniform()) >= _MIN_SPREAD]] = step
        for step, terms in enumerate(_TERMS):
            chosen = np.flatnonzero(degree == step)
            pull = np.diag([1.0] * (len(terms) - 1) + [0.0])
            least = terms[0]  # a degree's terms are the last ones
            lhs = gram[chosen, least:, least:] + (ridge * gram[chosen, 5, 5] + _PULL)[:, None, None] * pull
            solution[chosen, least:] = np.linalg.solve(lhs, moment[chosen, least:])
        source = _fill_from(own.reshape(n, m))
        pixels = np.einsum("ab,nac->cnb", self._pixels_from_scaled(), solution[source.ravel()]).reshape(3, n, m, 6)
        return BinFit(_close(pixels, 2), *(_close(array.reshape(n, m), 1) for array in (own, counts, degree)))

    def _scaled(self, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (width, height), scale = self.resolution, max(self.resolution) / 2
        return (column - (width - 1) / 2) / scale, (row - (height - 1) / 2) / scale

    def _pixels_from_scaled(self) -> np.ndarray:
        """Matrix M with basis(scaled) = M basis(pixels), shape (6, 6)."""
        (width, height), s = self.resolution, max(self.resolution) / 2
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return np.array(
            [
                [1 / s**2, 0, 0, -2 * cx / s**2, 0, cx**2 / s**2],
                [0, 1 / s**2, 0, 0, -2 * cy / s**2, cy**2 / s**2],
                [0, 0, 1 / s**2, -cy / s**2, -cx / s**2, cx * cy / s**2],
                [0, 0, 0, 1 / s, 0, -cx / s],
                [0, 0, 0, 0, 1 / s, -cy / s],
                [0, 0, 0, 0, 0, 1],
            ]
        )

    def _uniform(self) -> np.ndarray:
        """Mean of a aᵀ over all pixels, (6, 6)."""
        width, height = self.resolution
        a = polynomial_basis(*self._scaled(np.arange(width)[None, :], np.arange(height)[:, None])).reshape(-1, 6)
        return a.T @ a / len(a)


def two_sheets(touched: BinSums, around: BinSums, *, neighbours: float, ridge: float) -> tuple[BinFit, dict[str, Any]]:
    """Fit of the touched pixels, and fields of a ``PolyTable``: two sheets, and one for all."""
    contact, surround, together = (
        sums.solve(neighbours=neighbours, ridge=ridge) for sums in (touched, around, touched.plus(around))
    )
    sheets = {"gradients": contact.gradients, "surround": surround.gradients, "one_sheet": together.gradients}
    return contact, sheets | {"covered": contact.covered}


def _spread(gram: np.ndarray, terms: list[int], uniform: np.ndarray) -> np.ndarray:
    """Smallest eigenvalue (N,) of the monomials' covariance, over that of the whole image.

    1: as wide as the whole image in every direction of the model; 0: some combination of the terms is as good as constant.
    """
    varying = terms[:-1]

    def covariance(g: np.ndarray) -> np.ndarray:
        mean = g[..., varying, 5] / g[..., 5, 5][..., None]
        return g[..., varying, :][..., varying] / g[..., 5, 5][..., None, None] - mean[..., :, None] * mean[..., None, :]

    whiten = np.linalg.inv(np.linalg.cholesky(covariance(uniform)))
    return np.linalg.eigvalsh(whiten @ covariance(gram) @ whiten.T)[..., 0]


def _with_neighbours(sums: np.ndarray, weight: float) -> np.ndarray:
    """Sums (n, m, …) plus ``weight`` times those of the eight bins around; directions close."""
    if weight == 0.0:
        return sums
    rows = sums.copy()
    rows[1:] += sums[:-1]
    rows[:-1] += sums[1:]
    around = rows + np.roll(rows, 1, axis=1) + np.roll(rows, -1, axis=1)
    return sums + weight * (around - sums)


def _fill_from(covered: np.ndarray) -> np.ndarray:
    """Flat index of the bin that gives each bin (n, m) its polynomial; its own if covered."""
    n, m = covered.shape
    i, j = np.arange(n)[:, None], np.arange(m)[None, :]
    # Distance in magnitude first, gentler before steeper, and a direction counts as farther than any magnitude of the same direction.
    source = np.where(covered, i * m + j, -1)
    reached = covered.any(axis=0)
    if not reached.any():
        return i * m + j
    for column in np.flatnonzero(reached):
        have = np.flatnonzero(covered[:, column])
        distance = np.abs(np.arange(n)[:, None] - have[None, :]) + 0.25 * (have[None, :] > np.arange(n)[:, None])
        source[:, column] = have[np.argmin(distance, axis=1)] * m + column
    have = np.flatnonzero(reached)
    for column in np.flatnonzero(~reached):
        apart = np.abs((have - column + m // 2) % m - m // 2)
        source[:, column] = source[:, have[np.argmin(apart)]]
    return source


def _close(array: np.ndarray, axis: int) -> np.ndarray:
    """Append the bin of direction π, a copy of the one before it."""
    return np.concatenate([array, np.take(array, [-1], axis=axis)], axis=axis)
