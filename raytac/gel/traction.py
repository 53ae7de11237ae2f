"""Traction on a pad's grid from a total force."""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace

from raytac.gel.surface import GelSurface, PadGrid


def cell_areas(grid: PadGrid) -> np.ndarray:
    """Area of each node [m²], (Ny, Nx): a cell, half of one at edges, a quarter in corners."""
    along = [np.full(n, pitch) for n, pitch in zip(reversed(grid.shape), grid.pitch, strict=True)]
    for line in along:
        line[[0, -1]] *= 0.5
    return np.outer(along[1], along[0])


def foundation_traction(surface: GelSurface, force: np.ndarray, twist: np.ndarray, *, about_origin: bool = False) -> np.ndarray:
    """Traction [Pa], (B, Ny, Nx, 3), of a total force, distributed as by an elastic foundation.

    The normal traction is proportional to the indentation in contact (K. L. Johnson, Contact Mechanics, section 4.3). The tangential
    force is distributed like the normal one, and the twist likewise times the distance from the contact's centre. The sum of
    traction × ``cell_areas`` is exact; the distribution is a model. A contact narrower than a cell has no twist.

    Args:
        surface: gives contact and indentation.
        force: of the object on the gel, pad frame [N], shape (B, 3).
        twist: torque about +z through the contact's centre [N m], shape (B,).
        about_origin: the torque is about the pad frame's origin.
    """
    grid = surface.grid
    nodes = grid.x, grid.y, cell_areas(grid)
    return spread_force(nodes, surface.contact, surface.indentation, force, twist, about_origin=about_origin)


def spread_force(
    nodes: tuple[Any, Any, Any], contact: Any, indentation: Any, force: Any, twist: Any, *, about_origin: bool = False
) -> Any:
    """``foundation_traction`` of arrays of NumPy, or of PyTorch on any device.

    Args:
        nodes: x of the columns (Nx,) and y of the rows (Ny,) [m], and areas (Ny, Nx) [m²].
        contact, indentation: of the surfaces, (B, Ny, Nx), bool and [m].
        force, twist, about_origin: as there.
    """
    x, y, area = nodes
    xp, count = array_namespace(indentation), indentation.shape[0]

    def total(values: Any) -> Any:
        """Sums over the nodes (B, 1, 1), of rows, so that they do not depend on the batch."""
        return xp.reshape(xp.sum(xp.reshape(values * area, (count, -1)), axis=1), (count, 1, 1))

    share = xp.where(contact, indentation.clip(0.0), 0.0)
    whole = total(share)
    some = whole > 0.0
    share = share / xp.where(some, whole, 1.0)
    x, y = x[None, None, :], y[None, :, None]
    centre = total(share * x), total(share * y)
    if about_origin:
        twist = twist - (centre[0][:, 0, 0] * force[:, 1] - centre[1][:, 0, 0] * force[:, 0])
    x, y = x - centre[0], y - centre[1]
    arm = total(share * (x * x + y * y))
    # The mean square distance of a cell's area from its centre.
    cell = ((x[0, 0, 1] - x[0, 0, 0]) ** 2 + (y[0, 1, 0] - y[0, 0, 0]) ** 2) / 12.0
    turn = xp.where(arm > cell, twist[:, None, None] / xp.where(arm > cell, arm, 1.0), 0.0)
    parts = (force[:, k, None, None] for k in range(3))
    fx, fy, fz = (share * part for part in parts)
    spread = xp.stack([fx - share * turn * y, fy + share * turn * x, fz], axis=-1)
    return xp.astype(xp.where(some[..., None], spread, 0.0), xp.float32)
