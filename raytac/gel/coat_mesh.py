"""The coat as a triangle mesh: a soft pad's surface at rest and deformed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytac.errors import InputError

_OUTSIDE = -1e-6
"""Barycentric coordinate below which a point is outside a triangle, beyond rounding."""


@dataclass(frozen=True, repr=False)
class CoatMesh:
    """The outer face of a pad at rest, pad frame.

    The vertices are the crossings of grid lines, row by row: vertex (j, i) of ny rows and nx columns has number j·nx + i and lies at
    x = ``lines_x[i]``, y = ``lines_y[j]``. Grid lines need not be evenly spaced.
    """

    rest: np.ndarray
    """Vertices [m], shape (V, 3), float64, z the height of the surface at rest."""
    faces: np.ndarray
    """Vertex numbers (F, 3), int32, counter-clockwise seen from +z; they tile the face."""
    lines_x: np.ndarray
    """x of the columns [m], shape (nx,), ascending, from edge to edge of the pad."""
    lines_y: np.ndarray
    """y of the rows [m], shape (ny,), likewise."""

    def __post_init__(self) -> None:
        if self.rest.shape != (len(self.lines_x) * len(self.lines_y), 3):
            rule = f"must have shape (V, 3) with V = {len(self.lines_y)} rows x {len(self.lines_x)} columns"
            raise InputError("rest", value=self.rest.shape, rule=rule)

    def __repr__(self) -> str:
        return f"CoatMesh({len(self.lines_y)} x {len(self.lines_x)} vertices, {len(self.faces)} faces)"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of vertices (ny, nx)."""
        return len(self.lines_y), len(self.lines_x)

    @cached_property
    def face_areas(self) -> np.ndarray:
        """Area of each face at rest [m²], shape (F,)."""
        a, b, c = (self.rest[self.faces[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @cached_property
    def vertex_areas(self) -> np.ndarray:
        """A third of the areas of the faces around each vertex [m²], shape (V,)."""
        return np.bincount(self.faces.ravel(), np.repeat(self.face_areas / 3.0, 3), len(self.rest))


@dataclass(frozen=True, repr=False)
class DeformedCoat:
    """The coat of B pads at one instant: ``GelSurface.coat`` of a soft pad."""

    mesh: CoatMesh
    positions: np.ndarray
    """Vertices [m], (B, V, 3), float64, pad frame: where the image shows them (``SoftReader``)."""

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[1:] != self.mesh.rest.shape:
            raise InputError("positions", value=self.positions.shape, rule=f"must have shape (B, {len(self.mesh.rest)}, 3)")

    def __repr__(self) -> str:
        return f"DeformedCoat({self.mesh!r}, batch {len(self.positions)})"

    @property
    def displacement(self) -> np.ndarray:
        """Displacement of every vertex from rest [m], shape (B, V, 3)."""
        return self.positions - self.mesh.rest[None]


def bind_to_coat(mesh: CoatMesh, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the mesh at rest that contain points ``xy`` (…, 2) [m], seen along z.

    Returns vertex numbers (…, 3) and barycentric weights (…, 3).

    Raises ``InputError``: a point lies off the mesh.
    """
    points = np.asarray(xy, float).reshape(-1, 2)
    corners = mesh.rest[mesh.faces][..., :2]
    cell, cell_of_face = _cell(mesh, points), _cell(mesh, corners.mean(axis=1))
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


def _cell(mesh: CoatMesh, points: np.ndarray) -> np.ndarray:
    """Number of the cell between grid lines that contains each point, row by row."""
    column, row = (
        np.clip(np.searchsorted(line, points[:, k], side="right") - 1, 0, len(line) - 2)
        for k, line in enumerate((mesh.lines_x, mesh.lines_y))
    )
    return row * (len(mesh.lines_x) - 1) + column


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of points (N, 2) in triangles (N, 3, 2): areas of the parts over the whole."""
    a, b, c = (triangles[:, k] - points for k in range(3))

    def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]

    parts = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    return parts / parts.sum(axis=1, keepdims=True)
