"""From what the solver knows to what is shown: coat without the barrier's clearance, smooth surface, contact."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.interpolate import sampled
from raytac.gel.matmul import sandwich
from raytac.gel.surface import GelSurface, PadGrid, make_grid, rest_height
from raytac.physics.soft.correction.mesh_compliance import coat_compliance
from raytac.physics.soft.correction.normal import FineContact, FineGrid
from raytac.physics.soft.correction.splines import CoatPlaces, CoatSurface
from raytac.physics.soft.correction.standoff import StandOff
from raytac.physics.soft.correction.tangential import SkinMotion
from raytac.physics.soft.mesh import PadMesh
from raytac.shapes.part import Part, mesh_part
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

__all__ = ["UNSOLVED", "SeenObject", "SeenPad", "SoftReader", "SoftReading", "UnsolvedContactWarning"]

UNSOLVED = 5e-6
"""A contact whose residual is larger is warned of [m]."""

_SAMPLE = 0.2e-3
"""Spacing of the samples at which the clearance is measured [m]."""
_FINE = 0.1e-3
"""Spacing of the grid on which the contact is found [m]."""
_BEHIND = 1e-3
"""An underside so far below the coat [m] is that of an object beside or behind the pad: no contact overlaps by that much."""


class UnsolvedContactWarning(UserWarning):
    """The search for the contact below the size of a cell ended before it was found."""


@dataclass(frozen=True)
class SeenObject:
    """One object as B pads may touch it; pad frame."""

    parts: Sequence[Part]
    """Exact shape of a rigid object, object frame; empty for a soft one."""
    poses: np.ndarray
    """``pad_from_object``, (B, 4, 4)."""
    surface: tuple[np.ndarray, np.ndarray] | None = None
    """Of a soft object: vertices (B, n, 3) [m] and faces as they are now."""
    near: np.ndarray | None = None
    """Whether it counts, (B,) bool; None: always. One that does not touch may lie anywhere, also behind the pad."""
    friction: float | None = None
    """Coulomb's coefficient on the pad; None: not known, and the skin under shear and twist is shown as the mesh has it."""

    def counts(self, b: int) -> bool:
        return self.near is None or bool(self.near[b])

    def shape(self, b: int, lowered: float = 0.0) -> tuple[Sequence[Part], np.ndarray]:
        """Parts and their pose (4, 4) over pad ``b``, ``lowered`` along z [m]."""
        pose = self.poses[b].copy()
        if self.surface is not None:
            pose = np.eye(4)
        pose[2, 3] -= lowered
        return (self.parts if self.surface is None else (mesh_part(self.surface[0][b], self.surface[1]),)), pose


@dataclass(frozen=True)
class SeenPad:
    """What a solver knows of B copies of one pad; pad frame."""

    coat: np.ndarray
    """Vertices of the coat [m], shape (B, V, 3)."""
    forces: np.ndarray
    """What touches does to each of them [N], shape (B, V, 3)."""
    objects: tuple[SeenObject, ...]

    def is_finite(self) -> np.ndarray:
        """Whether every number of an environment is finite, (B,) bool."""
        arrays = [self.coat, self.forces]
        for thing in self.objects:
            arrays += [thing.poses] if thing.surface is None else [thing.poses, thing.surface[0]]
        return np.all([np.isfinite(values).all(axis=(1, 2)) for values in arrays], axis=0)


@dataclass(frozen=True)
class SoftReading:
    """B pads as they are shown; pad frame."""

    surface: GelSurface
    """Its ``coat`` lies on the height that is shown: the solver's vertices with the contact that was found below the size of a cell."""
    vertices: np.ndarray
    """The solver's own vertices of the coat [m], shape (B, V, 3): where ``forces`` act."""
    forces: np.ndarray
    """On each vertex of the coat [N], shape (B, V, 3)."""
    clearance: np.ndarray
    """Mean distance that the barrier kept [m], shape (B,); NaN out of contact."""
    poses: tuple[np.ndarray, ...]
    """Of each object: ``pad_from_object`` (B, 4, 4), lowered by the clearance."""
    underside: np.ndarray
    """Underside of the objects there over the grid [m], shape (B, Ny, Nx), inf where there is none. Of a rigid object, what lies
    wholly above the pad's highest point may be left out; of a soft one, all is there, in contact or not."""
    residual: np.ndarray
    """Deepest overlap or widest gap under pressure [m], (B,), that the search for the contact below the size of a cell left, before the
    coat was laid on the object; NaN out of contact."""
    failed: np.ndarray
    """Environments of which nothing is shown, (B,) bool: those that had failed, and those in which a number is not finite."""


class SoftReader:
    """Reads one kind of pad, whatever touches it: one object or several, rigid or soft."""

    def __init__(self, mesh: PadMesh, gelpad: GelpadSpec, grid: PadGrid) -> None:
        self.mesh, self.grid = mesh, grid
        self._surface = CoatSurface(mesh.coat, gelpad)
        self._rows, self._columns = (m.astype(np.float32) for m in self._surface.matrices(grid.x, grid.y))
        self._rest = grid.rest.astype(np.float32)
        self._gelpad = gelpad
        self._fine_pad = grid if min(grid.pitch) > 0.9 * _FINE else make_grid(gelpad, _FINE)
        self._fine: tuple[FineContact, FineGrid, SkinMotion] | None = None
        self._warned = False
        samples = make_grid(gelpad, max(_SAMPLE, *grid.pitch))
        self._stand_off = StandOff(self._surface, samples.rest, samples.x, samples.y, mesh.d_hat)
        corners = mesh.coat.rest[mesh.coat.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self._vertex_area = np.bincount(mesh.coat.faces.ravel(), np.repeat(area / 3.0, 3), len(mesh.coat.rest))

    def clearance(self, seen: SeenPad) -> np.ndarray:
        """Mean distance that the barrier keeps [m], shape (B,), NaN out of contact."""
        return np.array([self._fit(seen, b)[1] for b in range(len(seen.coat))])

    def read(self, seen: SeenPad, failed: np.ndarray) -> SoftReading:
        """All that is shown of every pad; NaN for those that ``failed``, (B,), or of which a number is not finite."""
        coat, vertices, forces = seen.coat.copy(), seen.coat.copy(), seen.forces.copy()
        poses = tuple(thing.poses.copy() for thing in seen.objects)
        batch = len(coat)
        clearance, residual = np.full(batch, np.nan), np.full(batch, np.nan)
        height = np.empty((batch, *self.grid.shape), np.float32)
        touched = np.zeros(height.shape, bool)
        centre, undersides = np.full((batch, 2), np.nan), np.full(height.shape, np.inf)
        rest = self.mesh.coat.rest
        failed = failed | ~seen.is_finite()
        for b in np.flatnonzero(~failed).tolist():
            places, kept = self._fit(seen, b)
            upwards = vertices[b, :, 2] - rest[:, 2]
            height[b] = self._rest + sandwich(self._rows, self._surface.rise(places, upwards), self._columns)
            if not np.isfinite(kept):
                undersides[b] = self._underside(seen, b, self.grid)
                continue
            clearance[b] = kept
            for pose in poses:
                pose[b, 2, 3] -= kept
            load = np.maximum(-forces[b, :, 2], 0.0)
            fine, to_grid, skin = self._fine_contact()
            smooth = None
            if len(seen.objects) > 1:
                smooth = self._fine_pad.rest + fine.here.lattice(self._surface.rise(places, upwards))
            near = self._underside(seen, b, self._fine_pad, kept, smooth)
            shape = fine.solve(places, upwards, load, near - self._fine_pad.rest)
            residual[b] = shape.residual
            same = self._fine_pad is self.grid
            under = undersides[b] = near if same else self._underside(seen, b, self.grid, kept, height[b])
            height[b], touched[b] = to_grid.lay(self._rest + to_grid.rise(shape), shape, under)
            coat[b, :, :2] = rest[:, :2] + skin.sideways(shape, vertices[b] - rest, load, _friction(seen, b))
            coat[b, :, 2] = self._on_surface(height[b], coat[b, :, :2])
            centre[b] = load @ vertices[b, :, :2] / load.sum()
        failed |= ~(np.isfinite(height).all(axis=(1, 2)) & np.isfinite(coat).all(axis=(1, 2)))
        for shown in (coat, vertices, forces, height, clearance, residual, centre, *poses):
            shown[failed] = np.nan
        touched[failed], undersides[failed] = False, np.inf
        self._tell(residual)
        deformed = DeformedCoat(self.mesh.coat, coat)
        surface = GelSurface(self.grid, height, touched, centre, _touched_pose(seen, poses), deformed)
        return SoftReading(surface, vertices, forces, clearance, poses, undersides, residual, failed)

    def _fit(self, seen: SeenPad, b: int) -> tuple[CoatPlaces, float]:
        """Material points of one coat under the lattice, and the clearance [m]."""
        coat, forces = seen.coat[b], seen.forces[b]
        moved = coat - self.mesh.coat.rest
        places = self._surface.places(moved)
        if not (forces[:, 2] < 0.0).any():
            return places, float("nan")
        below = float(self.grid.rest.max()) + 10.0 * self.mesh.d_hat
        under = np.full((len(self._stand_off.y), len(self._stand_off.x)), np.inf)
        for thing in seen.objects:
            if thing.counts(b):
                parts, pose = thing.shape(b)
                found = object_height(parts, pose[None], self._stand_off.x, self._stand_off.y, below=below)[0]
                np.minimum(under, found, out=under)
        if len(seen.objects) > 1:
            smooth = self._stand_off.heights(self._surface.rise(places, moved[:, 2]))
            under[under < smooth - _BEHIND] = np.inf
        return places, self._stand_off.clearance(places, moved[:, 2], -forces[:, 2] / self._vertex_area, under)

    def _on_surface(self, height: np.ndarray, place: np.ndarray) -> np.ndarray:
        """z of a shown ``height`` (Ny, Nx) [m] at places (V, 2); what is beyond the pad's edge is at the height of the edge."""
        x, y = (np.clip(place[:, k], line[0], line[-1]) for k, line in enumerate((self.grid.x, self.grid.y)))
        return rest_height(self._gelpad, x, y) + sampled(height - self._rest, self.grid.x, self.grid.y, x, y)

    def _tell(self, residual: np.ndarray) -> None:
        """Warn once if a contact was left unsolved."""
        worst = float(np.nanmax(residual, initial=0.0))
        if worst > UNSOLVED and not self._warned:
            self._warned = True
            warnings.warn(
                f"the contact below the size of a cell was left {1e6 * worst:.1f} µm from its solution, more than "
                f"{1e6 * UNSOLVED:g} µm: the shown coat is laid on the object where it touches, and off by about so much around it",
                UnsolvedContactWarning,
                stacklevel=2,
            )

    def _fine_contact(self) -> tuple[FineContact, FineGrid, SkinMotion]:
        """What finds the contact and takes it to grid and vertices; made at the first contact: the mesh's compliance takes a while."""
        if self._fine is None:
            found = coat_compliance(self.mesh, self._gelpad)[0]
            continued = coat_compliance(self.mesh, self._gelpad, rollers=True, along=(0, 1, 2))
            fine = FineContact(self._surface, self._gelpad, self._fine_pad.x, self._fine_pad.y, found[2], continued[2, 2])
            motion = SkinMotion(fine, self._gelpad, found, continued)
            self._fine = fine, FineGrid(fine, self.grid.x, self.grid.y), motion
        return self._fine

    def _underside(
        self, seen: SeenPad, b: int, grid: PadGrid, clearance: float = 0.0, smooth: np.ndarray | None = None
    ) -> np.ndarray:
        """Underside of the shown objects over a grid [m], (Ny, Nx); without what is far below the ``smooth`` coat there, if it is given."""
        under = np.full(grid.shape, np.inf)
        highest = float(grid.rest.max())
        for thing in seen.objects:
            if thing.counts(b):
                parts, pose = thing.shape(b, clearance)
                below = highest if thing.surface is None else np.inf
                np.minimum(under, object_height(parts, pose[None], grid.x, grid.y, below=below)[0], out=under)
        if len(seen.objects) > 1 and smooth is not None:
            under[under < smooth - _BEHIND] = np.inf
        return under


def _friction(seen: SeenPad, b: int) -> float | None:
    """Coulomb's coefficient if one rigid object alone touches pad ``b``; of several, each of which may drag the skin elsewhere, none."""
    things = [thing for thing in seen.objects if thing.counts(b)]
    return things[0].friction if len(things) == 1 and things[0].surface is None else None


def _touched_pose(seen: SeenPad, poses: tuple[np.ndarray, ...]) -> np.ndarray | None:
    """Pose (B, 4, 4) of the only object, or of the first that counts in each environment; None without one."""
    if not poses:
        return None
    found = poses[0].copy()
    for thing, pose in reversed(list(zip(seen.objects, poses, strict=True))):
        near = np.ones(len(pose), bool) if thing.near is None else thing.near
        found[near] = pose[near]
    return found
