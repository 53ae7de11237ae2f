"""One time step: driven bodies advance as far as they can, projected Newton finds the state of least incremental potential.

Each Newton iteration (i) tells the linear system where driven frames are going, so that the unknowns move out of their way in the same
step, and takes that step as far as gaps allow, until the frames have arrived; (ii) solves H p = −g by PCG, with the exact Hessian first
and a positive semi-definite one once negative curvature is met (projection on demand, after Longva et al. 2023, "Pitfalls of
Projection"); (iii) limits the step by continuous collision detection; (iv) halves it until the energy falls enough and no tetrahedron
is inverted. An environment is done when p is small and its frames have arrived, or are blocked. Environments never wait on or change
each other's arithmetic: every decision is a mask.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ipc import dynamics, elasticity
from ipc.collision import Collision
from ipc.contact import Contacts
from ipc.layout import Layout
from ipc.linear import Pcg, SystemView, row_column, row_sum
from ipc.preconditioner import make_preconditioner
from ipc.settings import Settings

__all__ = ["Newton", "StepCounts"]

wp.set_module_options({"enable_backward": False})

ARMIJO = 1e-4
CCD_SLACK = 0.1
"""A Newton step may use up nine tenths of any gap."""
GAP_FLOOR = 0.01
"""Driven bodies may not close a gap below this share of d̂; the soft side is given time to yield first."""
BLOCKED_ADVANCE = 1e-4
"""Frames that advance by less than this share of their motion although everything else had come to rest are blocked."""
POOR_ADVANCE = 0.05
"""Below this share of what was left, the unknowns get time to rest before the frames try again."""


@wp.kernel
def direction_size(
    p: wp.array2d(dtype=wp.vec3d),
    residual: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    # outputs
    size: wp.array(dtype=wp.float64),
    bad: wp.array(dtype=wp.int32),
):
    """Largest displacement of a node [m], and a mark for what is not finite."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    length = wp.length(p[env, i])
    if not (length < wp.float64(1.0e100)) or not (wp.length(residual[env, i]) < wp.float64(1.0e100)):
        bad[env] = 1
    else:
        wp.atomic_max(size, env, length)


@wp.kernel
def slope_of(
    p: wp.array2d(dtype=wp.vec3d),
    gradient: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    slope: wp.array2d(dtype=wp.float64),
):
    """g·p node by node [J]; p is zero on bonded nodes."""
    env, i = wp.tid()
    if active[env] != 0:
        slope[env, i] = wp.dot(p[env, i], gradient[env, i])


@wp.kernel
def judge(
    slope: wp.array(dtype=wp.float64),
    change: wp.array(dtype=wp.float64),
    noise: wp.array(dtype=wp.float64),
    min_det: wp.array(dtype=wp.float64),
    # outputs
    alpha: wp.array(dtype=wp.float64),
    searching: wp.array(dtype=wp.int32),
    trials: wp.array(dtype=wp.int32),
):
    """Ends the search of an environment whose energy fell enough (Armijo), else halves its step."""
    env = wp.tid()
    if searching[env] == 0:
        return
    trials[env] = trials[env] + 1
    bound = wp.float64(ARMIJO) * alpha[env] * slope[env] + noise[env]
    if change[env] <= bound and min_det[env] > wp.float64(0.0):
        searching[env] = 0
    else:
        alpha[env] = wp.float64(0.5) * alpha[env]


@wp.kernel
def push_rows(
    system: SystemView,
    contacts: Contacts,
    dx: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    # outputs
    residual: wp.array2d(dtype=wp.vec3d),
):
    """residual −= Σ q (q·dx) with vertex motions dx, on the unknowns."""
    env, r = wp.tid()
    if active[env] == 0 or r >= contacts.row_count[env]:
        return
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    s = wp.float64(0.0)
    for k in range(4):
        if verts[k] >= 0:
            s += wp.dot(row_column(row, k), dx[env, verts[k]])
    for k in range(4):
        v = verts[k]
        if v >= 0:
            q = s * (wp.transpose(system.R[env, system.vert_body[v]]) * row_column(row, k))
            for m in range(system.vert_count[v]):
                node = system.vert_nodes[v, m]
                if system.free[node] != 0:
                    wp.atomic_sub(residual, env, node, system.vert_weight[v, m] * q)


@wp.kernel
def take(y1: wp.array2d(dtype=Any), mask: wp.array(dtype=wp.int32), y: wp.array2d(dtype=Any)):
    """y = y1 where the mask is set."""
    env, i = wp.tid()
    if mask[env] != 0:
        y[env, i] = y1[env, i]


# Said here, so that the module is compiled once and not again at each new type.
for _type in (wp.vec3d, wp.mat33d):
    wp.overload(take, [wp.array2d(dtype=_type), wp.array(dtype=wp.int32), wp.array2d(dtype=_type)])


@wp.kernel
def difference(a: wp.array2d(dtype=wp.vec3d), b: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec3d)):
    """out = a − b."""
    env, i = wp.tid()
    out[env, i] = a[env, i] - b[env, i]


@dataclass
class StepCounts:
    """What one step did, per environment, shape (B,)."""

    newton: np.ndarray
    linear: np.ndarray
    line_search: np.ndarray
    relags: np.ndarray
    ccd: np.ndarray
    min_gap: np.ndarray
    min_det: np.ndarray
    converged: np.ndarray
    stalled: np.ndarray
    failed: np.ndarray
    projected: np.ndarray
    blocked: np.ndarray
    residual_speed: np.ndarray


class Newton:
    """State and arrays of a batch, and the step.

    Args:
        layout: the flat arrays.
        settings: how to step.
        batch: number of environments.
        d_hat: [m].    kappa: [Pa].
        device: Warp device.
    """

    def __init__(self, layout: Layout, settings: Settings, batch: int, d_hat: float, kappa: float, device: wp.Device) -> None:
        self.layout, self.settings, self.batch, self.device = layout, settings, batch, device
        self.nodes, self.verts, self.elements = len(layout.node_rest), int(layout.vert_start[-1]), len(layout.tets)
        bodies = len(layout.names)

        def const(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        def vectors(n: int) -> wp.array:
            return wp.zeros((batch, n), dtype=wp.vec3d, device=device)

        def numbers(*shape: int) -> wp.array:
            return wp.zeros(shape or batch, dtype=wp.float64, device=device)

        def flags() -> wp.array:
            return wp.zeros(batch, dtype=wp.int32, device=device)

        self.collision = Collision(layout, batch, d_hat, margin=d_hat, device=device)
        self.tets = const(layout.tets, wp.int32)
        self.grads = wp.array(layout.grads, dtype=wp.vec3d, device=device)
        self.elastic = [
            const(layout.volume, wp.float64),
            const(layout.model, wp.int32),
            const(layout.mu, wp.float64),
            const(layout.lam, wp.float64),
        ]
        self.node_body = const(layout.node_body, wp.int32)
        self.node_free = const(layout.node_free, wp.int32)
        self.row_start, self.col = const(layout.row_start, wp.int32), const(layout.col, wp.int32)
        rows = np.repeat(np.arange(self.nodes), np.diff(layout.row_start))
        diagonal = np.flatnonzero(rows == layout.col).astype(np.int32)
        drag = np.zeros(len(layout.col))
        drag[diagonal] = layout.node_damping / settings.dt
        self.mass, self.drag = const(layout.mass, wp.float64), const(drag, wp.float64)
        self.part_start, self.part = const(layout.part_start, wp.int32), const(layout.part, wp.int32)
        self.corner_start, self.corner = const(layout.corner_start, wp.int32), const(layout.corner, wp.int32)
        self.followers = [
            const(layout.node_vert_start, wp.int32),
            const(layout.node_vert, wp.int32),
            const(layout.node_vert_weight, wp.float64),
        ]
        self.vert_map = [
            const(layout.vert_body, wp.int32),
            const(layout.vert_count, wp.int32),
            const(layout.vert_nodes, wp.int32),
            const(layout.vert_weight, wp.float64),
        ]
        self.vert_local = wp.array(layout.vert_local[None], dtype=wp.vec3d, device=device)

        # State: node positions in their frames, world velocities, frames now and their targets.
        self.y, self.v = vectors(self.nodes), vectors(self.nodes)
        self.xw, self.xw_before, self.v_before = vectors(self.nodes), vectors(self.nodes), vectors(self.nodes)
        self.second_order = flags()
        self.frame_q, self.goal_q = (wp.zeros((batch, bodies), dtype=wp.quatd, device=device) for _ in range(2))
        self.frame_p, self.goal_p = vectors(bodies), vectors(bodies)
        self.R, self.R1 = (wp.zeros((batch, bodies), dtype=wp.mat33d, device=device) for _ in range(2))
        self.t, self.t1 = vectors(bodies), vectors(bodies)
        self.now_q = wp.zeros((batch, bodies), dtype=wp.quatd, device=device)
        self.kappa = wp.full(batch, kappa, dtype=wp.float64, device=device)
        self.acceleration = wp.full(batch, wp.vec3d(*settings.gravity), dtype=wp.vec3d, device=device)
        self.share, self.share1 = numbers(), numbers()

        # Work space.
        self.x, self.x1, self.dx, self.x_start = (vectors(self.verts) for _ in range(4))
        self.vert_gradient = vectors(self.verts)
        self.y_start, self.y1, self.p, self.gradient, self.residual = (vectors(self.nodes) for _ in range(5))
        self.target, self.local_target, self.local_start, self.xw1 = (vectors(self.nodes) for _ in range(4))
        self.el_F, self.el_P = (wp.zeros((batch, self.elements), dtype=wp.mat33d, device=device) for _ in range(2))
        self.el_mck = vectors(self.elements)
        self.el_J, self.el_energy, self.el_change = (numbers(batch, self.elements) for _ in range(3))
        self.node_change, self.force_size = numbers(batch, self.nodes), numbers(batch, self.nodes)
        self.system = SystemView()
        self.system.row_start, self.system.col, self.system.diagonal = self.row_start, self.col, const(diagonal, wp.int32)
        self.system.free, self.system.node_body = self.node_free, self.node_body
        self.system.vert_body, self.system.vert_count, self.system.vert_nodes, self.system.vert_weight = self.vert_map
        self.system.blocks = wp.zeros((batch, len(layout.col)), dtype=wp.mat33d, device=device)
        self.system.R = self.R
        self.pcg = Pcg(batch, self.nodes, device)
        self.preconditioner = make_preconditioner(layout, settings, batch, device)
        self.inertia_scale, self.alpha, self.slope, self.change, self.noise = (numbers() for _ in range(5))
        self.min_det, self.size, self.barrier_energy = (numbers() for _ in range(3))
        self.active, self.project, self.bad, self.searching, self.trials, self.mask = (flags() for _ in range(6))
        self.reach = 0.0
        self.timers: dict[str, float] = {}

    # --- small helpers ---------------------------------------------------------------------------------------------------------

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list | None = None) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs or [], device=self.device)

    def _timed(self, name: str, since: float) -> float:
        """Add the time since ``since`` to a stage's timer (on CUDA: until the host has queued it)."""
        now = time.perf_counter()
        self.timers[name] = self.timers.get(name, 0.0) + now - since
        return now

    @property
    def friction_eps(self) -> float:
        """ε = ε_v h [m]."""
        return self.settings.friction_velocity * self.settings.dt

    def set_frames(self, share: wp.array, R: wp.array, t: wp.array) -> None:
        """Frames a ``share`` (B,) of the way from where the step began to their targets."""
        inputs = [self.frame_q, self.frame_p, self.goal_q, self.goal_p, share]
        self._launch(dynamics.frames_at, self.frame_q.shape, inputs, [R, t, self.now_q])

    def place_vertices(self, y: wp.array, R: wp.array, t: wp.array, x: wp.array) -> None:
        """World positions of the vertices."""
        self._launch(dynamics.vertex_positions, x.shape, [y, R, t, *self.vert_map, self.vert_local], [x])

    def place_nodes(self, out: wp.array) -> None:
        """World positions of the nodes."""
        self._launch(dynamics.node_world, out.shape, [self.y, self.R, self.t, self.node_body], [out])

    def _aim_inertia(self, R: wp.array, t: wp.array) -> None:
        inputs = [self.target, self.xw, R, t, self.node_body]
        self._launch(dynamics.inertia_target, self.xw.shape, inputs, [self.local_target, self.local_start])

    # --- parts of a step -------------------------------------------------------------------------------------------------------

    def assemble(self, active: wp.array) -> None:
        """Forces, contacts and energies at y; ``gradient`` holds bonded nodes too, ``residual`` only the unknowns."""
        inputs = [self.y, self.tets, self.grads, *self.elastic, active, self.project]
        outputs = [self.el_F, self.el_P, self.el_mck, self.el_J, self.el_energy]
        self._launch(elasticity.element_state, self.el_J.shape, inputs, outputs)
        inputs = [self.corner_start, self.corner, self.grads, self.el_P, active]
        self._launch(elasticity.node_elastic_gradient, self.y.shape, inputs, [self.gradient])
        self.collision.assemble(
            *(
                self.x,
                self.x_start,
                self.R,
                self.t,
                self.kappa,
                self.friction_eps,
                active,
                self.vert_gradient,
                self.barrier_energy,
            )
        )
        inputs = [
            *(self.y, self.local_target, self.local_start, self.row_start, self.col, self.mass, self.drag, self.inertia_scale),
            *(self.vert_gradient, self.R, self.node_body, self.node_free, *self.followers, active),
        ]
        self._launch(dynamics.node_gradient, self.y.shape, inputs, [self.gradient, self.residual, self.force_size])

    def _fill_matrix(self, active: wp.array) -> None:
        inputs = [
            *(self.part_start, self.part, self.grads, *self.elastic, self.mass, self.drag, self.inertia_scale),
            *(self.el_F, self.el_mck, active),
        ]
        self._launch(elasticity.block_hessian, self.system.blocks.shape, inputs, [self.system.blocks])

    def _solve(self, active: np.ndarray) -> np.ndarray:
        """p for the active environments; returns PCG iterations (B,)."""
        since = time.perf_counter()
        iterations = np.zeros(self.batch, np.int64)
        todo = active.copy()
        self.p.zero_()
        for attempt in range(2):
            self.mask.assign(todo.astype(np.int32))
            self._fill_matrix(self.mask)
            since = self._timed("matrix", since)
            rows = self.collision.row_most
            self.preconditioner.update(self.system, self.collision.contacts, rows, self.mask)
            since = self._timed("preconditioner", since)
            result = self.pcg.solve(
                *(self.system, self.collision.contacts, rows, self.preconditioner, self.residual, self.p),
                *(self.settings.linear_tolerance, self.settings.max_linear, self.mask),
            )
            iterations[todo] += result.iterations[todo]
            since = self._timed("pcg", since)
            todo &= result.negative
            if attempt == 1 or not todo.any():
                return iterations
            # Make the matrix of these environments definite, and start over with their residual.
            project = self.project.numpy().copy()
            project[todo] = 1
            self.project.assign(project)
            self.mask.assign(todo.astype(np.int32))
            self.assemble(self.device_mask(todo))
            p = self.p.numpy().copy()
            p[todo] = 0.0
            self.p.assign(p)
        return iterations

    def device_mask(self, mask: np.ndarray) -> wp.array:
        """A device mask of the environments of ``mask`` (B,)."""
        return wp.array(mask.astype(np.int32), dtype=wp.int32, device=self.device)

    def _aim_frames(self, share: np.ndarray, travelling: np.ndarray) -> None:
        """Let the linear system know where the frames of the travelling environments go.

        Their inertia is taken at the targets, and ``x1`` − ``x`` becomes the motion that the contact rows will feel (see _push_ahead).
        """
        self.share1.assign(np.where(travelling, 1.0, share))
        self.set_frames(self.share1, self.R1, self.t1)
        self.place_vertices(self.y, self.R1, self.t1, self.x1)
        self._launch(difference, self.x.shape, [self.x1, self.x], [self.dx])
        self._aim_inertia(self.R1, self.t1)

    def _push_ahead(self, travelling: np.ndarray) -> None:
        """Residual −= Σ q (q·dx): what moves under orders pushes the unknowns ahead in the linear model."""
        if self.collision.row_most:
            inputs = [self.system, self.collision.contacts, self.dx, self.device_mask(travelling)]
            self._launch(push_rows, (self.batch, self.collision.row_most), inputs, [self.residual])

    def _travel(self, share: np.ndarray, travelling: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move frames and unknowns together as far as gaps allow; returns the new share and the length taken, both (B,).

        The energy is not asked: it is another one at the new frames. What counts is that gaps stay open and no element inverts.
        """
        since = time.perf_counter()
        mask = self.device_mask(travelling)
        length = np.where(travelling, 1.0, 0.0)
        for attempt in range(8):
            trial = np.where(travelling, share + length * (1.0 - share), share)
            trial = np.where(length == 1.0, 1.0, trial)
            self.share1.assign(trial)
            self.alpha.assign(length)
            self.set_frames(self.share1, self.R1, self.t1)
            self._launch(dynamics.advance_nodes, self.y.shape, [self.y, self.p, self.alpha, self.y1])
            self.place_vertices(self.y1, self.R1, self.t1, self.x1)
            self._launch(difference, self.x.shape, [self.x1, self.x], [self.dx])
            self.collision.refresh(self.x, self.dx, mask)
            self.alpha.fill_(1.0)
            # A shortened motion ends where a gap is about used up: it is looked at again (a turning frame's way is no straight line),
            # with half the limit, or rounding would refuse what was just allowed.
            ease = 1.0 if attempt == 0 else 0.5
            self.collision.limit_step(
                *(self.x, self.dx, (self.R, self.t), (self.R1, self.t1)),
                *(ease * (1.0 - self.settings.motion_fraction), ease * GAP_FLOOR * self.collision.d_hat, mask, self.alpha),
            )
            self.min_det.fill_(np.inf)
            inputs = [self.y, self.y1, self.tets, self.grads, *self.elastic, mask]
            self._launch(elasticity.element_energy_change, self.el_change.shape, inputs, [self.el_change, self.min_det])
            alpha = np.where(travelling, self.alpha.numpy(), 1.0)
            alpha = np.where(travelling & ~(self.min_det.numpy() > 0), 0.5 * alpha, alpha)
            if (alpha >= 1.0).all():
                break
            length = length * np.where(alpha >= 1.0, 1.0, alpha * (1.0 - 1e-9) if attempt < 6 else 0.0)
        # Environments that stay have their old y and frames in y1 and R1.
        for old, new in ((self.y, self.y1), (self.x, self.x1), (self.R, self.R1), (self.t, self.t1)):
            self._launch(take, old.shape, [new, mask], [old])
        self._aim_inertia(self.R, self.t)
        self._timed("travel", since)
        return trial, length

    def _line_search(self, active: np.ndarray, counts: StepCounts) -> tuple[np.ndarray, np.ndarray]:
        """Take the step p as far as contacts, energy and inversion allow.

        Returns:
            The length taken, 0 where none was, and the length that contacts allowed; both (B,).
        """
        since = time.perf_counter()
        self.mask.assign(active.astype(np.int32))
        self._launch(dynamics.vertex_motion, self.x.shape, [self.p, self.R, *self.vert_map], [self.dx])
        self.collision.refresh(self.x, self.dx, self.mask)
        since = self._timed("broad", since)
        self.alpha.fill_(1.0)
        frames = (self.R, self.t)
        self.collision.limit_step(self.x, self.dx, frames, frames, CCD_SLACK, 0.0, self.mask, self.alpha)
        allowed = self.alpha.numpy().copy()
        counts.ccd = np.where(active, np.minimum(counts.ccd, allowed), counts.ccd)
        since = self._timed("ccd", since)
        self._launch(slope_of, self.p.shape, [self.p, self.gradient, self.mask], [self.node_change])
        self.slope.zero_()
        row_sum(self.node_change, self.mask, self.slope)
        # Rounding of positions moves the energy by force × size × 1e-16: only steps of that effect are accepted without a true decrease.
        self.noise.zero_()
        row_sum(self.force_size, self.mask, self.noise)
        self.noise.assign(1e-15 * self.reach * self.noise.numpy())
        wp.copy(self.searching, self.mask)
        self.trials.zero_()
        for _ in range(self.settings.max_line_search):
            self._launch(dynamics.advance_nodes, self.y.shape, [self.y, self.p, self.alpha, self.y1])
            self.place_vertices(self.y1, self.R, self.t, self.x1)
            self.change.zero_()
            self.min_det.fill_(np.inf)
            inputs = [self.y, self.y1, self.tets, self.grads, *self.elastic, self.searching]
            self._launch(elasticity.element_energy_change, self.el_change.shape, inputs, [self.el_change, self.min_det])
            row_sum(self.el_change, self.searching, self.change)
            inputs = [
                *(self.y, self.y1, self.local_target, self.local_start, self.row_start, self.col),
                *(self.mass, self.drag, self.inertia_scale, self.searching),
            ]
            self._launch(dynamics.inertia_change, self.y.shape, inputs, [self.node_change])
            row_sum(self.node_change, self.searching, self.change)
            self.collision.energy_change(
                *(self.x, self.x1, self.x_start, self.R, self.t, self.kappa, self.friction_eps, self.searching, self.change)
            )
            inputs = [self.slope, self.change, self.noise, self.min_det]
            self._launch(judge, self.batch, inputs, [self.alpha, self.searching, self.trials])
            if not self.searching.numpy().any():
                break
        failed = self.searching.numpy().astype(bool)
        counts.line_search += self.trials.numpy()
        taken = active & ~failed
        self.mask.assign(taken.astype(np.int32))
        self._launch(take, self.y.shape, [self.y1, self.mask], [self.y])
        self._launch(take, self.x.shape, [self.x1, self.mask], [self.x])
        self._timed("line_search", since)
        return np.where(taken, self.alpha.numpy(), 0.0), allowed

    def _note_extremes(self, active: np.ndarray, counts: StepCounts) -> None:
        """Least gap and determinant of the state just assembled."""
        contacts = self.collision.contacts
        most = self.collision.contact_most
        if most:
            gap = contacts.gap.numpy()[:, :most]
            inside = np.arange(most)[None] < contacts.count.numpy()[:, None]
            least = np.where(inside, gap, np.inf).min(axis=1)
            counts.min_gap = np.where(active, np.minimum(counts.min_gap, least), counts.min_gap)
        counts.min_det = np.where(active, np.minimum(counts.min_det, self.el_J.numpy().min(axis=1)), counts.min_det)

    # --- the step --------------------------------------------------------------------------------------------------------------

    def step(self, alive: np.ndarray, moving: np.ndarray) -> StepCounts:
        """Advance the environments of ``alive`` (B,) by one time step; ``moving`` (B,) marks those whose frames have a target."""
        settings, batch = self.settings, self.batch
        counts = StepCounts(
            newton=np.zeros(batch, np.int64),
            linear=np.zeros(batch, np.int64),
            line_search=np.zeros(batch, np.int64),
            relags=np.zeros(batch, np.int64),
            ccd=np.ones(batch),
            min_gap=np.full(batch, np.inf),
            min_det=np.full(batch, np.inf),
            converged=np.zeros(batch, bool),
            stalled=np.zeros(batch, bool),
            failed=np.zeros(batch, bool),
            projected=np.zeros(batch, bool),
            blocked=np.zeros(batch),
            residual_speed=np.zeros(batch),
        )
        since = time.perf_counter()
        self.active.assign(alive.astype(np.int32))
        self.project.zero_()
        share = np.where(moving, 0.0, 1.0)
        self.share.assign(share)
        self.set_frames(self.share, self.R, self.t)
        self.place_vertices(self.y, self.R, self.t, self.x)
        wp.copy(self.x_start, self.x)
        wp.copy(self.y_start, self.y)
        self.place_nodes(self.xw)
        if settings.integrator != "bdf2":
            self.second_order.zero_()
        h2 = np.where(self.second_order.numpy() != 0, 4.0 / 9.0, 1.0) * settings.dt**2
        self.inertia_scale.assign(1.0 / h2)
        inputs = [self.xw, self.v, self.xw_before, self.v_before, self.second_order, self.acceleration, settings.dt]
        self._launch(dynamics.predict, self.xw.shape, inputs, [self.target])
        self._aim_inertia(self.R, self.t)
        self.reach = float(np.abs(np.nan_to_num(self.x.numpy())).max(initial=0.0))
        if self.collision.friction:
            self.dx.zero_()
            self.collision.refresh(self.x, self.dx, self.active)
            self.assemble(self.active)
            self.collision.lag(self.active)
        self._timed("begin", since)

        relagging = alive.copy()
        failed = np.zeros(batch, bool)
        for relag in range(settings.friction_relags + 1):
            share, failed_now = self._minimise(relagging & ~failed, share, counts)
            failed |= failed_now
            self.mask.assign((alive & ~failed).astype(np.int32))
            self.dx.zero_()
            self.collision.refresh(self.x, self.dx, self.mask)
            self.assemble(self.mask)
            self._note_extremes(alive & ~failed, counts)
            if not self.collision.friction or relag == settings.friction_relags:
                break
            relagging &= ~failed
            self.mask.assign(relagging.astype(np.int32))
            changed = self.collision.lag(self.mask)
            relagging &= changed > settings.friction_tolerance
            if not relagging.any():
                break
            counts.relags += relagging
        since = time.perf_counter()
        counts.blocked = 1.0 - share
        counts.projected = self.project.numpy().astype(bool)
        good = self.device_mask(alive & ~failed)
        self._launch(take, self.y.shape, [self.y_start, self.device_mask(failed)], [self.y])
        self.place_nodes(self.xw1)
        inputs = [self.xw1, self.xw, self.xw_before, self.second_order, settings.dt, good]
        self._launch(dynamics.new_velocity, self.xw.shape, inputs, [self.v, self.v_before])
        self._launch(take, self.xw.shape, [self.xw, good], [self.xw_before])
        self._launch(take, self.xw.shape, [self.xw1, good], [self.xw])
        if settings.integrator == "bdf2":
            self.second_order.assign((self.second_order.numpy() != 0) | (alive & ~failed))
        # The next step begins where the frames are now.
        self.share.assign(share)
        self.set_frames(self.share, self.R, self.t)
        wp.copy(self.frame_q, self.now_q)
        wp.copy(self.frame_p, self.t)
        self._timed("end", since)
        counts.converged &= ~failed
        counts.failed = failed
        return counts

    def _minimise(self, active: np.ndarray, share: np.ndarray, counts: StepCounts) -> tuple[np.ndarray, np.ndarray]:
        """Newton's method for the environments of ``active``; returns how far their frames came and which are not finite."""
        settings = self.settings
        active = active.copy()
        failed = np.zeros(self.batch, bool)
        counts.converged = np.where(active, False, counts.converged)
        used = np.zeros(self.batch, np.int64)
        # Frames on their way: a poor advance is followed by plain iterations until the unknowns rest, then by one more try.
        poor, rested, ready = np.zeros(self.batch, bool), np.zeros(self.batch, bool), np.ones(self.batch, bool)
        while active.any():
            since = time.perf_counter()
            mask = self.device_mask(active)
            self.dx.zero_()
            self.collision.refresh(self.x, self.dx, mask)
            since = self._timed("broad", since)
            travelling = active & (share < 1.0) & ready & (~poor | rested)
            if travelling.any():
                self._aim_frames(share, travelling)
            self.assemble(mask)
            self._note_extremes(active, counts)
            if travelling.any():
                self._push_ahead(travelling)
            self._timed("forces", since)
            counts.linear += self._solve(active)
            self.size.zero_()
            self.bad.zero_()
            self._launch(direction_size, self.p.shape, [self.p, self.residual, mask], [self.size, self.bad])
            bad = self.bad.numpy().astype(bool) & active
            failed |= bad
            active &= ~bad
            travelling &= ~bad
            speed = self.size.numpy() / settings.dt
            counts.residual_speed = np.where(active, speed, counts.residual_speed)
            counts.newton += active
            used += active
            blocked = np.zeros(self.batch, bool)
            if travelling.any():
                before = share
                share, length = self._travel(share, travelling)
                blocked = travelling & poor & (share - before < BLOCKED_ADVANCE)
                poor = np.where(travelling, length < POOR_ADVANCE, poor)
                rested &= ~travelling
                ready &= ~travelling
                active &= ~blocked
                counts.converged |= blocked
            plain = active & ~travelling
            if not plain.any():
                active &= used < settings.max_newton
                continue
            alpha, allowed = self._line_search(plain, counts)
            ready |= plain
            # A search that found nothing: try again with a definite matrix; if it was definite, this is as far as it goes.
            stuck = plain & (alpha == 0.0)
            if stuck.any():
                project = self.project.numpy().copy()
                give_up = stuck & (project != 0) & (speed > settings.velocity_tolerance)
                counts.stalled |= give_up
                active &= ~give_up
                project[stuck] = 1
                self.project.assign(project)
            # A step this small has arrived, also where rounding of the energies kept it from being taken.
            still = plain & (speed <= settings.velocity_tolerance) & (allowed >= 1.0)
            rested |= still
            done = active & still & (share >= 1.0)
            counts.converged |= done
            active &= ~done
            active &= used < settings.max_newton
        return share, failed
