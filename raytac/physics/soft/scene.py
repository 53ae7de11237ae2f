"""Soft scenes: any number of soft pads and bodies in one contact solver, driven by poses."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

import ipc
from raytac.errors import InputError, OverlapError
from raytac.gel.surface import PadGrid, chosen_envs, make_grid
from raytac.physics.soft.bodies import SceneBody, ScenePad, SceneRegistry, pad_body
from raytac.physics.soft.coat_state import CoatState, SceneCoat
from raytac.physics.soft.mesh import pad_stiffness
from raytac.physics.soft.reading import PadArrays, SoftReader, SoftReading
from raytac.physics.soft.scene_state import Poses, SceneReport, SceneState
from raytac.physics.soft.settings import DEFAULT_ACCURACY, SceneSettings
from raytac.physics.soft.substeps import Sleep, Substeps
from raytac.se3 import batch_of, inverse, nearest_rotation, quaternion, quaternions, rigid_poses

_GRAVITY = 0.0, 0.0, -9.81
_Poses = Mapping[str, ArrayLike]
"""``world_from_body`` by name, (4, 4) or (B, 4, 4)."""


class SoftScene:
    """Pads and bodies in B independent environments.

    Poses are ``world_from_…`` (…, 4, 4). A pad's gel is solved in the frame of its case, so a case that moves through the air carries
    its pad exactly. Surfaces are read as in a press (``SoftReader``).

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
        world_from_body: _Poses,
        *,
        dt: float = 0.01,
        gravity: ArrayLike | None = None,
        friction: Mapping[tuple[str, str], float] | None = None,
        ignored: Sequence[tuple[str, str]] = (),
        num_envs: int | None = None,
        device: str = "cpu",
        settings: ipc.Settings | None = None,
        accuracy: SceneSettings = DEFAULT_ACCURACY,
    ) -> None:
        """Put pads and bodies into the solver at their initial poses, clear of each other.

        Args:
            pads: S of them; names must be unique.
            bodies: the others; names must be unique too.
            world_from_pad: initial poses of the pads, (S, 4, 4) or (B, S, 4, 4).
            world_from_body: initial pose of each body by name, (4, 4) or (B, 4, 4).
            dt: length of a step [s].
            gravity: [m/s²], world frame, (3,) or (B, 3); None: (0, 0, −9.81), or that of ``settings``.
            friction: μ by pair of names, instead of the default. The default with a pad is the body's own coefficient if it has one, else
                that of the pad's gel; between bodies it is the larger of theirs, as in MuJoCo.
            ignored: pairs of names that pass through each other.
            num_envs: B; None: as many as the poses have.
            device: ``cpu``, ``cuda`` or ``auto``.
            settings: of the solver, instead of ``dt``, ``gravity`` and the tolerances of ``accuracy`` (see docs/concepts/soft-pad.md).
            accuracy: tolerances of the solver, and its substeps.

        Raises:
            InputError: no pads, names that repeat or are unknown, poses of a wrong shape or that are not rigid, or gravity and settings.
            OverlapError: bodies overlap at their initial poses; the message names the surfaces.
        """
        if gravity is not None and settings is not None:
            raise InputError("gravity", value=gravity, rule="must be left out where settings are given, which have their own")
        default_gravity = _GRAVITY if settings is None else settings.gravity
        self.gravity = np.asarray(default_gravity if gravity is None else gravity, float)
        self.num_envs = num_envs or batch_of(world_from_pad, 4, world_from_body)
        self._registry = SceneRegistry(pads, bodies, self.num_envs)
        self.pads, self.bodies = self._registry.pads, self._registry.bodies
        self._start = (
            rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(pads)),
            self._registry.starts(world_from_body),
        )
        d_hat = min(pad.mesh.d_hat for pad in pads)
        self.settings = settings or ipc.Settings(
            dt=dt,
            d_hat=d_hat,
            velocity_tolerance=accuracy.tolerance / dt,
            friction_slip=accuracy.slip,
            linear_tolerance=accuracy.linear_tolerance,
            forcing=accuracy.forcing,
            halvings=0,  # scenes have substeps of their own
        )
        solids = [_placed_at(body.solid, self._start[1][body.name][0]) for body in bodies]
        gels = [
            _placed_at(pad_body(pad.mesh, pad.sensor.gelpad, pad.name), pose)
            for pad, pose in zip(pads, self._start[0][0], strict=True)
        ]
        self._friction = mu = self._registry.friction() | dict(friction or {})
        try:
            self.world = ipc.World([*gels, *solids], self.settings, self.num_envs, device, mu, ignored)
            if settings is None:
                self.world.set_gravity(self.gravity)
            self._start_state = self.world.save()
            if self.num_envs > 1:
                self.world.restore(self._placed(*self._start, np.ones(self.num_envs, bool)))
        except ipc.OverlapError as error:
            raise OverlapError(f"bodies overlap where they start: {error}") from error
        except ipc.IpcError as error:
            raise InputError("scene", value=[*self.pads, *self.bodies], rule=f"cannot be solved: {error}") from error
        self._start_state = self.world.save()
        self._now = Poses(self._start[0], self._registry.driven(self._start[1])).copy()
        self._substeps = Substeps(self.pads, self.bodies, self, accuracy.substeps)
        self._sleep = Sleep(
            self.pads, self.bodies, self._substeps, self.world, self.settings.velocity_tolerance * self.settings.dt
        )
        self._asleep = np.zeros(self.num_envs, bool)
        self._energies = np.zeros(self.num_envs), np.zeros(self.num_envs)
        self._readers: dict[str, SoftReader] = {}
        self._coats: dict[str, SceneCoat] = {}
        self._coat_numbers = {name: self._surface_numbers(pad) for name, pad in self.pads.items()}
        self._failed = np.zeros(self.num_envs, bool)

    @property
    def failed(self) -> np.ndarray:
        """Environments that are frozen until they are reset, (B,), bool."""
        return self._failed.copy()

    def is_small(self, world_from_pad: ArrayLike, driven: _Poses | None = None, dt: ArrayLike | None = None) -> np.ndarray:
        """Environments (B,) in which ``step`` with the same arguments is not divided, or has failed."""
        done, goal = np.zeros(self.num_envs, int), self._goal(world_from_pad, driven)
        part, _ = self._substeps.next_part(done, self._now, goal, self._durations(dt))
        return self._failed | (part == self._substeps.limits.most)

    def step(
        self,
        world_from_pad: ArrayLike,
        driven: _Poses | None = None,
        dt: ArrayLike | None = None,
        envs: ArrayLike | None = None,
    ) -> SceneReport:
        """Advance environments by ``dt`` [s], one or (B,); None: the scene's.

        ``envs``: a mask (B,) or list of them, None for all; the others stay as they are.
        Cases move to ``world_from_pad``, (S, 4, 4) or (B, S, 4, 4), and driven bodies to the poses given; others stay.

        Two bodies that are near, one of them soft, may move at most ``SubstepLimits.step`` and ``turn`` against each other at a time. The
        step of that environment is then divided into halves, quarters and so on, with interpolated poses. Far from everything a pad may
        move any distance at once. Environments at rest in which nothing soft can be touched sleep: they are not solved (``Sleep``).

        Raises:
            InputError: an unknown or free body, a bad pose, or a motion near another body that would take more than
                ``SubstepLimits.most`` substeps (by default 6.4 mm or 128° in one step); nothing has moved then. Of several environments
                only the one with that motion fails, with a ``RuntimeWarning``.
        """
        start, goal, most = self._now.copy(), self._goal(world_from_pad, driven), self._substeps.limits.most
        chosen, durations = np.isin(np.arange(self.num_envs), chosen_envs(envs, self.num_envs)), self._durations(dt)
        before: SceneState | None = None
        total, self._asleep = self._carry(goal, durations, chosen)
        done = np.where(chosen & ~self._asleep, 0, most)
        while True:
            part, refused = self._substeps.next_part(done, self._now, goal, durations)
            if refused and self.num_envs == 1:
                if before is not None:
                    self.restore(before)
                raise self._substeps.refusal(0, refused[0], start, goal)
            if refused:
                for b, pair in refused.items():
                    warnings.warn(f"failed: {self._substeps.refusal(b, pair, start, goal)}", RuntimeWarning, stacklevel=2)
                self.fail(list(refused))
                continue
            if not part.any():
                sound = ~self._failed
                return replace(
                    total, failed=~sound, converged=total.converged & sound, last_converged=total.last_converged & sound
                )
            if self.num_envs == 1 and part[0] < most and before is None:
                before = self.save()
            done = done + part
            poses = start.towards(goal, done / most)
            total = total.then(self.advance(poses.pads, poses.bodies, durations * part / most, part > 0))

    def advance(
        self,
        world_from_pad: np.ndarray,
        driven: Mapping[str, np.ndarray],
        dt: ArrayLike | None = None,
        envs: np.ndarray | None = None,
    ) -> SceneReport:
        """One undivided solver step to (B, S, 4, 4) and (B, 4, 4) by name; others as for ``step``."""
        chosen = np.ones(self.num_envs, bool) if envs is None else envs
        self._aim(world_from_pad, driven, chosen)
        return self._report(self.world.step(self._durations(dt), chosen), chosen & ~self._failed)

    @property
    def asleep(self) -> np.ndarray:
        """Environments (B,) that slept through the last step: nothing touches their gels."""
        return self._asleep.copy()

    def _carry(self, goal: Poses, durations: np.ndarray, chosen: np.ndarray) -> tuple[SceneReport, np.ndarray]:
        """Move those of the chosen environments (B,) that sleep to ``goal``, without a solve.

        Returns a report of no steps, and which slept (B,).
        """
        asleep = chosen & ~self._failed & self._sleep.choose(self._now, goal)
        if asleep.any():
            self._aim(goal.pads, goal.bodies, asleep)
            self.world.carry(durations, asleep)
        return SceneReport.of_none(self._failed, *self._energies), asleep

    def _aim(self, world_from_pad: np.ndarray, driven: Mapping[str, np.ndarray], chosen: np.ndarray) -> None:
        """Set the targets of the environments (B,) that move next."""
        for k, name in enumerate(self.pads):
            self.world.set_target(name, world_from_pad[:, k, :3, 3], quaternions(world_from_pad[:, k]))
            self._now.pads[chosen, k] = world_from_pad[chosen, k]
        for name, pose in driven.items():
            self.world.set_target(name, pose[:, :3, 3], quaternions(pose))
            self._now.bodies[name][chosen] = pose[chosen]

    def _report(self, report: ipc.StepReport, stepped: np.ndarray) -> SceneReport:
        """The solver's report, of the environments (B,) that it stepped."""
        self._failed, self._energies = report.failed, (report.elastic, report.barrier)
        return SceneReport(
            failed=report.failed,
            converged=report.converged,
            unconverged=(stepped & ~report.converged & ~report.failed).astype(int),
            last_converged=report.converged,
            min_gap=report.min_gap,
            min_det=np.where(stepped, report.min_det, 1.0),
            blocked=report.blocked,
            newton=report.newton,
            linear=report.linear,
            elastic=report.elastic,
            barrier=report.barrier,
            substeps=stepped.astype(int),
        )

    def _durations(self, dt: ArrayLike | None) -> np.ndarray:
        """Duration of the step of every environment [s], (B,)."""
        return np.broadcast_to(np.asarray(self.settings.dt if dt is None else dt, float), self.num_envs)

    def wrench(self, pad: str) -> np.ndarray:
        """Contact force on a pad and torque about its origin, world axes, [N], [N m], (B, 6).

        The whole gel surface counts, its sides too. At rest it equals ``bond_wrench``, the wrench on the link that carries the pad, but
        for the gel's weight and inertia, since the link's model has the gel's mass.
        """
        return self._contact_wrench(self._registry.pad(pad).name)

    def bond_wrench(self, pad: str) -> np.ndarray:
        """Force and torque of a pad on its case, with its weight, as ``wrench``, (B, 6)."""
        wrench = self.world.wrench(self._registry.pad(pad).name)
        return np.concatenate([wrench.force, wrench.torque], axis=1)

    def body_wrench(self, name: str) -> np.ndarray:
        """Contact force on a body and torque about its origin, as ``wrench``, (B, 6)."""
        return self._contact_wrench(self._registry.body(name).name)

    def stiffness(self, pad: str) -> np.ndarray:
        """Upper bound of a pad's contact stiffness (B, 6, 6), world axes (``pad_stiffness``)."""
        gelpad = self._registry.pad(pad).sensor.gelpad
        sums, index = self.world.sums.host, self.world.layout.names.index(pad)
        rotation = np.zeros((self.num_envs, 6, 6))
        rotation[:, :3, :3] = rotation[:, 3:, 3:] = sums["rotation"][:, index]
        local = np.stack([pad_stiffness(gelpad, float(area)) for area in sums["area"][:, index]])
        return rotation @ local @ np.swapaxes(rotation, 1, 2)

    def pose(self, name: str) -> np.ndarray:
        """``world_from_body`` or ``world_from_pad`` (B, 4, 4); the best rigid fit of a soft body."""
        pose = np.tile(np.eye(4), (self.num_envs, 1, 1))
        body = None if name in self.pads else self._registry.body(name)
        if body is not None and not body.is_driven and isinstance(body.solid, ipc.SoftBody):
            rest = body.solid.mesh.vertices
            now = self.world.positions(name)
            mean, rest_mean = now.mean(axis=1), rest.mean(axis=0)
            pose[:, :3, :3] = nearest_rotation(np.einsum("bni,nj->bij", now - mean[:, None], rest - rest_mean))
            pose[:, :3, 3] = mean - pose[:, :3, :3] @ rest_mean
        else:
            sums, index = self.world.sums.host, self.world.layout.names.index(name)
            pose[:, :3, :3], pose[:, :3, 3] = sums["rotation"][:, index], sums["position"][:, index]
        return pose

    def velocity(self, name: str) -> np.ndarray:
        """Mean velocity of a free body's nodes [m/s], world frame, (B, 3)."""
        return self.world.velocities(self._registry.body(name).name).mean(axis=1)

    def mesh(self, name: str, frame: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Surface: vertices (B, n, 3) [m], world frame or that of ``frame``, and faces (F, 3)."""
        vertices, faces = self.world.surface(name)
        positions = self.world.positions(name)
        if name in self.pads or self._registry.body(name).is_soft:
            positions = positions[:, vertices]
        return (positions if frame is None else self._to_pad(frame, positions)), faces

    def skin(self, name: str, frame: str) -> tuple[np.ndarray, np.ndarray]:
        """As ``mesh``, but smooth if the body has a ``SoftSkin``."""
        skin = None if name in self.pads else self._registry.body(name).skin
        if skin is None:
            return self.mesh(name, frame)
        return skin.deform(self._to_pad(frame, self.world.positions(name))), skin.faces

    def coat(self, pad: str) -> np.ndarray:
        """The solver's vertices of a pad's coat [m], pad frame, shape (B, V, 3)."""
        return self.world.positions(pad, frame="body")[:, self._registry.pad(pad).mesh.coat_vertices]

    def coat_forces(self, pad: str) -> np.ndarray:
        """Contact force on each vertex of a coat [N], pad frame, shape (B, V, 3)."""
        return self.world.contact_forces(pad)[:, self._coat_numbers[pad]] @ self.world.frame(pad)[0]

    def grid(self, pad: str) -> PadGrid:
        """Grid that a pad's surface is read on."""
        return make_grid(self._registry.pad(pad).sensor.gelpad, self._registry.pad(pad).pitch)

    def reading(self, pad: str, grid: PadGrid | None = None, failed: np.ndarray | None = None) -> SoftReading:
        """Surface, contact, forces of a pad on its own grid or another; NaN where ``failed`` (B,)."""
        unread = self._failed if failed is None else self._failed | failed
        return self._reader(pad, grid).read(self.coat_state(pad), unread)

    def arrays(self, pad: str, grid: PadGrid | None = None, failed: np.ndarray | None = None) -> PadArrays:
        """As ``reading``, but arrays of the device that the next reading overwrites: no copies."""
        unread = self._failed if failed is None else self._failed | failed
        on_device = wp.array(unread, dtype=wp.bool, device=self.world.device)
        return self._reader(pad, grid).launch(self.coat_state(pad), on_device)

    def _reader(self, pad: str, grid: PadGrid | None) -> SoftReader:
        """The reader of a pad; on another grid than the last one it is made again."""
        scene_pad = self._registry.pad(pad)
        if pad not in self._readers or (grid is not None and grid is not self._readers[pad].grid):
            mesh = replace(scene_pad.mesh, d_hat=self.world.d_hat)
            self._readers[pad] = SoftReader(mesh, scene_pad.sensor.gelpad, grid or self.grid(pad), scene_pad.correction)
        return self._readers[pad]

    def coat_state(self, pad: str) -> CoatState:
        """A pad's coat with the forces on it, and the objects that it touches, on the device.

        The next call overwrites it.
        """
        if pad not in self._coats:
            others = [other for name, other in self.pads.items() if name != pad]
            # As in the solver, the last coefficient of a pair counts if it was given in both orders.
            friction = {name: mu for pair, mu in self._friction.items() if pad in pair for name in pair if name != pad}
            self._coats[pad] = SceneCoat(self.world, self._registry.pad(pad), others, self.bodies, friction)
        coat = self._coats[pad]
        state = coat.read()
        for name, k in coat.free.items():  # the rotation that fits a soft body best comes from the host
            column: Any = state.objects.poses[:, k]
            column.assign(inverse(self.pose(pad)) @ self.pose(name))
        return state

    def save(self) -> SceneState:
        """The state of every environment."""
        return SceneState(self.world.save(), self._now.copy())

    def restore(self, state: SceneState, envs: ArrayLike | None = None) -> None:
        """Return environments (mask, list, None: all) to a saved state; contact forces become 0."""
        mask = np.isin(np.arange(self.num_envs), chosen_envs(envs, self.num_envs))
        self.world.restore(state.world, mask)
        self._now.pads[mask] = state.poses.pads[mask]
        for name, pose in state.poses.bodies.items():
            self._now.bodies[name][mask] = pose[mask]
        self._failed = self._failed & ~mask | state.world.failed & mask

    def reset(
        self, envs: ArrayLike | None = None, world_from_pad: ArrayLike | None = None, world_from_body: _Poses | None = None
    ) -> None:
        """Return environments to rest, without history, at the initial poses or others.

        Shapes as for the scene itself. Raises ``OverlapError`` if bodies overlap at these poses; nothing has changed then.
        """
        mask = np.isin(np.arange(self.num_envs), chosen_envs(envs, self.num_envs))
        if world_from_pad is None and world_from_body is None:
            self.restore(SceneState(self._start_state, Poses(self._start[0], self._registry.driven(self._start[1]))), mask)
            return
        pads = self._start[0]
        if world_from_pad is not None:
            pads = rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(self.pads))
        bodies = self._start[1] | self._registry.named(world_from_body or {}, free=True)
        placed = SceneState(self._placed(pads, bodies, mask), Poses(pads, self._registry.driven(bodies)))
        try:
            self.restore(placed, mask)
        except ipc.OverlapError as error:
            raise OverlapError(f"bodies overlap at the poses of the reset: {error}") from error

    def fail(self, envs: ArrayLike) -> None:
        """Freeze environments, a mask (B,) or a list, until they are reset."""
        state, chosen = self.save(), chosen_envs(envs, self.num_envs)
        state.world.failed[chosen] = True
        self.restore(state, chosen)

    def _contact_wrench(self, name: str) -> np.ndarray:
        if name in self.bodies and isinstance(self.bodies[name].solid, ipc.HalfSpace):
            wrench = self.world.wrench(name)
            return np.concatenate([wrench.force, wrench.torque], axis=1)
        sums, index = self.world.sums.host, self.world.layout.names.index(name)
        force, torque = sums["force"][:, index], sums["torque"][:, index]
        lever = (
            sums["position"][:, index] - self.pose(name)[:, :3, 3]
        )  # of a free soft body the sums are about the world's origin
        return np.concatenate([force, torque + np.cross(lever, force)], axis=1)

    def _surface_numbers(self, pad: ScenePad) -> np.ndarray:
        """Number of each coat vertex among the solver's surface vertices."""
        vertex_of = self.world.surface(pad.name)[0]
        number = np.full(len(pad.mesh.tets.vertices), -1)
        number[vertex_of] = np.arange(len(vertex_of))
        return number[pad.mesh.coat_vertices]

    def _to_pad(self, pad: str, points: np.ndarray) -> np.ndarray:
        """Points (B, n, 3) from the world's to a pad's frame."""
        rotation, position = self.world.frame(pad)
        return (points - position[:, None]) @ rotation

    def _goal(self, world_from_pad: ArrayLike, driven: _Poses | None) -> Poses:
        """Poses at the end of a step; bodies that are not named stay."""
        pads = rigid_poses("world_from_pad", world_from_pad, self.num_envs, len(self.pads))
        return Poses(pads, self._now.bodies | self._registry.named(driven or {}))

    def _placed(self, pads: np.ndarray, bodies: Mapping[str, np.ndarray], mask: np.ndarray) -> ipc.State:
        """The present state; environments of the mask undeformed and at rest at these poses."""
        state, start, layout = self.world.save(), self._start_state, self.world.layout
        for name in ("y", "velocity", "frame_rotation", "frame_position", "kappa", "failed"):
            getattr(state, name)[mask] = getattr(start, name)[mask]
        state.stuck[mask] = -1
        poses = {name: pads[:, k] for k, name in enumerate(self.pads)} | dict(bodies)
        for name, pose in poses.items():
            body = self.bodies.get(name)
            index = layout.names.index(name)
            if body is None or body.is_driven:
                state.frame_position[mask, index] = pose[mask, :3, 3]
                state.frame_rotation[mask, index] = quaternions(pose)[mask]
                continue
            nodes = slice(layout.node_start[index], layout.node_start[index + 1])
            change = pose @ inverse(self._start[1][name][:1])
            nodes_now = np.einsum("bij,nj->bni", change[:, :3, :3], layout.node_rest[nodes]) + change[:, None, :3, 3]
            state.y[mask, nodes] = nodes_now[mask]
        return state


def _placed_at(solid: Any, pose: np.ndarray) -> Any:
    """A body of the solver at ``world_from_body`` (4, 4)."""
    return replace(solid, pose=ipc.Pose(tuple(pose[:3, 3].tolist()), tuple(quaternion(pose[:3, :3]).tolist())))
