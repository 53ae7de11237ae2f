"""Cosine series on evenly spaced nodes, and the gel layer's response wave by wave."""

from __future__ import annotations

import numpy as np

from raytac.gel.interpolate import SplineAxis
from raytac.physics.bonded_layer import layer_compliance
from raytac.specs.sensor import GelpadSpec

_REPEATS = 8
"""Repetitions of a pressure's spectrum to each side: 0.2 % is missing in the shortest waves."""
_FEW = 17
"""Wave numbers along each axis at which the repetitions are summed."""


class CosineSeries:
    """Cosine series through values at evenly spaced nodes, with zero slope at both edges."""

    def __init__(self, nodes: np.ndarray) -> None:
        """``nodes`` [m], shape (n,), evenly spaced from one edge to the other."""
        n = len(nodes)
        self._start, self._length = float(nodes[0]), float(nodes[-1] - nodes[0])
        self.wave_numbers = np.pi * np.arange(n) / self._length
        """[rad/m], shape (n,)."""
        half = np.ones(n)
        half[[0, -1]] = 0.5
        order = np.arange(n)
        self.analysis = 2.0 * half[:, None] * half * np.cos(np.pi * np.outer(order, order) / (n - 1)) / (n - 1)
        """Matrix from values at the nodes to amplitudes, shape (n, n)."""
        self.sine_analysis = 2.0 * np.sin(np.pi * np.outer(order, order) / (n - 1)) / (n - 1)
        """The same for sines, which are 0 at the ends, shape (n, n)."""

    def hats(self, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Wave numbers [rad/m] of orders (m,), 1 for half a wave, and amplitudes of hat functions.

        The hats are those of the nodes; the amplitudes (m,) are over those of the cosines through the same values.
        """
        return np.pi * order / self._length, np.sinc(0.5 * order / (len(self.wave_numbers) - 1)) ** 2

    def synthesis(self, t: np.ndarray) -> np.ndarray:
        """Matrix from amplitudes to values at ``t`` [m], shape (P, n)."""
        return np.cos(np.outer(np.asarray(t) - self._start, self.wave_numbers))

    def sines(self, t: np.ndarray) -> np.ndarray:
        """Sines of the same wave numbers at ``t`` [m], shape (P, n)."""
        return np.sin(np.outer(np.asarray(t) - self._start, self.wave_numbers))


def nodal_compliance(series_x: CosineSeries, series_y: CosineSeries, gelpad: GelpadSpec) -> np.ndarray:
    """Dent at the nodes [m] over pressure there [Pa], wave by wave, (Ny, Nx).

    The pressure is linear between nodes (products of hat functions). Its spectrum repeats beyond the shortest wave of the nodes, times the
    hats' own, and at the nodes all repetitions coincide: the sum is the response there. What they add is a smooth function of the wave
    number, so it is interpolated between a few.
    """
    orders = [np.arange(len(series.wave_numbers)) for series in (series_y, series_x)]
    few = [np.linspace(0.0, order[-1], _FEW) for order in orders]

    def compliance(order_y: np.ndarray, order_x: np.ndarray) -> np.ndarray:
        (k_y, hat_y), (k_x, hat_x) = series_y.hats(order_y), series_x.hats(order_x)
        return layer_compliance(np.hypot(k_x[None, :], k_y[:, None]), gelpad) * (hat_y[:, None] * hat_x)

    repeats = range(-_REPEATS, _REPEATS + 1)
    turn_y, turn_x = (2 * order[-1] for order in orders)
    repeated = sum(compliance(few[0] + turn_y * a, few[1] + turn_x * b) for a in repeats for b in repeats if a or b)
    over_y, over_x = (SplineAxis(at).matrix(order) for at, order in zip(few, orders, strict=True))
    return compliance(*orders) + over_y @ repeated @ over_x.T
