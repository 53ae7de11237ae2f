"""The public face: bodies in, steps, positions and forces out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ipc.bodies import AffineBody, Body, HalfSpace, SoftBody
from ipc.errors import IpcError, OverlapError
from ipc.layout import build_layout, rotation_matrix
from ipc.newton import Newton
from ipc.overlap import find_overlap
from ipc.potential import Potential
from ipc.report import ContactPairs, RigidMotion, StepReport, Wrench
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
        frame_rotation, frame_position: frames of bodies, grips and aims, quaternion (w, x, y, z) (B, frames, 4) and [m] (B, frames, 3).
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


def _quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (w, x, y, z) of rotation matrices, (..., 3, 3) to (..., 4): the eigenvector of Bar-Itzhack's matrix."""
    m = np.moveaxis(rotations, (-2, -1), (0, 1))
    zero = m[0, 0] * 0
    rows = [
        [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
    ]
    matrix = np.stack([np.stack([zero + e for e in row], axis=-1) for row in rows], axis=-2)
    return np.linalg.eigh(matrix)[1][..., -1]


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
        self._potential = Potential(self.layout, self.settings, num_envs, self.d_hat, self.kappa, self.device)
        self._newton = Newton(self._potential, self.layout, self.settings)
        self._failed = np.zeros(num_envs, bool)
        frames = self.layout.frame_pose
        # What the device is told before a step, kept here so that telling it costs one copy and no wait.
        self._goal_p = np.zeros((num_envs, len(frames), 3))
        self._goal_q = np.zeros((num_envs, len(frames), 4))
        self._told = False
        nodes = np.broadcast_to(self.layout.node_rest, (num_envs, *self.layout.node_rest.shape))
        self._start = State(
            y=nodes.copy(),
            velocity=np.zeros(nodes.shape),
            velocity_before=np.zeros(nodes.shape),
            position_before=np.zeros(nodes.shape),
            frame_rotation=np.broadcast_to(frames[:, 3:], (num_envs, len(frames), 4)).copy(),
            frame_position=np.broadcast_to(frames[:, :3], (num_envs, len(frames), 3)).copy(),
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

    def _frame(self, name: str) -> int:
        """Frame of a driven body, of a grip, or the aim of a driven affine body."""
        names = self.layout.frame_names
        for candidate in (f"{name}.aim", name):
            if candidate in names and self.layout.framed[names.index(candidate)]:
                return names.index(candidate)
        choices = ", ".join(n for n, f in zip(names, self.layout.framed, strict=True) if f) or "none"
        if name in names:
            raise IpcError(f"{name!r} moves freely and takes no pose; driven frames: {choices}")
        raise IpcError(f"no body or grip is named {name!r}: choose from {choices}")

    def _per_env(self, values: ArrayLike, shape: tuple[int, ...], what: str, dtype: type = float) -> NDArray:
        array = np.asarray(values, dtype=dtype)
        if array.shape not in (shape, (self.num_envs, *shape)):
            raise IpcError(f"{what} has shape {array.shape}: it must be {shape} or {(self.num_envs, *shape)}")
        if not np.isfinite(array).all():
            raise IpcError(f"{what} = {array}: it must be finite")
        return np.broadcast_to(array, (self.num_envs, *shape))

    def _pose(self, position: ArrayLike | None, rotation: ArrayLike | None) -> tuple[Floats | None, Floats | None]:
        """Position (B, 3) and unit quaternion (w, x, y, z) (B, 4) of every environment, where given."""
        p = None if position is None else self._per_env(position, (3,), "position")
        if rotation is None:
            return p, None
        q = self._per_env(rotation, (4,), "rotation")
        length = np.linalg.norm(q, axis=-1, keepdims=True)
        if not np.allclose(length, 1, atol=1e-6):
            raise IpcError(f"rotation = {rotation}: a quaternion (w, x, y, z) must have length 1")
        return p, q / length

    def _mask(self, envs: ArrayLike | None) -> NDArray[np.bool_]:
        """A mask (B,) from a mask, a list of environments, or None for all."""
        if envs is None:
            return np.ones(self.num_envs, bool)
        chosen = np.asarray(envs)
        if chosen.dtype == bool:
            if chosen.shape != (self.num_envs,):
                raise IpcError(f"envs is a mask of shape {chosen.shape}: it must be ({self.num_envs},)")
            return chosen.copy()
        if chosen.size and not np.issubdtype(chosen.dtype, np.integer):
            raise IpcError(f"envs = {envs}: give a mask or whole numbers")
        if chosen.size and (chosen.min() < 0 or chosen.max() >= self.num_envs):
            raise IpcError(f"envs names environments {chosen.min()} to {chosen.max()}: there are {self.num_envs}")
        mask = np.zeros(self.num_envs, bool)
        mask[chosen.astype(int)] = True
        return mask

    def set_target(self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None) -> None:
        """Say where a driven body's frame shall be at the end of the next step; it stays there until told otherwise.

        Args:
            name: a kinematic body, a half-space, a soft body with bonded vertices, a grip ``"<body>.<grip>"``, or an affine body with
                a drive, which goes there as far as its drive and contacts let it.
            position: frame origin in the world [m], shape (3,) or (B, 3); None keeps the last target's.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps the last target's. Steps turn by less than half a turn.
        """
        frame = self._frame(name)
        p, q = self._pose(position, rotation)
        if p is not None:
            self._goal_p[:, frame] = p
        if q is not None:
            self._goal_q[:, frame] = q[:, [1, 2, 3, 0]]
        self._told = False

    def set_gravity(self, gravity: ArrayLike) -> None:
        """Set the acceleration of every body [m/s²], world frame, shape (3,) or (B, 3)."""
        self._potential.acceleration.assign(np.ascontiguousarray(self._per_env(gravity, (3,), "gravity")))

    def set_velocity(self, name: str, velocity: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Set the velocity of all nodes of a soft or affine body [m/s], shape (3,) or (B, 3), world frame.

        With BDF2 the next step of these environments is backward Euler.
        """
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if first == last:
            raise IpcError(f"{name!r} has no unknowns: drive it with set_target")
        mask = self._mask(envs)
        v = _host(self._potential.v).copy()
        v[mask, first:last] = self._per_env(velocity, (3,), "velocity")[mask, None]
        self._potential.v.assign(v)
        # The earlier states that BDF2 looks back to know nothing of this velocity.
        history = _host(self._potential.second_order).copy()
        history[mask] = 0
        self._potential.second_order.assign(history)

    # --- stepping --------------------------------------------------------------------------------------------------------------

    def step(self, dt: float | None = None) -> StepReport:
        """Advance every environment that has not failed by ``dt`` [s]; None: by ``settings.dt``.

        On CUDA every new ``dt`` costs a recording; take few different ones.

        Raises:
            IpcError: ``dt`` is not positive, or differs from ``settings.dt`` with BDF2, whose formulas want equal steps.
        """
        if dt is not None and not 0.0 < dt < np.inf:
            raise IpcError(f"dt = {dt}: it must be positive")
        if dt is not None and dt != self.settings.dt and self.settings.integrator == "bdf2":
            raise IpcError(f"dt = {dt}: with BDF2 every step is as long as settings.dt = {self.settings.dt}")
        pot, alive = self._potential, ~self._failed
        pot.set_dt(dt or self.settings.dt)
        if not self._told:
            pot.goal_p.assign(self._goal_p)
            pot.goal_q.assign(self._goal_q)
            self._told = True
        found = self._newton.step(alive)
        failed = found["failed"].astype(bool)
        self._failed |= failed
        return StepReport(
            converged=found["converged"].astype(bool),
            failed=self._failed.copy(),
            stalled=found["stalled"].astype(bool),
            blocked=1.0 - found["share"],
            min_gap=found["min_gap"],
            min_det=found["min_det"],
            newton=found["newton"].astype(np.int64),
            linear=found["linear"].astype(np.int64),
            line_search=found["line_search"].astype(np.int64),
            relags=np.maximum(found["relags"], 0).astype(np.int64),
            projected=_host(pot.project).astype(bool),
            ccd=found["ccd"],
            speed=found["speed"],
            pairs=_host(pot.collision.contacts.count).astype(np.int64),
            kappa=_host(pot.kappa).copy(),
            elastic=_host(pot.elastic_energy).copy(),
            kinetic=_host(pot.kinetic).copy(),
            barrier=_host(pot.barrier).copy(),
        )

    @property
    def timers(self) -> dict[str, float]:
        """Seconds spent in ``step`` so far, and in each of its stages (on CUDA only with ``Settings.cuda_graph`` off)."""
        return dict(self._newton.timers)

    # --- outputs ---------------------------------------------------------------------------------------------------------------

    def frame(self, name: str) -> tuple[Floats, Floats]:
        """Where a driven body's or a grip's frame is in the world: rotations (B, 3, 3) and positions [m] (B, 3)."""
        body = self._frame(name)
        return _host(self._potential.R)[:, body].copy(), _host(self._potential.t)[:, body].copy()

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
        solver = self._potential
        if isinstance(self.bodies[body], SoftBody):
            y = _host(solver.y)[:, self.layout.node_start[body] : self.layout.node_start[body + 1]].copy()
            if frame == "body" and not self.layout.framed[body]:
                raise IpcError(f"{name!r} has no bonded vertices and so no frame of its own: choose frame='world'")
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
        return _host(self._potential.v)[:, first:last].copy()

    def affine_pose(self, name: str) -> tuple[Floats, Floats]:
        """A (B, 3, 3) and p [m] (B, 3) of an affine body's map x = A X + p."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if not isinstance(self.bodies[body], AffineBody):
            raise IpcError(f"{name!r} is no affine body")
        pose = self.bodies[body].pose
        corner = rotation_matrix(pose.rotation).T @ (self.layout.node_rest[first] - pose.position)
        y = _host(self._potential.y)[:, first:last]
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
        return -_host(self._potential.vert_gradient)[:, first:last]

    def traction(self, name: str) -> Floats:
        """Contact force per rest area at each surface vertex [Pa], world frame, (B, n, 3)."""
        body = self._index(name)
        area = self.layout.vert_area[self.layout.vert_start[body] : self.layout.vert_start[body + 1]]
        return self.contact_forces(name) / area[None, :, None]

    def wrench(self, name: str) -> Wrench:
        """What the others do to a body: contact forces on a kinematic or affine body or half-space, the bond's pull on a pad's frame.

        For a soft body with bonded vertices this is the force of the pad on what holds it, and ``"<body>.<grip>"`` gives the force on
        that grip; for a free soft body it is the sum of its contacts.
        """
        solver, layout = self._potential, self.layout
        if name in layout.frame_names[len(layout.names) :] and not name.endswith(".aim"):
            frame = layout.frame_names.index(name)
            return self._bond_wrench(int(layout.frame_body[frame]), frame, layout.grip_node[layout.grip_frame == frame])
        body = self._index(name)
        origin = _host(solver.t)[:, body] if layout.framed[body] else np.zeros((self.num_envs, 3))
        first, last = layout.vert_start[body : body + 2]
        if isinstance(self.bodies[body], HalfSpace):
            points, forces = self._plane_forces(body)
        elif isinstance(self.bodies[body], SoftBody) and layout.framed[body]:
            nodes = np.arange(layout.node_start[body], layout.node_start[body + 1])
            held = nodes[(layout.node_free[nodes] == 0) & ~np.isin(nodes, layout.grip_node)]
            return self._bond_wrench(body, body, held)
        else:
            points, forces = _host(solver.x)[:, first:last], -_host(solver.vert_gradient)[:, first:last]
        return Wrench(forces.sum(axis=1), np.cross(points - origin[:, None], forces).sum(axis=1))

    def _bond_wrench(self, body: int, frame: int, nodes: NDArray[np.int32]) -> Wrench:
        """What the body's bonded nodes do to the frame that holds them, about its origin."""
        solver = self._potential
        R, t = _host(solver.R)[:, body], _host(solver.t)
        forces = -np.einsum("bij,bnj->bni", R, _host(solver.gradient)[:, nodes])
        points = np.einsum("bij,bnj->bni", R, _host(solver.y)[:, nodes]) + t[:, None, body]
        return Wrench(forces.sum(axis=1), np.cross(points - t[:, None, frame], forces).sum(axis=1))

    def _plane_forces(self, body: int) -> tuple[Floats, Floats]:
        """Points and forces on a half-space: the reactions of its contacts, friction included, (B, n, 3)."""
        solver = self._potential
        collision = solver.collision
        forces = np.zeros((*solver.x.shape, 3))
        plane_of = self.layout.pairs[:, 1]
        x, start = _host(solver.x), _host(solver.x_start)
        found, lagged = (
            [_host(a) for a in (pairs.count, pairs.verts, pairs.pair, pairs.normal, size)]
            for pairs, size in (
                (collision.contacts, collision.contacts.force),
                (collision.lagged, collision.lagged.limit),
            )
        )

        def touching(count: NDArray, verts: NDArray, pair: NDArray, *values: NDArray) -> tuple[NDArray, ...]:
            n = int(count[env])
            mine = (verts[env, :n, 1] < 0) & (plane_of[pair[env, :n]] == body)
            return verts[env, :n][mine, 0], *(a[env, :n][mine] for a in values)

        for env in range(self.num_envs):
            v, normal, force = touching(*found)
            np.add.at(forces[env], v, -force[:, None] * normal)
            if not collision.friction:
                continue
            v, normal, limit = touching(*lagged)
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
        found = self._potential.collision.contacts
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

    def pressing(self) -> dict[tuple[str, str], tuple[Floats, Floats]]:
        """Normal forces at the end of the last step by pair of bodies: their sum on the first body [N] and where they act in the mean [m].

        World frame, (B, 3) each; NaN for the place where a pair does not touch. Pairs that nowhere touch are not in it.
        """
        contacts, x = self._potential.collision.contacts, _host(self._potential.x)
        count, pair, verts = _host(contacts.count), _host(contacts.pair), _host(contacts.verts)
        coef, normal, size = _host(contacts.coef), _host(contacts.normal), _host(contacts.force)
        env, k = np.nonzero(np.arange(pair.shape[1]) < count[:, None])
        vertices, weights, which = verts[env, k], coef[env, k], pair[env, k]
        weights = np.where((weights > 0.0) & (vertices >= 0), weights, 0.0)  # of the closest point on one side
        points = np.einsum("cn,cni->ci", weights, x[env[:, None], np.maximum(vertices, 0)]) / weights.sum(axis=1, keepdims=True)
        owner = self.layout.vert_body[vertices[:, 0]]  # the normal is the way out for the body of the first vertex
        sign = np.where(owner == self.layout.pairs[which, 0], 1.0, -1.0)
        forces = (sign * size[env, k])[:, None] * normal[env, k]
        found = {}
        for p in np.unique(which):
            mine = which == p
            total, place, weight = np.zeros((self.num_envs, 3)), np.zeros((self.num_envs, 3)), np.zeros(self.num_envs)
            np.add.at(total, env[mine], forces[mine])
            np.add.at(place, env[mine], size[env, k][mine, None] * points[mine])
            np.add.at(weight, env[mine], size[env, k][mine])
            with np.errstate(invalid="ignore", divide="ignore"):
                found[tuple(self.layout.names[b] for b in self.layout.pairs[p])] = total, place / weight[:, None]
        return found

    def rigid_motion(self, name: str) -> RigidMotion:
        """Mass, centre, inertia and velocities of a soft or affine body as if it moved as a whole at this instant; world frame."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if first == last:
            raise IpcError(f"{name!r} has no unknowns: its motion is what set_target says")
        row, end = self.layout.row_start[[first, last]]
        rows = np.repeat(np.arange(last - first), np.diff(self.layout.row_start[first : last + 1]))
        mass = np.zeros((last - first, last - first))
        mass[rows, self.layout.col[row:end] - first] = self.layout.mass[row:end]
        pot = self._potential
        R, t, nodes = _host(pot.R)[:, body], _host(pot.t)[:, body], slice(first, last)
        x = np.einsum("bij,bnj->bni", R, _host(pot.y)[:, nodes]) + t[:, None]
        v, share = _host(pot.v)[:, nodes], mass.sum(axis=0)
        total = float(share.sum())
        centre, velocity = (np.einsum("n,bni->bi", share / total, a) for a in (x, v))
        arm = x - centre[:, None]
        second = np.einsum("bni,nm,bmj->bij", arm, mass, arm)
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        momentum = np.cross(arm, np.einsum("nm,bmi->bni", mass, v - velocity[:, None])).sum(axis=1)
        spin = np.linalg.solve(inertia, momentum[..., None])[..., 0]
        return RigidMotion(total, centre, inertia, velocity, spin)

    def touching(self, name: str) -> dict[str, NDArray[np.bool_]]:
        """Which bodies were closer than d̂ to a body at the end of the last step, (B,) by name; without those that nowhere were."""
        body = self._index(name)
        found = self._potential.collision.contacts
        count, pair = _host(found.count), _host(found.pair)
        there = np.zeros((self.num_envs, len(self.layout.pairs)), bool)
        env, k = np.nonzero(np.arange(pair.shape[1]) < count[:, None])
        there[env, pair[env, k]] = True
        mine = np.flatnonzero((self.layout.pairs == body).any(axis=1) & there.any(axis=0))
        other = self.layout.pairs[mine].sum(axis=1) - body
        return {self.layout.names[b]: there[:, p] for p, b in zip(mine, other, strict=True)}

    # --- state -----------------------------------------------------------------------------------------------------------------

    def save(self) -> State:
        """A copy of the state of every environment."""
        s = self._potential
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

        Forces and contacts belong to a step, not to a state: there are none until the next one.

        Args:
            state: from :meth:`save` of a world of the same bodies.
            envs: a mask (B,) or list of the environments to restore; None for all. Others are not touched.

        Raises:
            OverlapError: if surfaces cross or touch in that state.
        """
        mask, s = self._mask(envs), self._potential
        for what, found, needed in (
            ("nodes", state.y.shape, (*s.y.shape, 3)),
            ("frames", state.frame_position.shape, (*s.frame_p.shape, 3)),
        ):
            if found != needed:
                raise IpcError(f"the state has {what} of shape {found}: this world has {needed}")
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
        self._goal_p[mask], self._goal_q[mask] = state.frame_position[mask], quaternions[mask]
        self._failed[mask] = state.failed[mask]
        s.collision.forget(mask)
        s.collision.drop(mask)
        for forces in (s.gradient, s.vert_gradient):
            kept = _host(forces).copy()
            kept[mask] = 0.0
            forces.assign(kept)
        s.set_frames(wp.zeros(self.num_envs, dtype=wp.float64, device=self.device), s.R, s.t)
        s.place_vertices(s.y, s.R, s.t, s.x)

    def reset(self, envs: ArrayLike | None = None) -> None:
        """Put environments (a mask (B,), a list, or None for all) back to how the world was made."""
        self.restore(self._start, envs)

    def teleport(
        self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None, envs: ArrayLike | None = None
    ) -> None:
        """Move a driven body's frame at once, with all that is bonded to it; its velocities become zero.

        Its target becomes that pose; those of other bodies stay. An affine body is put there, undeformed.

        Args:
            name: a driven body or a grip.
            position: [m], shape (3,) or (B, 3); None keeps it.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps it.
            envs: a mask (B,) or list of environments; None for all.

        Raises:
            OverlapError: if surfaces would cross or touch there.
        """
        frame, mask, state = self._frame(name), self._mask(envs), self.save()
        p, q = self._pose(position, rotation)
        before = rotation_matrix(state.frame_rotation), state.frame_position.copy()
        if p is not None:
            state.frame_position[mask, frame] = p[mask]
        if q is not None:
            state.frame_rotation[mask, frame] = q[mask]
        body = int(self.layout.frame_body[frame])
        moved = np.arange(len(self.layout.frame_names)) == frame
        nodes = slice(self.layout.node_start[body], self.layout.node_start[body + 1])
        if frame == body:
            self._carry_grips(state, body, mask, before)
            moved = self.layout.frame_body == body
        elif isinstance(self.bodies[body], AffineBody):
            turned = np.einsum("bij,nj->bni", rotation_matrix(state.frame_rotation[:, frame]), self.layout.aim_local[nodes])
            state.y[mask, nodes] = (turned + state.frame_position[:, frame, None])[mask]
        state.velocity[mask, nodes] = 0.0
        state.second_order[mask] = 0
        goal_p, goal_q = self._goal_p[:, ~moved].copy(), self._goal_q[:, ~moved].copy()
        self.restore(state, mask)
        self._goal_p[:, ~moved], self._goal_q[:, ~moved] = goal_p, goal_q
        self._told = False

    def _carry_grips(self, state: State, body: int, mask: NDArray[np.bool_], before: tuple[Floats, Floats]) -> None:
        """Grips keep their places in the frame of the body that was moved."""
        turn = rotation_matrix(state.frame_rotation[:, body]) @ np.swapaxes(before[0][:, body], -1, -2)
        for grip in np.flatnonzero((self.layout.frame_body == body) & (self.layout.frame_moves == 1)):
            if grip == body:
                continue
            arm = np.einsum("bij,bj->bi", turn, before[1][:, grip] - before[1][:, body])
            state.frame_position[mask, grip] = (state.frame_position[:, body] + arm)[mask]
            state.frame_rotation[mask, grip] = _quaternions(turn @ before[0][:, grip])[mask]

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
