"""What a marker finds at its place: height and slope of the surface, and how far the object has moved there."""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts

__all__ = ["height_and_slope", "height_at", "object_displacement"]


def _corners(surface: GelSurface, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat indices in ``height`` of the cells' first nodes and the place in the cell along x and y, each (B, M); clipped to the pad."""
    grid, nodes, parts = surface.grid, [], []
    for axis, count in enumerate(grid.shape[::-1]):
        place = (xy[..., axis] - grid.origin[axis]) / grid.pitch[axis]
        # fmin and fmax pass over NaN: where an environment failed, any node will do.
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
    first, wx, wy = _corners(surface, xy)
    # By flat indices, and in one precision: a fraction of the time of look-ups by three indices and of sums of two types.
    nx, height = surface.grid.shape[1], np.ascontiguousarray(surface.height).reshape(-1)
    a, b, c, d = (height.take(first + step).astype(float) for step in (0, 1, nx, nx + 1))
    top, bottom = a + wx * (b - a), c + wx * (d - c)
    return top + wy * (bottom - top)


def height_and_slope(surface: GelSurface, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z [m] (B, M), its gradient along x, y [-] (B, M, 2), whether the object touches the nearest node (B, M)) at points (B, M, 2) [m]."""
    slopes = []
    for axis, pitch in enumerate(surface.grid.pitch):
        half = np.zeros(2)
        half[axis] = 0.5 * pitch
        slopes.append((height_at(surface, xy + half) - height_at(surface, xy - half)) / pitch)
    first, wx, wy = _corners(surface, xy)
    nearest = first + (wy > 0.5) * surface.grid.shape[1] + (wx > 0.5)
    touched = np.ascontiguousarray(surface.contact).reshape(-1).take(nearest)
    return height_at(surface, xy), np.stack(slopes, axis=-1), touched


def object_displacement(contacts: Contacts, xy: np.ndarray) -> np.ndarray:
    """Tangential way since first touch [m], (B, M, 2), of the object at points ``xy`` (B, M, 2) [m]; that of the nearest contact.

    Δs + (R(Δθ) − 1)(M − G), as a rigid body moves; 0 in an environment without contact.
    """
    out = xy[:, :, None] - contacts.centre[:, None]
    apart = np.where(contacts.active[:, None], (out**2).sum(axis=-1), np.inf)
    nearest = apart.argmin(axis=2)
    rows = np.arange(len(xy))[:, None]
    out = np.take_along_axis(out, nearest[..., None, None], axis=2)[:, :, 0]
    angle = contacts.twist[rows, nearest]
    c, s = np.cos(angle) - 1.0, np.sin(angle)
    turned = np.stack([c * out[..., 0] - s * out[..., 1], s * out[..., 0] + c * out[..., 1]], axis=-1)
    way = contacts.shear[rows, nearest] + turned
    return np.where(np.any(contacts.active, axis=1)[:, None, None], way, 0.0)
