"""From what the solver knows to what is shown: coat without the barrier's clearance, smooth surface, contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.coat_surface import CoatPlaces, CoatSurface
from raytac.gel.fine_contact import FineContact, FineGrid
from raytac.gel.object_height import object_height
from raytac.gel.pad import make_grid
from raytac.gel.part import Part, mesh_part
from raytac.gel.product import sandwich
from raytac.gel.standoff import ContactFit, StandOff
from raytac.gel.surface import GelSurface, PadGrid
from raytac.physics.pad_compliance import coat_compliance
from raytac.physics.soft_contact import SoftContact
from raytac.physics.soft_mesh import PadMesh
from raytac.specs.sensor import GelpadSpec

__all__ = ["SoftReader", "SoftReading"]

_SAMPLE = 0.2e-3
"""Spacing of the samples at which the clearance is measured [m]."""
_FINE = 0.1e-3
"""Spacing of the grid on which the contact is found [m]."""


@dataclass(frozen=True)
class SoftReading:
    """B pads as they are shown; pad frame."""

    surface: GelSurface
    forces: np.ndarray
    """On each vertex of the coat [N], shape (B, V, 3)."""
    clearance: np.ndarray
    """Mean distance that the barrier kept [m], shape (B,); NaN out of contact."""
    poses: np.ndarray
    """``pad_from_object`` (B, 4, 4), lowered by the clearance."""
    underside: np.ndarray
    """Underside of the object there over the grid [m], shape (B, Ny, Nx), inf where it is not. Of a rigid object, what lies wholly
    above the pad's highest point may be left out; of a soft one, all is there, in contact or not."""


class SoftReader:
    """Reads a ``SoftContact``."""

    def __init__(self, mesh: PadMesh, gelpad: GelpadSpec, grid: PadGrid, parts: Sequence[Part]) -> None:
        self.mesh, self.grid, self.parts = mesh, grid, parts
        self._surface = CoatSurface(mesh.coat, gelpad)
        self._rows, self._columns = (m.astype(np.float32) for m in self._surface.matrices(grid.x, grid.y))
        self._rest = grid.rest.astype(np.float32)
        self._gelpad = gelpad
        self._fine_pad = make_grid(gelpad, max(_FINE, *grid.pitch))
        self._fine: tuple[FineContact, FineGrid] | None = None
        samples = make_grid(gelpad, max(_SAMPLE, *grid.pitch))
        self._stand_off = StandOff(self._surface, samples.rest, samples.x, samples.y, mesh.d_hat)
        corners = mesh.coat.rest[mesh.coat.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self._vertex_area = np.bincount(mesh.coat.faces.ravel(), np.repeat(area / 3.0, 3), len(mesh.coat.rest))

    def clearance(self, contact: SoftContact, driven: np.ndarray) -> np.ndarray:
        """Mean distance that the barrier keeps [m], shape (B,), NaN out of contact; ``driven`` (B, 4, 4): where a drive has the object."""
        coat, forces, poses = contact.coat(), contact.forces(), contact.pad_from_object(driven)
        return np.array([self._fit(contact, coat[b], forces[b], poses[b], b)[1].clearance for b in range(len(coat))])

    def read(self, contact: SoftContact, driven: np.ndarray, failed: np.ndarray) -> SoftReading:
        """All that is shown of every pad; NaN for those that ``failed``."""
        coat, forces, poses = contact.coat(), contact.forces(), contact.pad_from_object(driven).copy()
        batch = len(coat)
        clearance = np.full(batch, np.nan)
        height = np.empty((batch, *self.grid.shape), np.float32)
        touched = np.zeros(height.shape, bool)
        centre, undersides = np.full((batch, 2), np.nan), np.full(height.shape, np.inf)
        for b in range(batch):
            if failed[b]:
                coat[b] = forces[b] = poses[b] = height[b] = np.nan
                continue
            places, fit = self._fit(contact, coat[b], forces[b], poses[b], b)
            coat[b, :, 2] += fit.shift
            height[b] = self._heights(places, coat[b])
            if not np.isfinite(fit.clearance):
                undersides[b] = self._underside(contact, poses[b], 0.0, b, self.grid)
                continue
            clearance[b] = fit.clearance
            poses[b, 2, 3] -= fit.clearance
            load = np.maximum(-forces[b, :, 2], 0.0)
            contact_here, to_grid = self._fine_contact()
            near = self._underside(contact, poses[b], fit.clearance, b, self._fine_pad)
            upwards = coat[b, :, 2] - fit.shift - self.mesh.coat.rest[:, 2]
            shape = contact_here.solve(places, upwards, load, near - self._fine_pad.rest)
            under = undersides[b] = self._underside(contact, poses[b], fit.clearance, b, self.grid)
            height[b], touched[b] = to_grid.lay(self._rest + to_grid.rise(shape), shape, under)
            centre[b] = load @ coat[b, :, :2] / load.sum()
        deformed = DeformedCoat(self.mesh.coat, coat)
        surface = GelSurface(self.grid, height, touched, centre, poses, deformed)
        return SoftReading(surface, forces, clearance, poses, undersides)

    def _fit(
        self, contact: SoftContact, coat: np.ndarray, forces: np.ndarray, pose: np.ndarray, b: int
    ) -> tuple[CoatPlaces, ContactFit]:
        moved = coat - self.mesh.coat.rest
        places = self._surface.places(moved)
        if not (forces[:, 2] < 0.0).any():
            return places, ContactFit(float("nan"), np.zeros(len(coat)))
        below = float(self.grid.rest.max()) + 10.0 * self.mesh.d_hat
        parts, pose = self._object(contact, pose, b)
        under = object_height(parts, pose[None], self._stand_off.x, self._stand_off.y, below=below)[0]
        return places, self._stand_off.fit(places, moved[:, 2], -forces[:, 2] / self._vertex_area, under)

    def _object(self, contact: SoftContact, pose: np.ndarray, b: int) -> tuple[Sequence[Part], np.ndarray]:
        """Parts and pose of one object; a soft one is its surface as it is now."""
        soft = contact.soft_object()
        return (self.parts, pose) if soft is None else ((mesh_part(soft[0][b], soft[1]),), np.eye(4))

    def _heights(self, places: CoatPlaces, coat: np.ndarray) -> np.ndarray:
        rise = self._surface.rise(places, coat[:, 2] - self.mesh.coat.rest[:, 2])
        return self._rest + sandwich(self._rows, rise, self._columns)

    def _fine_contact(self) -> tuple[FineContact, FineGrid]:
        """What finds the contact, and what takes it to the grid; made at the first contact, since the mesh's compliance takes a while."""
        if self._fine is None:
            found, continued = (coat_compliance(self.mesh, self._gelpad, rollers=rollers) for rollers in (False, True))
            fine = FineContact(self._surface, self._gelpad, self._fine_pad.x, self._fine_pad.y, found, continued)
            self._fine = fine, FineGrid(fine, self.grid.x, self.grid.y)
        return self._fine

    def _underside(self, contact: SoftContact, shown: np.ndarray, clearance: float, b: int, grid: PadGrid) -> np.ndarray:
        """Underside of the shown object over a grid [m], (Ny, Nx)."""
        parts, pose = self._object(contact, shown, b)
        if parts is self.parts:
            return object_height(parts, pose[None], grid.x, grid.y, below=float(grid.rest.max()))[0]
        pose[2, 3] = -clearance
        return object_height(parts, pose[None], grid.x, grid.y)[0]
