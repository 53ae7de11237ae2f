"""Bodies of a world: soft, affine, kinematic, half-spaces; queries for vertices to bond."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipc.bodies.material import Material, Stiff
from ipc.errors import IpcError
from ipc.meshes.mesh import TetMesh, TriMesh


def rotation_matrix(quaternion: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices of unit quaternions (w, x, y, z), shape (..., 4) to (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class Pose:
    """``world_from_body``: x_world = R(rotation) x_body + position.

    Attributes:
        position: origin of the body in the world [m].
        rotation: unit quaternion (w, x, y, z).
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not np.isfinite(self.position).all():
            raise IpcError(f"position = {self.position}: it must be finite")
        if not abs(np.linalg.norm(self.rotation) - 1) < 1e-6:
            raise IpcError(f"rotation = {self.rotation}: a quaternion (w, x, y, z) must have length 1")


@dataclass(frozen=True)
class SoftBody:
    """A deformable solid.

    Attributes:
        name: unique name.
        mesh: tetrahedra in the body's frame.
        material: elastic material.
        bonded: indices of the vertices that are fixed to the body's frame: they move with its pose exactly and are no unknowns.
        pose: ``world_from_body`` at the start. With bonded vertices the frame is driven (see ``World.set_target``); without, it only
            places the body.
        self_contact: if True, the body's surface may touch itself.
        grips: further sets of vertices, each bonded exactly to a moving frame of its own, which is driven under the name
            ``"<body>.<grip>"`` and begins at ``pose``; they need ``bonded`` vertices beside them, whose frame the body is solved in.
        volume_blocks: number of each tetrahedron's volume block, shape (T,), or −1 for none. The tetrahedra of a block resist the change
            of their mean dilation instead of each its own, so that a nearly incompressible body does not lock
            (``ipc.solver.dilation``); ``ipc.grid_blocks`` makes blocks of the cells of a grid. None: no blocks.
        own_volume: stiffness of each tetrahedron of a block against a change of its own volume, λ'/μ, at most λ/μ: 0 may let a free
            surface wrinkle, and λ/μ is a body without blocks.
    """

    name: str
    mesh: TetMesh
    material: Material
    bonded: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pose: Pose = Pose()
    self_contact: bool = False
    grips: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    volume_blocks: NDArray[np.int64] | None = None
    own_volume: float = 0.0

    def __post_init__(self) -> None:
        bonded = self._vertices("bonded", self.bonded)
        grips = {key: self._vertices(key, ids) for key, ids in self.grips.items()}
        if grips and not len(bonded):
            raise IpcError(f"{self.name}: grips {', '.join(grips)} need bonded vertices beside them")
        fixed = np.concatenate([bonded, *grips.values()])
        if len(np.unique(fixed)) < len(fixed):
            raise IpcError(f"{self.name}: a vertex is held twice, by bonded or grips {', '.join(grips)}")
        object.__setattr__(self, "bonded", bonded)
        object.__setattr__(self, "grips", grips)
        mu, lam = self.material.coefficients()
        if not 0 <= self.own_volume <= lam / mu:
            raise IpcError(f"{self.name}: own_volume = {self.own_volume}: it must lie in [0, λ/μ], here [0, {lam / mu:.4g}]")
        if self.volume_blocks is not None:
            blocks = np.asarray(self.volume_blocks)
            if blocks.shape != (len(self.mesh.tets),) or not np.issubdtype(blocks.dtype, np.integer) or blocks.min() < -1:
                rule = f"they must be whole numbers of at least −1, shape ({len(self.mesh.tets)},), one a tetrahedron"
                raise IpcError(f"{self.name}: volume_blocks of shape {blocks.shape} and type {blocks.dtype}: {rule}")
            object.__setattr__(self, "volume_blocks", blocks.astype(np.int64))

    def _vertices(self, what: str, ids: ArrayLike) -> NDArray[np.int64]:
        unique = np.unique(np.asarray(ids, dtype=np.int64))
        if len(unique) and (unique[0] < 0 or unique[-1] >= len(self.mesh.vertices)):
            raise IpcError(f"{self.name}: {what} names vertices {unique[0]} to {unique[-1]}: there are {len(self.mesh.vertices)}")
        return unique


@dataclass(frozen=True)
class AffineBody:
    """A near-rigid solid with twelve unknowns, x = A X + p (Lan et al. 2022).

    Attributes:
        name: unique name.
        surface: closed surface in the body's frame; mass and inertia come from its volume.
        material: stiffness and density.
        pose: ``world_from_body`` at the start.
        drive: strength s of a drive towards the pose given by ``World.set_target`` (its start at first): the step adds
            ½ s/h² ‖x − x_aim‖²_M, so that a free body covers s/(1 + s) of the distance in one step and contact may stop it. 0: free.
    """

    name: str
    surface: TriMesh
    material: Stiff = field(default_factory=Stiff)
    pose: Pose = Pose()
    drive: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.drive < np.inf:
            raise IpcError(f"{self.name}: drive = {self.drive}: it must be finite and not negative")


@dataclass(frozen=True)
class KinematicBody:
    """A rigid surface of prescribed pose (see ``World.set_target``); it may be open.

    Attributes:
        name: unique name.
        surface: triangles in the body's frame.
        pose: ``world_from_body`` at the start.
    """

    name: str
    surface: TriMesh
    pose: Pose = Pose()


@dataclass(frozen=True)
class HalfSpace:
    """The solid half-space z ≤ 0 of its own frame; it may move.

    Attributes:
        name: unique name.
        pose: ``world_from_body`` at the start; the frame's z axis is the outward normal.
    """

    name: str
    pose: Pose = Pose()


Body = SoftBody | AffineBody | KinematicBody | HalfSpace


def vertices_in_box(mesh: TetMesh, low: ArrayLike, high: ArrayLike, tolerance: float = 1e-9) -> NDArray[np.int64]:
    """Vertices of ``mesh`` in a box [m], to within ``tolerance`` [m]; ±inf opens a side."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    inside = ((mesh.vertices >= low - tolerance) & (mesh.vertices <= high + tolerance)).all(axis=1)
    return np.flatnonzero(inside)


def vertices_near(mesh: TetMesh, what: TriMesh | ArrayLike, distance: float) -> NDArray[np.int64]:
    """Vertices of ``mesh`` within ``distance`` [m] of a surface or of points [m] (P, 3)."""
    if not distance >= 0:
        raise IpcError(f"distance = {distance}: it cannot be negative")
    if isinstance(what, TriMesh):
        corners = what.vertices[what.faces]
    else:
        corners = np.repeat(np.asarray(what, dtype=np.float64).reshape(-1, 1, 3), 3, axis=1)
    near = np.zeros(len(mesh.vertices), bool)
    for a, b, c in corners:
        near |= _squared_distance(mesh.vertices, a, b, c) <= distance**2
    return np.flatnonzero(near)


def _squared_distance(points: NDArray[np.float64], *corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances of points (V, 3) to a triangle, by its plane and its edges."""
    squared = np.full(len(points), np.inf)
    for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
        edge, rel = end - start, points - start
        along = np.clip(rel @ edge / max(edge @ edge, 1e-300), 0.0, 1.0)
        squared = np.minimum(squared, ((rel - along[:, None] * edge) ** 2).sum(axis=1))
    u, v, rel = corners[1] - corners[0], corners[2] - corners[0], points - corners[0]
    normal = np.cross(u, v)
    size = normal @ normal
    if size == 0:
        return squared
    s, t = np.cross(rel, v) @ normal / size, np.cross(u, rel) @ normal / size
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    return np.where(inside, (rel @ normal) ** 2 / size, squared)
