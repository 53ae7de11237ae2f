"""A pad and an object in the contact solver, seen from the pad."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module names its functions at run time.)

from __future__ import annotations

import mujoco
import numpy as np

import ipc
from raytac.errors import RaytacError
from raytac.physics.soft_bodies import OBJECT, PAD, pad_body
from raytac.physics.soft_mesh import PadMesh
from raytac.specs.sensor import GelpadSpec

__all__ = ["GRAVITY", "SoftContact"]

GRAVITY = 9.81
"""Acceleration that makes a free body's mass its weight [m/s²]."""
_TIME_STEP = 0.01
_CLOSE = 5e-7
"""A step is solved when no vertex would move further than this [m]."""
_CREEP = 1e-6
"""What sticks may creep by so much a step [m]."""
_BLOCKED = 1e-3
"""Share of a step's motion that may be left undone."""
_UNSETTLED, _SETTLINGS = 0.01, 60
"""Friction has settled when the coat's forces change by less than this share in a step; so many steps are tried."""
_SLIGHT = 1e-5
"""A force too small to be judged [N]."""


class SoftContact:
    """B copies of a bonded pad and one object. Every pose and vector here is in the pad frame unless it says otherwise."""

    def __init__(
        self,
        mesh: PadMesh,
        gelpad: GelpadSpec,
        body: ipc.KinematicBody | ipc.AffineBody | ipc.SoftBody,
        starts: np.ndarray,
        device: str,
    ) -> None:
        """``starts``: ``pad_from_object`` of each environment, shape (B, 4, 4), clear of the pad; ``device``: ``cpu`` or ``cuda``.

        Raises:
            RaytacError: the object overlaps the pad where it starts; the message names the surfaces.
        """
        self.mesh, self.body, self._friction = mesh, body, gelpad.friction
        settings = ipc.Settings(
            dt=_TIME_STEP,
            d_hat=mesh.d_hat,
            friction=gelpad.friction,
            velocity_tolerance=_CLOSE / _TIME_STEP,
            friction_velocity=_CREEP / _TIME_STEP,
            friction_relags=0,  # a loading in small steps stays within the cone; what unloads is followed by settle_friction
        )
        first = starts[0]
        pose = ipc.Pose(tuple(first[:3, 3].tolist()), _quaternion(first[:3, :3]))
        placed = type(body)(**{**{name: getattr(body, name) for name in body.__dataclass_fields__}, "pose": pose})
        try:
            self.world = ipc.World([pad_body(mesh, gelpad), placed], settings, num_envs=len(starts), device=device)
            if len(starts) > 1:
                self._spread(starts)
        except ipc.OverlapError as error:
            raise RaytacError(f"the object overlaps the pad where it starts, 1 mm above the first touch: {error}") from error
        self._start = self.world.save()
        vertex_of, self._object_faces = self.world.surface(PAD)[0], self.world.surface(OBJECT)[1]
        place = np.full(len(mesh.tets.vertices), -1)
        place[vertex_of] = np.arange(len(vertex_of))
        self._coat_on_surface = place[mesh.coat_vertices]
        self._world_from_pad = np.tile(np.eye(4), (len(starts), 1, 1))

    def reset(self) -> None:
        """Back to the start, without history."""
        self.world.restore(self._start)
        self._world_from_pad[:] = np.eye(4)

    def drive(self, pad_from_object: np.ndarray, world_from_pad: np.ndarray | None = None) -> np.ndarray:
        """One step that takes the object to ``pad_from_object`` (B, 4, 4); the case moves if ``world_from_pad`` (B, 4, 4) is given.

        A free object is not driven. Returns which environments failed, shape (B,).
        """
        if world_from_pad is not None:
            self._world_from_pad = world_from_pad.copy()
            self.world.set_target(PAD, world_from_pad[:, :3, 3], _quaternions(world_from_pad))
        if not isinstance(self.body, ipc.AffineBody):
            world_from_object = self._world_from_pad @ pad_from_object
            self.world.set_target(OBJECT, world_from_object[:, :3, 3], _quaternions(world_from_object))
        report = self.world.step()
        return report.failed | (report.blocked > _BLOCKED)

    def settle_friction(self, pad_from_object: np.ndarray, world_from_pad: np.ndarray | None, failed: np.ndarray) -> np.ndarray:
        """Stand still until friction is that of the contacts there are; poses as for ``drive``.

        Friction is bounded by the normal forces with which a step begins. In an unloading those are too large, and some are of contacts
        that the step has opened: friction would pull on the pad where nothing touches it any more. Environments that ``failed``, (B,),
        are not waited for. Returns which failed meanwhile, (B,).
        """
        lost, forces = failed.copy(), self.forces()
        for _ in range(_SETTLINGS):
            if not forces[~lost].any():
                break
            lost |= self.drive(pad_from_object, world_from_pad)
            before, forces = forces, self.forces()
            changed, borne = (np.linalg.norm(f, axis=2).sum(axis=1) for f in (forces - before, forces))
            total = forces.sum(axis=1)
            cone = (1.0 + _UNSETTLED) * self._friction * np.maximum(-total[:, 2], 0.0) + _SLIGHT
            settled = (changed <= _UNSETTLED * borne) & (np.linalg.norm(total[:, :2], axis=1) <= cone)
            if (settled | lost).all():
                break
        return lost

    def weigh(self, share: float) -> None:
        """Let gravity act with ``share`` of its strength, towards −z of the world."""
        self.world.set_gravity((0.0, 0.0, -share * GRAVITY))

    def speed(self) -> np.ndarray:
        """Greatest speed of any point of a free object [m/s], shape (B,)."""
        return np.linalg.norm(self.world.velocities(OBJECT), axis=-1).max(axis=-1)

    def coat(self) -> np.ndarray:
        """Vertices of the coat [m], shape (B, V, 3)."""
        return self.world.positions(PAD, frame="body")[:, self.mesh.coat_vertices]

    def forces(self) -> np.ndarray:
        """What the object does to each vertex of the coat [N], shape (B, V, 3)."""
        forces = self.world.contact_forces(PAD)[:, self._coat_on_surface]
        return forces @ self._world_from_pad[:, :3, :3]

    def pad_from_object(self, driven: np.ndarray) -> np.ndarray:
        """Pose (B, 4, 4): ``driven`` itself unless the object is free."""
        if not isinstance(self.body, ipc.AffineBody):
            return driven
        pose = np.tile(np.eye(4), (len(driven), 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = self.world.affine_pose(OBJECT)
        return pose

    def soft_object(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Surface of a soft object: vertices (B, n, 3) [m] and faces; None for a rigid one."""
        if not isinstance(self.body, ipc.SoftBody):
            return None
        at = self.world.positions(OBJECT)[:, self.world.surface(OBJECT)[0]] - self._world_from_pad[:, None, :3, 3]
        return at @ self._world_from_pad[:, :3, :3], self._object_faces

    def _spread(self, starts: np.ndarray) -> None:
        """Put the object of each environment at its own start; all have the same attitude."""
        if not isinstance(self.body, ipc.AffineBody):
            self.world.teleport(OBJECT, starts[:, :3, 3], _quaternions(starts))
            return
        state, free = self.world.save(), len(self.mesh.tets.vertices)
        state.y[:, free:] += (starts[:, :3, 3] - starts[0, :3, 3])[:, None]
        self.world.restore(state)


def _quaternions(poses: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of poses (B, 4, 4), shape (B, 4)."""
    return np.array([_quaternion(pose[:3, :3]) for pose in poses])


def _quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Quaternion wxyz of a rotation matrix (3, 3)."""
    found = np.empty(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(rotation).ravel())
    return tuple((found / np.linalg.norm(found)).tolist())
