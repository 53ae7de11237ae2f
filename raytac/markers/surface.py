"""Surface tracking: every marker is a point of the soft pad's coat, which moves with the triangle that it lies in.

As in Chen et al. (T-RO 2024) and TacIPC (Du et al., RA-L 2024): barycentric coordinates at rest, kept for ever.
"""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples

__all__ = ["CoatPoints", "SurfaceModel", "bind_to_coat"]

_OUTSIDE = -1e-6
"""Barycentric coordinate from which a point counts as outside a triangle: rounding on a shared edge is not outside."""


def bind_to_coat(mesh: CoatMesh, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the mesh at rest that contain the points ``xy`` [m], shape (…, 2), seen along z.

    Returns vertex numbers (…, 3) and barycentric weights (…, 3).

    Raises:
        InputError: a point lies off the mesh.
    """
    points = np.asarray(xy, float).reshape(-1, 2)
    corners = mesh.rest[mesh.faces][..., :2]
    columns = len(mesh.lines_x) - 1
    cell, cell_of_face = (row * columns + column for column, row in (_cell(mesh, points), _cell(mesh, corners.mean(axis=1))))
    order = np.argsort(cell_of_face, kind="stable")
    first, last = (np.searchsorted(cell_of_face[order], cell, side=side) for side in ("left", "right"))
    best = np.full(len(points), -np.inf)
    face, weights = np.zeros(len(points), dtype=int), np.zeros((len(points), 3))
    for k in range(int((last - first).max(initial=0))):
        candidate = order[np.minimum(first + k, len(order) - 1)]
        w = _barycentric(corners[candidate], points)
        least = np.where(first + k < last, w.min(axis=1), -np.inf)
        better = least > best
        face[better], weights[better], best[better] = candidate[better], w[better], least[better]
    if (best < _OUTSIDE).any():
        point = points[best < _OUTSIDE][0]
        raise InputError("markers", value=[1e3 * float(v) for v in point], rule="a marker (x, y in mm) lies off the coat's mesh")
    shape = np.asarray(xy).shape[:-1]
    return mesh.faces[face].reshape(*shape, 3), weights.reshape(*shape, 3)


def _cell(mesh: CoatMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the cell between grid lines that contains each point."""
    column, row = (
        np.clip(np.searchsorted(line, values, side="right") - 1, 0, len(line) - 2)
        for line, values in ((mesh.lines_x, points[:, 0]), (mesh.lines_y, points[:, 1]))
    )
    return column, row


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of points (N, 2) in triangles (N, 3, 2): areas of the parts over the whole."""
    a, b, c = (triangles[:, k] - points for k in range(3))

    def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]

    parts = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    return parts / parts.sum(axis=1, keepdims=True)


class CoatPoints:
    """Markers bound to a coat mesh; they are bound again when mesh or pattern change."""

    def __init__(self) -> None:
        self._bound: tuple[CoatMesh, np.ndarray, np.ndarray, np.ndarray] | None = None

    def interpolate(self, mesh: CoatMesh, rest: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values of the mesh's vertices (B, V, n) at the markers at ``rest`` (B, M, 3) [m], shape (B, M, n).

        Raises:
            InputError: a marker lies off the mesh.
        """
        pattern = rest[:1] if rest.strides[0] == 0 else rest
        if self._bound is None or self._bound[0] is not mesh or not np.array_equal(self._bound[1], pattern):
            self._bound = mesh, np.array(pattern), *bind_to_coat(mesh, pattern[..., :2])
        vertices, weights = self._bound[2:]
        env = np.arange(len(values))[:, None, None]
        return (weights[..., None] * values[env, vertices]).sum(axis=2)


class SurfaceModel:
    """Model of ``SurfaceMarkers``."""

    needs_contacts = False
    device = "cpu"

    def __init__(self) -> None:
        self._points = CoatPoints()

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y and z [m], shape (B, M, 3), of markers at ``rest`` (B, M, 3).

        Raises:
            InputError: the surface has no coat mesh, or a marker lies off it.
        """
        if surface.coat is None:
            rule = "needs a soft pad (physics='ipc'): a rigid pad has heights only; choose another model, such as fots"
            raise InputError("markers", value="surface", rule=rule)
        mesh = surface.coat.mesh
        return self._points.interpolate(mesh, rest, surface.coat.positions - mesh.rest)
