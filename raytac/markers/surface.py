"""Surface tracking: every marker is a point of the simulated coat, carried along by the triangle that it lies in.

As in Chen et al. (T-RO 2024) and TacIPC (Du et al., RA-L 2024): barycentric coordinates at rest, the same ones ever after.
"""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples

__all__ = ["SurfaceMarkers", "bind"]

_OUTSIDE = -1e-6
"""Barycentric coordinate from which a point counts as outside a triangle: rounding on a shared edge is not outside."""


def bind(mesh: CoatMesh, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the mesh at rest that hold the points ``xy`` [m], shape (…, 2), seen along z.

    Returns vertex numbers (…, 3) and barycentric weights (…, 3).

    Raises:
        InputError: a point lies off the mesh.
    """
    points = np.asarray(xy, float).reshape(-1, 2)
    corners = mesh.rest[mesh.faces][..., :2]
    column, row = _cell(mesh, points)
    face_column, face_row = _cell(mesh, corners.mean(axis=1))
    columns = len(mesh.lines_x) - 1
    cell_of_face = face_row * columns + face_column
    order = np.argsort(cell_of_face, kind="stable")
    cell = row * columns + column
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
        lost = points[best < _OUTSIDE][0]
        raise InputError("markers", value=[1e3 * float(v) for v in lost], rule="a marker (x, y in mm) lies off the coat's mesh")
    shape = np.asarray(xy).shape[:-1]
    return mesh.faces[face].reshape(*shape, 3), weights.reshape(*shape, 3)


def _cell(mesh: CoatMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the cell between grid lines that holds each point."""
    found = []
    for line, values in ((mesh.lines_x, points[:, 0]), (mesh.lines_y, points[:, 1])):
        found.append(np.clip(np.searchsorted(line, values, side="right") - 1, 0, len(line) - 2))
    return found[0], found[1]


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of points (N, 2) in triangles (N, 3, 2): areas of the parts over the whole."""
    a, b, c = (triangles[:, k] - points for k in range(3))

    def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]

    parts = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    return parts / parts.sum(axis=1, keepdims=True)


class SurfaceMarkers:
    """The model ``surface``: needs a physics that simulates the gel, ``GelSurface.coat``."""

    name = "surface"
    needs_contacts = False
    device = "cpu"

    def __init__(self) -> None:
        self._bound: tuple[CoatMesh, np.ndarray, np.ndarray, np.ndarray] | None = None

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y and z [m], shape (B, M, 3), of markers at ``rest`` (B, M, 3).

        Raises:
            InputError: the surface has no coat mesh, or a marker lies off it.
        """
        if surface.coat is None:
            rule = "needs a simulated gel (physics='ipc'): a rigid pad knows only heights; choose another model"
            raise InputError("markers", value="surface", rule=rule, choices=("fots", "superposition", "force_field"))
        vertices, weights = self._bind(surface.coat.mesh, rest)
        positions, at_rest = surface.coat.positions, surface.coat.mesh.rest
        env = np.arange(len(positions))[:, None, None]
        moved = positions[env, vertices] - at_rest[vertices]
        return (weights[..., None] * moved).sum(axis=2)

    def _bind(self, mesh: CoatMesh, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and weights (B or 1, M, 3); bound once for a mesh and a pattern."""
        one = rest[:1] if rest.strides[0] == 0 else rest
        if self._bound is None or self._bound[0] is not mesh or not np.array_equal(self._bound[1], one):
            self._bound = mesh, np.array(one), *bind(mesh, one[..., :2])
        return self._bound[2], self._bound[3]
