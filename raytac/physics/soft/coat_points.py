"""Traction on the grid of soft pads and motion of their markers, on the solver's device."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh, bind_to_coat
from raytac.gel.surface import PadGrid
from raytac.gel.traction import cell_areas

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.struct
class Points:
    """Points of triangles of a coat, P of them."""

    corner: wp.array(dtype=wp.vec3i)
    """Vertices of the triangle."""
    weight: wp.array(dtype=wp.vec3d)
    """Barycentric weights."""


@wp.struct
class Rows:
    """A sparse matrix over the vertices, by rows."""

    start: wp.array(dtype=wp.int32)
    column: wp.array(dtype=wp.int32)
    weight: wp.array(dtype=wp.float64)


@wp.kernel
def smooth(rows: Rows, forces: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec3d)):
    """Matrix times forces (B, V), by (environment, vertex)."""
    env, v = wp.tid()
    total = wp.vec3d()
    for k in range(rows.start[v], rows.start[v + 1]):
        total += rows.weight[k] * forces[env, rows.column[k]]
    out[env, v] = total


@wp.func
def at_point(points: Points, values: wp.array2d(dtype=wp.vec3d), env: wp.int32, i: wp.int32) -> wp.vec3d:
    corner, weight = points.corner[i], points.weight[i]
    return weight[0] * values[env, corner[0]] + weight[1] * values[env, corner[1]] + weight[2] * values[env, corner[2]]


@wp.kernel
def spread(points: Points, values: wp.array2d(dtype=wp.vec3d), out: wp.array3d(dtype=wp.vec3f)):
    """Values of vertices (B, V) at the nodes of a grid, by (environment, row)."""
    env, row = wp.tid()
    for i in range(out.shape[2]):
        value = at_point(points, values, env, row * out.shape[2] + i)
        out[env, row, i] = wp.vec3f(wp.float32(value[0]), wp.float32(value[1]), wp.float32(value[2]))


@wp.kernel
def follow(points: Points, rest: wp.array2d(dtype=wp.vec3d), coat: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec2f)):
    """Displacements along x and y of points, by (environment, point); ``rest``: (1, V)."""
    env, i = wp.tid()
    moved = at_point(points, coat, env, i) - at_point(points, rest, 0, i)
    out[env, i] = wp.vec2f(wp.float32(moved[0]), wp.float32(moved[1]))


class CoatTraction:
    """Traction of forces on a coat's vertices, over a grid, linear on each triangle.

    Contact with facets loads neighbouring vertices unevenly: vertices of eight triangles more than those of four, by about 15 % against
    their areas. One pass averages each vertex's traction over its triangles and back by area; it keeps the sum and costs one cell of
    resolution. A vertex's traction is then its force over the integral of its hat function on the grid, so that the sum of
    traction × ``cell_areas`` is the total force exactly. It is per area of the coat at rest, at the rest position (the first
    Piola-Kirchhoff traction).
    """

    def __init__(self, mesh: CoatMesh, grid: PadGrid, device: Any = "cpu") -> None:
        """Prepare a grid. Raises ``InputError`` where it is too coarse for the mesh."""
        corner, weight = bind_to_coat(mesh, np.stack(np.meshgrid(grid.x, grid.y), axis=-1))
        corner, weight = corner.reshape(-1, 3), np.maximum(weight, 0.0).reshape(-1, 3)
        share = weight * cell_areas(grid).ravel()[:, None]
        area = np.bincount(corner.ravel(), share.ravel(), len(mesh.rest))
        if not (area > 0.0).all():
            lone = int((area <= 0.0).sum())
            rule = f"must be finer than the coat's cells: {lone} of its vertices have no node around them"
            raise InputError("pitch", value=grid.pitch, rule=rule)
        self._points, self._shape, self._device = _points(corner, weight, device), grid.shape, device
        self._rows = _rows(_averaging(mesh) / area[:, None], device)
        self._at_vertices: Any = None
        self._out: Any = None

    def launch(self, forces: wp.array) -> wp.array:
        """Launch the traction [Pa] (B, Ny, Nx) of ``vec3f``, of forces (B, V) of ``vec3d`` [N].

        The next call with as many environments overwrites it.
        """
        count = forces.shape[0]
        if self._out is None or len(self._out) != count:
            self._at_vertices = wp.zeros_like(forces)
            self._out = wp.zeros((count, *self._shape), dtype=wp.vec3f, device=self._device)
        self._launch(smooth, forces.shape, [self._rows, forces, self._at_vertices])
        self._launch(spread, self._out.shape[:2], [self._points, self._at_vertices, self._out])
        return self._out

    def __call__(self, forces: np.ndarray) -> np.ndarray:
        """Traction [Pa], shape (B, Ny, Nx, 3), float32, of forces [N], shape (B, V, 3), copied."""
        return self.launch(wp.array(forces, dtype=wp.vec3d, device=self._device)).numpy().copy()

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)


class CoatMarkers:
    """Displacements of markers that move with the triangles of the coat that they lie in."""

    def __init__(self, mesh: CoatMesh, xy: np.ndarray, num_envs: int, device: Any = "cpu") -> None:
        """Markers at ``xy`` (M, 2) [m] at rest. Raises ``InputError`` for one off the mesh."""
        self._points = _points(*bind_to_coat(mesh, xy), device)
        self._rest = wp.array(mesh.rest[None], dtype=wp.vec3d, device=device)
        self.displacement = wp.zeros((num_envs, len(xy)), dtype=wp.vec2f, device=device)
        """Along x and y [m], (B, M) of ``vec2f``, of the last ``launch``."""

    def launch(self, coat: wp.array) -> wp.array:
        """Launch ``displacement`` for the coat (B, V) of ``vec3d`` [m], as it is shown."""
        inputs = [self._points, self._rest, coat, self.displacement]
        wp.launch(follow, dim=self.displacement.shape, inputs=inputs, device=self.displacement.device)
        return self.displacement


def _averaging(mesh: CoatMesh) -> np.ndarray:
    """Matrix (V, V) that averages forces over the triangles around, with the same sum."""
    matrix = np.zeros((len(mesh.rest),) * 2)
    for a in range(3):
        for b in range(3):
            np.add.at(matrix, (mesh.faces[:, a], mesh.faces[:, b]), mesh.face_areas / 9.0)
    return matrix / mesh.vertex_areas


def _rows(matrix: np.ndarray, device: Any) -> Any:
    row, column = np.nonzero(matrix)
    rows: Any = Rows()
    rows.start = wp.array(np.searchsorted(row, np.arange(len(matrix) + 1)), dtype=wp.int32, device=device)
    rows.column = wp.array(column, dtype=wp.int32, device=device)
    rows.weight = wp.array(matrix[row, column], dtype=wp.float64, device=device)
    return rows


def _points(corner: np.ndarray, weight: np.ndarray, device: Any) -> Any:
    points: Any = Points()
    points.corner = wp.array(corner, dtype=wp.vec3i, device=device)
    points.weight = wp.array(weight, dtype=wp.vec3d, device=device)
    return points
