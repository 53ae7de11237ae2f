"""Displacements in the plane as sums of plane waves, and evenly spaced nodes, on a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.gel.products import Matrices, Products
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.physics.soft.correction.plane_kernels import Lines


def node_lines(x: np.ndarray, y: np.ndarray) -> Any:
    """Evenly spaced nodes for the kernels, of columns ``x`` and rows ``y`` [m]."""
    lines: Any = Lines()
    lines.origin, lines.count = wp.vec2d(float(x[0]), float(y[0])), wp.vec2i(len(x), len(y))
    lines.pitch = wp.vec2d(float((x[-1] - x[0]) / (len(x) - 1)), float((y[-1] - y[0]) / (len(y) - 1)))
    return lines


@dataclass(frozen=True)
class PlaneField:
    """Displacements along x and y [m] of every environment, or their amplitudes."""

    x: Matrices
    y: Matrices

    @staticmethod
    def zeros(products: Products, rows: int, columns: int) -> PlaneField:
        """Fields of zeros."""
        return PlaneField(products.zeros(rows, columns), products.zeros(rows, columns))


class PlaneWaves:
    """Synthesis of displacements from amplitudes, over the lines of one grid.

    Waves of x are sines along x and cosines along y, waves of y the other way about.
    """

    def __init__(self, along: tuple[CosineSeries, CosineSeries], x: np.ndarray, y: np.ndarray, products: Products,
                 waves: tuple[int, int] | None = None) -> None:  # fmt: skip
        """Prepare the lines ``x``, ``y`` [m].

        ``along``: series along x and y; ``waves``: rows and columns of amplitudes, from the longest on; None is all.
        """
        constant, self._products = products.constant, products
        rows, columns = (len(along[1].wave_numbers), len(along[0].wave_numbers)) if waves is None else waves
        self._cos_x, self._sin_x = (constant(f(x).T[:columns]) for f in (along[0].synthesis, along[0].sines))
        self._cos_y, self._sin_y = (constant(f(y)[:, :rows]) for f in (along[1].synthesis, along[1].sines))
        self._spare = products.zeros(len(y), columns)

    def displacement(
        self, amplitudes: PlaneField, out: PlaneField, active: wp.array, window: tuple[Any, Any] = (None, None)
    ) -> None:
        """Launch the displacement [m] within windows of rows and columns; None is all."""
        multiply, (rows, columns) = self._products.multiply, window
        for along_y, along_x, wave, field in (
            (self._cos_y, self._sin_x, amplitudes.x, out.x),
            (self._sin_y, self._cos_x, amplitudes.y, out.y),
        ):
            multiply(along_y, wave, self._spare, rows=rows, active=active)
            multiply(self._spare, along_x, field, rows=rows, columns=columns, active=active)
