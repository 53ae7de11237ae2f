"""The undeformed pad: its domed rest surface and the regular grid of nodes over it."""

from __future__ import annotations

import numpy as np

from raytac.checks import check_number
from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.specs.sensor import GelpadSpec

__all__ = ["COARSEST_PITCH", "MOST_CELLS", "grid_pitch", "make_grid", "rest_height"]

COARSEST_PITCH = 0.1e-3
"""Spacing of the pad's grid where the image does not ask for a finer one [m]."""


MOST_CELLS = 8192
"""Most cells of the pad's grid along an axis, as many as an image can have pixels."""


def grid_pitch(pixel: tuple[float, float]) -> float:
    """Spacing [m] of the nodes for an image whose pixels cover ``pixel`` (x, y) [m] of the pad: as fine as the image."""
    return min(COARSEST_PITCH, *pixel)


def rest_height(gelpad: GelpadSpec, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rest surface z [m] at pad-frame positions ``x``, ``y`` [m] of any shapes that broadcast.

    z = −``gelpad.sag(x, y)``: 0 at the pad centre, an exact circle along both axes, the paraboloid −x²/(2Rx) − y²/(2Ry) to fourth
    order, flat along an axis whose radius is ``inf``.
    """
    return -gelpad.sag(np.asarray(x, float), np.asarray(y, float))


def make_grid(gelpad: GelpadSpec, pitch: float) -> PadGrid:
    """Grid of nodes over the whole pad.

    ``pitch`` [m] is the wanted spacing; along each axis it is adjusted to size / round(size / pitch), so that nodes fall on both
    edges. Raises ``InputError`` if the pitch is not positive and finite, or leaves fewer than two cells along an axis or more than
    ``MOST_CELLS``.
    """
    check_number("pitch", pitch, "(0, inf)", "m")
    for axis, size in zip("xy", gelpad.size, strict=True):
        if not 1.5 <= size / pitch <= MOST_CELLS:
            rule = f"must divide the pad's {size:g} m along {axis} into 2 to {MOST_CELLS} cells"
            raise InputError("pitch", value=pitch, rule=rule)
    x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / pitch) + 1) for size in gelpad.size)
    return PadGrid(x=x, y=y, rest=rest_height(gelpad, x[None, :], y[:, None]))
