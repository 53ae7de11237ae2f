"""The undeformed pad: its domed rest surface and the regular grid of nodes over it."""

from __future__ import annotations

import numpy as np

from raytac.checks import check_kind, check_number
from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.specs.sensor import GelpadSpec

__all__ = ["COARSEST_PITCH", "MOST_CELLS", "check_grid", "grid_pitch", "make_grid", "rest_height"]

COARSEST_PITCH = 0.1e-3
"""Spacing of the pad's grid where the image does not ask for a finer one [m]."""


MOST_CELLS = 8192
"""Most cells of the pad's grid along an axis, as many as an image can have pixels."""
_SAME = 1e-6
"""Difference within which a grid is of a pad [m]."""


def grid_pitch(pixel: tuple[float, float]) -> float:
    """Spacing [m] of the nodes for an image whose pixels cover ``pixel`` (x, y) [m] of the pad: as fine as the image."""
    return min(COARSEST_PITCH, *pixel)


def rest_height(gelpad: GelpadSpec, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rest surface z [m] at pad-frame positions ``x``, ``y`` [m] of any shapes that broadcast.

    z = −``gelpad.sag(x, y)``: 0 at the pad centre, an exact circle along both axes, the paraboloid −x²/(2Rx) − y²/(2Ry) to fourth
    order, flat along an axis whose radius is ``inf``.
    """
    return -gelpad.sag(np.asarray(x, float), np.asarray(y, float))


def check_grid(gelpad: GelpadSpec, grid: PadGrid) -> None:
    """Raise ``InputError`` unless ``grid`` spans this gelpad, to a micrometre, and rests on its dome."""
    ends = [float(nodes[k]) for nodes in (grid.x, grid.y) for k in (0, -1)]
    own = [sign * 0.5 * size for size in gelpad.size for sign in (-1.0, 1.0)]
    if not np.allclose(ends, own, rtol=0.0, atol=_SAME):
        rule = f"must be a grid of this sensor's pad, x and y from {own} m"
        raise InputError("surface.grid", value=ends, rule=rule)
    off = float(np.abs(grid.rest - rest_height(gelpad, grid.x[None, :], grid.y[:, None])).max())
    if not off <= _SAME:
        raise InputError("surface.grid", value=off, rule="must rest on this sensor's dome; its nodes are so far off it [m]")


def make_grid(gelpad: GelpadSpec, pitch: float) -> PadGrid:
    """Grid of nodes over the whole pad.

    ``pitch`` [m] is the wanted spacing; along each axis it is adjusted to size / round(size / pitch), so that nodes fall on both
    edges. Raises ``InputError`` if the pitch is not positive and finite, or leaves fewer than two cells along an axis or more than
    ``MOST_CELLS``.
    """
    check_kind("gelpad", gelpad, GelpadSpec)
    check_number("pitch", pitch, "(0, inf)", "m")
    for axis, size in zip("xy", gelpad.size, strict=True):
        if not 1.5 <= size / pitch <= MOST_CELLS:
            rule = f"must divide the pad's {size:g} m along {axis} into 2 to {MOST_CELLS} cells"
            raise InputError("pitch", value=pitch, rule=rule)
    x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / pitch) + 1) for size in gelpad.size)
    return PadGrid(x=x, y=y, rest=rest_height(gelpad, x[None, :], y[:, None]))
