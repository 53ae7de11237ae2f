"""What a marker finds at its place: height and slope of the surface, and how far the object has moved there."""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts

__all__ = ["height_and_slope", "height_at", "object_way"]


def _corners(surface: GelSurface, xy: np.ndarray) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Indices (env, row, column) of the cells' first nodes and the place in the cell along x and y, each (B, M); clipped to the pad."""
    grid = surface.grid
    last = np.array((len(grid.x) - 1.001, len(grid.y) - 1.001))
    # Both axes in one call, since calls cost more than these numbers. fmin and fmax pass over NaN: where an environment failed, any
    # node will do.
    place = np.fmax(np.fmin((xy - np.array((grid.x[0], grid.y[0]))) / np.array(grid.pitch), last), 0.0)
    node = place.astype(int)
    part = place - node
    return (np.arange(len(xy))[:, None], node[..., 1], node[..., 0]), part[..., 0], part[..., 1]


def height_at(surface: GelSurface, xy: np.ndarray) -> np.ndarray:
    """z of the surface at points (B, M, 2) [m], bilinear, shape (B, M)."""
    (env, row, column), wx, wy = _corners(surface, xy)
    # One take by flat indices: a fraction of the time of four look-ups by three indices.
    _, ny, nx = surface.height.shape
    node, height = (env * ny + row) * nx + column, np.ascontiguousarray(surface.height).reshape(-1)
    corners = height.take(node[..., None] + np.array((0, nx, 1, nx + 1)))
    left, right = corners[..., :2], corners[..., 2:]
    lines = left + wx[..., None] * (right - left)
    top, bottom = lines[..., 0], lines[..., 1]
    return top + wy * (bottom - top)


def height_and_slope(surface: GelSurface, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z [m] (B, M), its gradient along x, y [-] (B, M, 2), whether the object touches the nearest node (B, M)) at points (B, M, 2) [m]."""
    slopes = []
    for axis, pitch in enumerate(surface.grid.pitch):
        half = np.zeros(2)
        half[axis] = 0.5 * pitch
        slopes.append((height_at(surface, xy + half) - height_at(surface, xy - half)) / pitch)
    (env, row, column), wx, wy = _corners(surface, xy)
    contact = np.asarray(surface.contact)
    touched = contact[env, row + (wy > 0.5), column + (wx > 0.5)]
    return height_at(surface, xy), np.stack(slopes, axis=-1), touched


def object_way(contacts: Contacts, xy: np.ndarray) -> np.ndarray:
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
