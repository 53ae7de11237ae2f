"""The contact below the size of the mesh's cells: what a coarse solution misses, put right by linear elasticity on a fine grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.interpolate import SplineAxis, hat_matrix
from raytac.gel.matmul import product, sandwich
from raytac.physics.soft.correction.layer import CosineSeries, layer_compliance
from raytac.physics.soft.correction.splines import CoatPlaces, CoatSurface
from raytac.specs.sensor import GelpadSpec

__all__ = ["FineContact", "FineGrid", "FineShape"]

_CLOSE = 1e-6
"""The contact is found when no gap under pressure is wider, and no overlap deeper [m]."""
_LEFT = 20e-6
"""Gaps under pressure that are smaller are closed in the end [m]: between nodes, waves leave some micrometres beside a sharp rim."""
_ROUNDS = 40
"""Most steps of that search; the best of them counts."""
_FAR = 5e-3
"""A gap [m] that no press closes; where there is no object, the gap counts as so wide."""
_REACH = 0.4e-3
"""Gap at zero pressure from which a place is taken to stay clear [m]: more than gel comes up beside a contact."""
_LEAST = 1e-4
"""Vertices that bear less than this share of the most loaded one do not count as touching."""


@dataclass(frozen=True)
class FineShape:
    """One coat with its contact found on the fine grid."""

    rise: np.ndarray
    """Height over rest [m] that is not the normal contact's doing, over the lattice of ``CoatSurface.rise``."""
    pressure: np.ndarray
    """Normal pressure on the fine grid [Pa], (Ny, Nx), >= 0."""
    waves: np.ndarray
    """Amplitudes of the dent that it makes in the layer [m], (Ny, Nx), of the fine grid's cosines."""
    border: np.ndarray
    """Dent [m] at the coat's vertices that the layer's waves miss since the pad ends, (rows, columns)."""
    held: np.ndarray
    """Normal forces on the coat's vertices [N], (V,), along z, that hold the same mesh in contact by linear elasticity."""
    residual: float
    """Deepest overlap or widest gap under pressure that the search for the contact left [m]."""


class FineGrid:
    """Takes shapes on the fine grid to the lines of another grid."""

    def __init__(self, contact: FineContact, x: np.ndarray, y: np.ndarray) -> None:
        mesh = contact.surface.mesh
        self.waves_y, self.waves_x = (
            contact.series_y.synthesis(y).astype(np.float32),
            contact.series_x.synthesis(x).T.astype(np.float32),
        )
        self.border_y = SplineAxis(mesh.lines_y).matrix(y).astype(np.float32)
        self.border_x = SplineAxis(mesh.lines_x).matrix(x).T.astype(np.float32)
        self._rise_y, self._rise_x = (m.astype(np.float32) for m in contact.surface.matrices(x, y))
        self._nearest = tuple(np.abs(line[:, None] - fine).argmin(axis=1) for line, fine in ((y, contact.y), (x, contact.x)))

    def rise(self, shape: FineShape) -> np.ndarray:
        """Height over rest [m], (Ny, Nx)."""
        waves, border = sandwich(self.waves_y, shape.waves, self.waves_x), sandwich(self.border_y, shape.border, self.border_x)
        return self.lattice(shape.rise) - waves - border

    def lattice(self, rise: np.ndarray) -> np.ndarray:
        """``CoatSurface.rise`` over these lines [m], (Ny, Nx)."""
        return sandwich(self._rise_y, rise, self._rise_x)

    def touching(self, shape: FineShape) -> np.ndarray:
        """Where there is pressure, (Ny, Nx), bool: where the nearest node of the fine grid has some."""
        return (shape.pressure > 0.0)[np.ix_(*self._nearest)]

    def lay(self, height: np.ndarray, shape: FineShape, underside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The coat laid on the object between the nodes of the fine grid, and where it touches; both (Ny, Nx).

        Nowhere does it reach into the object; where there is pressure, gaps that the search for the contact may have left are closed,
        g → g³/(1 + g²) with g = gap / 20 µm.

        Args:
            height: coat [m].
            underside: z of the object [m], not finite where it is not.
        """
        gap = np.where(np.isfinite(underside), underside, np.inf) - height
        touching = self.touching(shape) & np.isfinite(gap)
        g = np.where(touching, gap, 0.0) / _LEFT
        closed = np.where(touching, _LEFT * g / (1.0 + g * g), 0.0)
        return (height + np.where(gap < 0.0, gap, closed)).astype(np.float32), touching


class FineContact:
    """Corrects a coat for what its mesh cannot resolve (*defect correction*), one pad at a time.

    A mesh with cells wider than a contact, or than the bend at a contact's rim, makes the dent too wide and lumpy. Where that
    comes from linear elasticity it can be undone. Let w be the solver's height over rest, C its vertices in contact, E w the linear
    response of *the same mesh* to whatever normal forces on C give the heights that w has there, and A p the linear response of
    *the gel* to a pressure p on a fine grid. The shown coat is

        rest + (w − E w) − A p,   with p >= 0, never above the object's underside, and p = 0 where below it:

    the mesh's own normal contact is exchanged for one that is found anew on the fine grid (a linear complementarity problem). What
    remains of the solver, w − E w, is all that is neither: friction, shear and twist, large strain, the gel's way sideways. It jumps
    from vertices that touch, where it is 0, to those beside them, and which do is the mesh's doing: waves of two cells, which are not the
    gel's, are taken out of it. The finer the mesh, the less E w and A p differ. (Correction by the difference of two discretisations of
    a simplified operator: K. Böhmer, P. Hemker and H. Stetter, The defect correction approach, Computing Suppl. 5, 1984.)

    A is the layer's exact compliance (``layer_compliance``) over cosines, as if the pad were continued by its mirror image, and the
    difference that the pad's true sides make, on the coat's own mesh, where it is smooth.
    """

    def __init__(
        self,
        surface: CoatSurface,
        gelpad: GelpadSpec,
        x: np.ndarray,
        y: np.ndarray,
        compliance: np.ndarray,
        continued: np.ndarray,
    ) -> None:
        """Fine grid lines ``x`` (Nx,), ``y`` (Ny,) [m], even, from edge to edge of the pad.

        ``compliance``: z of the coat's vertices over a force along z on each [m/N], (V, V), of the pad's mesh; ``continued``: the same
        if the sides of the pad may not move outwards.
        """
        self.surface, self.x, self.y = surface, x, y
        mesh = surface.mesh
        self._compliance = compliance
        self.sides = (compliance - continued).astype(np.float32)
        self._even_y, self._even_x = _evening(mesh.lines_y), _evening(mesh.lines_x).T
        self.series_x, self.series_y = CosineSeries(x), CosineSeries(y)
        waves = np.hypot(self.series_x.wave_numbers[None, :], self.series_y.wave_numbers[:, None])
        hats = self.series_y.hat[:, None] * self.series_x.hat
        self.layer = (layer_compliance(waves, gelpad) * hats).astype(np.float32)
        self.analysis_y, self.analysis_x = self.series_y.analysis.astype(np.float32), self.series_x.analysis.T.astype(np.float32)
        area_x, area_y = (np.full(len(t), t[1] - t[0]) for t in (x, y))
        for line in (area_x, area_y):
            line[[0, -1]] *= 0.5
        self.force_y = (hat_matrix(mesh.lines_y, y).T * area_y).astype(np.float32)
        self.force_x = (hat_matrix(mesh.lines_x, x) * area_x[:, None]).astype(np.float32)
        self.here = FineGrid(self, x, y)

    def solve(self, places: CoatPlaces, upwards: np.ndarray, load: np.ndarray, clear: np.ndarray) -> FineShape:
        """Find the contact of one pad.

        Args:
            places: material points of the coat (see ``CoatSurface.places``).
            upwards: displacement of its vertices along z [m], shape (V,).
            load: normal force on its vertices [N], shape (V,), 0 out of contact.
            clear: z of the object's underside less the coat at rest [m], over the fine grid; not finite where there is no object.
        """
        held = self._holding(upwards, self.touching(load))
        left = self._even_y @ (upwards - self._compliance @ held).reshape(self.surface.mesh.shape) @ self._even_x
        rise = self.surface.rise(places, left.ravel())
        overlap = self.here.lattice(rise) - np.where(np.isfinite(clear), clear, _FAR)
        start = sandwich(self.force_y.T, load.reshape(self.surface.mesh.shape), self.force_x.T)
        pressure = np.zeros(overlap.shape, np.float32)
        near = overlap > -_REACH
        if near.any():
            rows, columns = (_span(np.asarray(near.any(axis=k))) for k in (1, 0))
            window = _Window(self, rows, columns)
            found, residual = window.press(overlap[rows, columns].astype(np.float32), start[rows, columns])
            pressure[rows, columns] = found
            return FineShape(rise, pressure, *window.respond(found), held, residual)
        return FineShape(rise, pressure, np.zeros_like(pressure), np.zeros(self.surface.mesh.shape, np.float32), held, 0.0)

    @staticmethod
    def touching(load: np.ndarray) -> np.ndarray:
        """Which vertices count as in contact, (V,), by their normal ``load`` [N]."""
        return load > _LEAST * load.max()

    def _holding(self, upwards: np.ndarray, touching: np.ndarray) -> np.ndarray:
        """Forces along z [N], (V,), on ``touching`` vertices that give them the heights they have, by linear elasticity of the mesh.

        Vertices that are bonded cannot move and bear no force here.
        """
        free = touching & (np.diagonal(self._compliance) > 0.0)
        held = np.zeros(len(upwards))
        held[free] = np.linalg.solve(self._compliance[np.ix_(free, free)], upwards[free])
        return held


class _Window:
    """Rows and columns of the fine grid outside which nothing can touch: the contact is searched in there alone, which saves work."""

    def __init__(self, contact: FineContact, rows: slice, columns: slice) -> None:
        c, here = contact, contact.here
        self._layer, self._sides = c.layer, c.sides
        self._analysis = c.analysis_y[:, rows], c.analysis_x[columns]
        self._force = c.force_y[:, rows], c.force_x[columns]
        self._waves = here.waves_y[rows], here.waves_x[:, columns]
        self._border = here.border_y[rows], here.border_x[:, columns]

    def respond(self, pressure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Dent of a pressure [Pa] in this window: amplitudes of the layer's waves, and at the coat's vertices what the sides add [m]."""
        force = sandwich(self._force[0], pressure, self._force[1])
        border = product(self._sides, force.reshape(-1, 1)).reshape(force.shape)
        return self._layer * sandwich(self._analysis[0], pressure, self._analysis[1]), border

    def dent(self, pressure: np.ndarray) -> np.ndarray:
        """The same in this window [m]."""
        waves, border = self.respond(pressure)
        return sandwich(self._waves[0], waves, self._waves[1]) + sandwich(self._border[0], border, self._border[1])

    def press(self, overlap: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Pressure >= 0 [Pa] whose dent takes the ``overlap`` [m] away and leaves no gap under pressure; and the residual [m].

        Conjugate gradients over the nodes in contact, which are revised in every step (I. A. Polonsky and L. M. Keer, Wear 231, 1999).
        """
        pressure = np.where(overlap > 0.0, np.maximum(start, start.max() * 1e-3), 0.0).astype(np.float32)
        way, before, keep, best = np.zeros_like(pressure), 1.0, False, (pressure, np.inf)
        for _ in range(_ROUNDS):
            gap = self.dent(pressure) - overlap
            inside = pressure > 0.0
            left = float(np.square(gap[inside], dtype=float).sum())
            residual = max(-float(gap.min()), float(np.abs(gap[inside]).max(initial=0.0)))
            if residual < best[1]:
                best = pressure, residual
            if residual < _CLOSE:
                break
            way = np.where(inside, gap + (left / before if keep else 0.0) * way, 0.0).astype(np.float32)
            before = left
            answer = self.dent(way)
            along = float((answer[inside] * way[inside]).sum(dtype=float))
            if not along > 0.0:
                break
            stride = np.float32((gap[inside] * way[inside]).sum(dtype=float) / along)
            pressure = np.maximum(np.where(inside, pressure - stride * way, 0.0), 0.0)
            overlapping = (pressure <= 0.0) & (gap < 0.0)
            keep = not overlapping.any()
            pressure[overlapping] -= stride * gap[overlapping]
        return best


def _evening(lines: np.ndarray) -> np.ndarray:
    """Takes waves of two cells out of values on ``lines`` (n,) and leaves straight ones as they are; (n, n), the ends stay.

    Of a wave of λ even cells cos²(π/λ) is left: half of one of four cells, 0.85 of one of eight.
    """
    cell, n = np.diff(lines), len(lines)
    out = np.eye(n)
    for i in range(1, n - 1):
        out[i, i - 1 : i + 2] = 0.5 * cell[i] / (cell[i - 1] + cell[i]), 0.5, 0.5 * cell[i - 1] / (cell[i - 1] + cell[i])
    return out


def _span(used: np.ndarray) -> slice:
    """From the first to the last that is true."""
    at = np.flatnonzero(used)
    return slice(int(at[0]), int(at[-1]) + 1)
