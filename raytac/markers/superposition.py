"""Superposition: the pad's linear response to the loads that hold the contact where the object has put it.

Taxim (Si and Yuan, RA-L 2022) adds up displacement fields of unit loads, from a finite-element model, with the weights that
give the contact its known displacement. Here the fields are those of the soft pad's own tetrahedra at rest (``raytac.markers.compliance``).
With C the compliance of the coat's vertices and A those in contact:

    C_AA f = u_A,    u = C_·A f,

u_A: down to the object along z, along x and y with the object since first touch. A vertex that the object would have to pull is let go. One
that would need more than Coulomb's μ |f_z| to be taken along slides: it keeps only its z, and f_xy = μ |f_z| the way it was pulled. Each
time the rest is solved again.
"""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples
from raytac.markers.sampling import height_and_slope, object_way
from raytac.markers.surface import bind
from raytac.specs.sensor import SensorSpec

__all__ = ["SuperpositionMarkers"]

_ROUNDS = 8
"""How often vertices under tension are let go, or slide; those that are left then keep their load."""
_LEVEL = "coarse"
"""Pad whose unit-load fields are used."""


class SuperpositionMarkers:
    """The model ``superposition``; needs the package ``raytac[ipc]`` for the pad's tetrahedra, and no calibration."""

    name = "superposition"
    needs_contacts = True
    device = "cpu"

    def __init__(self, sensor: SensorSpec) -> None:
        from raytac.markers.compliance import cached_compliance
        from raytac.physics.soft.mesh import pad_mesh

        mesh = pad_mesh(sensor.gelpad, _LEVEL)
        self.coat = mesh.coat
        self._compliance = cached_compliance(mesh, sensor.gelpad)
        self._friction = sensor.gelpad.friction
        self._bound: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert contacts is not None
        batch = len(rest)
        places = np.broadcast_to(self.coat.rest[:, :2], (batch, len(self.coat.rest), 2))
        height, _, touched = height_and_slope(surface, places)
        way = object_way(contacts, places)
        wanted = np.concatenate([way, (height - self.coat.rest[:, 2])[..., None]], axis=-1)
        held = touched & (wanted[..., 2] < 0)
        moved = np.zeros((batch, len(self.coat.rest), 3))
        for b in np.flatnonzero(held.any(axis=1)):
            moved[b] = self._superpose(wanted[b], held[b])
        vertices, weights = self._bind(rest)
        env = np.arange(batch)[:, None, None]
        return (weights[..., None] * moved[env, vertices, :2]).sum(axis=2)

    def _superpose(self, wanted: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Displacement of all vertices (V, 3) that takes the ``held`` ones where ``wanted`` (V, 3) says."""
        held, slides = held.copy(), np.zeros(len(held), bool)
        pull = np.zeros((len(held), 2))
        """Direction of what takes a sliding vertex along."""
        for _ in range(_ROUNDS):
            at = np.flatnonzero(held)
            dof = (3 * at[:, None] + np.arange(3)).ravel()
            load = self._load(dof, wanted[at], slides[at], pull[at])
            pulled = load[:, 2] > 0
            along = np.linalg.norm(load[:, :2], axis=1)
            loose = ~pulled & ~slides[at] & (along > self._friction * -load[:, 2])
            if pulled.all() or not (pulled | loose).any():
                break
            held[at[pulled]] = False
            slides[at[loose]] = True
            pull[at[loose]] = load[loose, :2] / along[loose, None]
        return (self._compliance[:, dof] @ load.ravel()).reshape(-1, 3)

    def _load(self, dof: np.ndarray, wanted: np.ndarray, slides: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Loads [N] (A, 3) on the vertices of ``dof`` (3 A): what takes them where ``wanted`` (A, 3) says, or friction where they slide."""
        matrix, right = self._compliance[np.ix_(dof, dof)].astype(float), wanted.copy()
        # The unit of these rows is that of the others, so that the matrix stays well-conditioned.
        unit = float(np.trace(matrix)) / len(dof)
        right[slides, :2] = 0.0
        for k in np.flatnonzero(slides):
            for axis in range(2):
                matrix[3 * k + axis] = 0.0
                matrix[3 * k + axis, 3 * k + axis] = unit
                matrix[3 * k + axis, 3 * k + 2] = unit * self._friction * pull[k, axis]
        return np.linalg.solve(matrix, right.ravel()).reshape(-1, 3)

    def _bind(self, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        one = rest[:1] if rest.strides[0] == 0 else rest
        if self._bound is None or not np.array_equal(self._bound[0], one):
            self._bound = np.array(one), *bind(self.coat, one[..., :2])
        return self._bound[1], self._bound[2]
