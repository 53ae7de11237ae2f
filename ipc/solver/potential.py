"""The incremental potential of a batch: its state, its value, its gradient and its Hessian.

    E(x) = ½ ‖x − x̃‖²_M / h² + elastic energy + contact barrier + lagged friction      (Li et al. 2020, equation 3, divided by h²)

Everything is written by kernel launches of fixed dimensions into arrays of fixed address; nothing waits for the device, so a step can be
recorded as one CUDA graph. Only buffers of :class:`ipc.contact.collision.Collision` may grow, between recordings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ipc.arrays import filled
from ipc.bodies.layout import Layout
from ipc.contact.collision import Collision
from ipc.reduce import BLOCK, MAX, MIN, SUM, Reducer
from ipc.settings import Settings
from ipc.solver import dilation, dynamics, elasticity, frames, reuse
from ipc.solver.halves import copy_half, fold_rows
from ipc.solver.linear import SystemView, find_volume_motions, push_blocks, push_rows, slice_rows, turn_rows

_SLICE = 32
"""Rows of the matrix that lie interleaved on CUDA: as many as threads run in step."""
_MANY_FOLLOWERS = 64
"""Vertices of a node from which on a block of threads sums their contact forces."""


class Potential:
    """State and work space of a batch, and the launches that evaluate them.

    Args:
        layout: bodies of the world.
        settings: of the solver.
        batch: number of environments B.
        d_hat: distance below which surfaces repel [m].
        kappa: stiffness of the barrier [Pa].
        device: that holds all arrays.
    """

    def __init__(self, layout: Layout, settings: Settings, batch: int, d_hat: float, kappa: float, device: wp.Device) -> None:
        self.layout, self.settings, self.batch, self.device = layout, settings, batch, device
        nodes, verts, elements = len(layout.node_rest), int(layout.vert_start[-1]), len(layout.tets)
        count = len(layout.frame_names)

        def ints(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.int32, device=device)

        def floats(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.float64, device=device)

        def vectors(n: int) -> wp.array:
            return wp.zeros((batch, n), dtype=wp.vec3d, device=device)

        def matrices(n: int) -> wp.array:
            return wp.zeros((batch, n), dtype=wp.mat33d, device=device)

        def numbers(*shape: int) -> wp.array:
            return wp.zeros(shape or batch, dtype=wp.float64, device=device)

        self.collision = Collision(layout, batch, d_hat, d_hat, settings.deterministic, device, settings.broad_phase)
        self.reduce = Reducer(batch, max(nodes, verts, elements), device)
        self.reduce.prepare(nodes, verts, elements)
        self.elements = filled(elasticity.Elements, device, {name: getattr(layout, name) for name in elasticity.Elements.vars})
        volumes = {name: getattr(layout, name) for name in dilation.VolumeBlocks.vars if name != "corner_place"}
        volumes["corner_place"] = dilation.corner_places(layout)
        self.volumes = filled(dilation.VolumeBlocks, device, volumes)
        self.node_body, self.node_free = ints(layout.node_body), ints(layout.node_free)
        rows = np.repeat(np.arange(nodes, dtype=np.int64), np.diff(layout.row_start))
        diagonal = np.flatnonzero(rows == layout.col).astype(np.int32)
        self.dt = wp.full(batch, settings.dt, dtype=wp.float64, device=device)
        drag = np.zeros(len(layout.col))
        drag[diagonal] = layout.node_damping
        massive = np.flatnonzero(layout.mass)
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows[massive], minlength=nodes))])
        pattern = {"row_start": starts, "block": massive, "col": layout.col, "mass": layout.mass}
        inertia = layout.mass * (1.0 + layout.node_drive[rows])
        self.masses = filled(dynamics.Masses, device, {**pattern, "inertia": inertia, "drag": drag})
        self.drive = [floats(layout.node_drive), ints(layout.node_aim), wp.array(layout.aim_local, dtype=wp.vec3d, device=device)]
        self.driven = bool((layout.node_aim >= 0).any())
        self.grips = len(layout.grip_node)
        self.grip = [
            *(ints(layout.grip_node), ints(layout.grip_frame)),
            *(wp.array(layout.grip_local, dtype=wp.vec3d, device=device), self.node_body),
        ]
        self.frame_moves = ints(layout.frame_moves)
        self.part_start, self.part = ints(layout.part_start), ints(layout.part)
        self.corner_start, self.corner = ints(layout.corner_start), ints(layout.corner)
        followed = {name: getattr(layout, f"vert_{name}") for name in ("body", "count", "nodes", "weight", "local")}
        followers = {f"follower{name}": getattr(layout, f"node_vert{name}") for name in ("_start", "", "_weight")}
        self.verts = filled(frames.VertexMap, device, followed | followers)
        many, place = np.flatnonzero(np.diff(layout.node_vert_start) >= _MANY_FOLLOWERS), np.full(nodes, -1)
        place[many] = np.arange(len(many))
        self.summed_nodes, self.summed_place = ints(many), ints(place)
        self.summed_gradient = numbers(batch, 3 * len(many))

        # State: node positions in their bodies' frames, world velocities, frames as they are, and their goals.
        self.y, self.v = vectors(nodes), vectors(nodes)
        self.frame_q, self.goal_q, self.now_q = (wp.zeros((batch, count), dtype=wp.quatd, device=device) for _ in range(3))
        self.frame_p, self.goal_p = vectors(count), vectors(count)
        self.R, self.R1, self.t, self.t1 = matrices(count), matrices(count), vectors(count), vectors(count)
        self.kappa = wp.full(batch, kappa, dtype=wp.float64, device=device)
        self.acceleration = wp.full(batch, wp.vec3d(*settings.gravity), dtype=wp.vec3d, device=device)

        # Work space: x are vertices in the world; names with a 1 belong to the state that is tried.
        self.x, self.x1, self.dx, self.x_start, self.vert_gradient = (vectors(verts) for _ in range(5))
        self.y_start, self.y1, self.p, self.lift = (vectors(nodes) for _ in range(4))
        self.gradient, self.residual, self.right_side = (vectors(nodes) for _ in range(3))
        self.xw, self.xw1, self.target, self.local_target, self.local_start = (vectors(nodes) for _ in range(5))
        self.el_F, self.el_P = matrices(elements), matrices(elements)
        self.el_mckl = wp.zeros((batch, elements), dtype=wp.vec4d, device=device)
        self.el_J, self.el_energy, self.el_change, self.el_J1, self.el_dJ = (numbers(batch, elements) for _ in range(5))
        blocks, pairs = len(layout.block_volume), len(layout.pair_node)
        self.volume_blocks = blocks
        self.dilation = numbers(batch, blocks)
        self.node_change, self.force_size, self.vert_size = numbers(batch, nodes), numbers(batch, nodes), numbers(batch, verts)
        self.reach, self.barrier, self.elastic_energy, self.kinetic = (numbers() for _ in range(4))
        self.collision.measure_from(self.x_start, self.y_start, (self.frame_q, self.frame_p), (self.goal_q, self.goal_p))
        self.last = wp.zeros(batch, dtype=wp.float64, device=device)  # size of the Newton step before [m]
        self.project = wp.zeros(batch, dtype=wp.int32, device=device)
        self.everyone = wp.full(batch, 1, dtype=wp.int32, device=device)

        width = _SLICE if device.is_cuda else 1
        base, self.where = slice_rows(layout.row_start, width)
        columns = np.zeros(int(self.where.max()) + 1, np.int32)
        columns[self.where] = layout.col
        above = np.flatnonzero(layout.col >= rows)
        mirror = np.searchsorted(rows * nodes + layout.col, layout.col[above].astype(np.int64) * nodes + rows[above])
        self.upper = ints(np.stack([above, self.where[above], self.where[mirror]], axis=1))
        self.places = ints(_element_places(layout, rows, self.where))
        rows_at = {"row_base": base, "row_length": np.diff(layout.row_start)}
        rows_at |= {name: getattr(layout, name) for name in ("block_pair_start", "pair_block", "pair_node")}
        rows_at |= {name: getattr(layout, name) for name in ("node_pair_start", "node_pair")}
        self.system = filled(SystemView, device, {**rows_at, "col": columns, "diagonal": self.where[diagonal]})
        self.system.volume_row, self.system.volume_motion = vectors(pairs), numbers(batch, blocks)
        self.system.stride, self.system.free = width, self.node_free
        self.system.verts = self.verts
        self.system.blocks = matrices(len(columns))
        self.system.R = self.R
        self.system.project = self.project
        self.mirrors = True
        self._filled: Any = None
        """Mask of :mod:`ipc.solver.reuse`."""

    def launch(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list | None = None) -> None:
        """Launch a kernel on the device of the batch."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs or [], device=self.device)

    @property
    def friction_eps(self) -> float:
        """ε [m]."""
        return self.settings.friction_slip

    # --- places ----------------------------------------------------------------------------------------------------------------

    def set_frames(self, progress: wp.array, R: wp.array, t: wp.array) -> None:
        """Frames at a share ``progress`` (B,) of their motion in this step."""
        inputs = [self.frame_q, self.frame_p, self.goal_q, self.goal_p, progress]
        self.launch(frames.frames_at, self.frame_q.shape, inputs, [R, t, self.now_q])

    def place_grips(self, y: wp.array, R: wp.array, t: wp.array) -> None:
        """Move the gripped nodes to their places in their frames."""
        if self.grips:
            self.launch(frames.place_grips, (self.batch, self.grips), [*self.grip, R, t], [y])

    def place_vertices(self, y: wp.array, R: wp.array, t: wp.array, x: wp.array) -> None:
        """World positions of the vertices."""
        self.launch(frames.vertex_positions, x.shape, [y, R, t, self.verts], [x])

    def place_nodes(self, out: wp.array) -> None:
        """World positions of the nodes."""
        self.launch(frames.node_world, out.shape, [self.y, self.R, self.t, self.node_body], [out])

    def aim_inertia(self, R: wp.array, t: wp.array) -> None:
        """Inertia's target and the start of the step, in the given frames."""
        inputs = [self.target, self.xw, R, t, self.node_body]
        self.launch(dynamics.inertia_target, self.xw.shape, inputs, [self.local_target, self.local_start])

    def aim(self) -> None:
        """x̃ from the start of the step."""
        self.launch(dynamics.predict, self.xw.shape, [self.xw, self.v, self.acceleration, self.dt], [self.target])
        if self.driven:
            self.launch(dynamics.aim_bodies, self.xw.shape, [self.goal_q, self.goal_p, *self.drive], [self.target])

    def prescribe(self, progress: wp.array) -> None:
        """Prescribed motion to ``progress`` (B,): ``dx``, ``lift`` of gripped nodes, inertia."""
        self.set_frames(progress, self.R1, self.t1)
        if self.grips:
            wp.copy(self.y1, self.y)
            self.place_grips(self.y1, self.R1, self.t1)
            self.launch(frames.lift_grips, (self.batch, self.grips), [self.grip[0], self.y, self.y1], [self.lift])
        self.place_vertices(self.y1 if self.grips else self.y, self.R1, self.t1, self.x1)
        self.launch(dynamics.difference, self.x.shape, [self.x1, self.x], [self.dx])
        self.aim_inertia(self.R1, self.t1)

    def push_prescribed(self, mask: wp.array) -> None:
        """Residual −= H times the prescribed motion, which pushes the unknowns ahead."""
        contacts = self.collision.contacts
        lanes = self.collision.lanes
        self.launch(push_rows, (self.batch, lanes), [self.system, contacts, self.dx, mask, lanes], [self.residual])
        if self.grips:
            if self.volume_blocks:
                self.launch(find_volume_motions, self.dilation.shape, [self.system, self.lift, mask])
            self.launch(push_blocks, self.y.shape, [self.system, self.lift, mask], [self.residual])

    # --- value, gradient, Hessian ----------------------------------------------------------------------------------------------

    def evaluate_elements(self, active: wp.array) -> None:
        """F, stress, energy and Hessian factors of the elements at y."""
        if self.volume_blocks:
            self.launch(dilation.element_dilation, self.el_J.shape, [self.y, self.elements, active], [self.el_J])
            inputs = [self.elements, self.volumes, self.el_J, active]
            self.launch(dilation.mean_dilation, self.dilation.shape, inputs, [self.dilation])
        inputs = [self.y, self.elements, self.dilation, active, self.project]
        outputs = [self.el_F, self.el_P, self.el_mckl, self.el_J, self.el_energy]
        self.launch(elasticity.element_state, self.el_J.shape, inputs, outputs)

    def touch(self, active: wp.array) -> None:
        """Contacts at x, with forces and rows of the barrier."""
        self.collision.touch(self.x, self.R, self.t, self.kappa, active, self.vert_gradient, self.barrier)

    def add_friction(self, active: wp.array) -> None:
        """Friction's forces and rows, once after each :meth:`touch`."""
        self.collision.add_friction(self.x, self.x_start, self.friction_eps, self.last, active, self.vert_gradient)

    def assemble(self, active: wp.array, *, touched: bool = False) -> None:
        """Forces, contacts and energies at y; ``residual`` is −``gradient`` on the unknowns.

        ``touched``: :meth:`touch` was called at this y.
        """
        self.evaluate_elements(active)
        inputs = [self.corner_start, self.corner, self.elements, self.el_P, active]
        self.launch(elasticity.node_elastic_gradient, self.y.shape, inputs, [self.gradient])
        if not touched:
            self.touch(active)
        self.add_friction(active)
        if len(self.summed_nodes):
            threads = BLOCK if self.device.is_cuda else 1
            inputs, outputs = [self.vert_gradient, self.verts, self.summed_nodes, active, threads], [self.summed_gradient]
            dim = (self.batch, len(self.summed_nodes), threads)
            wp.launch(dynamics.sum_followers, dim, inputs, outputs, device=self.device, block_dim=BLOCK)
        inputs = [
            *(self.y, self.local_target, self.local_start, self.masses, self.dt, self.vert_gradient),
            *(self.summed_place, self.summed_gradient, self.R, self.node_body, self.node_free, self.verts, active),
        ]
        self.launch(dynamics.node_gradient, self.y.shape, inputs, [self.gradient, self.residual, self.force_size])

    def fill_matrix(self, active: wp.array) -> None:
        """Inertia and elasticity, from results of :meth:`evaluate_elements`."""
        blocks, dim = self.system.blocks, (self.batch, len(self.upper))
        if self.device.is_cuda:
            inputs = [
                *(self.upper, self.part_start, self.part, self.elements, self.masses, self.dt),
                *(self.el_F, self.el_mckl, active),
            ]
            self.launch(elasticity.block_hessian, dim, inputs, [blocks])
        else:
            if self._filled is not None:
                inputs = [self.el_F, self.project, active]
                self.launch(reuse.choose_stale, self.batch, inputs, [self._filled_F, self._filled, self._stale])
            self._fill_elements(active if self._filled is None else self._stale, blocks)
        if self.volume_blocks:
            inputs, row = [self.elements, self.volumes, self.el_F, active], self.system.volume_row
            if self.device.is_cuda:
                self.launch(dilation.dilation_rows, row.shape, inputs, [row])
            else:
                inputs = [*inputs, self.system.block_pair_start]
                self.launch(dilation.block_dilation_rows, self.dilation.shape, inputs, [row])

    def _fill_elements(self, active: wp.array, blocks: wp.array) -> None:
        dim = self.batch, len(self.upper)
        self.launch(elasticity.fill_inertia, dim, [self.upper, self.masses, self.dt, active], [blocks])
        inputs = [self.places, self.elements, self.el_F, self.el_mckl, active]
        self.launch(elasticity.add_element_blocks, self.el_J.shape, inputs, [blocks])
        if self.mirrors:
            self.launch(elasticity.mirror_blocks, dim, [self.upper, active], [blocks])

    def forget_matrix(self) -> None:
        """Let the next :meth:`fill_matrix` compute all blocks."""
        if self._filled is not None:
            self._filled.fill_(reuse.NONE)

    def turn_rows(self, active: wp.array) -> None:
        """Write the contact rows of :meth:`touch` over the unknowns."""
        lanes = self.collision.lanes
        self.launch(turn_rows, (self.batch, lanes), [self.system, self.collision.contacts, active, lanes])

    def use_halves(self) -> None:
        """Let products take the blocks above the diagonal twice (:mod:`ipc.solver.halves`).

        Contact rows are added to the blocks then, and blocks that nobody reads are left out.
        """
        layout, where = self.layout, self.where
        rows = np.repeat(np.arange(len(layout.node_rest), dtype=np.int64), np.diff(layout.row_start))
        unknown = (layout.node_free[rows] != 0) & (layout.node_free[layout.col] != 0)
        above = np.flatnonzero(unknown & (layout.col > rows))
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows[above], minlength=len(layout.node_rest)))])
        self.system.above, self.system.above_start = (
            wp.array(values, dtype=wp.int32, device=self.device) for values in (where[above], starts)
        )
        system, pairs = self.system, self.system.volume_row.shape[1]
        system.half_rows, system.half_diagonal, system.half_volume = (
            wp.zeros((self.batch, size), dtype=wp.vec4d, device=self.device)
            for size in (3 * len(above), 3 * len(layout.node_rest), pairs)
        )
        # Gripped nodes push the unknowns with whole rows, and affine bodies are eliminated by whole blocks.
        self.mirrors = self.grips > 0 or bool((layout.vert_count > 1).any())
        if not self.mirrors:
            upper = self.upper.numpy()
            self.upper = wp.array(upper[unknown[upper[:, 0]]], dtype=wp.int32, device=self.device)
            places = _element_places(layout, rows, where, unknown)
            self.places = wp.array(places, dtype=wp.int32, device=self.device)
            self._filled_F = wp.zeros_like(self.el_F)
            self._filled, self._stale = (wp.full(self.batch, reuse.NONE, dtype=wp.int32, device=self.device) for _ in range(2))

    def fold_rows(self, active: wp.array) -> None:
        """Copy half of the matrix and add the rows of :meth:`turn_rows`, if halves are used."""
        if self.system.above_start is not None:
            size = max(len(self.system.free), self.system.half_volume.shape[1])
            self.launch(copy_half, (self.batch, size), [self.system, active])
            self.launch(fold_rows, (self.batch,), [self.system, self.collision.contacts, active])

    def try_step(self, alpha: wp.array) -> None:
        """y1 = y + alpha p and its vertices, in the frames as they are."""
        self.launch(dynamics.advance_nodes, self.y.shape, [self.y, self.p, alpha, self.y1])
        self.place_vertices(self.y1, self.R, self.t, self.x1)

    def elastic_change(self, active: wp.array, min_det: wp.array) -> None:
        """Elastic energy change from y to y1, and ``min_det`` (B,) ← min(min_det, det F at y1).

        After :meth:`evaluate_elements` at y.
        """
        inputs, outputs = [self.el_F, self.y1, self.elements, active], [self.el_change, self.el_J1, self.el_dJ]
        self.launch(elasticity.element_energy_change, self.el_change.shape, inputs, outputs)
        if self.volume_blocks:
            inputs = [self.elements, self.volumes, self.el_J1, self.el_dJ, active]
            self.launch(dilation.block_energy_change, self.dilation.shape, inputs, [self.el_change])
        self.reduce(self.el_J1, active, MIN, min_det)

    def change(self, active: wp.array, change: wp.array, min_det: wp.array) -> None:
        """``change`` (B,) becomes E(y1) − E(y) [J], summed from differences."""
        change.zero_()
        self.elastic_change(active, min_det)
        self.reduce(self.el_change, active, SUM, change)
        inputs = [self.y, self.y1, self.local_target, self.local_start, self.masses, self.dt, active]
        self.launch(dynamics.inertia_change, self.y.shape, inputs, [self.node_change])
        self.reduce(self.node_change, active, SUM, change)
        placed = self.R, self.t
        self.collision.energy_change(self.x, self.x1, self.x_start, *placed, self.kappa, self.friction_eps, active, change)

    def slope(self, active: wp.array, slope: wp.array, noise: wp.array) -> None:
        """``slope`` (B,) ← g·p [J]; ``noise`` (B,) ← Σ ‖force‖ [N], for rounding of energies."""
        slope.zero_()
        noise.zero_()
        self.launch(dynamics.slope_of, self.p.shape, [self.p, self.gradient], [self.node_change])
        self.reduce(self.node_change, active, SUM, slope)
        self.reduce(self.force_size, active, SUM, noise)

    def size_of_step(self, active: wp.array, size: wp.array) -> None:
        """``size`` (B,) of ``active`` ← largest ‖p‖ of a node [m].

        Above 1e100 where p is not finite.
        """
        self.launch(dynamics.clear, (self.batch,), [active], [size])
        self.launch(dynamics.lengths, self.p.shape, [self.p, self.residual], [self.node_change])
        self.reduce(self.node_change, active, MAX, size)

    def measure_reach(self) -> None:
        """``reach`` (B,) ← largest distance of a vertex from the origin [m]."""
        self.reach.zero_()
        self.launch(dynamics.lengths, self.x.shape, [self.x, self.x], [self.vert_size])
        self.reduce(self.vert_size, self.everyone, MAX, self.reach)

    def energies(self) -> None:
        """Elastic and kinetic energies (B,) [J]."""
        self.elastic_energy.zero_()
        self.kinetic.zero_()
        self.reduce(self.el_energy, self.everyone, SUM, self.elastic_energy)
        self.launch(dynamics.kinetic_energy, self.v.shape, [self.v, self.masses], [self.node_change])
        self.reduce(self.node_change, self.everyone, SUM, self.kinetic)


def _element_places(layout: Layout, rows: np.ndarray, where: np.ndarray, used: np.ndarray | None = None) -> np.ndarray:
    """Places (E, 10) of the elements' blocks as in ``elasticity.add_element_blocks``.

    Args:
        rows: row of each block of the matrix (K,).
        where: place of each block (K,).
        used: False for blocks that are left out (K,); None for none.
    """
    blocks = np.empty(16 * len(layout.tets), np.int64)
    blocks[layout.part] = np.repeat(np.arange(len(layout.col)), np.diff(layout.part_start))
    blocks = blocks.reshape(-1, 16)
    ab = np.array(elasticity.PAIRS)
    straight, turned = blocks[:, ab], blocks[:, 4 * (ab % 4) + ab // 4]
    places = np.where(rows[straight] <= layout.col[straight], where[straight], -1 - where[turned])
    return places if used is None else np.where(used[straight], places, elasticity.UNUSED)
