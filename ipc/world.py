"""The public face: bodies in, steps, positions and forces out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ipc import dynamics
from ipc.bodies import Body, HalfSpace, SoftBody
from ipc.errors import IpcError, OverlapError
from ipc.layout import build_layout, rotation_matrix
from ipc.linear import row_sum
from ipc.newton import Newton
from ipc.overlap import find_overlap
from ipc.report import ContactPairs, StepReport, Wrench
from ipc.settings import Settings

__all__ = ["State", "World"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """A snapshot of every environment; arrays lead with the environment, B.

    Attributes:
        y: node positions in their body's frame [m] (B, N, 3).
        velocity, velocity_before: node velocities, world frame [m/s] (B, N, 3).
        position_before: node positions one step earlier, world frame [m] (B, N, 3).
        frame_rotation, frame_position: frames, quaternion (w, x, y, z) (B, bodies, 4) and [m] (B, bodies, 3).
        second_order: BDF2 has a history (B,).
        kappa: [Pa] (B,).
        failed: (B,).
    """

    y: Floats
    velocity: Floats
    velocity_before: Floats
    position_before: Floats
    frame_rotation: Floats
    frame_position: Floats
    second_order: NDArray[np.int32]
    kappa: Floats
    failed: NDArray[np.bool_]


def _host(array: wp.array) -> NDArray[Any]:
    """The array in NumPy: a view on the CPU, a copy from CUDA."""
    return array.numpy()


class World:
    """Bodies that deform, move and touch, in ``num_envs`` copies that do not see each other.

    Args:
        bodies: what there is; names are unique.
        settings: how to step.
        num_envs: number of environments, B.
        device: ``"cpu"``, ``"cuda"``, ``"cuda:1"`` or ``"auto"`` (CUDA if there is one).
        friction: μ by pair of body names, where it differs from ``settings.friction``.
        ignored: pairs of body names that pass through each other.

    Raises:
        IpcError: if names repeat, a pair is unknown, nothing can move, or the device does not exist.
        OverlapError: if surfaces cross or touch at the start.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        settings: Settings | None = None,
        num_envs: int = 1,
        device: str = "auto",
        friction: Mapping[tuple[str, str], float] | None = None,
        ignored: Sequence[tuple[str, str]] = (),
    ) -> None:
        if num_envs < 1:
            raise IpcError(f"num_envs = {num_envs}: at least one environment is needed")
        self.settings = settings or Settings()
        self.bodies = tuple(bodies)
        self.num_envs = num_envs
        self.layout = build_layout(self.bodies, self.settings.friction, friction or {}, ignored)
        wp.init()
        if device == "auto":
            device = "cuda" if wp.is_cuda_available() else "cpu"
        try:
            self.device = wp.get_device(device)
        except Exception as error:
            raise IpcError(
                f"device = {device!r}: choose 'auto' or one of {', '.join(d.alias for d in wp.get_devices())}"
            ) from error
        self.d_hat = self.settings.d_hat or 0.1 * self.layout.min_edge
        self.kappa = self.settings.kappa or self.layout.max_young or 1e5
        self._solver = Newton(self.layout, self.settings, num_envs, self.d_hat, self.kappa, self.device)
        self._failed = np.zeros(num_envs, bool)
        self._moving = np.zeros(num_envs, bool)
        frames = [
            (body.pose.position, body.pose.rotation) if framed else ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            for body, framed in zip(self.bodies, self.layout.framed, strict=True)
        ]
        nodes = np.broadcast_to(self.layout.node_rest, (num_envs, *self.layout.node_rest.shape))
        self._start = State(
            y=nodes.copy(),
            velocity=np.zeros(nodes.shape),
            velocity_before=np.zeros(nodes.shape),
            position_before=np.zeros(nodes.shape),
            frame_rotation=np.broadcast_to(np.array([f[1] for f in frames], float), (num_envs, len(frames), 4)).copy(),
            frame_position=np.broadcast_to(np.array([f[0] for f in frames], float), (num_envs, len(frames), 3)).copy(),
            second_order=np.zeros(num_envs, np.int32),
            kappa=np.full(num_envs, self.kappa),
            failed=np.zeros(num_envs, bool),
        )
        self.restore(self._start)

    # --- driving ---------------------------------------------------------------------------------------------------------------

    def _index(self, name: str) -> int:
        if name not in self.layout.names:
            raise IpcError(f"no body is named {name!r}: choose from {', '.join(self.layout.names)}")
        return self.layout.names.index(name)

    def _framed(self, name: str) -> int:
        body = self._index(name)
        if not self.layout.framed[body]:
            choices = ", ".join(n for n, f in zip(self.layout.names, self.layout.framed, strict=True) if f) or "none"
            raise IpcError(f"{name!r} moves freely and takes no pose; driven bodies: {choices}")
        return body

    def _per_env(self, values: ArrayLike, shape: tuple[int, ...], what: str, dtype: type = float) -> NDArray:
        array = np.asarray(values, dtype=dtype)
        if array.shape not in (shape, (self.num_envs, *shape)):
            raise IpcError(f"{what} has shape {array.shape}: it must be {shape} or {(self.num_envs, *shape)}")
        if not np.isfinite(array).all():
            raise IpcError(f"{what} = {array}: it must be finite")
        return np.broadcast_to(array, (self.num_envs, *shape))

    def _mask(self, envs: ArrayLike | None) -> NDArray[np.bool_]:
        """A mask (B,) from a mask, a list of environments, or None for all."""
        if envs is None:
            return np.ones(self.num_envs, bool)
        chosen = np.asarray(envs)
        if chosen.dtype == bool:
            if chosen.shape != (self.num_envs,):
                raise IpcError(f"envs is a mask of shape {chosen.shape}: it must be ({self.num_envs},)")
            return chosen.copy()
        if chosen.size and (chosen.min() < 0 or chosen.max() >= self.num_envs):
            raise IpcError(f"envs names environments {chosen.min()} to {chosen.max()}: there are {self.num_envs}")
        mask = np.zeros(self.num_envs, bool)
        mask[chosen.astype(int)] = True
        return mask

    def set_target(self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None) -> None:
        """Say where a driven body's frame shall be at the end of the next step; it stays there until told otherwise.

        Args:
            name: a kinematic body, a half-space, or a soft body with bonded vertices.
            position: frame origin in the world [m], shape (3,) or (B, 3); None keeps the last target's.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps the last target's. Steps turn by less than half a turn.
        """
        body = self._framed(name)
        goal_p, goal_q = _host(self._solver.goal_p).copy(), _host(self._solver.goal_q).copy()
        if position is not None:
            goal_p[:, body] = self._per_env(position, (3,), "position")
        if rotation is not None:
            q = self._per_env(rotation, (4,), "rotation")
            if not np.allclose(np.linalg.norm(q, axis=-1), 1, atol=1e-6):
                raise IpcError(f"rotation = {rotation}: a quaternion (w, x, y, z) must have length 1")
            goal_q[:, body] = (q / np.linalg.norm(q, axis=-1, keepdims=True))[:, [1, 2, 3, 0]]
        self._solver.goal_p.assign(goal_p)
        self._solver.goal_q.assign(goal_q)
        self._moving[:] = True

    def set_gravity(self, gravity: ArrayLike) -> None:
        """Set the acceleration of every body [m/s²], world frame, shape (3,) or (B, 3)."""
        self._solver.acceleration.assign(np.ascontiguousarray(self._per_env(gravity, (3,), "gravity")))

    def set_velocity(self, name: str, velocity: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Set the velocity of all nodes of a soft or affine body [m/s], shape (3,) or (B, 3), world frame."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if first == last:
            raise IpcError(f"{name!r} has no unknowns: drive it with set_target")
        mask = self._mask(envs)
        v = _host(self._solver.v).copy()
        v[mask, first:last] = self._per_env(velocity, (3,), "velocity")[mask, None]
        self._solver.v.assign(v)

    # --- stepping --------------------------------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Advance every environment that has not failed by ``settings.dt``."""
        solver = self._solver
        alive = ~self._failed
        # Who is told to stay where it is has no way to go.
        self._moving &= (_host(solver.goal_p) != _host(solver.frame_p)).any(axis=(1, 2)) | (
            _host(solver.goal_q) != _host(solver.frame_q)
        ).any(axis=(1, 2))
        counts = solver.step(alive, self._moving & alive)
        # Frames that got where they were told are at rest from now on; blocked ones keep trying.
        self._moving &= counts.blocked > 0
        self._failed |= counts.failed
        everything = solver.device_mask(np.ones(self.num_envs, bool))
        elastic, kinetic = (wp.zeros(self.num_envs, dtype=wp.float64, device=self.device) for _ in range(2))
        row_sum(solver.el_energy, everything, elastic)
        inputs = [solver.v, solver.row_start, solver.col, solver.mass]
        wp.launch(dynamics.kinetic_energy, dim=solver.v.shape, inputs=inputs, outputs=[solver.node_change], device=self.device)
        row_sum(solver.node_change, everything, kinetic)
        return StepReport(
            converged=counts.converged & alive,
            failed=self._failed.copy(),
            stalled=counts.stalled,
            blocked=counts.blocked,
            min_gap=counts.min_gap,
            min_det=counts.min_det,
            newton=counts.newton,
            linear=counts.linear,
            line_search=counts.line_search,
            relags=counts.relags,
            projected=counts.projected,
            ccd=counts.ccd,
            speed=counts.residual_speed,
            pairs=_host(solver.collision.contacts.count).astype(np.int64),
            kappa=_host(solver.kappa).copy(),
            elastic=_host(elastic).copy(),
            kinetic=_host(kinetic).copy(),
            barrier=_host(solver.barrier_energy).copy(),
        )

    @property
    def timers(self) -> dict[str, float]:
        """Seconds spent in each stage of the steps so far (on CUDA: until the host has queued the work)."""
        return dict(self._solver.timers)

    # --- outputs ---------------------------------------------------------------------------------------------------------------

    def frame(self, name: str) -> tuple[Floats, Floats]:
        """``world_from_body`` of a driven body: rotations (B, 3, 3) and positions [m] (B, 3)."""
        body = self._framed(name)
        return _host(self._solver.R)[:, body].copy(), _host(self._solver.t)[:, body].copy()

    def positions(self, name: str, frame: str = "world") -> Floats:
        """Positions [m] of a body, (B, n, 3): all vertices of a soft body's mesh, else its surface's vertices.

        Args:
            name: the body.
            frame: ``"world"``, or ``"body"`` for a bonded soft body in its own moving frame.
        """
        body = self._index(name)
        if isinstance(self.bodies[body], HalfSpace):
            raise IpcError(f"{name!r} is a half-space and has no vertices")
        if frame not in ("world", "body"):
            raise IpcError(f"frame = {frame!r}: choose 'world' or 'body'")
        solver = self._solver
        if isinstance(self.bodies[body], SoftBody):
            y = _host(solver.y)[:, self.layout.node_start[body] : self.layout.node_start[body + 1]].copy()
            if frame == "body":
                return y
            return np.einsum("bij,bnj->bni", _host(solver.R)[:, body], y) + _host(solver.t)[:, body, None]
        if frame == "body":
            raise IpcError(f"{name!r} is no soft body: frame='body' is for bonded soft bodies")
        return _host(solver.x)[:, self.layout.vert_start[body] : self.layout.vert_start[body + 1]].copy()

    def velocities(self, name: str) -> Floats:
        """World velocities [m/s] of a soft body's vertices, (B, n, 3), or of an affine body's four reference corners (B, 4, 3)."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if first == last:
            raise IpcError(f"{name!r} has no unknowns: its motion is what set_target says")
        return _host(self._solver.v)[:, first:last].copy()

    def affine_pose(self, name: str) -> tuple[Floats, Floats]:
        """A (B, 3, 3) and p [m] (B, 3) of an affine body's map x = A X + p."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if last - first != 4 or isinstance(self.bodies[body], SoftBody):
            raise IpcError(f"{name!r} is no affine body")
        pose = self.bodies[body].pose
        corner = rotation_matrix(pose.rotation).T @ (self.layout.node_rest[first] - pose.position)
        y = _host(self._solver.y)[:, first:last]
        A = np.einsum("bki,kj->bij", y, self.layout.grads[self.layout.tet_start[body]])
        return A, y[:, 0] - A @ corner

    def surface(self, name: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """A body's surface: mesh vertex of each surface vertex (n,), and triangles (F, 3) in surface vertex numbers."""
        body = self._index(name)
        first, last = self.layout.vert_start[body : body + 2]
        faces = self.layout.faces[self.layout.face_start[body] : self.layout.face_start[body + 1]] - first
        if isinstance(self.bodies[body], SoftBody):
            return self.layout.vert_nodes[first:last, 0] - self.layout.node_start[body], faces
        return np.arange(last - first, dtype=np.int32), faces

    def contact_forces(self, name: str) -> Floats:
        """Contact and friction force on each surface vertex [N], world frame, (B, n, 3); order as in :meth:`surface`."""
        body = self._index(name)
        first, last = self.layout.vert_start[body : body + 2]
        return -_host(self._solver.vert_gradient)[:, first:last]

    def traction(self, name: str) -> Floats:
        """Contact force per rest area at each surface vertex [Pa], world frame, (B, n, 3)."""
        body = self._index(name)
        area = self.layout.vert_area[self.layout.vert_start[body] : self.layout.vert_start[body + 1]]
        return self.contact_forces(name) / area[None, :, None]

    def wrench(self, name: str) -> Wrench:
        """What the others do to a body: contact forces on a kinematic or affine body or half-space, the bond's pull on a pad's frame.

        For a soft body with bonded vertices this is the force of the pad on what holds it; for a free one, the sum of its contacts.
        """
        body = self._index(name)
        solver, layout = self._solver, self.layout
        origin = _host(solver.t)[:, body] if layout.framed[body] else np.zeros((self.num_envs, 3))
        first, last = layout.vert_start[body : body + 2]
        if isinstance(self.bodies[body], HalfSpace):
            points, forces = self._plane_forces(body)
        elif isinstance(self.bodies[body], SoftBody) and layout.framed[body]:
            nodes = np.arange(layout.node_start[body], layout.node_start[body + 1])
            nodes = nodes[layout.node_free[nodes] == 0]
            R = _host(solver.R)[:, body]
            forces = -np.einsum("bij,bnj->bni", R, _host(solver.gradient)[:, nodes])
            points = np.einsum("bij,bnj->bni", R, _host(solver.y)[:, nodes]) + origin[:, None]
        else:
            points, forces = _host(solver.x)[:, first:last], -_host(solver.vert_gradient)[:, first:last]
        return Wrench(forces.sum(axis=1), np.cross(points - origin[:, None], forces).sum(axis=1))

    def _plane_forces(self, body: int) -> tuple[Floats, Floats]:
        """Points and forces on a half-space: the reactions of its contacts, friction included, (B, n, 3)."""
        solver = self._solver
        collision = solver.collision
        forces = np.zeros((*solver.x.shape, 3))
        plane_of = self.layout.pairs[:, 1]
        found, lagged = collision.contacts, collision.lagged
        x, start = _host(solver.x), _host(solver.x_start)
        for env in range(self.num_envs):
            n = int(_host(found.count)[env])
            verts = _host(found.verts)[env, :n]
            mine = (verts[:, 1] < 0) & (plane_of[_host(found.pair)[env, :n]] == body)
            normal, force = _host(found.normal)[env, :n][mine], _host(found.force)[env, :n][mine]
            np.add.at(forces[env], verts[mine, 0], -force[:, None] * normal)
            n = int(_host(lagged.count)[env]) if collision.friction else 0
            verts = _host(lagged.verts)[env, :n]
            mine = (verts[:, 1] < 0) & (plane_of[_host(lagged.pair)[env, :n]] == body)
            v, normal, limit = verts[mine, 0], _host(lagged.normal)[env, :n][mine], _host(lagged.limit)[env, :n][mine]
            u = x[env, v] - start[env, v]
            u -= (u * normal).sum(axis=1, keepdims=True) * normal
            y, eps = np.linalg.norm(u, axis=1), solver.friction_eps
            ratio = np.where(y >= eps, 1.0 / np.maximum(y, eps), (2.0 - y / eps) / eps)
            np.add.at(forces[env], v, (limit * ratio)[:, None] * u)
        return x, forces

    def contacts(self, env: int = 0) -> ContactPairs:
        """The contact pairs of one environment at the end of the last step."""
        if not 0 <= env < self.num_envs:
            raise IpcError(f"env = {env}: environments are 0 to {self.num_envs - 1}")
        found = self._solver.collision.contacts
        n = int(_host(found.count)[env])
        pairs = self.layout.pairs[_host(found.pair)[env, :n]]
        names = self.layout.names
        return ContactPairs(
            bodies=tuple((names[a], names[b]) for a, b in pairs),
            vertices=_host(found.verts)[env, :n].copy(),
            weights=_host(found.coef)[env, :n].copy(),
            normal=_host(found.normal)[env, :n].copy(),
            gap=_host(found.gap)[env, :n].copy(),
            force=_host(found.force)[env, :n].copy(),
        )

    # --- state -----------------------------------------------------------------------------------------------------------------

    def save(self) -> State:
        """A copy of the state of every environment."""
        s = self._solver
        return State(
            y=_host(s.y).copy(),
            velocity=_host(s.v).copy(),
            velocity_before=_host(s.v_before).copy(),
            position_before=_host(s.xw_before).copy(),
            frame_rotation=_host(s.frame_q)[..., [3, 0, 1, 2]].copy(),
            frame_position=_host(s.frame_p).copy(),
            second_order=_host(s.second_order).copy(),
            kappa=_host(s.kappa).copy(),
            failed=self._failed.copy(),
        )

    def restore(self, state: State, envs: ArrayLike | None = None) -> None:
        """Put environments back to a saved state; targets become the frames of that state.

        Args:
            state: from :meth:`save` of a world of the same bodies.
            envs: a mask (B,) or list of the environments to restore; None for all. Others are not touched.

        Raises:
            OverlapError: if surfaces cross or touch in that state.
        """
        mask, s = self._mask(envs), self._solver
        if state.y.shape != _host(s.y).shape:
            raise IpcError(f"the state has nodes of shape {state.y.shape}: this world has {_host(s.y).shape}")
        self._check_overlap(state, mask)
        quaternions = state.frame_rotation[..., [1, 2, 3, 0]]
        for target, values in (
            (s.y, state.y),
            (s.v, state.velocity),
            (s.v_before, state.velocity_before),
            (s.xw_before, state.position_before),
            (s.frame_q, quaternions),
            (s.goal_q, quaternions),
            (s.frame_p, state.frame_position),
            (s.goal_p, state.frame_position),
            (s.second_order, state.second_order),
            (s.kappa, state.kappa),
        ):
            merged = _host(target).copy()
            merged[mask] = values[mask]
            target.assign(merged)
        self._failed[mask] = state.failed[mask]
        self._moving[mask] = False
        s.collision.forget(mask)
        s.collision.drop_lag(mask)
        s.share.fill_(0.0)
        s.set_frames(s.share, s.R, s.t)
        s.place_vertices(s.y, s.R, s.t, s.x)

    def reset(self, envs: ArrayLike | None = None) -> None:
        """Put environments (a mask (B,), a list, or None for all) back to how the world was made."""
        self.restore(self._start, envs)

    def teleport(
        self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None, envs: ArrayLike | None = None
    ) -> None:
        """Move a driven body's frame at once, with all that is bonded to it; its velocities become zero.

        Args:
            name: a driven body.
            position: [m], shape (3,) or (B, 3); None keeps it.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps it.
            envs: a mask (B,) or list of environments; None for all.

        Raises:
            OverlapError: if surfaces would cross or touch there.
        """
        body, mask, state = self._framed(name), self._mask(envs), self.save()
        if position is not None:
            state.frame_position[mask, body] = self._per_env(position, (3,), "position")[mask]
        if rotation is not None:
            state.frame_rotation[mask, body] = self._per_env(rotation, (4,), "rotation")[mask]
        nodes = slice(self.layout.node_start[body], self.layout.node_start[body + 1])
        state.velocity[mask, nodes] = 0.0
        state.second_order[mask] = 0
        self.restore(state, mask)

    def _check_overlap(self, state: State, mask: NDArray[np.bool_]) -> None:
        """Refuse surfaces that cross; environments that look alike are checked once."""
        seen: set[bytes] = set()
        for env in np.flatnonzero(mask):
            key = state.y[env].tobytes() + state.frame_rotation[env].tobytes() + state.frame_position[env].tobytes()
            if key in seen or state.failed[env] or not np.isfinite(state.y[env]).all():
                continue
            seen.add(key)
            found = find_overlap(self.layout, state.y[env], state.frame_rotation[env], state.frame_position[env])
            if found is not None:
                raise OverlapError(f"environment {env}: {found}")

    def pairs_of_bodies(self) -> list[tuple[str, str]]:
        """The pairs of bodies that may touch."""
        return [(self.layout.names[a], self.layout.names[b]) for a, b in self.layout.pairs]
