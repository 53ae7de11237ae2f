"""Response of the gel layer at the nodes of a grid to pressures that are linear between them."""

from __future__ import annotations

import numpy as np

from raytac.gel.interpolate import SplineAxis
from raytac.physics.bonded_layer import layer_compliance
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.specs.sensor import GelpadSpec

_REPEATS = 8
"""Repetitions of a pressure's spectrum to each side that are counted: 0.2 % is missing in the shortest waves."""
_FEW = 17
"""Wave numbers along each axis at which the repetitions are summed."""


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
