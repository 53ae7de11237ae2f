"""The clearance that a barrier keeps between object and coat, and how it is taken out of what is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.coat_surface import CoatPlaces, CoatSurface
from raytac.gel.spline import hat_matrix

__all__ = ["ContactFit", "StandOff"]

_ROUNDS = 3
"""Passes of the local correction; each leaves about a fifth of what the one before left."""
_COVERED = 0.5
"""Share of a vertex's surroundings that must be in contact for the whole local correction; with less, it fades to none."""
_TIGHTEST = 2.0
"""Tightest curvature that a cell can follow: a radius of so many cells. A facet on it sags by cell / (8 · this)."""


@dataclass(frozen=True)
class ContactFit:
    """How one coat lies against its object."""

    clearance: float
    """Mean clearance, weighted by pressure [m]: the object has to be brought down by so much to touch. NaN out of contact."""
    shift: np.ndarray
    """What the coat's vertices are then moved up by [m], shape (V,)."""


class StandOff:
    """Takes the barrier's clearance out of a contact, one pad at a time.

    The barrier holds the coat's facets a little off the object, and where the coat wraps a curved object its vertices lie deeper than its
    facets. Both are artefacts of the discretisation: a real coat touches. With c = underside of the object − surface of the coat on a
    grid of samples, at the places that bear pressure and where c < d̂ + cell/16 (more than the barrier and a facet's sag can explain is
    no contact but a recess of the object):

    1. *mean*: the clearance of the press is the mean of c, weighted by the pressure. The object is taken to be that much lower than
       the solver has it, and a press to a depth drives it that much higher: the coat, not the barrier's shell, is at the commanded depth.
    2. *local*: each vertex in contact moves by the mean of what is left of c around it (three passes). It fades out at the rim of
       the contact. Vertices out of contact stay where the solver put them, unless the smooth coat would reach into the object there.
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
        self._reach = d_hat + np.maximum(cell_y[:, None], cell_x[None, :]) / (8.0 * _TIGHTEST)

    def heights(self, rise: np.ndarray) -> np.ndarray:
        """Coat over the samples [m], (Ny, Nx), from the lattice of ``CoatSurface.rise``."""
        return self.rest + self._rows @ rise.astype(np.float32) @ self._columns

    def fit(self, places: CoatPlaces, upwards: np.ndarray, pressure: np.ndarray, underside: np.ndarray) -> ContactFit:
        """Clearance and local shifts of one pad.

        Args:
            places: material points of the coat (see ``CoatSurface.places``).
            upwards: displacement of its vertices along z [m], shape (V,).
            pressure: on its vertices [Pa], shape (V,), 0 out of contact.
            underside: z of the object over the samples [m], shape (Ny, Nx), not finite where it is not.
        """
        shape = self._surface.mesh.shape
        borne = self._hat_y @ np.maximum(pressure, 0.0).reshape(shape).astype(np.float32) @ self._hat_x.T
        shift = np.zeros(len(upwards))
        there = np.isfinite(underside)
        gap = np.where(there, underside, 0.0) - self.heights(self._surface.rise(places, upwards))
        near = there & (borne > 0.0) & (gap < self._reach)
        weight = np.where(near, borne, 0.0)
        if not weight.sum() > 0.0:
            return ContactFit(float("nan"), shift)
        clearance = float((weight * gap).sum() / weight.sum())
        gap = gap - clearance
        for again in range(_ROUNDS):
            if again:
                moved = self._surface.rise(places, upwards + shift)
                gap = np.where(there, underside, 0.0) - clearance - self.heights(moved)
            counted = (near | (there & (gap < 0.0))).astype(np.float32)
            share = self._hat_y.T @ counted @ self._hat_x
            mean = (self._hat_y.T @ (counted * gap).astype(np.float32) @ self._hat_x) / np.maximum(share, 1e-6)
            shift += (np.clip(share / self._everywhere / _COVERED, 0.0, 1.0) * mean).ravel()
        return ContactFit(clearance, shift)


def _cell_length(lines: np.ndarray, t: np.ndarray) -> np.ndarray:
    cell = np.clip(np.searchsorted(lines, t, side="right") - 1, 0, len(lines) - 2)
    return np.diff(lines)[cell]
