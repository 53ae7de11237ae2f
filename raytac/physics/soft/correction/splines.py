"""From the moved vertices of a coat to the smooth surface over the pad's grid that optics takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.interpolate import SplineAxis
from raytac.gel.surface import rest_height
from raytac.specs.sensor import GelpadSpec

__all__ = ["CoatPlaces", "CoatSurface"]

_FINER = 3
"""Lines of the inner lattice to one cell of the coat."""
_ROUNDS = 8
"""Most steps of the search for the material point under a place."""
_CLOSE = 1e-8
"""That search ends when no point moves further than this [m]."""


@dataclass(frozen=True)
class CoatPlaces:
    """The material points that have come under the lattice of a ``CoatSurface``, P = rows · columns of them."""

    sag: np.ndarray
    """Rest height at the material point less that at the place [m], shape (P,)."""
    corner: np.ndarray
    """Vertex of the lower corner of each point's cell, shape (P,)."""
    along_x: np.ndarray
    along_y: np.ndarray
    """Spline weights in the cell, shapes (4, P), as ``SplineAxis.weights`` gives them."""


class CoatSurface:
    """The coat as a C² surface: bicubic splines through the way that its vertices went from rest, looked at from above.

    The three components of the displacement are splines of the material position (u, v), so that the surface at rest is exactly the dome
    and the deformed one has continuous normals and curvature: no facet of the mesh shows. A height field needs the height at a *place*,
    so the material point (u, v) that has come to (x, y) is found first, by (u, v) ← (x, y) − d_xy(u, v). That is done on a lattice of
    three lines a cell; a second spline takes the heights from there to the nodes of a grid, in two matrix products a pad.

    Where the edge of the pad has drawn back, the height at its edge is carried on. Where the coat hangs over itself, which no height
    field can hold, the search does not settle, and the height is that of the point it got to.
    """

    def __init__(self, mesh: CoatMesh, gelpad: GelpadSpec) -> None:
        self.mesh = mesh
        self._gelpad = gelpad
        self._axis_x, self._axis_y = SplineAxis(mesh.lines_x), SplineAxis(mesh.lines_y)
        self._lattice_x, self._lattice_y = SplineAxis(_finer(mesh.lines_x)), SplineAxis(_finer(mesh.lines_y))
        x, y = np.meshgrid(self._lattice_x.lines, self._lattice_y.lines)
        self._x, self._y = x.ravel(), y.ravel()
        self._rest = rest_height(gelpad, self._x, self._y)

    def places(self, displacement: np.ndarray) -> CoatPlaces:
        """Material points under the lattice, for vertices that went ``displacement`` [m], shape (V, 3)."""
        across = self._fields(displacement[:, :2])
        u, v = self._x, self._y
        for _ in range(_ROUNDS):
            corner, weights = self._cells(u, v)
            went = _blend(across, corner, *weights, self.mesh.shape[1])
            step_u, step_v = self._x - went[0] - u, self._y - went[1] - v
            u, v = u + step_u, v + step_v
            if max(np.abs(step_u).max(), np.abs(step_v).max()) < _CLOSE:
                break
        corner, (along_x, along_y) = self._cells(u, v)
        lines_x, lines_y = self.mesh.lines_x, self.mesh.lines_y
        on_pad = np.clip(u, lines_x[0], lines_x[-1]), np.clip(v, lines_y[0], lines_y[-1])
        return CoatPlaces(rest_height(self._gelpad, *on_pad) - self._rest, corner, along_x, along_y)

    def rise(self, places: CoatPlaces, upwards: np.ndarray) -> np.ndarray:
        """Height above the surface at rest [m] over the lattice, (rows, columns), where the vertices rose by ``upwards`` [m], (V,)."""
        fields = self._fields(upwards[:, None])
        risen = _blend(fields, places.corner, places.along_x, places.along_y, self.mesh.shape[1])[0]
        return (places.sag + risen).reshape(len(self._lattice_y.lines), len(self._lattice_x.lines))

    def matrices(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(rows, columns): the surface over grid lines ``x``, ``y`` [m] rises by rows @ ``rise(…)`` @ columns above rest."""
        return self._lattice_y.matrix(y), self._lattice_x.matrix(x).T

    def _cells(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        column, along_x = self._axis_x.weights(u)
        row, along_y = self._axis_y.weights(v)
        return row * self.mesh.shape[1] + column, (along_x, along_y)

    def _fields(self, values: np.ndarray) -> np.ndarray:
        """Values (V, C) at the vertices with their second derivatives along x, y and both, shape (2, 2, C, V)."""
        rows, columns = self.mesh.shape
        f = np.moveaxis(values, -1, 0).reshape(-1, rows, columns)
        bent_x, bent_y = self._axis_x.bending, self._axis_y.bending
        fy = bent_y @ f
        return np.stack([[f, f @ bent_x.T], [fy, fy @ bent_x.T]]).reshape(2, 2, len(f), rows * columns)


def _blend(fields: np.ndarray, corner: np.ndarray, along_x: np.ndarray, along_y: np.ndarray, columns: int) -> np.ndarray:
    """Splines of ``_fields`` at P points, shape (C, P)."""
    out = np.zeros((fields.shape[2], len(corner)))
    for k in range(4):  # value and second derivative at the lower and the upper row
        for m in range(4):
            at = corner + (k % 2) * columns + m % 2
            out += (along_y[k] * along_x[m]) * fields[k // 2, m // 2][:, at]
    return out


def _finer(lines: np.ndarray) -> np.ndarray:
    """Every cell cut into ``_FINER`` equal ones."""
    share = np.arange(_FINER) / _FINER
    return np.append((lines[:-1, None] + share * np.diff(lines)[:, None]).ravel(), lines[-1])
