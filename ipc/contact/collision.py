"""Contact of a batch: candidate lists, forces and rows, friction, and limits of steps.

Nothing here waits for the device: launches cover the buffers, counts are read by the kernels, and what did not fit raises the flag
``overflow``. The caller then discards its work, calls ``grow`` and repeats it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ipc.bodies.layout import Layout
from ipc.broad_phase import lists
from ipc.broad_phase.trees import Trees, trees_pay
from ipc.contact import ccd, contacts, friction, normal
from ipc.reduce import SUM, Reducer

__all__ = ["Collision"]

_GROW = 2


class Collision:
    """Contact buffers of a batch of environments; every buffer grows when it is too small.

    Args:
        layout: the flat arrays.
        batch: number of environments.
        d_hat: distance below which surfaces repel [m].
        margin: widening of the vertices' boxes [m].
        deterministic: sort the lists, and add up in their order.
        device: Warp device.
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
        self.lanes = max(32, min(1024, 2**17 // batch)) if device.is_cuda and not deterministic else 1
        self._sort = deterministic and device.is_cuda
        verts, bodies = int(layout.vert_start[-1]), len(layout.names)
        plane_vert, plane_body, plane_pair = [], [], []
        meshes = []
        for index, (a, b) in enumerate(layout.pairs):
            if layout.half_space[b]:
                ids = np.arange(int(layout.vert_start[a]), int(layout.vert_start[a + 1]))
                plane_vert.append(ids)
                plane_body.append(np.full(len(ids), b))
                plane_pair.append(np.full(len(ids), index))
            else:
                meshes.append((index, int(a), int(b)))
        self.planes = sum(len(p) for p in plane_vert)
        self.friction: bool = bool((layout.friction > 0).any())

        def ints(parts: list) -> wp.array:
            return wp.array(np.concatenate([np.zeros(0), *parts]).astype(np.int32), dtype=wp.int32, device=device)

        self.surface = lists.Surface()
        self.surface.edges = wp.array(layout.edges, dtype=wp.int32, device=device)
        self.surface.faces = wp.array(layout.faces, dtype=wp.int32, device=device)
        self.surface.vert_area = wp.array(layout.vert_area, dtype=wp.float64, device=device)
        self.surface.edge_area = wp.array(layout.edge_area, dtype=wp.float64, device=device)
        self.surface.edge_rest2 = wp.array(layout.edge_rest2, dtype=wp.float64, device=device)
        self.surface.plane_vert, self.surface.plane_body, self.surface.plane_pair = (
            ints(plane_vert),
            ints(plane_body),
            ints(plane_pair),
        )
        self.surface.d_hat = d_hat
        self.pair_mu = wp.array(layout.friction, dtype=wp.float64, device=device)
        self.vert_body = wp.array(layout.vert_body, dtype=wp.int32, device=device)

        self._meshes = len(meshes) > 0
        by_trees = broad_phase == "bvh" or (broad_phase == "auto" and trees_pay(layout, meshes, device.is_cuda))
        self._trees = Trees(layout, meshes, batch, device) if by_trees and meshes else None

        # Lists of primitives, six a body pair (three where a body meets itself): see _searches.
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

        self._searches: list[tuple[str, int, int, int, int]] = []
        for index, a, b in meshes if self._trees is None else []:
            va, ea, fa = (add_list(kind, a, b) for kind in range(3))
            if a == b:
                self._searches += [("pt", va, fa, index, len(members[va])), ("ee", ea, ea, index, len(members[ea]))]
                continue
            vb, eb, fb = (add_list(kind, b, a) for kind in range(3))
            self._searches += [
                ("pt", va, fb, index, len(members[va])),
                ("pt", vb, fa, index, len(members[vb])),
                ("ee", ea, eb, index, len(members[ea])),
            ]
        self._prim_kind, self._prim_index, self._prim_other, self._prim_list = (
            ints(kinds),
            ints(members),
            ints(others),
            ints(numbers),
        )
        self._prims = starts[-1]
        self._list_start = wp.array(np.array(starts, np.int32), dtype=wp.int32, device=device)
        self._list_count = wp.zeros((batch, max(1, len(starts) - 1)), dtype=wp.int32, device=device)
        self._members = wp.zeros((batch, max(1, starts[-1])), dtype=wp.int32, device=device)
        self._low, self._high = (wp.zeros((batch, verts), dtype=wp.vec3d, device=device) for _ in range(2))
        self._body_low, self._body_high = (wp.zeros((batch, bodies, 3), dtype=wp.float64, device=device) for _ in range(2))
        self._stale = wp.zeros(batch, dtype=wp.int32, device=device)
        self.candidates = lists.Candidates()
        self.candidates.pt_count, self.candidates.ee_count = (wp.zeros(batch, dtype=wp.int32, device=device) for _ in range(2))
        self._size_candidates(512, 1024)
        self.contacts = contacts.Contacts()
        self.contacts.count, self.contacts.row_count = (wp.zeros(batch, dtype=wp.int32, device=device) for _ in range(2))
        self.lagged, self._old = friction.Lagged(), friction.Lagged()
        self.lagged.count, self._old.count = (wp.zeros(batch, dtype=wp.int32, device=device) for _ in range(2))
        self._size_contacts(256, 768)
        self.overflow = wp.zeros(1, dtype=wp.int32, device=device)
        self._any_stale = wp.zeros(1, dtype=wp.int32, device=device)
        self._change = wp.zeros((batch, verts), dtype=wp.vec3d, device=device)
        self._change_size = wp.zeros((batch, verts), dtype=wp.float64, device=device)
        self._force = wp.zeros(batch, dtype=wp.float64, device=device)
        self._reduce = Reducer(batch, max(1, verts), device)
        self._reduce.prepare(verts)
        self._low.fill_(wp.vec3d(1.0, 1.0, 1.0))  # an empty box (low above high): the first check builds a list

    # --- buffers ---------------------------------------------------------------------------------------------------------------

    def _size_candidates(self, pt: int, ee: int) -> None:
        self.candidates.pt, self.candidates.ee = (wp.zeros((self.batch, n), dtype=wp.vec3i, device=self.device) for n in (pt, ee))
        self._ordered = {n: wp.zeros((self.batch, n), dtype=wp.vec3i, device=self.device) for n in (pt, ee) if self._sort}

    def _size_contacts(self, pairs: int, rows: int) -> None:
        for name, dtype in {
            **{"verts": wp.vec4i, "coef": wp.vec4d, "normal": wp.vec3d},
            **{"force": wp.float64, "gap": wp.float64, "pair": wp.int32},
        }.items():
            setattr(self.contacts, name, wp.zeros((self.batch, pairs), dtype=dtype, device=self.device))
        self.contacts.row_verts = wp.zeros((self.batch, rows), dtype=wp.vec4i, device=self.device)
        self.contacts.row = wp.zeros((self.batch, rows), dtype=contacts.mat34d, device=self.device)
        fields = {"verts": wp.vec4i, "coef": wp.vec4d, "normal": wp.vec3d, "limit": wp.float64, "pair": wp.int32}
        room = pairs if self.friction else 1
        for lagged in (self.lagged, self._old):
            for name, dtype in fields.items():
                new = wp.zeros((self.batch, room), dtype=dtype, device=self.device)
                before = getattr(lagged, name)
                if before is not None:
                    values = new.numpy()
                    values[:, : min(room, before.shape[1])] = before.numpy()[:, :room]
                    new.assign(values)
                setattr(lagged, name, new)

    def grow(self) -> None:
        """Make room for twice what did not fit; new lists are made at the next check."""
        counts = (self.candidates.pt_count, self.candidates.ee_count, self.contacts.count, self.contacts.row_count)
        rooms = (self.candidates.pt, self.candidates.ee, self.contacts.force, self.contacts.row)
        most = [int(c.numpy().max()) for c in counts]
        room = [r.shape[1] for r in rooms]
        pt, ee, pairs, rows = (max(r, int(_GROW * m)) if m > r else r for r, m in zip(room, most, strict=True))
        if (pt, ee) != (room[0], room[1]):
            self._size_candidates(pt, ee)
            self.forget(np.ones(self.batch, bool))
        if (pairs, rows) != (room[2], room[3]):
            self._size_contacts(pairs, rows)
        self.overflow.zero_()

    # --- broad phase -----------------------------------------------------------------------------------------------------------

    def forget(self, envs: np.ndarray) -> None:
        """Drop the lists of the environments of the mask (B,): their vertices were moved by hand."""
        low = self._low.numpy()
        low[envs] = np.inf
        self._low.assign(low)

    def refresh(self, x: wp.array, dx: wp.array, active: wp.array) -> None:
        """Make the candidates valid for all positions from x to x + dx (B, V), or set ``overflow``."""
        if not self._meshes:
            return
        self._stale.zero_()
        self._any_stale.zero_()
        inputs, outputs = [x, dx, self._low, self._high, active], [self._stale, self._any_stale]
        wp.launch(lists.leaves_box, dim=x.shape, inputs=inputs, outputs=outputs, device=self.device)
        wp.capture_if(self._any_stale, on_true=self._rebuild, x=x, dx=dx)

    def _rebuild(self, x: wp.array, dx: wp.array) -> None:
        """New boxes and lists for the stale environments."""
        device, stale = self.device, self._stale
        bodies = (self.batch, self._body_low.shape[1])
        inputs, outputs = [x, dx, self.margin, stale], [self._low, self._high]
        wp.launch(lists.vertex_boxes, dim=x.shape, inputs=inputs, outputs=outputs, device=device)
        wp.launch(lists.clear_body_boxes, dim=bodies, inputs=[stale, self._body_low, self._body_high], device=device)
        inputs, outputs = [self._low, self._high, self.vert_body, stale], [self._body_low, self._body_high]
        wp.launch(lists.body_boxes, dim=x.shape, inputs=inputs, outputs=outputs, device=device)
        wp.launch(lists.reset_lists, dim=self.batch, inputs=[stale, self._list_count, self.candidates], device=device)
        boxes = (self._low, self._high, self._body_low, self._body_high)
        if self._trees is None:
            self._search_lists(boxes, stale)
        else:
            self._trees.find(boxes, self.surface, self.vert_body, stale, self.candidates)
        if self._sort:
            for items, count in ((self.candidates.pt, self.candidates.pt_count), (self.candidates.ee, self.candidates.ee_count)):
                ordered = self._ordered[items.shape[1]]
                inputs, outputs = [items, count, stale], [ordered]
                wp.launch(lists.rank_candidates, dim=items.shape, inputs=inputs, outputs=outputs, device=device)
                wp.launch(lists.put_back, dim=items.shape, inputs=[ordered, count, stale], outputs=[items], device=device)
        wp.launch(lists.check_candidates, dim=self.batch, inputs=[self.candidates], outputs=[self.overflow], device=device)

    def _search_lists(self, boxes: tuple[wp.array, ...], stale: wp.array) -> None:
        """All against all, of the primitives that reach the other body."""
        inputs = [
            *(*boxes, self.surface),
            *(self._prim_kind, self._prim_index, self._prim_other, self._prim_list, self._list_start, stale),
        ]
        outputs = [self._list_count, self._members]
        wp.launch(lists.select_prims, dim=(self.batch, self._prims), inputs=inputs, outputs=outputs, device=self.device)
        for kind, first, second, pair, size in self._searches:
            kernel = lists.find_pt if kind == "pt" else lists.find_ee
            inputs = [
                *(*boxes[:2], self.surface, self._members, self._list_start, self._list_count),
                *(first, second, pair, stale),
            ]
            wp.launch(kernel, dim=(self.batch, size), inputs=inputs, outputs=[self.candidates], device=self.device)

    # --- contact ---------------------------------------------------------------------------------------------------------------

    def _each(self, kernel: Any, inputs: list, outputs: list) -> None:
        """Launch a kernel whose threads go over the lists of an environment together."""
        inputs = [*inputs, self.lanes]
        wp.launch(kernel, dim=(self.batch, self.lanes), inputs=inputs, outputs=outputs, device=self.device)

    def assemble(
        self,
        x: wp.array,
        start: wp.array,
        R: wp.array,
        t: wp.array,
        kappa: wp.array,
        friction_eps: float,
        active: wp.array,
        gradient: wp.array,
        energy: wp.array,
    ) -> None:
        """Contacts, rows, ``gradient`` (B, V) [N] and ``energy`` (B,) [J] of barrier and friction.

        What does not fit sets ``overflow``.
        """
        device = self.device
        wp.launch(contacts.clear, dim=x.shape, inputs=[active], outputs=[gradient, energy, self.contacts], device=device)
        outputs = [gradient, energy, self.contacts]
        if self._meshes:
            for kernel in (normal.contact_pt, normal.contact_ee):
                self._each(kernel, [x, self.surface, self.candidates, kappa, active], outputs)
        if self.planes:
            inputs = [x, self.surface, R, t, kappa, active]
            self._each(normal.contact_plane, inputs, outputs)
        if self.friction:
            inputs = [x, start, self.lagged, friction_eps, active]
            outputs = [gradient, self.contacts]
            self._each(friction.friction_rows, inputs, outputs)
        wp.launch(contacts.check_contacts, dim=self.batch, inputs=[self.contacts], outputs=[self.overflow], device=device)

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

        No distance falls below ``floor`` (B,) [m] either.

        ``reach`` (B,) is the largest coordinate [m]: no step ends with distances that rounding could close.
        """
        if self._meshes:
            for ee, items in ((False, self.candidates.pt), (True, self.candidates.ee)):
                inputs = [x, dx, self.surface, self.candidates, ee, slack, floor, reach, active]
                wp.launch(ccd.ccd_pairs, dim=items.shape, inputs=inputs, outputs=[alpha], device=self.device)
        if self.planes:
            inputs = [x, dx, self.surface, *frames0, *frames1, slack, floor, reach, active]
            wp.launch(ccd.ccd_plane, dim=(self.batch, self.planes), inputs=inputs, outputs=[alpha], device=self.device)

    # --- friction --------------------------------------------------------------------------------------------------------------

    def lag(self, active: wp.array, changed: wp.array) -> None:
        """Freeze the contacts of the active environments for friction.

        ``changed`` (B,) becomes by how much the friction limits μ λ n changed, as a share of their sum.
        """
        device, dim = self.device, self.lagged.limit.shape
        wp.launch(friction.keep_lagged, dim=dim, inputs=[self.lagged, active], outputs=[self._old], device=device)
        inputs = [self.contacts, self.pair_mu, active]
        wp.launch(friction.lag_contacts, dim=dim, inputs=inputs, outputs=[self.lagged], device=device)
        wp.launch(
            friction.clear_change,
            dim=self._change.shape,
            inputs=[active],
            outputs=[self._change, self._force, changed],
            device=device,
        )
        for lagged, sign in ((self.lagged, 1.0), (self._old, -1.0)):
            inputs, outputs = [lagged, sign, active], [self._change, self._force]
            self._each(friction.lag_difference, inputs, outputs)
        inputs, outputs = [self._change, active], [self._change_size]
        wp.launch(friction.size_of_change, dim=self._change.shape, inputs=inputs, outputs=outputs, device=device)
        self._reduce(self._change_size, active, SUM, changed)
        wp.launch(friction.share_of_change, dim=self.batch, inputs=[self._force, active], outputs=[changed], device=device)

    def drop(self, envs: np.ndarray) -> None:
        """Forget the contacts and the lagged pairs of the environments of the mask (B,)."""
        for counts in (self.contacts.count, self.contacts.row_count, self.lagged.count):
            count = counts.numpy()
            count[envs] = 0
            counts.assign(count)
