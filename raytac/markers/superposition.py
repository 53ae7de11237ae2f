"""Superposition: the pad's linear response to loads that keep the contact in its place.

Taxim (Si and Yuan, RA-L 2022) adds up displacement fields of unit loads, from a finite-element model, with the weights that
give the contact its known displacement. Here the fields are those of the soft pad's own tetrahedra at rest, by its linear stiffness with
the solver's Lamé constants, held where the case holds the pad; inverted once and kept on disk. With C the compliance of the coat's
vertices and A those in contact:

    C_AA f = u_A,    u = C_·A f,

u_A: down to the object along z, along x and y with the object since first touch. A vertex that the object would have to pull is released.
One that would need more than Coulomb's μ |f_z| to stick slides: it keeps only its z, and f_xy = μ |f_z| in the direction of its last
load. Each time the system is solved again.
"""

from __future__ import annotations

import hashlib
import io

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.io.arrays import npy_bytes
from raytac.io.cache import cache_folder, keep_cached, read_cached
from raytac.io.code_digest import code_digest
from raytac.markers.contacts import Contacts, ContactSamples
from raytac.markers.sampling import height_and_slope, object_displacement
from raytac.markers.surface import CoatPoints
from raytac.physics.soft.correction import mesh_compliance
from raytac.physics.soft.mesh import PadMesh, pad_mesh
from raytac.specs.sensor import GelpadSpec, SensorSpec


class SuperpositionModel:
    """Model of ``Superposition``; ``level`` and ``rounds`` as there."""

    needs_contacts = True
    device = "cpu"

    def __init__(self, sensor: SensorSpec, level: str, rounds: int) -> None:
        mesh = pad_mesh(sensor.gelpad, level)
        self.coat = mesh.coat
        self._compliance = cached_compliance(mesh, sensor.gelpad)
        self._friction, self._rounds = sensor.gelpad.friction, rounds
        self._points = CoatPoints()

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert contacts is not None
        batch = len(rest)
        places = np.broadcast_to(self.coat.rest[:, :2], (batch, len(self.coat.rest), 2))
        height, _, touched = height_and_slope(surface, places)
        shear = object_displacement(contacts, places)
        prescribed = np.concatenate([shear, (height - self.coat.rest[:, 2])[..., None]], axis=-1)
        in_contact = touched & (prescribed[..., 2] < 0)
        moved = np.zeros((batch, len(self.coat.rest), 3))
        for b in np.flatnonzero(in_contact.any(axis=1)):
            moved[b] = self._superpose(prescribed[b], in_contact[b])
        return self._points.interpolate(self.coat, rest, moved[..., :2])

    def _superpose(self, prescribed: np.ndarray, in_contact: np.ndarray) -> np.ndarray:
        """Displacement of all vertices (V, 3) with ``prescribed`` (V, 3) at those ``in_contact``."""
        sticking, slides = in_contact.copy(), np.zeros(len(in_contact), bool)
        direction = np.zeros((len(in_contact), 2))
        """Direction of the friction on a sliding vertex."""
        for _ in range(self._rounds):
            at = np.flatnonzero(sticking)
            dof = (3 * at[:, None] + np.arange(3)).ravel()
            load = self._load(dof, prescribed[at], slides[at], direction[at])
            pulled = load[:, 2] > 0
            tangential = np.linalg.norm(load[:, :2], axis=1)
            loose = ~pulled & ~slides[at] & (tangential > self._friction * -load[:, 2])
            if pulled.all() or not (pulled | loose).any():
                break
            sticking[at[pulled]] = False
            slides[at[loose]] = True
            direction[at[loose]] = load[loose, :2] / tangential[loose, None]
        return (self._compliance[:, dof] @ load.ravel()).reshape(-1, 3)

    def _load(self, dof: np.ndarray, prescribed: np.ndarray, slides: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Loads [N] (A, 3) on ``dof`` (3 A): displacements as ``prescribed``, or sliding friction."""
        matrix, right = self._compliance[np.ix_(dof, dof)].astype(float), prescribed.copy()
        # The unit of these rows is that of the others, so that the matrix stays well-conditioned.
        unit = float(np.trace(matrix)) / len(dof)
        right[slides, :2] = 0.0
        for k in np.flatnonzero(slides):
            for axis in range(2):
                matrix[3 * k + axis] = 0.0
                matrix[3 * k + axis, 3 * k + axis] = unit
                matrix[3 * k + axis, 3 * k + 2] = unit * self._friction * direction[k, axis]
        return np.linalg.solve(matrix, right.ravel()).reshape(-1, 3)


def coat_compliance(mesh: PadMesh, gelpad: GelpadSpec) -> np.ndarray:
    """Displacement of the coat's vertices by unit loads [m/N], (3V, 3V), at 3 v + axis."""
    count = 3 * len(mesh.coat_vertices)
    return mesh_compliance.coat_compliance(mesh, gelpad, along=(0, 1, 2)).transpose(2, 1, 3, 0).reshape(count, count)


def cached_compliance(mesh: PadMesh, gelpad: GelpadSpec) -> np.ndarray:
    """``coat_compliance``, float32, from the user's cache; warns where that is damaged."""
    basis = *mesh_compliance.compliance_basis(mesh, gelpad), code_digest(__name__, mesh_compliance.__name__)
    digest = hashlib.sha256(repr(basis).encode()).hexdigest()[:24]
    folder = cache_folder("markers")
    path = None if folder is None else folder / f"compliance-{digest}.npy"
    kept = read_cached(path)
    if kept is not None:
        return np.load(io.BytesIO(kept), allow_pickle=False)
    fields = coat_compliance(mesh, gelpad).astype(np.float32)
    keep_cached(path, npy_bytes(fields))
    return fields
