"""Any number of soft pads and bodies in one contact solver, driven by poses; what the press stands on, and what robots carry."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

import ipc
from raytac.errors import InputError, OverlapError
from raytac.gel.surface import PadGrid, chosen_envs, make_grid
from raytac.physics.soft.bodies import Cast, SceneBody, ScenePad, pad_body
from raytac.physics.soft.mesh import pad_stiffness
from raytac.physics.soft.reading import CoatState, ContactObject, SoftReader, SoftReading
from raytac.physics.soft.substeps import MOST_SUBSTEPS, Poses, SceneReport, Travel
from raytac.se3 import batch_of, inverse, nearest_rotation, quaternion, quaternions, rigid_poses

__all__ = ["CREEP", "MOST_SUBSTEPS", "ScenePad", "SceneReport", "SceneState", "SoftScene"]

CREEP = 5e-5
"""ε_v [m/s]: under a share r of the greatest friction, what sticks creeps at ε_v (1 − √(1 − r)); r = 0.75: 0.05 mm in two seconds."""
_CLOSE = 2e-8
"""A step is solved when no vertex would move further than this [m]; forces of what sticks want it small against ε_v dt."""
_LINEAR = 1e-6
"""Residual of the linear solve [-]: a grasped body that travels must come along to a small share of ε_v dt, or friction would slip."""


_GRAVITY = 0.0, 0.0, -9.81


@dataclass(frozen=True)
class SceneState:
    """Everything that a scene's next step depends on; from ``SoftScene.save``."""

    world: ipc.State
    poses: Poses


class SoftScene:
    """Pads and bodies in B environments that do not see each other.

    Poses are ``world_from_…`` (…, 4, 4). A pad's gel is solved in the frame of its case, so a case that travels through the air takes
    its pad along exactly. What the pads show is read by the same code as in a press (``SoftReader``).

    .. code-block:: python

        scene = SoftScene([ScenePad("left", sensor, mesh), ScenePad("right", sensor, mesh)],
                          [scene_body("cube", (primitive("box", (8e-3,) * 3),), "affine", density=500.0)],
                          world_from_pads, {"cube": world_from_cube}, dt=0.01)
        report = scene.step(world_from_pads)
        reading = scene.reading("left")
    """

    def __init__(
        self,
        pads: Sequence[ScenePad],
        bodies: Sequence[SceneBody],
        world_from_pad: ArrayLike,
        world_from_body: Mapping[str, ArrayLike],
        *,
        dt: float = 0.01,
        gravity: ArrayLike | None = None,
        friction: Mapping[tuple[str, str], float] | None = None,
        ignored: Sequence[tuple[str, str]] = (),
        num_envs: int | None = None,
        device: str = "cpu",
        settings: ipc.Settings | None = None,
    ) -> None:
        """Put pads and bodies into the solver where they start, clear of each other.

        Args:
            pads: S of them, by unique names.
            bodies: by names that are unique too.
            world_from_pad: where the pads start, (S, 4, 4) or (B, S, 4, 4).
            world_from_body: of each body by name, (4, 4) or (B, 4, 4).
            dt: length of a step [s].
            gravity: [m/s²], world frame, (3,) or (B, 3); None: (0, 0, −9.81), or that of ``settings``.
            friction: μ by pair of names where the rule does not fit. The rule: with a pad, the body's own coefficient if it has one, else
                the pad's gel's; between bodies, the larger of theirs, as in MuJoCo.
            ignored: pairs of names that pass through each other.
            num_envs: B; None: as the poses say.
            device: ``cpu``, ``cuda`` or ``auto``.
            settings: of the solver, instead of ``dt``, ``gravity`` and this module's own (see docs/soft-pad.md).

        Raises:
            InputError: no pads, names that repeat or are unknown, poses of a wrong shape or that are not rigid, or gravity and settings.
            OverlapError: bodies overlap where they start; the message names the surfaces.
        """
        if gravity is not None and settings is not None:
            raise InputError("gravity", value=gravity, rule="must be left out where settings are given, which have their own")
        given = (settings.gravity if settings is not None else _GRAVITY) if gravity is None else gravity
        self.gravity = np.asarray(given, float)
        self.num_envs = num_envs or batch_of(world_from_pad, 4, world_from_body)
        self._cast = Cast(pads, bodies, self.num_envs)
        self.pads, self.bodies = self._cast.pads, self._cast.bodies
        self._start = rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(pads)), self._cast.starts(world_from_body)
        d_hat = min(pad.mesh.d_hat for pad in pads)
        self.settings = settings or ipc.Settings(
            dt=dt,
            d_hat=d_hat,
            velocity_tolerance=_CLOSE / dt,
            friction_velocity=CREEP,
            friction_relags=0,  # every step lags it anew, and steps are small in contact
            linear_tolerance=_LINEAR,
        )
        placed = [self._at_start(body.solid, self._start[1][body.name][0]) for body in bodies]
        gels = [
            self._at_start(pad_body(pad.mesh, pad.sensor.gelpad, pad.name), self._start[0][0, k]) for k, pad in enumerate(pads)
        ]
        self._friction = mu = self._cast.friction() | dict(friction or {})
        try:
            self.world = ipc.World([*gels, *placed], self.settings, self.num_envs, device, mu, ignored)
            if settings is None:
                self.world.set_gravity(self.gravity)
            if self.num_envs > 1:
                self._spread(*self._start, np.ones(self.num_envs, bool))
        except ipc.OverlapError as error:
            raise OverlapError(f"bodies overlap where they start: {error}") from error
        except ipc.IpcError as error:
            raise InputError("scene", value=[*self.pads, *self.bodies], rule=f"cannot be solved: {error}") from error
        self._begin = self.world.save()
        self._now = Poses(self._start[0], self._cast.driven(self._start[1])).copy()
        self._travel = Travel(self)
        self._readers: dict[str, SoftReader] = {}
        self._on_surface = {name: self._coat_on_surface(pad) for name, pad in self.pads.items()}
        self._failed = np.zeros(self.num_envs, bool)

    @property
    def failed(self) -> np.ndarray:
        """Environments that stay as they are until they are reset, (B,), bool."""
        return self._failed.copy()

    # --- stepping --------------------------------------------------------------------------------------------------------------

    def is_small(self, world_from_pad: ArrayLike, driven: Mapping[str, ArrayLike] | None = None, dt: float | None = None) -> bool:
        """Whether the way to these poses in ``dt`` (all as for ``step``) is one that ``step`` would make in one go."""
        part, refused = self._travel.part(0, self._now, self._goal(world_from_pad, driven), dt or self.settings.dt)
        return part == MOST_SUBSTEPS and not refused

    def step(
        self, world_from_pad: ArrayLike, driven: Mapping[str, ArrayLike] | None = None, dt: float | None = None
    ) -> SceneReport:
        """Advance by ``dt`` [s] (None: the scene's).

        Cases go to ``world_from_pad``, (S, 4, 4) or (B, S, 4, 4), driven bodies to their poses; others stay.

        Where two bodies are near, their relative way in one go is at most ``STEP`` and ``TURN``: the step is then cut into halves, quarters
        and so on of its time, and poses between are interpolated. Far from everything a pad may go any way at once.

        Raises:
            InputError: an unknown or free body, a bad pose, or a motion near another body that would take more than
                ``MOST_SUBSTEPS`` parts (6.4 mm or 128° in one step); nothing has moved then. Of several environments the one that is
                told to move so fails instead, with a ``RuntimeWarning``, and the others go on.
        """
        begun, goal = self._now, self._goal(world_from_pad, driven)
        before: SceneState | None = None
        done, total = 0, None
        while done < MOST_SUBSTEPS:
            part, refused = self._travel.part(done, self._now, goal, dt or self.settings.dt)
            if refused and self.num_envs == 1:
                if before is not None:
                    self.restore(before)
                raise self._travel.refusal(0, refused[0], begun, goal)
            if refused:
                for b, pair in refused.items():
                    warnings.warn(f"failed: {self._travel.refusal(b, pair, begun, goal)}", RuntimeWarning, stacklevel=2)
                self.fail(list(refused))
                continue
            if part < MOST_SUBSTEPS and before is None:
                before = self.save()
            done += part
            at = begun.towards(goal, done / MOST_SUBSTEPS)
            found = self.advance(at.pads, at.bodies, (dt or self.settings.dt) * part / MOST_SUBSTEPS)
            total = found if total is None else total.then(found)
        assert total is not None
        return total

    def advance(self, world_from_pad: np.ndarray, driven: Mapping[str, np.ndarray], dt: float | None = None) -> SceneReport:
        """One step of the solver, as it is told: (B, S, 4, 4) and (B, 4, 4) by name; ``dt`` [s]: None for the scene's."""
        for k, name in enumerate(self.pads):
            self.world.set_target(name, world_from_pad[:, k, :3, 3], quaternions(world_from_pad[:, k]))
        for name, pose in driven.items():
            self.world.set_target(name, pose[:, :3, 3], quaternions(pose))
        self._now = Poses(world_from_pad, self._now.bodies | dict(driven)).copy()
        report = self.world.step(dt)
        self._failed = report.failed
        return SceneReport(
            report.failed,
            report.converged,
            (~report.converged & ~report.failed).astype(int),
            report.converged,
            report.min_gap,
            report.min_det,
            report.blocked,
            report.newton,
            report.elastic,
            report.barrier,
            substeps=1,
        )

    # --- reading ---------------------------------------------------------------------------------------------------------------

    def wrench(self, pad: str) -> np.ndarray:
        """Force [N] of what touches a pad and its torque [N m] about the pad frame's origin, world axes, shape (B, 6).

        All of the gel's surface counts, its sides too. At rest it is what the pad does to the link that carries it (``bond_wrench``);
        the gel's weight and inertia are not in it, since the link's model has the gel's mass.
        """
        return self._contact_wrench(self._cast.pad(pad).name)

    def bond_wrench(self, pad: str) -> np.ndarray:
        """Force [N] and torque about the pad frame's origin [N m] of a pad on its case, world axes, shape (B, 6): with its weight."""
        found = self.world.wrench(self._cast.pad(pad).name)
        return np.concatenate([found.force, found.torque], axis=1)

    def body_wrench(self, name: str) -> np.ndarray:
        """Force [N] of what touches a body and its torque [N m] about the body's origin, world axes, shape (B, 6)."""
        return self._contact_wrench(self._cast.body(name).name)

    def stiffness(self, pad: str) -> np.ndarray:
        """Bound of the stiffness of what touches a pad, (B, 6, 6), world axes, about the place where it presses: see ``pad_stiffness``."""
        mine = self._cast.pad(pad)
        bodies = self.world.layout.names.index(pad)
        first, last = self.world.layout.vert_start[bodies : bodies + 2]
        loaded = np.linalg.norm(self.world.contact_forces(pad), axis=2) > 0.0
        areas = (loaded * self.world.layout.vert_area[first:last]).sum(axis=1)
        turn = np.zeros((self.num_envs, 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = self.world.frame(pad)[0]
        local = np.stack([pad_stiffness(mine.sensor.gelpad, float(area)) for area in areas])
        return turn @ local @ np.swapaxes(turn, 1, 2)

    def pose(self, name: str) -> np.ndarray:
        """``world_from_body`` or ``world_from_pad`` (B, 4, 4) as it is; of a free soft body, the rigid motion that fits it best."""
        found = np.tile(np.eye(4), (self.num_envs, 1, 1))
        body = None if name in self.pads else self._cast.body(name)
        if body is None or body.is_driven:
            found[:, :3, :3], found[:, :3, 3] = self.world.frame(name)
        elif isinstance(body.solid, ipc.SoftBody):
            rest = body.solid.mesh.vertices
            now = self.world.positions(name)
            middle, centre = now.mean(axis=1), rest.mean(axis=0)
            found[:, :3, :3] = nearest_rotation(np.einsum("bni,nj->bij", now - middle[:, None], rest - centre))
            found[:, :3, 3] = middle - found[:, :3, :3] @ centre
        else:
            matrix, position = self.world.affine_pose(name)
            found[:, :3, :3], found[:, :3, 3] = nearest_rotation(matrix), position
        return found

    def velocity(self, name: str) -> np.ndarray:
        """Mean velocity of a free body's nodes [m/s], world frame, (B, 3)."""
        return self.world.velocities(self._cast.body(name).name).mean(axis=1)

    def mesh(self, name: str, seen_from: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Surface of a body or pad as it is: vertices (B, n, 3) [m], world frame or that of the pad ``seen_from``, and faces (F, 3)."""
        vertices, faces = self.world.surface(name)
        at = self.world.positions(name)
        if name in self.pads or self._cast.body(name).is_soft:
            at = at[:, vertices]
        return (at if seen_from is None else self._into(seen_from, at)), faces

    def skin(self, name: str, seen_from: str) -> tuple[np.ndarray, np.ndarray]:
        """Surface of a soft body, or of another pad, without facets if it has a ``SoftSkin``; as ``mesh``."""
        skin = None if name in self.pads else self._cast.body(name).skin
        if skin is None:
            return self.mesh(name, seen_from)
        return skin.carried(self._into(seen_from, self.world.positions(name))), skin.faces

    def coat(self, pad: str) -> np.ndarray:
        """Vertices of a pad's coat [m], pad frame, shape (B, V, 3): as the solver has them, with the barrier's clearance."""
        return self.world.positions(pad, frame="body")[:, self._cast.pad(pad).mesh.coat_vertices]

    def coat_forces(self, pad: str) -> np.ndarray:
        """What touches does to each vertex of a coat [N], pad frame, shape (B, V, 3)."""
        return self.world.contact_forces(pad)[:, self._on_surface[pad]] @ self.world.frame(pad)[0]

    def grid(self, pad: str) -> PadGrid:
        """Grid that a pad's surface is read on."""
        return make_grid(self._cast.pad(pad).sensor.gelpad, self._cast.pad(pad).pitch)

    def reading(self, pad: str, grid: PadGrid | None = None, failed: np.ndarray | None = None) -> SoftReading:
        """What a pad shows, on its own grid or another: surface, contact, forces on its coat; NaN in environments that failed.

        ``failed``: further environments (B,) that are lost, if not by this scene.
        """
        mine = self._cast.pad(pad)
        if pad not in self._readers or (grid is not None and grid is not self._readers[pad].grid):
            mesh = replace(mine.mesh, d_hat=self.world.d_hat)
            self._readers[pad] = SoftReader(mesh, mine.sensor.gelpad, grid or self.grid(pad), mine.correction)
        return self._readers[pad].read(self.coat_state(pad), self._failed if failed is None else self._failed | failed)

    def coat_state(self, pad: str) -> CoatState:
        """A pad's coat with the forces on it, and the objects that it touches."""
        frame = inverse(self.pose(self._cast.pad(pad).name))
        objects = []
        for name, near in self.world.touching(pad).items():
            body = self.bodies.get(name)
            if body is not None and not body.is_soft:
                objects.append(ContactObject(body.parts, frame @ self.pose(name), None, near, self._friction_between(pad, name)))
            elif name != pad:
                objects.append(ContactObject((), frame @ self.pose(name), self.skin(name, pad), near))
        return CoatState(self.coat(pad), self.coat_forces(pad), tuple(objects))

    def _friction_between(self, pad: str, body: str) -> float:
        """μ as the solver has it, which takes the last where a pair was given both ways round."""
        return [mu for pair, mu in self._friction.items() if set(pair) == {pad, body}][-1]

    # --- state -----------------------------------------------------------------------------------------------------------------

    def save(self) -> SceneState:
        """The state of every environment."""
        return SceneState(self.world.save(), self._now.copy())

    def restore(self, state: SceneState, envs: ArrayLike | None = None) -> None:
        """Put environments, a mask (B,) or a list, None for all, back to a saved state; there are no contact forces until the next step."""
        mask = np.isin(np.arange(self.num_envs), chosen_envs(envs, self.num_envs))
        self.world.restore(state.world, mask)
        self._now.pads[mask] = state.poses.pads[mask]
        for name, pose in state.poses.bodies.items():
            self._now.bodies[name][mask] = pose[mask]
        self._failed = self._failed & ~mask | state.world.failed & mask

    def reset(
        self,
        envs: ArrayLike | None = None,
        world_from_pad: ArrayLike | None = None,
        world_from_body: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Undeformed, at rest, without history, where the scene was made or at other poses (shapes as for the scene itself).

        Raises:
            OverlapError: bodies overlap at these poses; nothing has changed then.
        """
        mask = np.isin(np.arange(self.num_envs), chosen_envs(envs, self.num_envs))
        if world_from_pad is None and world_from_body is None:
            self.restore(SceneState(self._begin, Poses(self._start[0], self._cast.driven(self._start[1]))), mask)
            return
        cases = (
            self._start[0]
            if world_from_pad is None
            else rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(self.pads))
        )
        places = self._start[1] | self._cast.named(world_from_body or {}, free=True)
        before = self.save()
        try:
            self.world.restore(self._begin, mask)
            self._spread(cases, places, mask)
        except ipc.OverlapError as error:
            self.world.restore(before.world, mask)
            raise OverlapError(f"bodies overlap at the poses of the reset: {error}") from error
        self.restore(SceneState(self.world.save(), Poses(cases, self._cast.driven(places))), mask)

    def fail(self, envs: ArrayLike) -> None:
        """Let environments, a mask (B,) or a list, stay as they are until they are reset."""
        state, chosen = self.save(), chosen_envs(envs, self.num_envs)
        state.world.failed[chosen] = True
        self.restore(state, chosen)

    # --- inner -----------------------------------------------------------------------------------------------------------------

    def _contact_wrench(self, name: str) -> np.ndarray:
        if name in self.bodies and isinstance(self.bodies[name].solid, ipc.HalfSpace):
            found = self.world.wrench(name)
            return np.concatenate([found.force, found.torque], axis=1)
        forces = self.world.contact_forces(name)
        arm = self.mesh(name)[0] - self.pose(name)[:, None, :3, 3]
        return np.concatenate([forces.sum(axis=1), np.cross(arm, forces).sum(axis=1)], axis=1)

    def _coat_on_surface(self, pad: ScenePad) -> np.ndarray:
        """Surface vertex of the solver under each vertex of the coat."""
        vertex_of = self.world.surface(pad.name)[0]
        place = np.full(len(pad.mesh.tets.vertices), -1)
        place[vertex_of] = np.arange(len(vertex_of))
        return place[pad.mesh.coat_vertices]

    def _into(self, pad: str, points: np.ndarray) -> np.ndarray:
        """Points (B, n, 3), world frame, in a pad's frame."""
        rotation, position = self.world.frame(pad)
        return (points - position[:, None]) @ rotation

    def _goal(self, world_from_pad: ArrayLike, driven: Mapping[str, ArrayLike] | None) -> Poses:
        pads = rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(self.pads))
        return Poses(pads, self._now.bodies | self._cast.named(driven or {}))

    def _spread(self, cases: np.ndarray, places: Mapping[str, np.ndarray], mask: np.ndarray) -> None:
        """Put environments of the mask at poses of their own, undeformed and at rest."""
        state, layout = self.world.save(), self.world.layout
        poses = {name: cases[:, k] for k, name in enumerate(self.pads)} | dict(places)
        for name, pose in poses.items():
            body = self.bodies.get(name)
            index = layout.names.index(name)
            if body is None or body.is_driven:
                state.frame_position[mask, index] = pose[mask, :3, 3]
                state.frame_rotation[mask, index] = quaternions(pose)[mask]
                continue
            nodes = slice(layout.node_start[index], layout.node_start[index + 1])
            change = pose @ inverse(self._start[1][name][:1])
            moved = np.einsum("bij,nj->bni", change[:, :3, :3], layout.node_rest[nodes]) + change[:, None, :3, 3]
            state.y[mask, nodes] = moved[mask]
        self.world.restore(state, mask)

    @staticmethod
    def _at_start(solid, pose: np.ndarray):
        return replace(solid, pose=ipc.Pose(tuple(pose[:3, 3].tolist()), tuple(quaternion(pose[:3, :3]).tolist())))
