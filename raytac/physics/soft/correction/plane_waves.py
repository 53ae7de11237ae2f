"""Sums of waves over the nodes of a grid, and evenly spaced nodes, on a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.gel.products import Matrices, Products
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.physics.soft.correction.plane_kernels import Lines, sort_waves, unfold


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


class CosineSum:
    """Synthesis of a field from the amplitudes of all cosines of a grid, at its nodes.

    A cosine at the mirror image of a node in the grid's middle is the same, or of odd waves the opposite. So even and odd waves are summed
    apart at the nodes of one quarter, in half of the operations.
    """

    def __init__(self, along: tuple[CosineSeries, CosineSeries], x: np.ndarray, y: np.ndarray, products: Products) -> None:
        """Prepare the nodes ``x``, ``y`` [m] of the series ``along`` x and y."""
        self._products, (ny, nx) = products, (len(y), len(x))
        order_y, order_x = (np.r_[0:n:2, 1:n:2] for n in (ny, nx))
        half_y, half_x = ((n + 1) // 2 for n in (ny, nx))
        self._cos_y = products.constant(along[1].synthesis(y[:half_y])[:, order_y])
        self._cos_x = products.constant(along[0].synthesis(x[:half_x])[:, order_x].T)
        self._parts_y, self._parts_x = (
            [products.part(0, half), products.part(half, n)] for half, n in ((half_y, ny), (half_x, nx))
        )
        self._sorted = products.zeros(ny, nx)
        self._rows = [products.zeros(half_y, nx) for _ in range(2)]
        self._quarters = [[products.zeros(half_y, half_x) for _ in range(2)] for _ in range(2)]

    def find(self, factor: Matrices, amplitudes: Matrices, active: wp.array, out: Matrices) -> None:
        """Launch the field of ``amplitudes`` times a ``factor`` that all environments share."""
        products, device, lines = self._products, self._products.device, len(active)
        inputs = [active, factor.numbers, amplitudes.numbers, self._sorted.numbers]
        wp.launch(sort_waves, (lines, out.shape[0]), inputs=inputs, device=device)
        for part, rows, quarters in zip(self._parts_y, self._rows, self._quarters, strict=True):
            products.multiply(self._cos_y, self._sorted, rows, inner=part, active=active)
            for across, quarter in zip(self._parts_x, quarters, strict=True):
                products.multiply(rows, self._cos_x, quarter, inner=across, active=active)
        fields = [quarter.numbers for quarters in self._quarters for quarter in quarters]
        wp.launch(unfold, (lines, self._cos_y.shape[0]), inputs=[active, *fields, out.numbers], device=device)
