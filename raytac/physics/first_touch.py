"""Where an object first touches the domed pad when it comes down along −z, and how far it may go on from there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytac.errors import InputError
from raytac.gel.object_height import object_bounds, object_height
from raytac.gel.pad import rest_height
from raytac.gel.part import Part
from raytac.gel.surface import PadGrid
from raytac.specs.sensor import GelpadSpec

__all__ = ["FirstTouch", "first_touch", "first_touch_z", "gap_at_touch"]

_ZOOMS, _FINE = 4, 17


class FirstTouch(NamedTuple):
    """Where an object first touches the pad."""

    z: float
    """Height of the object's origin [m], pad frame."""
    gap: np.ndarray
    """What ``gap_at_touch`` gives there, (Ny, Nx) [m]."""
    deepest: float
    """Travel from there [m] that takes the object's lowest point over the pad to the bonded face: the thickness at the centre of the pad,
    less on the flanks of the dome."""


def first_touch(parts: Sequence[Part], pose: np.ndarray, gelpad: GelpadSpec, grid: PadGrid) -> FirstTouch:
    """First touch of an object that comes down along −z.

    ``pose`` (4, 4): rotation and x, y of the object in the pad frame; its z is ignored. The touch is at the node of ``grid`` with
    the least distance between object and gel, refined by zooming in on it (a factor 8, four times), so that the result does not
    depend on the pitch beyond features that fall between nodes; the lowest point is refined likewise. Raises ``InputError`` if no part is
    above the pad.
    """
    if not parts:
        raise InputError("parts", value=(), rule="an object without parts cannot touch")
    above = pose.copy()
    above[2, 3] = 0.0

    def underside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return object_height(parts, above[None], x, y)[0]

    def gap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return underside(x, y) - rest_height(gelpad, x[None, :], y[:, None])

    gaps = gap(grid.x, grid.y)
    least = _least(gap, gaps, grid)
    if not np.isfinite(least):
        low, high = object_bounds(parts, above)
        span = f"x {low[0]:.4g}…{high[0]:.4g}, y {low[1]:.4g}…{high[1]:.4g} m"
        rule = f"no part of the object, which spans {span}, is above a node of the pad"
        raise InputError("position", value=tuple(above[:2, 3].tolist()), rule=rule)
    lowest = _least(underside, gaps + grid.rest, grid)
    return FirstTouch(-least, np.maximum(gaps - least, 0.0), gelpad.thickness + lowest - least)


def first_touch_z(parts: Sequence[Part], pose: np.ndarray, gelpad: GelpadSpec, grid: PadGrid) -> float:
    """The height alone."""
    return first_touch(parts, pose, gelpad, grid).z


def gap_at_touch(parts: Sequence[Part], pose: np.ndarray, grid: PadGrid) -> np.ndarray:
    """Distance [m] along z from the resting gel to the object at each node, (Ny, Nx), for a pose at first touch; >= 0."""
    return np.maximum(object_height(parts, pose[None], grid.x, grid.y)[0] - grid.rest, 0.0)


def _least(of: Callable[[np.ndarray, np.ndarray], np.ndarray], values: np.ndarray, grid: PadGrid) -> float:
    """Least value of a function over the pad, which has ``values`` on the grid's nodes: that node is zoomed in on."""
    x, y, least = grid.x, grid.y, np.inf
    for zoom in range(_ZOOMS + 1):
        if zoom:
            values = of(x, y)
        j, i = np.unravel_index(np.argmin(values), values.shape)
        least = min(least, float(values[j, i]))
        if not np.isfinite(least):
            break
        x, y = _around(x, int(i), grid.x), _around(y, int(j), grid.y)
    return least


def _around(nodes: np.ndarray, index: int, pad: np.ndarray) -> np.ndarray:
    """Finer nodes over the two cells beside one node, kept on the pad."""
    step = nodes[1] - nodes[0]
    return np.linspace(max(nodes[index] - step, pad[0]), min(nodes[index] + step, pad[-1]), _FINE)
