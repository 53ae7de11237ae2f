"""Traction of vertex forces in NumPy: the oracle of ``raytac.physics.soft.coat_points``."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh, bind_to_coat
from raytac.gel.surface import PadGrid
from raytac.gel.traction import cell_areas


class CoatTraction:
    """Traction of forces on a coat's vertices, over a grid, linear on each triangle.

    Contact with facets loads neighbouring vertices unevenly: vertices of eight triangles more than those of four, by about 15 % against
    their areas. One pass averages each vertex's traction over its triangles and back by area; it keeps the sum and costs one cell of
    resolution. A vertex's traction is then its force over the integral of its hat function on the grid, so that the sum of
    traction × ``cell_areas`` is the total force exactly. It is per area of the coat at rest, at the rest position (the first
    Piola-Kirchhoff traction).
    """

    def __init__(self, mesh: CoatMesh, grid: PadGrid) -> None:
        corner, weight = bind_to_coat(mesh, np.stack(np.meshgrid(grid.x, grid.y), axis=-1))
        self._corner, self._weight = corner.reshape(-1, 3), np.maximum(weight, 0.0).reshape(-1, 3)
        share = self._weight * cell_areas(grid).ravel()[:, None]
        self._area = np.bincount(self._corner.ravel(), share.ravel(), len(mesh.rest))
        if not (self._area > 0.0).all():
            lone = int((self._area <= 0.0).sum())
            rule = f"must be finer than the coat's cells: {lone} of its vertices have no node around them"
            raise InputError("pitch", value=grid.pitch, rule=rule)
        self._shape = grid.shape
        self._faces = mesh.faces
        self._third, self._lumped = mesh.face_areas[:, None, None] / 3.0, mesh.vertex_areas[:, None]

    def __call__(self, forces: np.ndarray) -> np.ndarray:
        """Traction [Pa], shape (B, Ny, Nx, 3), float32, of forces [N], shape (B, V, 3)."""
        at_vertices = np.stack([self._smoothed(f) for f in forces]) / self._area[:, None]
        spread = sum(at_vertices[:, self._corner[:, k]] * self._weight[:, k, None] for k in range(3))
        return np.asarray(spread, np.float32).reshape(len(forces), *self._shape, 3)

    def _smoothed(self, forces: np.ndarray) -> np.ndarray:
        """Forces (V, 3) after one averaging pass over the triangles, with the same sum."""
        at_faces = (forces / self._lumped)[self._faces].mean(axis=1, keepdims=True) * self._third
        out = np.zeros_like(forces)
        np.add.at(out, self._faces, np.broadcast_to(at_faces, (len(self._faces), 3, 3)))
        return out
