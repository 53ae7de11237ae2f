"""A world of bodies: time steps, positions and forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ipc.bodies.body import AffineBody, Body, HalfSpace, SoftBody, rotation_matrix
from ipc.bodies.layout import build_layout
from ipc.body_arrays import BodyArrays, ContactArrays, WorldArrays
from ipc.contact.overlap import OverlapCheck, find_overlap
from ipc.errors import IpcError
from ipc.report import ContactPairs, PairForces, PatchMotion, RigidMotion, StepReport, Wrench
from ipc.settings import Settings, barrier_stiffness
from ipc.solver.forces import bond_wrench, contact_pairs, contact_wrench, host, touching
from ipc.solver.newton import Newton
from ipc.solver.patch_motion import RestPatches
from ipc.solver.potential import Potential
from ipc.solver.rest_state import RestState
from ipc.state import State, env_mask, per_env, start_state, teleported, unit_pose
from ipc.sums import StepSums
from ipc.warp_start import LAUNCH, start_warp

Floats = NDArray[np.float64]


class World:
    """Bodies that deform, move and touch, in ``num_envs`` copies that do not see each other.

    Threads may have a world each; their steps wait for each other. ``sums`` are forces, boxes and motions of whole bodies
    (:class:`ipc.sums.StepSums`), on the device and in NumPy.

    Args:
        bodies: of unique names.
        settings: of the time step; None is the default ones.
        num_envs: number of environments B.
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
        start_warp()
        if device == "auto":
            device = "cuda" if wp.is_cuda_available() else "cpu"
        try:
            self.device = wp.get_device(device)
        except Exception as error:
            raise IpcError(
                f"device = {device!r}: choose 'auto' or one of {', '.join(d.alias for d in wp.get_devices())}"
            ) from error
        self.d_hat = self.settings.d_hat or 0.1 * self.layout.min_edge
        self.kappa = self.settings.kappa or barrier_stiffness(self.layout, self.settings.dt)
        with LAUNCH:
            self._potential = Potential(self.layout, self.settings, num_envs, self.d_hat, self.kappa, self.device)
            self._newton = Newton(self._potential, self.layout, self.settings)
        self._arrays = WorldArrays(self.layout, self._potential)
        self.sums = StepSums(self.layout, self.bodies, self._potential)
        self._failed = np.zeros(num_envs, bool)
        self._patches: dict[int, RestPatches] = {}
        self._check_overlap = OverlapCheck(self.layout)
        self._dt = np.full(num_envs, self.settings.dt)
        self._rest: RestState | None = None
        self._expected = np.zeros(num_envs, bool)
        frames = self.layout.frame_pose
        # Targets of the next step. They are copied to the device before a step if they changed.
        self._goal_p = np.zeros((num_envs, len(frames), 3))
        self._goal_q = np.zeros((num_envs, len(frames), 4))
        self._targets_set = True
        self._start = start_state(self.layout, num_envs, self.kappa)
        self.restore(self._start)

    def _index(self, name: str) -> int:
        if name not in self.layout.names:
            raise IpcError(f"no body is named {name!r}: choose from {', '.join(self.layout.names)}")
        return self.layout.names.index(name)

    def _nodes(self, name: str) -> slice:
        """Nodes of a soft or affine body."""
        body = self._index(name)
        nodes = slice(*self.layout.node_start[body : body + 2])
        if nodes.start == nodes.stop:
            raise IpcError(f"{name!r} has no unknowns: set_target prescribes its motion")
        return nodes

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

    def set_target(self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None) -> None:
        """Set the pose of a driven frame from the end of the next step on.

        Args:
            name: a kinematic body, a half-space, a soft body with bonded vertices, a grip ``"<body>.<grip>"``, or an affine body with
                a drive, which reaches the pose as far as its drive and contacts allow.
            position: frame origin in the world [m], shape (3,) or (B, 3); None keeps the last target's.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps the last target's. Steps turn by less than half a turn.
        """
        frame = self._frame(name)
        p, q = unit_pose(position, rotation, self.num_envs)
        if p is not None:
            self._goal_p[:, frame] = p
        if q is not None:
            self._goal_q[:, frame] = q[:, [1, 2, 3, 0]]
        self._targets_set = True

    def set_gravity(self, gravity: ArrayLike) -> None:
        """Set the acceleration of every body [m/s²], world frame, shape (3,) or (B, 3)."""
        self._potential.acceleration.assign(np.ascontiguousarray(per_env(gravity, (3,), "gravity", self.num_envs)))
        self._expected[:] = False

    def set_velocity(self, name: str, velocity: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Set the world velocity of a soft or affine body's nodes [m/s], shape (3,) or (B, 3)."""
        mask, nodes = env_mask(envs, self.num_envs), self._nodes(name)
        v = host(self._potential.v).copy()
        v[mask, nodes] = per_env(velocity, (3,), "velocity", self.num_envs)[mask, None]
        self._potential.v.assign(v)
        self.sums.expire()
        self._expected[mask] = False

    def step(self, dt: ArrayLike | None = None, envs: ArrayLike | None = None) -> StepReport:
        """Advance environments that have not failed by ``dt`` [s]; None: by ``settings.dt``.

        Args:
            dt: length of the step of all environments, or of each (B,); those that are not stepped may have any.
            envs: a mask (B,) or list of the environments to step; None for all. The others stay as they are, with the forces of their
                last step; their report says that they converged in no iteration.

        Raises ``IpcError`` if ``dt`` is not positive.
        """
        with LAUNCH:
            chosen, pot = self._prepare(dt, envs), self._potential
            alive = ~self._failed & chosen
            if self._rest is not None:
                self._rest.expect(alive)
                self._expected |= alive
            values = self._newton.step(alive)
            self._arrays.update()
            self.sums.expire()
        self._failed |= values["failed"].astype(bool)
        self._expected &= values["halved"] == 0
        return StepReport(
            converged=values["converged"].astype(bool) | (~chosen & ~self._failed),
            failed=self._failed.copy(),
            stalled=values["stalled"].astype(bool),
            halved=values["halved"],
            blocked=np.where(chosen | self._failed, 1.0 - values["progress"], 0.0),
            min_gap=values["min_gap"],
            min_det=values["min_det"],
            newton=values["newton"].astype(np.int64),
            linear=values["linear"].astype(np.int64),
            line_search=values["line_search"].astype(np.int64),
            relags=np.maximum(values["relags"], 0).astype(np.int64),
            projected=values["projected"].astype(bool),
            ccd=values["ccd"],
            speed=values["speed"],
            pairs=host(pot.collision.contacts.count).astype(np.int64),
            kappa=host(pot.kappa).copy(),
            elastic=host(pot.elastic_energy).copy(),
            kinetic=host(pot.kinetic).copy(),
            barrier=host(pot.barrier).copy(),
        )

    def distance_from_rest(self) -> Floats:
        """Distance of each environment from rest without contact of bonded bodies [m], (B,).

        The largest distance of a node of a bonded soft body from where inertia and gravity alone would have put it in the last step; of
        other nodes, the displacement in that step. Infinite where there was no step since the state was set, where a body has a drive or
        damping, or a grip, and at the first call, which solves for how far bodies bend under their own mass.
        """
        if not self._can_rest():
            return np.full(self.num_envs, np.inf)
        with LAUNCH:
            if self._rest is None:
                self._rest = RestState(self.layout, self.settings, self._potential)
            known = self._expected & ~self._failed
            return np.where(known, self._rest.distance(known), np.inf)

    def carry(self, dt: ArrayLike | None = None, envs: ArrayLike | None = None) -> None:
        """Let a step pass without a solve, in environments where nothing touches a bonded body.

        Driven bodies go to their targets. Bonded soft bodies go along, bent by inertia and gravity alone, and bodies that move freely stay
        where they are. That is what :meth:`step` would do, to within :meth:`distance_from_rest`, in an environment whose driven bodies do
        not come near others; the caller has to know that. Forces stay those of the last step.

        Args:
            dt, envs: as of :meth:`step`.

        Raises ``IpcError``: as :meth:`step`, or a world in which a body has a drive or damping, or a grip.
        """
        if not self._can_rest():
            raise IpcError("bodies with a drive, damping or a grip are never at rest: use step")
        with LAUNCH:
            chosen = self._prepare(dt, envs) & ~self._failed
            if self._rest is None:
                self._rest = RestState(self.layout, self.settings, self._potential)
            self._rest.carry(chosen)
            self.sums.expire()
        self._expected |= chosen

    def _can_rest(self) -> bool:
        """True if no body has a drive, damping or a grip."""
        return not (self._potential.driven or self._potential.grips or self.layout.node_damping.any())

    def _prepare(self, dt: ArrayLike | None, envs: ArrayLike | None) -> NDArray[np.bool_]:
        """Set the duration of a step and its targets; returns the mask (B,) of the environments."""
        chosen, pot = env_mask(envs, self.num_envs), self._potential
        durations = per_env(self.settings.dt if dt is None else dt, (), "dt", self.num_envs)
        if not (durations[chosen] > 0.0).all():
            raise IpcError(f"dt = {dt}: it must be positive")
        if not np.array_equal(durations, self._dt):
            self._dt = np.array(durations)
            pot.dt.assign(self._dt)
        if self._targets_set:
            pot.goal_p.assign(self._goal_p)
            pot.goal_q.assign(self._goal_q)
            self._targets_set = False
        return chosen

    @property
    def timers(self) -> dict[str, float]:
        """Seconds spent in ``step`` and its stages (these without ``Settings.graph``)."""
        return dict(self._newton.timers)

    def arrays(self, name: str) -> BodyArrays:
        """A body's positions, velocities and forces as arrays of the device, for DLPack; no copies."""
        return self._arrays.body(self._index(name))

    def contact_arrays(self) -> ContactArrays:
        """All contact pairs as arrays of the device.

        A step may replace them by longer ones: ask again after each.
        """
        return self._arrays.contacts()

    def frame(self, name: str) -> tuple[Floats, Floats]:
        """World rotations (B, 3, 3) and positions [m] (B, 3) of a driven body's or grip's frame."""
        body = self._frame(name)
        return host(self._potential.R)[:, body].copy(), host(self._potential.t)[:, body].copy()

    def positions(self, name: str, frame: str = "world") -> Floats:
        """Positions [m] (B, n, 3) of all vertices of a soft body's mesh, or of another's surface.

        Args:
            frame: ``"world"``, or ``"body"`` for a bonded soft body in its own moving frame.
        """
        body = self._index(name)
        if isinstance(self.bodies[body], HalfSpace):
            raise IpcError(f"{name!r} is a half-space and has no vertices")
        if frame not in ("world", "body"):
            raise IpcError(f"frame = {frame!r}: choose 'world' or 'body'")
        pot = self._potential
        if isinstance(self.bodies[body], SoftBody):
            y = host(pot.y)[:, self.layout.node_start[body] : self.layout.node_start[body + 1]].copy()
            if frame == "body" and not self.layout.framed[body]:
                raise IpcError(f"{name!r} has no bonded vertices and so no frame of its own: choose frame='world'")
            if frame == "body":
                return y
            return np.einsum("bij,bnj->bni", host(pot.R)[:, body], y) + host(pot.t)[:, body, None]
        if frame == "body":
            raise IpcError(f"{name!r} is no soft body: frame='body' is for bonded soft bodies")
        return host(pot.x)[:, self.layout.vert_start[body] : self.layout.vert_start[body + 1]].copy()

    def velocities(self, name: str) -> Floats:
        """World velocities [m/s] of a soft body's vertices or an affine body's corners, (B, n, 3)."""
        return host(self._potential.v)[:, self._nodes(name)].copy()

    def affine_pose(self, name: str) -> tuple[Floats, Floats]:
        """A (B, 3, 3) and p [m] (B, 3) of an affine body's map x = A X + p."""
        body = self._index(name)
        first, last = self.layout.node_start[body : body + 2]
        if not isinstance(self.bodies[body], AffineBody):
            raise IpcError(f"{name!r} is no affine body")
        pose = self.bodies[body].pose
        corner = rotation_matrix(pose.rotation).T @ (self.layout.node_rest[first] - pose.position)
        y = host(self._potential.y)[:, first:last]
        A = np.einsum("bki,kj->bij", y, self.layout.grads[self.layout.tet_start[body]])
        return A, y[:, 0] - A @ corner

    def surface(self, name: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Mesh vertex of each surface vertex (n,), and triangles (F, 3) of surface vertices."""
        body = self._index(name)
        first, last = self.layout.vert_start[body : body + 2]
        faces = self.layout.faces[self.layout.face_start[body] : self.layout.face_start[body + 1]] - first
        if isinstance(self.bodies[body], SoftBody):
            return self.layout.vert_nodes[first:last, 0] - self.layout.node_start[body], faces
        return np.arange(last - first, dtype=np.int32), faces

    def contact_forces(self, name: str) -> Floats:
        """Contact and friction force on each vertex of :meth:`surface` [N], world frame, (B, n, 3)."""
        body = self._index(name)
        first, last = self.layout.vert_start[body : body + 2]
        return -host(self._potential.vert_gradient)[:, first:last]

    def traction(self, name: str) -> Floats:
        """Contact force per rest area at each surface vertex [Pa], world frame, (B, n, 3)."""
        body = self._index(name)
        area = self.layout.vert_area[self.layout.vert_start[body] : self.layout.vert_start[body + 1]]
        return self.contact_forces(name) / area[None, :, None]

    def wrench(self, name: str) -> Wrench:
        """Force and torque on a body by the others, or on a frame by the nodes bonded to it.

        For a soft body with bonded vertices this is the force of the pad on what holds it, and ``"<body>.<grip>"`` gives the force on
        that grip; for a free soft body it is the sum of its contacts.
        """
        layout = self.layout
        if name in layout.frame_names[len(layout.names) :] and not name.endswith(".aim"):
            frame = layout.frame_names.index(name)
            nodes = layout.grip_node[layout.grip_frame == frame]
            return bond_wrench(self._potential, int(layout.frame_body[frame]), frame, nodes)
        body = self._index(name)
        if isinstance(self.bodies[body], SoftBody) and layout.framed[body]:
            nodes = np.arange(layout.node_start[body], layout.node_start[body + 1])
            nodes = nodes[(layout.node_free[nodes] == 0) & ~np.isin(nodes, layout.grip_node)]
            return bond_wrench(self._potential, body, body, nodes)
        return contact_wrench(layout, self._potential, body)

    def contacts(self, env: int = 0) -> ContactPairs:
        """The contact pairs of one environment at the end of the last step."""
        if not 0 <= env < self.num_envs:
            raise IpcError(f"env = {env}: environments are 0 to {self.num_envs - 1}")
        return contact_pairs(self.layout, self._potential, env)

    def pressing(self) -> dict[tuple[str, str], PairForces]:
        """Forces at the end of the last step by names of two bodies that touch in any environment."""
        sums, result = self.sums.host, {}
        for p, (one, two) in enumerate(self.layout.pairs.tolist()):
            place = sums["pair_place"][:, p]
            if np.isfinite(place).any():
                wrench = np.concatenate([sums["pair_force"][:, p], sums["pair_torque"][:, p]], axis=1)
                names = self.layout.names[one], self.layout.names[two]
                result[names] = PairForces(sums["pair_normal"][:, p].copy(), place.copy(), wrench)
        return result

    def rigid_motion(self, name: str) -> RigidMotion:
        """Mass, centre, inertia and velocities of a soft or affine body as if it were rigid now."""
        self._nodes(name)
        body, sums = self._index(name), self.sums.host
        values = [sums[key][:, body].copy() for key in ("centre", "inertia", "velocity", "spin")]
        return RigidMotion(float(self.sums.mass[body]), *values)

    def held_patch(self, name: str, env: int) -> PatchMotion | None:
        """The part of a bonded soft body under contact forces, as if it moved as a whole.

        None where nothing touches its free nodes, as before any step. The first call for a body inverts its rest matrix.

        Raises ``IpcError``: no soft body with bonded vertices, or one too large or too ill-conditioned to be inverted.
        """
        body = self._index(name)
        if not isinstance(self.bodies[body], SoftBody) or not self.layout.framed[body]:
            raise IpcError(f"{name!r} is no soft body with bonded vertices")
        if body not in self._patches:
            self._patches[body] = RestPatches(self.layout, self.settings, body)
        return self._patches[body].loaded(self._potential, env)

    def touching(self, name: str) -> dict[str, NDArray[np.bool_]]:
        """Masks (B,) of other bodies that were closer than d̂ at the end of the last step, by name."""
        return touching(self.layout, self._potential, self._index(name))

    def overlap(self, env: int = 0) -> str | None:
        """Describe surfaces that cross, touch or contain each other; None where all are apart.

        Edges and triangles are compared exactly, on the host: a check for tests and experiments, not for every step of a batch. Only
        pairs of bodies that may touch are looked at, a body with itself where it has ``self_contact``.
        """
        if not 0 <= env < self.num_envs:
            raise IpcError(f"env = {env}: environments are 0 to {self.num_envs - 1}")
        s = self._potential
        return find_overlap(self.layout, host(s.x)[env], host(s.R)[env, :, :, 2], host(s.t)[env])

    def save(self) -> State:
        """A copy of the state of every environment."""
        s = self._potential
        stuck, slip = s.collision.slips()
        return State(
            y=host(s.y).copy(),
            velocity=host(s.v).copy(),
            frame_rotation=host(s.frame_q)[..., [3, 0, 1, 2]].copy(),
            frame_position=host(s.frame_p).copy(),
            kappa=host(s.kappa).copy(),
            failed=self._failed.copy(),
            stuck=stuck,
            slip=slip,
        )

    def restore(self, state: State, envs: ArrayLike | None = None) -> None:
        """Put environments back to a saved state; targets become the frames of that state.

        Forces and contacts belong to a step, not to a state: there are none until the next one. What friction remembers is in the state.

        Args:
            state: from :meth:`save` of a world of the same bodies.
            envs: a mask (B,) or list of the environments to restore; None for all. Others are not touched.

        Raises:
            OverlapError: if surfaces cross or touch in that state.
        """
        mask, s = env_mask(envs, self.num_envs), self._potential
        for what, given, needed in (
            ("nodes", state.y.shape, (*s.y.shape, 3)),
            ("frames", state.frame_position.shape, (*s.frame_p.shape, 3)),
        ):
            if given != needed:
                raise IpcError(f"the state has {what} of shape {given}: this world has {needed}")
        self._check_overlap(state, mask)
        quaternions = state.frame_rotation[..., [1, 2, 3, 0]]
        with LAUNCH:
            for target, values in (
                (s.y, state.y),
                (s.v, state.velocity),
                (s.frame_q, quaternions),
                (s.goal_q, quaternions),
                (s.frame_p, state.frame_position),
                (s.goal_p, state.frame_position),
                (s.kappa, state.kappa),
            ):
                merged = host(target).copy()
                merged[mask] = values[mask]
                target.assign(merged)
            self._goal_p[mask], self._goal_q[mask] = state.frame_position[mask], quaternions[mask]
            self._failed[mask] = state.failed[mask]
            self._expected[mask] = False
            s.collision.forget(mask)
            s.collision.drop(mask)
            if s.collision.friction and s.collision.set_slips(state.stuck, state.slip, mask):
                self._newton.forget_recordings()
            for forces in (s.gradient, s.vert_gradient):
                kept = host(forces).copy()
                kept[mask] = 0.0
                forces.assign(kept)
            s.set_frames(wp.zeros(self.num_envs, dtype=wp.float64, device=self.device), s.R, s.t)
            s.place_vertices(s.y, s.R, s.t, s.x)
            self._arrays.update()
            self.sums.expire()

    def reset(self, envs: ArrayLike | None = None) -> None:
        """Put environments (a mask (B,), a list, or None for all) back to the start of the world."""
        self.restore(self._start, envs)

    def teleport(
        self, name: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None, envs: ArrayLike | None = None
    ) -> None:
        """Move a driven frame at once, with all that is bonded to it; velocities become zero.

        Its target becomes that pose; those of other bodies stay. An affine body is put there, undeformed.

        Args:
            name: a driven body or a grip.
            position: [m], shape (3,) or (B, 3); None keeps it.
            rotation: quaternion (w, x, y, z), shape (4,) or (B, 4); None keeps it.
            envs: a mask (B,) or list of environments; None for all.

        Raises:
            OverlapError: if surfaces would cross or touch there.
        """
        frame, mask, state = self._frame(name), env_mask(envs, self.num_envs), self.save()
        p, q = unit_pose(position, rotation, self.num_envs)
        moved = teleported(state, self.layout, self.bodies[int(self.layout.frame_body[frame])], frame, p, q, mask)
        goal_p, goal_q = self._goal_p[:, ~moved].copy(), self._goal_q[:, ~moved].copy()
        self.restore(state, mask)
        self._goal_p[:, ~moved], self._goal_q[:, ~moved] = goal_p, goal_q
        self._targets_set = True
