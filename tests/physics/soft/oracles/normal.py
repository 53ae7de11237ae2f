"""Correction of normal contact below the size of the mesh's cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.components import span
from raytac.gel.interpolate import SplineAxis, hat_matrix
from raytac.physics.soft.correction.cosine_series import CosineSeries, nodal_compliance
from raytac.physics.soft.settings import DEFAULT_CORRECTION, Correction
from raytac.specs.sensor import GelpadSpec
from tests.physics.soft.oracles.coat_surface import CoatPlaces, CoatSurface
from tests.physics.soft.oracles.matmul import product, sandwich

_SHORTEST = 0.5
"""c of ``_stiffen``, in units of the grid: the fewest steps of the solver for pins, a coin and a gear."""


@dataclass(frozen=True)
class NormalContact:
    """Normal contact of one pad, solved on the fine grid."""

    rise: np.ndarray
    """w − E w: height over rest [m] not due to normal contact, as of ``CoatSurface.rise``."""
    pressure: np.ndarray
    """p: normal pressure on the fine grid [Pa], (Ny, Nx), >= 0."""
    waves: np.ndarray
    """Cosine amplitudes of the pressure [Pa], (Ny, Nx)."""
    dent: np.ndarray
    """A p at the nodes of the fine grid [m], (Ny, Nx)."""
    mesh_forces: np.ndarray
    """Normal forces on the coat's vertices [N], (V,), that hold the linear mesh in contact."""
    residual: float
    """Deepest overlap or widest gap under pressure that the solution has [m]."""


class ContactSampler:
    """Evaluates normal contacts of the fine grid over the lines of another grid, or of its own.

    Between the nodes the dent is a cubic spline: cosines up to the shortest wave of the grid would ring along a sharp rim.
    """

    def __init__(self, correction: NormalCorrection, x: np.ndarray, y: np.ndarray) -> None:
        self._closed_gap = correction.settings.closed_gap
        self._rise_y, self._rise_x = (m.astype(np.float32) for m in correction.surface.matrices(x, y))
        self._between = None
        self._nearest: tuple[slice | np.ndarray, ...] = slice(None), slice(None)
        if not (np.array_equal(x, correction.x) and np.array_equal(y, correction.y)):
            fine = (y, correction.y), (x, correction.x)
            self._nearest = np.ix_(*(np.abs(line[:, None] - nodes).argmin(axis=1) for line, nodes in fine))
            over_y, over_x = (SplineAxis(nodes).matrix(line).astype(np.float32) for line, nodes in fine)
            self._between = over_y, over_x.T

    def rise(self, contact: NormalContact) -> np.ndarray:
        """Corrected height over rest [m], (Ny, Nx)."""
        dent = contact.dent if self._between is None else sandwich(self._between[0], contact.dent, self._between[1])
        return self.lattice(contact.rise) - dent

    def lattice(self, rise: np.ndarray) -> np.ndarray:
        """``CoatSurface.rise`` over these lines [m], (Ny, Nx)."""
        return sandwich(self._rise_y, rise, self._rise_x)

    def touching(self, contact: NormalContact) -> np.ndarray:
        """Mask (Ny, Nx) of the nodes whose nearest node of the fine grid has pressure."""
        return (contact.pressure > 0.0)[self._nearest]

    def lay(self, height: np.ndarray, contact: NormalContact, underside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lay the coat on the object between fine nodes; returns height and contact mask (Ny, Nx).

        Overlaps are removed. Gaps under pressure are closed, g → g³/(1 + g²) with g = gap / 20 µm (``Correction.closed_gap``).

        Args:
            height: coat [m].
            underside: z of the object [m], not finite where it is not.
        """
        gap = np.where(np.isfinite(underside), underside, np.inf) - height
        touching = self.touching(contact) & np.isfinite(gap)
        g = np.where(touching, gap, 0.0) / self._closed_gap
        closed = np.where(touching, self._closed_gap * g / (1.0 + g * g), 0.0)
        return (height + np.where(gap < 0.0, gap, closed)).astype(np.float32), touching


class NormalCorrection:
    """Corrects a coat's height for its coarse mesh (*defect correction*), one pad at a time.

    A mesh whose cells are wider than a contact, or than the bend at its rim, makes the dent too wide and uneven. The part of that error
    that is linear elasticity can be undone. Let w be the solver's height over rest and C its vertices in contact. E w is the linear
    response of *the same mesh* to the normal forces on C that give the heights w there. A p is the linear response of *the gel layer*
    to a pressure p on a fine grid. The corrected coat is

        rest + (w − E w) − A p,   p >= 0, never above the object's underside, and p = 0 where it lies below.

    So the mesh's normal contact is exchanged for the solution of a linear complementarity problem on the fine grid. The remainder w − E w
    holds everything else: friction, shear, twist, large strain, sideways motion. It is 0 at vertices that touch and jumps beside them,
    which is an artefact of the mesh; waves of two cells are therefore filtered out of it. The finer the mesh, the less E w and A p differ.
    (Correction by the difference of two discretisations of a simplified operator: K. Böhmer, P. Hemker and H. Stetter, The defect
    correction approach, Computing Suppl. 5, 1984.)

    A is the layer's exact response (``layer_compliance``) at the nodes to pressures that are linear between them, wave by wave over
    cosines, as if the pad were continued by its mirror image. Such pressures have waves shorter than the grid resolves. At the nodes
    these look like longer ones and are counted there: without them, every jump of pressure at a rim rings as waves of two cells. The
    difference that the pad's free sides make is smooth and is added on the coat's own mesh.
    """

    def __init__(
        self,
        surface: CoatSurface,
        gelpad: GelpadSpec,
        x: np.ndarray,
        y: np.ndarray,
        compliance: np.ndarray,
        continued: np.ndarray,
        settings: Correction = DEFAULT_CORRECTION,
    ) -> None:
        """Prepare the fine grid of even lines ``x`` (Nx,), ``y`` (Ny,) [m], from edge to edge.

        Args:
            compliance: z of the coat's vertices over a force along z on each [m/N], (V, V), of the pad's mesh.
            continued: the same if the pad's sides may not move outwards.
        """
        self.surface, self.x, self.y, self.settings = surface, x, y, settings
        mesh, self._compliance = surface.mesh, compliance
        self.sides = (compliance - continued).astype(np.float32)
        self._smooth_y, self._smooth_x = _smoothing(mesh.lines_y), _smoothing(mesh.lines_x).T
        self.series_x, self.series_y = CosineSeries(x), CosineSeries(y)
        self.layer = nodal_compliance(self.series_x, self.series_y, gelpad).astype(np.float32)
        self.analysis_y, self.analysis_x = self.series_y.analysis.astype(np.float32), self.series_x.analysis.T.astype(np.float32)
        self.waves_y = self.series_y.synthesis(y).astype(np.float32)
        self.waves_x = self.series_x.synthesis(x).T.astype(np.float32)
        self.border_y = SplineAxis(mesh.lines_y).matrix(y).astype(np.float32)
        self.border_x = SplineAxis(mesh.lines_x).matrix(x).T.astype(np.float32)
        area_x, area_y = (np.full(len(t), t[1] - t[0]) for t in (x, y))
        for line in (area_x, area_y):
            line[[0, -1]] *= 0.5
        self.force_y = (hat_matrix(mesh.lines_y, y).T * area_y).astype(np.float32)
        self.force_x = (hat_matrix(mesh.lines_x, x) * area_x[:, None]).astype(np.float32)
        self.sampler = ContactSampler(self, x, y)

    def solve(self, places: CoatPlaces, upwards: np.ndarray, load: np.ndarray, clear: np.ndarray) -> NormalContact:
        """Solve the contact of one pad.

        Args:
            places: material points of the coat (see ``CoatSurface.places``).
            upwards: w, displacement of its vertices along z [m], shape (V,).
            load: normal force on its vertices [N], shape (V,), 0 out of contact.
            clear: z of the object's underside less the coat at rest [m], over the fine grid; not finite where there is no object.
        """
        forces = self._mesh_forces(upwards, self.touching(load))
        remainder = self._smooth_y @ (upwards - self._compliance @ forces).reshape(self.surface.mesh.shape) @ self._smooth_x
        rise = self.surface.rise(places, remainder.ravel())
        overlap = self.sampler.lattice(rise) - np.where(np.isfinite(clear), clear, self.settings.open_gap)
        start = sandwich(self.force_y.T, load.reshape(self.surface.mesh.shape), self.force_x.T)
        pressure = np.zeros(overlap.shape, np.float32)
        near = overlap > -self.settings.clear_gap
        if near.any():
            rows, columns = (span(near.any(axis=k)) for k in (1, 0))
            window = _Window(self, rows, columns)
            p, residual = window.solve(overlap[rows, columns].astype(np.float32), start[rows, columns])
            pressure[rows, columns] = p
            waves, border = window.respond(p)
            dent = sandwich(self.waves_y, self.layer * waves, self.waves_x) + sandwich(self.border_y, border, self.border_x)
            return NormalContact(rise, pressure, waves, dent, forces, residual)
        return NormalContact(rise, pressure, np.zeros_like(pressure), np.zeros_like(pressure), forces, 0.0)

    def touching(self, load: np.ndarray) -> np.ndarray:
        """Mask (V,) of the vertices in contact, by their normal ``load`` [N]."""
        return load > self.settings.least_load * load.max()

    def _mesh_forces(self, upwards: np.ndarray, touching: np.ndarray) -> np.ndarray:
        """Forces [N], (V,), on ``touching`` vertices that lift the mesh ``upwards``; 0 if bonded."""
        free = touching & (np.diagonal(self._compliance) > 0.0)
        forces = np.zeros(len(upwards))
        forces[free] = np.linalg.solve(self._compliance[np.ix_(free, free)], upwards[free])
        return forces


class _Window:
    """Rows and columns of the fine grid outside which nothing can touch, to save work."""

    def __init__(self, correction: NormalCorrection, rows: slice, columns: slice) -> None:
        c = correction
        self._settings, self._layer, self._sides = c.settings, c.layer, c.sides
        self._analysis = c.analysis_y[:, rows], c.analysis_x[columns]
        self._force = c.force_y[:, rows], c.force_x[columns]
        self._waves = c.waves_y[rows], c.waves_x[:, columns]
        self._border = c.border_y[rows], c.border_x[:, columns]

    def respond(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cosine amplitudes of p [Pa], (Ny, Nx) of the pad, and the sides' dent [m] at the coat's vertices."""
        force = sandwich(self._force[0], p, self._force[1])
        border = product(self._sides, force.reshape(-1, 1)).reshape(force.shape)
        return sandwich(self._analysis[0], p, self._analysis[1]), border

    def dent(self, p: np.ndarray) -> np.ndarray:
        """A p in this window [m]."""
        waves, border = self.respond(p)
        return sandwich(self._waves[0], self._layer * waves, self._waves[1]) + sandwich(self._border[0], border, self._border[1])

    def solve(self, overlap: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
        """Pressure p >= 0 [Pa] with g = A p − ``overlap`` >= 0 and g p = 0, and the residual [m].

        Conjugate gradients over the nodes in contact, which are revised in every step (I. A. Polonsky and L. M. Keer, A numerical method
        for solving rough contact problems, Wear 231, 1999), with a preconditioner (``_stiffen``): g is their gap, z the preconditioned
        gap, t the direction, G = g·z, τ the step length, δ is 0 after nodes were added.
        """
        p = np.where(overlap > 0.0, np.maximum(start, start.max() * 1e-3), 0.0).astype(np.float32)
        t, last_G, δ, best = np.zeros_like(p), 1.0, False, (p, np.inf)
        for _ in range(self._settings.normal_iterations):
            gap = self.dent(p) - overlap
            inside = p > 0.0
            g = np.where(inside, gap, np.float32(0.0))
            residual = max(-float(gap.min()), float(np.abs(g).max()))
            if residual < best[1]:
                best = p, residual
            if residual < self._settings.gap_tolerance:
                break
            z = _stiffen(g)
            G = float((g * z).sum(dtype=float))
            t = np.where(inside, z + np.float32(G / last_G if δ else 0.0) * t, np.float32(0.0))
            last_G = G
            r = self.dent(t)
            curvature = float((r * t).sum(dtype=float))
            if not curvature > 0.0:
                break
            τ = np.float32((g * t).sum(dtype=float) / curvature)
            p = np.maximum(p - τ * t, np.float32(0.0))
            overlapping = (p <= 0.0) & (gap < 0.0)
            δ = not overlapping.any()
            p[overlapping] -= τ * np.float32(_SHORTEST) * gap[overlapping]
        return best


def _stiffen(gap: np.ndarray) -> np.ndarray:
    """Preconditioned gap, same shape: a local operator that grows with wave number, as A falls.

    A falls as 1/k. In units of the grid c + k² (c − the five-point Laplacian) times that varies by 7 where 1/k varies by 200.
    """
    out = np.float32(4.0 + _SHORTEST) * gap
    out[1:] -= gap[:-1]
    out[:-1] -= gap[1:]
    out[:, 1:] -= gap[:, :-1]
    out[:, :-1] -= gap[:, 1:]
    return out


def _smoothing(lines: np.ndarray) -> np.ndarray:
    """Filter (n, n) on ``lines`` (n,): waves of λ even cells keep cos²(π/λ), 0 of two cells."""
    cell, n = np.diff(lines), len(lines)
    out = np.eye(n)
    for i in range(1, n - 1):
        out[i, i - 1 : i + 2] = 0.5 * cell[i] / (cell[i - 1] + cell[i]), 0.5, 0.5 * cell[i - 1] / (cell[i - 1] + cell[i])
    return out
