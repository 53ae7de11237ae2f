"""The clearance that a barrier keeps between object and coat, and how it is taken out of what is shown."""

from __future__ import annotations

import numpy as np

from raytac.gel.interpolate import hat_matrix
from raytac.gel.matmul import sandwich
from raytac.physics.soft.correction.splines import CoatPlaces, CoatSurface

__all__ = ["StandOff"]

_SAG = 3.0
"""Allowance for a facet's sag on a convex object, in units of how far the object lies below its own mean over a cell: for curvature κ
that is κ cell²/6, and a vertex was seen to lie up to 0.35 κ cell² below the facets around it (ball of 3.2 mm on cells of 1 mm)."""
_SLACK = 1.0 / 64.0
"""Further allowance, as a share of the cell."""
_CUT = 0.5e-3
"""Height above the object's lowest point [m] up to which its underside counts in that mean; beyond the object it counts as so high."""


class StandOff:
    """Takes the barrier's clearance out of a contact, one pad at a time.

    The barrier holds the coat's facets a little off the object, and where the coat wraps a curved object its vertices lie deeper than
    its facets. Both are artefacts of the discretisation: a real coat touches. Let c = underside of the object − smooth coat. Over samples
    that bear pressure and where c is no more than barrier and sag explain (more is a recess of the object; and facets sag only where the
    object is convex, so lower than its own mean over a cell), the clearance of the press is the mean of c weighted by pressure. The
    object is taken to be that much lower than the solver has it, and a press to a depth drives it that much higher: the coat, not the
    barrier's shell, is at the commanded depth.

    The coat that is shown in and around the contact comes from ``FineContact``; this says where the object is.
    """

    def __init__(self, surface: CoatSurface, rest: np.ndarray, x: np.ndarray, y: np.ndarray, d_hat: float) -> None:
        """Samples at ``x`` (Nx,) and ``y`` (Ny,) [m], where the coat at rest has the height ``rest`` (Ny, Nx) [m]."""
        self.x, self.y, self.rest = x, y, rest
        self._surface = surface
        self._rows, self._columns = (m.astype(np.float32) for m in surface.matrices(x, y))
        mesh = surface.mesh
        self._hat_y, self._hat_x = (
            hat_matrix(lines, t).astype(np.float32) for lines, t in ((mesh.lines_y, y), (mesh.lines_x, x))
        )
        self._everywhere = np.outer(self._hat_y.sum(axis=0), self._hat_x.sum(axis=0))
        cell_x, cell_y = (_cell_length(lines, t) for lines, t in ((mesh.lines_x, x), (mesh.lines_y, y)))
        self._reach = d_hat + _SLACK * np.maximum(cell_y[:, None], cell_x[None, :])

    def heights(self, rise: np.ndarray) -> np.ndarray:
        """Coat over the samples [m], (Ny, Nx), from the lattice of ``CoatSurface.rise``."""
        return self.rest + sandwich(self._rows, rise, self._columns)

    def clearance(self, places: CoatPlaces, upwards: np.ndarray, pressure: np.ndarray, underside: np.ndarray) -> float:
        """Mean clearance of one pad, weighted by pressure [m]: the object has to be brought down by so much to touch. NaN out of contact.

        Args:
            places: material points of the coat (see ``CoatSurface.places``).
            upwards: displacement of its vertices along z [m], shape (V,).
            pressure: on its vertices [Pa], shape (V,), 0 out of contact.
            underside: z of the object over the samples [m], shape (Ny, Nx), not finite where it is not.
        """
        borne = sandwich(self._hat_y, np.maximum(pressure, 0.0).reshape(self._surface.mesh.shape), self._hat_x.T)
        there = np.isfinite(underside)
        if not (there.any() and borne.any()):
            return float("nan")
        gap = np.where(there, underside, 0.0) - self.heights(self._surface.rise(places, upwards))
        near = there & (borne > 0.0) & (gap < self._reach + _SAG * self._bulge(underside, there))
        weight = np.where(near, borne, 0.0)
        return float((weight * gap).sum() / weight.sum()) if weight.sum() > 0.0 else float("nan")

    def _bulge(self, underside: np.ndarray, there: np.ndarray) -> np.ndarray:
        """How far the object lies below its mean over a cell around [m], (Ny, Nx), 0 where it lies above."""
        highest = underside[there].min() + _CUT
        cut = np.minimum(np.where(there, underside, highest), highest).astype(np.float32)
        mean = sandwich(self._hat_y.T, cut, self._hat_x) / np.maximum(self._everywhere, 1e-6)
        return np.maximum(sandwich(self._hat_y, mean, self._hat_x.T) - cut, 0.0)


def _cell_length(lines: np.ndarray, t: np.ndarray) -> np.ndarray:
    cell = np.clip(np.searchsorted(lines, t, side="right") - 1, 0, len(lines) - 2)
    return np.diff(lines)[cell]
