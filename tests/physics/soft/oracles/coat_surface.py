"""The coat as a smooth surface, and the barrier's clearance between it and an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.interpolate import SplineAxis, cell_lengths, hat_matrix
from raytac.gel.surface import rest_height
from raytac.specs.sensor import GelpadSpec
from tests.physics.soft.oracles.matmul import sandwich

_FINER = 3
"""Cells of the lattice to one cell of the coat."""
_ITERATIONS = 8
"""Most steps of the search for the material point at a place."""
_TOLERANCE = 1e-8
"""Step below which that search has converged [m]."""
_SAG = 3.0
"""Allowance for a facet's sag on a convex object, over its depth below its mean over a cell.

For curvature κ that depth is κ cell²/6, and vertices lie up to 0.35 κ cell² below the facets around them (ball of 3.2 mm, cells of
1 mm)."""
_SLACK = 1.0 / 64.0
"""Further allowance, as a share of the cell."""
_CUT = 0.5e-3
"""Height above the object's lowest point [m] at which its underside is cut off in that mean."""


@dataclass(frozen=True)
class CoatPlaces:
    """Material points at the P = rows · columns places of a ``CoatSurface``'s lattice."""

    sag: np.ndarray
    """Rest height at the material point less that at the place [m], shape (P,)."""
    corner: np.ndarray
    """Vertex of the lower corner of each point's cell, shape (P,)."""
    along_x: np.ndarray
    along_y: np.ndarray
    """Spline weights in the cell, shapes (4, P), as ``SplineAxis.weights`` gives them."""


class CoatSurface:
    """The coat as a C² height field: bicubic splines through its vertices' displacements.

    The three components of the displacement d are splines of the material position (u, v). So the surface at rest is exactly the dome,
    and the deformed one has continuous normals and curvature: no facet of the mesh shows. A height field needs the height at a *place*.
    The material point (u, v) that has come to (x, y) is therefore solved for first, by (u, v) ← (x, y) − d_xy(u, v), on a lattice of
    three lines to a cell. A second spline takes the heights from there to the nodes of a grid, in two matrix products a pad.

    Where the edge of the pad has drawn back, the height at its edge is continued. Where the coat hangs over itself, which no height
    field can hold, the search does not converge, and the height is that of its last point.
    """

    def __init__(self, mesh: CoatMesh, gelpad: GelpadSpec) -> None:
        self.mesh = mesh
        self._gelpad = gelpad
        self._axis_x, self._axis_y = SplineAxis(mesh.lines_x), SplineAxis(mesh.lines_y)
        self._lattice_x, self._lattice_y = SplineAxis(_refine(mesh.lines_x)), SplineAxis(_refine(mesh.lines_y))
        x, y = np.meshgrid(self._lattice_x.lines, self._lattice_y.lines)
        self._x, self._y = x.ravel(), y.ravel()
        self._rest = rest_height(gelpad, self._x, self._y)

    def places(self, displacement: np.ndarray) -> CoatPlaces:
        """Material points at the lattice's places, for a ``displacement`` (V, 3) [m]."""
        sideways = self._fields(displacement[:, :2])
        u, v = self._x, self._y
        for _ in range(_ITERATIONS):
            corner, weights = self._cells(u, v)
            d_x, d_y = _evaluate(sideways, corner, *weights, self.mesh.shape[1])
            step_u, step_v = self._x - d_x - u, self._y - d_y - v
            u, v = u + step_u, v + step_v
            if max(np.abs(step_u).max(), np.abs(step_v).max()) < _TOLERANCE:
                break
        corner, (along_x, along_y) = self._cells(u, v)
        lines_x, lines_y = self.mesh.lines_x, self.mesh.lines_y
        on_pad = np.clip(u, lines_x[0], lines_x[-1]), np.clip(v, lines_y[0], lines_y[-1])
        return CoatPlaces(rest_height(self._gelpad, *on_pad) - self._rest, corner, along_x, along_y)

    def rise(self, places: CoatPlaces, upwards: np.ndarray) -> np.ndarray:
        """Height over rest on the lattice [m], (rows, columns), for a displacement along z (V,)."""
        fields = self._fields(upwards[:, None])
        d_z = _evaluate(fields, places.corner, places.along_x, places.along_y, self.mesh.shape[1])[0]
        return (places.sag + d_z).reshape(len(self._lattice_y.lines), len(self._lattice_x.lines))

    def matrices(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(rows, columns) of grid lines [m]: rows @ ``rise(…)`` @ columns is the height over rest."""
        return self._lattice_y.matrix(y), self._lattice_x.matrix(x).T

    def _cells(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        column, along_x = self._axis_x.weights(u)
        row, along_y = self._axis_y.weights(v)
        return row * self.mesh.shape[1] + column, (along_x, along_y)

    def _fields(self, values: np.ndarray) -> np.ndarray:
        """Vertex values (V, C) and second derivatives along x, y and both, (2, 2, C, V)."""
        rows, columns = self.mesh.shape
        f = np.moveaxis(values, -1, 0).reshape(-1, rows, columns)
        bending_x, bending_y = self._axis_x.bending, self._axis_y.bending
        fy = bending_y @ f
        return np.stack([[f, f @ bending_x.T], [fy, fy @ bending_x.T]]).reshape(2, 2, len(f), rows * columns)


class BarrierClearance:
    """Measures the mean clearance that the barrier keeps in a contact, one pad at a time.

    The barrier holds the coat's facets slightly off the object, and where the coat wraps a curved object its vertices lie deeper than
    its facets. Both are artefacts of the discretisation: a real coat touches. Let c = underside of the object − smooth coat. The
    clearance is the mean of c weighted by pressure, over samples under pressure and where c is no more than barrier and sag explain.
    A larger c is a recess of the object. Facets sag only where the object is convex, that is lower than its own mean over a cell.

    The object is shown lower than the solver has it by this clearance, and a press to a depth drives it higher by as much: the coat, not
    the barrier, is at the commanded depth.
    """

    def __init__(self, surface: CoatSurface, rest: np.ndarray, x: np.ndarray, y: np.ndarray, d_hat: float) -> None:
        """Sample at ``x`` (Nx,), ``y`` (Ny,) [m], where the coat rests at ``rest`` (Ny, Nx) [m]."""
        self.x, self.y, self.rest = x, y, rest
        self._surface, self._d_hat = surface, d_hat
        self._rows, self._columns = (m.astype(np.float32) for m in surface.matrices(x, y))
        mesh = surface.mesh
        self._hat_y, self._hat_x = (
            hat_matrix(lines, t).astype(np.float32) for lines, t in ((mesh.lines_y, y), (mesh.lines_x, x))
        )
        self._weights = np.outer(self._hat_y.sum(axis=0), self._hat_x.sum(axis=0))
        cell_x, cell_y = (cell_lengths(lines, t) for lines, t in ((mesh.lines_x, x), (mesh.lines_y, y)))
        self._reach = d_hat + _SLACK * np.maximum(cell_y[:, None], cell_x[None, :])

    def heights(self, rise: np.ndarray) -> np.ndarray:
        """Coat over the samples [m], (Ny, Nx), from the lattice of ``CoatSurface.rise``."""
        return self.rest + sandwich(self._rows, rise, self._columns)

    def measure(self, places: CoatPlaces, upwards: np.ndarray, pressure: np.ndarray, underside: np.ndarray) -> float:
        """Mean clearance of one pad [m], weighted by pressure; NaN out of contact.

        Args:
            places: material points of the coat (see ``CoatSurface.places``).
            upwards: displacement of its vertices along z [m], shape (V,).
            pressure: on its vertices [Pa], shape (V,), 0 out of contact.
            underside: z of the object over the samples [m], shape (Ny, Nx), not finite where it is not.
        """
        pressure = sandwich(self._hat_y, np.maximum(pressure, 0.0).reshape(self._surface.mesh.shape), self._hat_x.T)
        above = np.isfinite(underside)
        if not (above.any() and pressure.any()):
            return float("nan")
        gap = np.where(above, underside, 0.0) - self.heights(self._surface.rise(places, upwards))
        touching = above & (pressure > 0.0) & (gap < self._reach + _SAG * self._bulge(underside, above))
        weight = np.where(touching, pressure, 0.0)
        most = 2.0 * self._d_hat + (self.rest - underside)[above].max()
        return min(float((weight * gap).sum() / weight.sum()), float(most)) if weight.sum() > 0.0 else float("nan")

    def _bulge(self, underside: np.ndarray, above: np.ndarray) -> np.ndarray:
        """Depth of the object below its own mean over a cell [m], (Ny, Nx), 0 where it lies above."""
        highest = underside[above].min() + _CUT
        cut = np.minimum(np.where(above, underside, highest), highest).astype(np.float32)
        mean = sandwich(self._hat_y.T, cut, self._hat_x) / np.maximum(self._weights, 1e-6)
        return np.maximum(sandwich(self._hat_y, mean, self._hat_x.T) - cut, 0.0)


def _evaluate(fields: np.ndarray, corner: np.ndarray, along_x: np.ndarray, along_y: np.ndarray, columns: int) -> np.ndarray:
    """Splines of ``_fields`` at P points, shape (C, P)."""
    out = np.zeros((fields.shape[2], len(corner)))
    for k in range(4):  # value and second derivative at the lower and the upper row
        for m in range(4):
            vertex = corner + (k % 2) * columns + m % 2
            out += (along_y[k] * along_x[m]) * fields[k // 2, m // 2][:, vertex]
    return out


def _refine(lines: np.ndarray) -> np.ndarray:
    """Lines with every cell divided into ``_FINER`` equal ones."""
    share = np.arange(_FINER) / _FINER
    return np.append((lines[:-1, None] + share * np.diff(lines)[:, None]).ravel(), lines[-1])
