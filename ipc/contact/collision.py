"""Contact of a batch: candidate lists, forces and rows, friction, and limits of steps.

Nothing here waits for the device: launches cover the buffers, counts are read by the kernels, and what did not fit raises the flag
``overflow``. The caller then discards its work, calls ``grow`` and repeats it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ipc.arrays import filled
from ipc.blocks import THREADS
from ipc.bodies.layout import Layout
from ipc.broad_phase import lists
from ipc.broad_phase.trees import Trees, trees_pay
from ipc.contact import ccd, contacts, friction, normal
from ipc.contact.reach import NEAR, Reach
from ipc.reduce import SUM, Reducer

_GROW = 2


class Collision:
    """Contact buffers of a batch of environments; every buffer grows when it is too small.

    Args:
        layout: bodies of the world.
        batch: number of environments B.
        d_hat: distance below which surfaces repel [m].
        margin: widening of the vertices' boxes [m].
        deterministic: sort the lists, and add up in their order.
        device: that holds all buffers.
        broad_phase: search for pairs, as in :class:`ipc.settings.Settings`.
    """

    def __init__(
        self,
        layout: Layout,
        batch: int,
        d_hat: float,
        margin: float,
        deterministic: bool,
        device: wp.Device,
        broad_phase: str = "auto",
    ) -> None:
        self.batch, self.device, self.margin, self.d_hat = batch, device, margin, d_hat
        # Threads that share the pairs of an environment. One alone adds forces up in the order of the lists.
        self.lanes = max(32, min(1024, 2**18 // batch)) if device.is_cuda and not deterministic else 1
        # The same where nothing is added up. Most pairs are far apart and cost little more than a thread that has none.
        self._pair_threads = max(256, 2**18 // batch) if device.is_cuda else 1
        self._block = THREADS if device.is_cuda else 1
        self._sort = deterministic and device.is_cuda
        pairs = [(index, int(a), int(b)) for index, (a, b) in enumerate(layout.pairs)]
        mesh_pairs = [pair for pair in pairs if not layout.half_space[pair[2]]]
        self._meshes = len(mesh_pairs) > 0
        self._make_surface(layout, [pair for pair in pairs if layout.half_space[pair[2]]])
        by_trees = broad_phase == "bvh" or (broad_phase == "auto" and trees_pay(layout, mesh_pairs, device.is_cuda))
        self._trees = Trees(layout, mesh_pairs, batch, device) if by_trees and mesh_pairs else None
        self._make_searches(layout, mesh_pairs if self._trees is None else [])
        self._make_boxes(layout)
        self.candidates = lists.Candidates()
        self.candidates.pt_count, self.candidates.ee_count = self._zeros((batch,), wp.int32), self._zeros((batch,), wp.int32)
        self.candidates.moved, self.candidates.near = self._zeros((batch,), wp.float64), NEAR * d_hat
        if not device.is_cuda:
            self.candidates.near_count = self._zeros((2, batch), wp.int32)
        verts = int(layout.vert_start[-1])
        self._reach = Reach(batch, verts, d_hat, self._pair_threads, device)
        self._size_candidates(512, 1024)
        self.contacts = contacts.Contacts()
        for name in ("count", "row_count", "open_count"):
            setattr(self.contacts, name, self._zeros((batch,), wp.int32))
        self._make_friction(layout)
        self._size_contacts(256, 768)
        self.overflow = self._zeros((1,), wp.int32)
        self._any_stale = self._zeros((1,), wp.int32)
        self._change, self._change_size = self._zeros((batch, verts), wp.vec3d), self._zeros((batch, verts), wp.float64)
        self._force = self._zeros((batch, 2), wp.float64)
        self._reduce = Reducer(batch, max(1, verts), device)
        self._reduce.prepare(verts)

    # --- parts of the constructor ----------------------------------------------------------------------------------------------

    def _make_surface(self, layout: Layout, plane_pairs: list[tuple[int, int, int]]) -> None:
        """Geometry of all surfaces, and the vertices that may meet a plane.

        ``plane_pairs``: number of each body pair with a half-space, its first body and the half-space.
        """
        shapes = ("edges", "faces", "vert_area", "edge_area", "edge_rest2")
        self.surface = filled(lists.Surface, self.device, {name: getattr(layout, name) for name in shapes})
        verts = [np.arange(int(layout.vert_start[a]), int(layout.vert_start[a + 1])) for _, a, _ in plane_pairs]
        counts = [len(ids) for ids in verts]
        self.planes = sum(counts)
        self.surface.plane_vert = self._ints(verts)
        self.surface.plane_body = self._ints([np.full(n, plane) for n, (_, _, plane) in zip(counts, plane_pairs, strict=True)])
        self.surface.plane_pair = self._ints([np.full(n, index) for n, (index, _, _) in zip(counts, plane_pairs, strict=True)])
        self.surface.d_hat = self.d_hat
        self.vert_body = wp.array(layout.vert_body, dtype=wp.int32, device=self.device)
        self._vert_start = wp.array(layout.vert_start, dtype=wp.int32, device=self.device)

    def _make_searches(self, layout: Layout, mesh_pairs: list[tuple[int, int, int]]) -> None:
        """Lists of primitives, and the searches between them.

        Points are searched against triangles and edges against edges. A body pair takes six lists, or three where a body meets itself.
        A search is (edges?, list, other list, body pair, size of the first list).
        """
        kinds, members, others, numbers, starts = [], [], [], [], [0]
        ranges = (layout.vert_start, layout.edge_start, layout.face_start)

        def add_list(kind: int, body: int, other: int) -> int:
            ids = np.arange(ranges[kind][body], ranges[kind][body + 1])
            kinds.append(np.full(len(ids), kind))
            members.append(ids)
            others.append(np.full(len(ids), other))
            numbers.append(np.full(len(ids), len(starts) - 1))
            starts.append(starts[-1] + len(ids))
            return len(starts) - 2

        self._searches: list[tuple[bool, int, int, int, int]] = []
        for index, a, b in mesh_pairs:
            va, ea, fa = (add_list(kind, a, b) for kind in range(3))
            if a == b:
                self._searches += [(False, va, fa, index, len(members[va])), (True, ea, ea, index, len(members[ea]))]
                continue
            vb, eb, fb = (add_list(kind, b, a) for kind in range(3))
            self._searches += [
                (False, va, fb, index, len(members[va])),
                (False, vb, fa, index, len(members[vb])),
                (True, ea, eb, index, len(members[ea])),
            ]
        self._prim_kind, self._prim_index, self._prim_other, self._prim_list = map(self._ints, (kinds, members, others, numbers))
        self._prims = starts[-1]
        self._list_start = wp.array(np.array(starts, np.int32), dtype=wp.int32, device=self.device)
        self._list_count = self._zeros((self.batch, max(1, len(starts) - 1)), wp.int32)
        self._members = self._zeros((self.batch, max(1, starts[-1])), wp.int32)

    def _make_boxes(self, layout: Layout) -> None:
        """Boxes of vertices and bodies; empty ones, so that the first check builds a list."""
        verts, bodies = int(layout.vert_start[-1]), len(layout.names)
        self._boxes = lists.Boxes()
        self._boxes.low, self._boxes.high = (self._zeros((self.batch, verts), wp.vec3d) for _ in range(2))
        self._boxes.body_low, self._boxes.body_high = (self._zeros((self.batch, bodies), wp.vec3d) for _ in range(2))
        self._boxes.low.fill_(wp.vec3d(1.0, 1.0, 1.0))  # above ``high``
        self._stale = self._zeros((self.batch,), wp.int32)

    def _make_friction(self, layout: Layout) -> None:
        """Properties of the bodies that friction reads, and its lists without entries."""
        bodies = len(layout.names)
        self.friction: bool = bool((layout.friction > 0).any())
        self.pair_mu = wp.array(layout.friction, dtype=wp.float64, device=self.device)
        self.lagged, self._old, self.memory = friction.Lagged(), friction.Lagged(), friction.Memory()
        for pairs in (self.lagged, self._old, self.memory):
            pairs.count = self._zeros((self.batch,), wp.int32)
        self.lagged.fresh, self._old.fresh = self._zeros((self.batch,), wp.int32), self._zeros((self.batch,), wp.int32)
        self._index = friction.Index()
        framed = layout.frame_moves[:bodies] == 1
        soft = np.diff(layout.node_start) > 0
        # Slips turn with the second body of a pair, but rather with a rigid one, or else with one that has a frame.
        rank = 2 * (framed & ~soft) + (framed & soft)
        first, second = layout.pairs.T
        values = {"framed": framed, "node_start": layout.node_start, "body": np.where(rank[first] > rank[second], first, second)}
        values["vert_body"] = layout.vert_body
        self._turning = filled(friction.Turning, self.device, values)
        self._turning.turn = self._zeros((self.batch, bodies), wp.mat33d)

    def _ints(self, parts: list) -> wp.array:
        return wp.array(np.concatenate([np.zeros(0), *parts]).astype(np.int32), dtype=wp.int32, device=self.device)

    def _zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    # --- buffers ---------------------------------------------------------------------------------------------------------------

    def _size_candidates(self, pt: int, ee: int) -> None:
        """Make lists for ``pt`` pairs of point and triangle and ``ee`` pairs of edges, empty."""
        self.candidates.pt, self.candidates.ee = (self._zeros((self.batch, n), wp.vec3i) for n in (pt, ee))
        self.candidates.pt_gap, self.candidates.ee_gap = (self._zeros((self.batch, n), wp.float64) for n in (pt, ee))
        if not self.device.is_cuda:
            self.candidates.pt_near, self.candidates.ee_near = (self._zeros((self.batch, n), wp.int32) for n in (pt, ee))
        self._ordered = {n: self._zeros((self.batch, n), wp.vec3i) for n in (pt, ee) if self._sort}

    def _size_contacts(self, pairs: int, rows: int) -> None:
        """Make room for contacts of ``pairs`` and their Hessian's ``rows``; what is there is kept."""
        place = {"verts": wp.vec4i, "coef": wp.vec4d, "normal": wp.vec3d, "pair": wp.int32}
        self._resize(self.contacts, place | {"force": wp.float64, "gap": wp.float64}, pairs)
        fields = {
            "row_verts": wp.vec4i,
            "concave": wp.int32,
            "row": contacts.mat34d,
            "row_nodes": wp.vec4i,
            "node_row": contacts.mat34d,
            "row_body": wp.int32,
            "body_row": contacts.mat34d,
            "scaled_row": contacts.mat34d,
            "open_row": wp.int32,
        }
        self._resize(self.contacts, fields, rows)
        room = pairs if self.friction else 1
        for lagged in (self.lagged, self._old):  # contacts, and as many that have gone
            fields = place | {"limit": wp.float64, "slip": wp.vec3d, "guard": wp.float64, "turn": wp.mat33d, "swing": wp.vec3d}
            self._resize(lagged, fields, 2 * room)
        self._resize(self.memory, {"verts": wp.vec4i, "pair": wp.int32, "slip": wp.vec3d}, room)
        self._resize(self._index, {"first": wp.int32, "next": wp.int32}, 2 * room)

    def _resize(self, struct: Any, fields: dict[str, Any], room: int) -> None:
        """Give arrays of a struct another second dimension; what they hold is kept."""
        for name, dtype in fields.items():
            new = self._zeros((self.batch, room), dtype)
            before = getattr(struct, name)
            if before is not None:
                values, kept = new.numpy(), min(room, before.shape[1])
                values[:, :kept] = before.numpy()[:, :kept]
                new.assign(values)
            setattr(struct, name, new)

    def grow(self) -> None:
        """Make room for twice what did not fit; new lists are made at the next check."""
        counts = (self.candidates.pt_count, self.candidates.ee_count, self.contacts.count, self.contacts.row_count)
        buffers = (self.candidates.pt, self.candidates.ee, self.contacts.force, self.contacts.row)
        needed = [int(count.numpy().max()) for count in counts]
        room = [values.shape[1] for values in buffers]
        pt, ee, pairs, rows = (_GROW * need if need > size else size for size, need in zip(room, needed, strict=True))
        if [pt, ee] != room[:2]:
            self._size_candidates(pt, ee)
            self.forget(np.ones(self.batch, bool))
        if [pairs, rows] != room[2:]:
            self._size_contacts(pairs, rows)
        self.overflow.zero_()

    # --- broad phase -----------------------------------------------------------------------------------------------------------

    def forget(self, envs: np.ndarray) -> None:
        """Drop the lists of the environments of the mask (B,): their vertices were moved by hand."""
        low = self._boxes.low.numpy()
        low[envs] = np.inf
        self._boxes.low.assign(low)

    def refresh(self, x: wp.array, dx: wp.array, active: wp.array) -> None:
        """Make the candidates valid for all positions from x to x + dx (B, V), or set ``overflow``."""
        if not self._meshes:
            return
        self._stale.zero_()
        self._any_stale.zero_()
        self._launch(lists.leaves_box, x.shape, [x, dx, self._boxes, active], [self._stale, self._any_stale])
        wp.capture_if(self._any_stale, on_true=self._rebuild, x=x, dx=dx)
        self._reach.update(x, dx, self.surface, self.candidates, self._stale, active)

    def _rebuild(self, x: wp.array, dx: wp.array) -> None:
        """New boxes and lists for the stale environments."""
        boxes, stale, candidates = self._boxes, self._stale, self.candidates
        self._launch(lists.clear_body_boxes, boxes.body_low.shape, [stale], [boxes])
        self._launch(lists.fill_boxes, x.shape, [x, dx, self.margin, self.vert_body, stale], [boxes])
        self._launch(lists.reset_lists, self.batch, [stale], [self._list_count, candidates])
        if self._trees is None:
            self._search_lists()
        else:
            self._trees.find(boxes, self.surface, self.vert_body, stale, candidates)
        if self._sort:
            for items, count in ((candidates.pt, candidates.pt_count), (candidates.ee, candidates.ee_count)):
                ordered = self._ordered[items.shape[1]]
                self._launch(lists.rank_candidates, items.shape, [items, count, stale], [ordered])
                self._launch(lists.put_back, items.shape, [ordered, count, stale], [items])
        self._launch(lists.check_candidates, self.batch, [candidates], [self.overflow])

    def _search_lists(self) -> None:
        """Search all against all, among the primitives that reach the other body."""
        prims = [self._prim_kind, self._prim_index, self._prim_other, self._prim_list]
        inputs = [self._boxes, self.surface, *prims, self._list_start, self._stale]
        self._launch(lists.select_prims, (self.batch, self._prims), inputs, [self._list_count, self._members])
        common = [self._boxes, self.surface, self._members, self._list_start, self._list_count]
        for *search, size in self._searches:
            self._launch(lists.find_pairs, (self.batch, size), [*common, *search, self._stale], [self.candidates])

    # --- contact ---------------------------------------------------------------------------------------------------------------

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _each(self, kernel: Any, inputs: list, outputs: list) -> None:
        """Launch a kernel whose threads go over the lists of an environment together."""
        self._launch(kernel, (self.batch, self.lanes), [*inputs, self.lanes], outputs)

    def touch(
        self, x: wp.array, R: wp.array, t: wp.array, kappa: wp.array, active: wp.array, gradient: wp.array, energy: wp.array
    ) -> None:
        """Contacts at x with the barrier's rows; sets ``overflow`` if they do not fit.

        Args:
            x: vertices [m], (B, V).
            R, t: rotations and positions of frames (B, frames).
            kappa: stiffness of the barrier (B,).
            active: mask (B,).
            gradient, energy: become the gradient (B, V) [N] and the energy of the barrier (B,) [J].
        """
        outputs = [gradient, energy, self.contacts]
        self._launch(contacts.clear, x.shape, [active], outputs)
        if self._meshes:
            for ee in (False, True):
                self._each(normal.contact_pairs, [x, self.surface, self.candidates, ee, kappa, active], outputs)
        if self.planes:
            self._each(normal.contact_plane, [x, self.surface, R, t, kappa, active], outputs)
        self._launch(contacts.check_contacts, self.batch, [self.contacts], [self.overflow])

    def add_friction(
        self, x: wp.array, start: wp.array, friction_eps: float, last: wp.array, active: wp.array, gradient: wp.array
    ) -> None:
        """Add friction's forces and rows to those of :meth:`touch`; may set ``overflow``.

        Args:
            x, start: vertices now and at the start of the step [m], (B, V).
            friction_eps: ε, the slip at which friction yields [m].
            last: slip below which rows of friction have the majoriser's curvature alone [m], (B,).
            active, gradient: as of :meth:`touch`.
        """
        if self.friction:
            self._each(friction.friction_rows, [x, start, self.lagged, friction_eps, last, active], [gradient, self.contacts])
            self._launch(contacts.check_contacts, self.batch, [self.contacts], [self.overflow])

    def energy_change(
        self,
        x0: wp.array,
        x1: wp.array,
        start: wp.array,
        R: wp.array,
        t: wp.array,
        kappa: wp.array,
        friction_eps: float,
        active: wp.array,
        change: wp.array,
    ) -> None:
        """Add the change of barrier and friction energy from x0 to x1 to ``change`` (B,) [J]."""
        if self._meshes:
            for ee in (False, True):
                self._each(normal.energy_pairs, [x0, x1, self.surface, self.candidates, ee, kappa, active], [change])
        if self.planes:
            self._each(normal.energy_plane, [x0, x1, self.surface, R, t, kappa, active], [change])
        if self.friction:
            self._each(friction.friction_change, [x0, x1, start, self.lagged, friction_eps, active], [change])

    def limit_step(
        self,
        x: wp.array,
        dx: wp.array,
        frames0: tuple[wp.array, wp.array],
        frames1: tuple[wp.array, wp.array],
        slack: wp.array,
        floor: wp.array,
        reach: wp.array,
        active: wp.array,
        alpha: wp.array,
    ) -> None:
        """Lower ``alpha`` (B,) to the share of dx that leaves ``slack`` of every distance.

        No distance falls below ``floor`` (B,) [m] either. ``reach`` (B,) is the largest coordinate [m]: no step ends with distances
        that rounding could close.
        """
        if self._meshes:
            for ee, items in ((False, self.candidates.pt), (True, self.candidates.ee)):
                threads = min(items.shape[1], self._pair_threads)
                inputs = [x, dx, self.surface, self.candidates, ee, slack, floor, reach, active, threads]
                self._launch(ccd.ccd_pairs, (self.batch, threads), inputs, [alpha])
        if self.planes:
            inputs = [x, dx, self.surface, *frames0, *frames1, slack, floor, reach, active]
            self._launch(ccd.ccd_plane, (self.batch, self.planes), inputs, [alpha])

    # --- friction --------------------------------------------------------------------------------------------------------------

    def measure_from(self, x: wp.array, y: wp.array, frames: tuple[wp.array, wp.array], goals: tuple[wp.array, wp.array]) -> None:
        """Say where the start of a step is kept, and the frames' goals.

        Vertices are (B, V), nodes (B, N), rotations and positions of frames (B, frames).
        """
        turning = self._turning
        turning.x, turning.y, (turning.frame_q, turning.frame_p), (turning.goal_q, turning.goal_p) = x, y, frames, goals

    def lag(self, relags: wp.array, active: wp.array, changes: tuple[wp.array, wp.array, wp.array], guarded: bool) -> None:
        """Freeze active contacts for friction.

        Args:
            relags: −1 at the start of a step (B,).
            active: mask (B,).
            changes: become the relative changes of the limits μ λ n at all vertices, at those of the body where it is largest, and of
                their sum, (B,) each.
            guarded: True where :meth:`guard_slips` is called after Newton steps.
        """
        changed, worst_changed, sum_changed = changes
        self._launch(friction.turns_ahead, self._turning.turn.shape, [self._turning, active], [self._turning.turn])
        limits, vertices = self.lagged.limit.shape, self._change.shape
        self._launch(friction.keep_lagged, limits, [self.lagged, active], [self._old])
        self._fill_index(self.memory, active)
        inputs = [self._turning, self.contacts, self.memory, self._index, self.pair_mu, self.d_hat, relags, active]
        self._launch(friction.lag_contacts, limits, inputs, [self.lagged])
        if guarded:
            self._fill_index(self._old, active)
            self._launch(friction.carry_guards, limits, [self._old, self._index, relags, active], [self.lagged])
        self._launch(friction.clear_change, vertices, [active], [self._change, self._force, changed, worst_changed])
        for lagged, sign in ((self.lagged, 1.0), (self._old, -1.0)):
            self._each(friction.lag_difference, [lagged, sign, active], [self._change, self._force])
        self._launch(friction.size_of_change, vertices, [self._change, active], [self._change_size])
        self._reduce(self._change_size, active, SUM, changed)
        self._launch(friction.share_of_change, self.batch, [self._force, active], [changed, sum_changed])
        inputs = [self.lagged, self._change_size, self._vert_start, self.vert_body, active, self._block]
        dim = (self.batch, len(self._vert_start) - 1, self._block)
        wp.launch(friction.worst_share, dim, inputs, [worst_changed], device=self.device, block_dim=self._block)

    def guard_slips(self, x: wp.array, dx: wp.array, start: wp.array, active: wp.array, halt: wp.array) -> None:
        """Choose the curvature of friction after a Newton step dx from x (B, V), in the mask (B,).

        Nothing changes while ``halt`` (1,) is set.
        """
        inputs = [x, dx, start, active, halt, self.lanes]
        self._launch(friction.guard_slips, (self.batch, self.lanes), inputs, [self.lagged])

    def undo_lag(self, active: wp.array) -> None:
        """Put back the friction from before the last :meth:`lag`, in the mask (B,)."""
        self._launch(friction.keep_lagged, self.lagged.limit.shape, [self._old, active], [self.lagged])

    def average(self, share: wp.array, active: wp.array) -> None:
        """Let a ``share`` (B,) of the limits be those of the last ``lag``.

        The rest are those before it.
        """
        self._launch(friction.weigh_fresh, self.lagged.limit.shape, [share, active], [self.lagged])
        self._fill_index(self.lagged, active)
        self._each(friction.add_old, [self._old, share, self._index, active], [self.lagged])

    def remember(self, x: wp.array, y: wp.array, R: wp.array, friction_slip: float, active: wp.array) -> None:
        """Elastic slips of the contacts at the end of a step, for the next one.

        Args:
            x, y, R: vertices (B, V), nodes (B, N) and frames (B, frames) that the contacts belong to.
            friction_slip: ε [m].
            active: mask (B,).
        """
        self._launch(friction.turns, self._turning.turn.shape, [self._turning, y, R, active], [self._turning.turn])
        self._fill_index(self.lagged, active)
        inputs = [x, self._turning, self.contacts, self.lagged, self._index, friction_slip, active]
        self._launch(friction.remember, self.memory.slip.shape, inputs, [self.memory])

    def _fill_index(self, pairs: Any, active: wp.array) -> None:
        self._launch(friction.clear_index, self._index.first.shape, [active], [self._index])
        self._launch(friction.fill_index, self._index.first.shape, [pairs.verts, pairs.count, active], [self._index])

    def drop(self, envs: np.ndarray) -> None:
        """Forget the contacts, the lagged pairs and the slips of the environments of the mask (B,)."""
        for counts in (self.contacts.count, self.contacts.row_count, self.lagged.count, self.memory.count):
            count = counts.numpy()
            count[envs] = 0
            counts.assign(count)

    def slips(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and body pair that :meth:`remember` keeps, and their elastic slip [m].

        Shapes (B, C, 5), −1 where unused, and (B, C, 3).
        """
        memory = self.memory
        count = memory.count.numpy()
        used = np.arange(count.max(initial=0)) < count[:, None]
        verts, pair, slip = (a.numpy()[:, : used.shape[1]] for a in (memory.verts, memory.pair, memory.slip))
        keys = np.concatenate([verts, pair[..., None]], axis=2)
        return np.where(used[..., None], keys, -1), np.where(used[..., None], slip, 0.0)

    def set_slips(self, pairs: np.ndarray, slip: np.ndarray, envs: np.ndarray) -> bool:
        """Set what :meth:`slips` returns, in the environments of the mask (B,).

        Returns True if buffers had to grow for it.
        """
        used = pairs[..., 0] >= 0
        counts = used.sum(axis=1)
        most = int(counts[envs].max(initial=0))
        grows = most > self.memory.slip.shape[1]
        if grows:
            self._size_contacts(most, self.contacts.row.shape[1])
        memory = self.memory
        count, verts, pair, slips = (a.numpy().copy() for a in (memory.count, memory.verts, memory.pair, memory.slip))
        for env in np.flatnonzero(envs):
            n, here = counts[env], used[env]
            count[env] = n
            verts[env, :n], pair[env, :n], slips[env, :n] = pairs[env, here, :4], pairs[env, here, 4], slip[env, here]
        for target, values in ((memory.count, count), (memory.verts, verts), (memory.pair, pair), (memory.slip, slips)):
            target.assign(values)
        return grows
