"""Smoothing by successive Gaussians with the contact re-imposed: two equivalent methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from raytac.gel.gaussian import GaussianBlur, fast_gaussian_matrix
from raytac.gel.matmul import product

__all__ = ["ComposedGaussians", "LocalField", "Piece", "SmoothedField", "WholeField", "around"]

Piece = tuple[slice, slice]
"""Rows and columns, with plain starts and stops."""

_LARGEST = 512
"""Nodes along an axis up to which Gaussians are kept as matrices: 1 MB each in float32."""


class SmoothedField(Protocol):
    """A field, 0 at first outside a piece ``touched``, which is set again after every Gaussian."""

    def smooth(self) -> np.ndarray:
        """Apply the next Gaussian; returns the field on ``touched``."""
        ...

    def impose(self, values: np.ndarray) -> None:
        """Set the field on ``touched``."""
        ...

    def over(self, window: Piece) -> np.ndarray:
        """The field on the initial window, with the last Gaussian if there is one."""
        ...


class WholeField:
    """The field on all nodes of a window, Gaussian by Gaussian."""

    def __init__(
        self, values: np.ndarray, touched: Piece, window: Piece, blurs: Sequence[GaussianBlur], final: GaussianBlur | None
    ) -> None:
        """``values``: on ``touched``, float32; ``window``: beyond it the field stays 0."""
        self._blurs, self._final, self._window, self._next = blurs, final, window, 0
        self._field = np.zeros([line.stop - line.start for line in window], np.float32)
        self._touched = _within(touched, window)
        self._field[self._touched] = values

    def smooth(self) -> np.ndarray:
        self._field = self._blurs[self._next](self._field, self._window)
        self._next += 1
        return self._field[self._touched]

    def impose(self, values: np.ndarray) -> None:
        self._field[self._touched] = values

    def over(self, window: Piece) -> np.ndarray:
        return self._field if self._final is None else self._final(self._field, window)


class ComposedGaussians:
    """Products of successive Gaussians as matrices on one grid, made at the first small contact.

    Successive discrete Gaussians are one of the sum of their variances, also with mirrored borders (see ``gaussian_matrix``).
    """

    def __init__(self, shape: tuple[int, int], pitch: tuple[float, float], sigmas: Sequence[float]) -> None:
        """``shape`` (Ny, Nx); ``pitch`` (x, y) [m]; ``sigmas`` [m] in their order."""
        self.shape, self.pitch, self._squares = shape, pitch, np.square(sigmas)
        self._matrices: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @property
    def fits(self) -> bool:
        """True if the matrices are small enough to be cached."""
        return max(self.shape) <= _LARGEST

    def sigma(self, first: int, last: int) -> float:
        """Standard deviation of the Gaussians from ``first`` to ``last`` [m]."""
        return float(np.sqrt(self._squares[first : last + 1].sum()))

    def apply(self, first: int, last: int, values: np.ndarray, touched: Piece, piece: Piece) -> np.ndarray:
        """Field on ``piece`` after the Gaussians ``first`` to ``last`` of ``values`` on ``touched``."""
        if (first, last) not in self._matrices:
            sigma = self.sigma(first, last)
            self._matrices[first, last] = tuple(  # type: ignore[assignment]
                fast_gaussian_matrix(nodes, sigma / pitch) for nodes, pitch in zip(self.shape, reversed(self.pitch), strict=True)
            )
        along_y, along_x = self._matrices[first, last]
        return product(product(along_y[piece[0], touched[0]], values), along_x[piece[1], touched[1]].T)


class LocalField:
    """The field as a sum of increments on ``touched``, each smoothed by all later Gaussians.

    Only the re-imposed contact is not linear, and it acts on ``touched`` alone. So the field is computed there, and at the end over the
    window. With m nodes along a side of ``touched`` and n Gaussians this takes about n² m³ multiply-adds, whatever the window.
    """

    def __init__(
        self, values: np.ndarray, touched: Piece, gaussians: ComposedGaussians, count: int, final: bool, reach: float
    ) -> None:
        """``count`` Gaussians before an imposition, and one more if ``final``; ``reach``: standard deviations at which they end."""
        self._gaussians, self._touched = gaussians, touched
        self._last, self._reach = count - 1 + final, reach
        self._increments, self._present = [values], values

    def smooth(self) -> np.ndarray:
        last = len(self._increments) - 1
        total = np.zeros_like(self._present)
        for first, values in enumerate(self._increments):
            total += self._gaussians.apply(first, last, values, self._touched, self._touched)
        self._present = total
        return total

    def impose(self, values: np.ndarray) -> None:
        self._increments.append(values - self._present)
        self._present = values

    def over(self, window: Piece) -> np.ndarray:
        total = np.zeros([line.stop - line.start for line in window], np.float32)
        for first, values in enumerate(self._increments):
            if first > self._last:  # no Gaussian comes after it
                total[_within(self._touched, window)] += values
                continue
            # A discrete Gaussian narrower than a node reaches farther for its width than a wide one.
            margin = self._reach * self._gaussians.sigma(first, self._last) + 2.0 * max(self._gaussians.pitch)
            piece = around(self._touched, margin, self._gaussians.pitch, window)
            total[_within(piece, window)] += self._gaussians.apply(first, self._last, values, self._touched, piece)
        return total


def around(piece: Piece, margin: float, pitch: tuple[float, float], within: Piece) -> Piece:
    """A piece with a ``margin`` [m] around it, clipped to the piece ``within``."""
    rows, columns = (
        slice(max(line.start - nodes, whole.start), min(line.stop + nodes, whole.stop))
        for line, nodes, whole in zip(piece, (int(np.ceil(margin / p)) for p in reversed(pitch)), within, strict=True)
    )
    return rows, columns


def _within(piece: Piece, window: Piece) -> Piece:
    """A piece of the grid in the window's own rows and columns."""
    rows, columns = (slice(line.start - whole.start, line.stop - whole.start) for line, whole in zip(piece, window, strict=True))
    return rows, columns
