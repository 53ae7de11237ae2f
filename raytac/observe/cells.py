"""Means over equal cells of a grid of nodes."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError

__all__ = ["CellMeans"]


class CellMeans:
    """From values at nodes (B, Ny, Nx) to their means over (rows, columns) cells; a node belongs to the cell that it lies in."""

    def __init__(self, nodes: tuple[int, int], cells: tuple[int, int]) -> None:
        """Raises ``InputError`` if there are more cells than nodes."""
        for name, n, m in zip(("rows", "columns"), nodes, cells, strict=True):
            if m > n:
                raise InputError("map_shape", value=tuple(cells), rule=f"must not have more {name} than the pad's grid, {n}")
        self.nodes, self.cells = tuple(nodes), tuple(cells)
        self._starts = [np.arange(m) * n // m for n, m in zip(nodes, cells, strict=True)]
        self._counts = [np.diff(np.append(s, n)) for s, n in zip(self._starts, nodes, strict=True)]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Means (B, rows, columns), float64."""
        summed = np.add.reduceat(values, self._starts[0], axis=1, dtype=float)
        summed = np.add.reduceat(summed, self._starts[1], axis=2)
        return summed / (self._counts[0][:, None] * self._counts[1])
