"""Surface and object at the markers: height, slope, contact, displacement."""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts


def _cells(surface: GelSurface, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First node of each point's cell as a flat index, and its place in the cell, (B, M).

    Points beyond the pad are moved to its edge.
    """
    grid, nodes, parts = surface.grid, [], []
    for axis, count in enumerate(grid.shape[::-1]):
        place = (xy[..., axis] - grid.origin[axis]) / grid.pitch[axis]
        # fmin and fmax ignore NaN: where an environment failed, any node is as good.
        place = np.fmax(np.fmin(place, count - 1.001), 0.0)
        nodes.append(place.astype(int))
        parts.append(place - nodes[-1])
    ny, nx = grid.shape
    first = nodes[1] * nx + nodes[0]
    if len(xy) > 1:
        first += (nx * ny) * np.arange(len(xy))[:, None]
    return first, parts[0], parts[1]


def height_at(surface: GelSurface, xy: np.ndarray) -> np.ndarray:
    """z of the surface at points (B, M, 2) [m], bilinear, shape (B, M)."""
    first, wx, wy = _cells(surface, xy)
    # Flat indices and one precision take a fraction of the time of three indices and sums of two types.
    nx, height = surface.grid.shape[1], np.ascontiguousarray(surface.height).reshape(-1)
    a, b, c, d = (height.take(first + step).astype(float) for step in (0, 1, nx, nx + 1))
    top, bottom = a + wx * (b - a), c + wx * (d - c)
    return top + wy * (bottom - top)


def height_and_slope(surface: GelSurface, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z [m] (B, M), gradient (B, M, 2), contact of the nearest node (B, M), at (B, M, 2) [m]."""
    slopes = []
    for axis, pitch in enumerate(surface.grid.pitch):
        half = np.zeros(2)
        half[axis] = 0.5 * pitch
        slopes.append((height_at(surface, xy + half) - height_at(surface, xy - half)) / pitch)
    first, wx, wy = _cells(surface, xy)
    nearest = first + (wy > 0.5) * surface.grid.shape[1] + (wx > 0.5)
    touched = np.ascontiguousarray(surface.contact).reshape(-1).take(nearest)
    return height_at(surface, xy), np.stack(slopes, axis=-1), touched


def object_displacement(contacts: Contacts, xy: np.ndarray) -> np.ndarray:
    """Displacement (B, M, 2) [m] of the object at points ``xy`` (B, M, 2) [m].

    It is tangential, since first touch.
    That of the nearest contact, as a rigid body: Δs + (R(Δθ) − 1)(M − G). 0 in an environment without contact.
    """
    x = xy[:, :, None] - contacts.centre[:, None]
    squared = np.where(contacts.active[:, None], (x**2).sum(axis=-1), np.inf)
    nearest = squared.argmin(axis=2)
    rows = np.arange(len(xy))[:, None]
    x = np.take_along_axis(x, nearest[..., None, None], axis=2)[:, :, 0]
    angle = contacts.twist[rows, nearest]
    c, s = np.cos(angle) - 1.0, np.sin(angle)
    turned = np.stack([c * x[..., 0] - s * x[..., 1], s * x[..., 0] + c * x[..., 1]], axis=-1)
    displacement = contacts.shear[rows, nearest] + turned
    return np.where(np.any(contacts.active, axis=1)[:, None, None], displacement, 0.0)
