"""A soft pad read in NumPy, one pad after the other: the oracle of ``raytac.physics.soft.reading``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.interpolate import hat_matrix, sampled
from raytac.gel.surface import GelSurface, PadGrid, make_grid, rest_height
from raytac.physics.soft.correction.mesh_compliance import correction_compliances
from raytac.physics.soft.mesh import PadMesh
from raytac.physics.soft.settings import DEFAULT_CORRECTION, Correction
from raytac.shapes.part import Part, mesh_part
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec
from tests.physics.soft.oracles.coat_surface import BarrierClearance, CoatPlaces, CoatSurface
from tests.physics.soft.oracles.matmul import sandwich
from tests.physics.soft.oracles.normal import ContactSampler, NormalCorrection
from tests.physics.soft.oracles.tangential import TangentialCorrection

_SAMPLE = 0.2e-3
"""Spacing of the samples at which the clearance is measured [m]."""
_BEHIND = 1e-3
"""Overlap [m] beyond that of any contact: the object is beside or behind the pad."""


class UnsolvedContactWarning(UserWarning):
    """The search for the contact below the size of a cell ended before it converged."""


@dataclass(frozen=True)
class ContactObject:
    """One object that B pads may touch; pad frame."""

    parts: Sequence[Part]
    """Exact shape of a rigid object, object frame; empty for a soft one."""
    poses: np.ndarray
    """``pad_from_object``, (B, 4, 4)."""
    surface: tuple[np.ndarray, np.ndarray] | None = None
    """Present vertices (B, n, 3) [m] and faces of a soft object."""
    touching: np.ndarray | None = None
    """Mask (B,) of the environments in which it touches, else it may lie behind; None: all."""
    friction: float | None = None
    """Coulomb's coefficient on the pad; None: not known, friction is shown as the mesh has it."""

    def touches(self, b: int) -> bool:
        return self.touching is None or bool(self.touching[b])

    def shape(self, b: int, lowered: float = 0.0) -> tuple[Sequence[Part], np.ndarray]:
        """Parts and their pose (4, 4) over pad ``b``, ``lowered`` along z [m]."""
        pose = self.poses[b].copy() if self.surface is None else np.eye(4)
        pose[2, 3] -= lowered
        return (self.parts if self.surface is None else (mesh_part(self.surface[0][b], self.surface[1]),)), pose


@dataclass(frozen=True)
class CoatState:
    """The solver's state of B copies of one pad's coat; pad frame."""

    vertices: np.ndarray
    """Vertices of the coat [m], shape (B, V, 3)."""
    forces: np.ndarray
    """Contact force on each of them [N], shape (B, V, 3)."""
    objects: tuple[ContactObject, ...]

    def is_finite(self) -> np.ndarray:
        """Mask (B,) of the environments in which every number is finite."""
        arrays = [self.vertices, self.forces]
        for thing in self.objects:
            arrays += [thing.poses] if thing.surface is None else [thing.poses, thing.surface[0]]
        return np.all([np.isfinite(values).all(axis=(1, 2)) for values in arrays], axis=0)

    def underside(
        self, b: int, x: np.ndarray, y: np.ndarray, below: float, soft_below: float = np.inf, lowered: float = 0.0
    ) -> np.ndarray:
        """Underside over pad ``b`` at lines ``x``, ``y`` [m], (Ny, Nx), ``lowered`` [m]; or inf.

        What lies wholly above ``below`` may be missing, of soft objects above ``soft_below`` [m].
        """
        under = np.full((len(y), len(x)), np.inf)
        for thing in self.objects:
            if thing.touches(b):
                parts, pose = thing.shape(b, lowered)
                limit = below if thing.surface is None else soft_below
                np.minimum(under, object_height(parts, pose[None], x, y, below=limit)[0], out=under)
        return under

    def friction(self, b: int) -> float | None:
        """Coulomb's coefficient if a single rigid object touches pad ``b``, else None."""
        things = [thing for thing in self.objects if thing.touches(b)]
        return things[0].friction if len(things) == 1 and things[0].surface is None else None


@dataclass(frozen=True)
class SoftReading:
    """B pads as they are shown; pad frame."""

    surface: GelSurface
    """Its ``coat`` is the height shown: the solver's vertices with the correction, if any."""
    vertices: np.ndarray
    """The solver's own vertices of the coat [m], shape (B, V, 3): where ``forces`` act."""
    forces: np.ndarray
    """Contact force on each vertex of the coat [N], shape (B, V, 3)."""
    clearance: np.ndarray
    """Mean distance that the barrier kept [m], shape (B,); NaN out of contact."""
    poses: tuple[np.ndarray, ...]
    """``pad_from_object`` (B, 4, 4) of each object, lowered by the clearance."""
    underside: np.ndarray
    """Underside of the objects over the grid [m], (B, Ny, Nx), inf where there is none.

    Rigid parts wholly above the pad's highest point may be missing."""
    residual: np.ndarray
    """Deepest overlap or widest gap under pressure [m], (B,), of the corrected contact.

    It is taken before the coat is laid on the object; NaN out of contact, or without correction."""
    failed: np.ndarray
    """Environments of which nothing is shown, (B,) bool: they failed, or are not finite."""


class SoftReader:
    """Reads one kind of pad, whatever touches it: one object or several, rigid or soft."""

    def __init__(
        self, mesh: PadMesh, gelpad: GelpadSpec, grid: PadGrid, correction: Correction | None = DEFAULT_CORRECTION
    ) -> None:
        """Prepare surfaces on ``grid``; without ``correction`` the spline through the vertices."""
        self.mesh, self.grid, self.correction, self._gelpad = mesh, grid, correction, gelpad
        self._surface = CoatSurface(mesh.coat, gelpad)
        self._rows, self._columns = (m.astype(np.float32) for m in self._surface.matrices(grid.x, grid.y))
        self._rest, self._fine_grid = grid.rest.astype(np.float32), grid
        if correction is not None and min(grid.pitch) <= 0.9 * correction.pitch:
            self._fine_grid = make_grid(gelpad, correction.pitch)
        self._warned = False
        samples = make_grid(gelpad, max(_SAMPLE, *grid.pitch))
        self._clearance = BarrierClearance(self._surface, samples.rest, samples.x, samples.y, mesh.d_hat)

    def clearance(self, state: CoatState) -> np.ndarray:
        """Mean distance that the barrier keeps [m], shape (B,), NaN out of contact."""
        return np.array([self._measure(state, b)[1] for b in range(len(state.vertices))])

    def read(self, state: CoatState, failed: np.ndarray) -> SoftReading:
        """Surface, contact and forces of every pad; NaN where ``failed`` (B,) or not finite."""
        coat, vertices, forces = state.vertices.copy(), state.vertices.copy(), state.forces.copy()
        poses = tuple(thing.poses.copy() for thing in state.objects)
        batch = len(coat)
        clearance, residual = np.full(batch, np.nan), np.full(batch, np.nan)
        height = np.empty((batch, *self.grid.shape), np.float32)
        touched = np.zeros(height.shape, bool)
        centre, undersides = np.full((batch, 2), np.nan), np.full(height.shape, np.inf)
        failed = failed | ~state.is_finite()
        for b in np.flatnonzero(~failed).tolist():
            places, kept = self._measure(state, b)
            height[b] = self._rest + sandwich(self._rows, self._surface.rise(places, self._upwards(state, b)), self._columns)
            if not np.isfinite(kept):
                undersides[b] = self._underside(state, b, self.grid)
                continue
            clearance[b] = kept
            for pose in poses:
                pose[b, 2, 3] -= kept
            load = np.maximum(-forces[b, :, 2], 0.0)
            if self.correction is None:
                undersides[b] = self._underside(state, b, self.grid, kept, height[b])
                touched[b] = self._bears(load) & (undersides[b] - height[b] < self.mesh.d_hat)
            else:
                height[b], touched[b], undersides[b], coat[b], residual[b] = self._correct(
                    state, b, places, kept, height[b], load
                )
            centre[b] = load @ vertices[b, :, :2] / load.sum()
        failed |= ~(np.isfinite(height).all(axis=(1, 2)) & np.isfinite(coat).all(axis=(1, 2)))
        for shown in (coat, vertices, forces, height, clearance, residual, centre, *poses):
            shown[failed] = np.nan
        touched[failed], undersides[failed] = False, np.inf
        self._warn(residual)
        deformed = DeformedCoat(self.mesh.coat, coat)
        surface = GelSurface(self.grid, height, touched, centre, _touched_pose(state, poses), deformed)
        return SoftReading(surface, vertices, forces, clearance, poses, undersides, residual, failed)

    def _upwards(self, state: CoatState, b: int) -> np.ndarray:
        return state.vertices[b, :, 2] - self.mesh.coat.rest[:, 2]

    def _bears(self, load: np.ndarray) -> np.ndarray:
        """Mask (Ny, Nx) of the nodes in cells of which a vertex has a ``load`` (V,) [N]."""
        mesh = self.mesh.coat
        at_y, at_x = hat_matrix(mesh.lines_y, self.grid.y), hat_matrix(mesh.lines_x, self.grid.x)
        return at_y @ load.reshape(mesh.shape) @ at_x.T > 0.0

    def _correct(
        self, state: CoatState, b: int, places: CoatPlaces, clearance: float, plain: np.ndarray, load: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Height, contact mask, underside (Ny, Nx), coat vertices (V, 3) and residual of pad ``b``.

        ``plain``: height without correction [m].
        """
        assert self.correction is not None
        normal, sampler, tangential = self._stages
        rest, upwards = self.mesh.coat.rest, self._upwards(state, b)
        smooth = None
        if len(state.objects) > 1:
            smooth = self._fine_grid.rest + normal.sampler.lattice(self._surface.rise(places, upwards))
        under_fine = self._underside(state, b, self._fine_grid, clearance, smooth)
        contact = normal.solve(places, upwards, load, under_fine - self._fine_grid.rest)
        under = under_fine if self._fine_grid is self.grid else self._underside(state, b, self.grid, clearance, plain)
        if self.correction.normal:
            height, touched = sampler.lay(self._rest + sampler.rise(contact), contact, under)
        else:
            height, touched = plain, sampler.touching(contact)
        sideways = tangential.sideways(contact, state.vertices[b] - rest, load, state.friction(b))
        coat = np.empty_like(rest)
        coat[:, :2] = rest[:, :2] + sideways
        coat[:, 2] = self._height_at(height, coat[:, :2])
        return height, touched, under, coat, contact.residual

    def _measure(self, state: CoatState, b: int) -> tuple[CoatPlaces, float]:
        """Material points of one coat under the lattice, and the clearance [m]."""
        forces, displacement = state.forces[b], state.vertices[b] - self.mesh.coat.rest
        places = self._surface.places(displacement)
        if not (forces[:, 2] < 0.0).any():
            return places, float("nan")
        below = float(self.grid.rest.max()) + 10.0 * self.mesh.d_hat
        under = state.underside(b, self._clearance.x, self._clearance.y, below, below)
        if len(state.objects) > 1:
            smooth = self._clearance.heights(self._surface.rise(places, displacement[:, 2]))
            under[under < smooth - _BEHIND] = np.inf
        return places, self._clearance.measure(places, displacement[:, 2], -forces[:, 2] / self.mesh.coat.vertex_areas, under)

    def _height_at(self, height: np.ndarray, place: np.ndarray) -> np.ndarray:
        """z of a ``height`` field (Ny, Nx) [m] at places (V, 2), extended beyond the pad's edge."""
        x, y = (np.clip(place[:, k], line[0], line[-1]) for k, line in enumerate((self.grid.x, self.grid.y)))
        return rest_height(self._gelpad, x, y) + sampled(height - self._rest, self.grid.x, self.grid.y, x, y)

    def _warn(self, residual: np.ndarray) -> None:
        """Warn once of a contact that was not solved."""
        worst = float(np.nanmax(residual, initial=0.0))
        if self.correction is not None and worst > self.correction.unsolved and not self._warned:
            self._warned = True
            warnings.warn(
                f"the contact below the size of a cell was left {1e6 * worst:.1f} µm from its solution, more than "
                f"{1e6 * self.correction.unsolved:g} µm: the shown coat is laid on the object where it touches, and off by about so much "
                "around it",
                UnsolvedContactWarning,
                stacklevel=2,
            )

    @cached_property
    def _stages(self) -> tuple[NormalCorrection, ContactSampler, TangentialCorrection]:
        """Stages of the correction, made at the first contact: the compliance takes a while."""
        assert self.correction is not None
        x, y = self._fine_grid.x, self._fine_grid.y
        compliance, continued = correction_compliances(self.mesh, self._gelpad)
        normal = NormalCorrection(self._surface, self._gelpad, x, y, compliance[2], continued[2, 2], self.correction)
        tangential = TangentialCorrection(normal, self._gelpad, compliance, continued)
        return normal, ContactSampler(normal, self.grid.x, self.grid.y), tangential

    def _underside(
        self, state: CoatState, b: int, grid: PadGrid, clearance: float = 0.0, smooth: np.ndarray | None = None
    ) -> np.ndarray:
        """Underside of the objects over a grid [m], (Ny, Nx), but for what is far below ``smooth``."""
        under = state.underside(b, grid.x, grid.y, float(grid.rest.max()), lowered=clearance)
        if len(state.objects) > 1 and smooth is not None:
            under[under < smooth - _BEHIND] = np.inf
        return under


def _touched_pose(state: CoatState, poses: tuple[np.ndarray, ...]) -> np.ndarray | None:
    """Pose (B, 4, 4) of the first object that touches in each environment; None without objects."""
    if not poses:
        return None
    result = poses[0].copy()
    for thing, pose in reversed(list(zip(state.objects, poses, strict=True))):
        touching = np.ones(len(pose), bool) if thing.touching is None else thing.touching
        result[touching] = pose[touching]
    return result
