"""Everything that surfaces do to each other: candidate lists, contact forces and rows, friction, and how far a step may go."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ipc import broad, ccd, contact, friction
from ipc.layout import Layout

__all__ = ["Collision"]

_GROW = 1.5


class Collision:
    """Contact buffers of a batch of environments; every buffer grows when it is too small.

    Args:
        layout: the flat arrays.
        batch: number of environments.
        d_hat: distance below which surfaces repel [m].
        margin: widening of the vertices' boxes [m].
        device: Warp device.
    """

    def __init__(self, layout: Layout, batch: int, d_hat: float, margin: float, device: wp.Device) -> None:
        self.batch, self.device, self.margin, self.d_hat = batch, device, margin, d_hat
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

        self.surface = contact.Surface()
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

        # Lists of primitives, six a body pair (three where a body meets itself): see _searches.
        kinds, members, others, lists, starts = [], [], [], [], [0]
        ranges = (layout.vert_start, layout.edge_start, layout.face_start)

        def add_list(kind: int, body: int, other: int) -> int:
            ids = np.arange(ranges[kind][body], ranges[kind][body + 1])
            kinds.append(np.full(len(ids), kind))
            members.append(ids)
            others.append(np.full(len(ids), other))
            lists.append(np.full(len(ids), len(starts) - 1))
            starts.append(starts[-1] + len(ids))
            return len(starts) - 2

        self._searches: list[tuple[str, int, int, int, int]] = []
        for index, a, b in meshes:
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
            ints(lists),
        )
        self._prims = starts[-1]
        self._list_start = wp.array(np.array(starts, np.int32), dtype=wp.int32, device=device)
        self._list_count = wp.zeros((batch, max(1, len(starts) - 1)), dtype=wp.int32, device=device)
        self._members = wp.zeros((batch, max(1, starts[-1])), dtype=wp.int32, device=device)
        self._low, self._high = (wp.zeros((batch, verts), dtype=wp.vec3d, device=device) for _ in range(2))
        self._body_low, self._body_high = (wp.zeros((batch, bodies, 3), dtype=wp.float64, device=device) for _ in range(2))
        self._stale = wp.zeros(batch, dtype=wp.int32, device=device)
        self.candidates = contact.Candidates()
        self.candidates.pt_count, self.candidates.ee_count = (wp.zeros(batch, dtype=wp.int32, device=device) for _ in range(2))
        self._size_candidates(256, 256)
        self.contacts = contact.Contacts()
        self.contacts.count, self.contacts.row_count = (wp.zeros(batch, dtype=wp.int32, device=device) for _ in range(2))
        self._size_contacts(128, 256)
        self.lagged = friction.Lagged()
        self.lagged.count = wp.zeros(batch, dtype=wp.int32, device=device)
        self._size_lagged(self.lagged, 1)
        self._old = friction.Lagged()
        self._old.count = wp.zeros(batch, dtype=wp.int32, device=device)
        self._size_lagged(self._old, 1)
        self._lag_most = self._old_most = 0
        self.pt_most = self.ee_most = self.contact_most = self.row_most = 0
        self.rebuilds = 0
        self._force_scratch = wp.zeros((batch, verts), dtype=wp.vec3d, device=device)
        self._size_scratch = wp.zeros(batch, dtype=wp.float64, device=device)
        self._low.fill_(wp.vec3d(1.0, 1.0, 1.0))  # an empty box (low above high): the first look builds a list

    # --- buffers ---------------------------------------------------------------------------------------------------------------

    def _size_candidates(self, pt: int, ee: int) -> None:
        self.candidates.pt, self.candidates.ee = (wp.zeros((self.batch, n), dtype=wp.vec3i, device=self.device) for n in (pt, ee))
        self._pt_room, self._ee_room = pt, ee

    def _size_contacts(self, pairs: int, rows: int) -> None:
        new = {"verts": wp.vec4i, "coef": wp.vec4d, "normal": wp.vec3d, "force": wp.float64, "gap": wp.float64, "pair": wp.int32}
        for name, dtype in new.items():
            setattr(self.contacts, name, wp.zeros((self.batch, pairs), dtype=dtype, device=self.device))
        self.contacts.row_verts = wp.zeros((self.batch, rows), dtype=wp.vec4i, device=self.device)
        self.contacts.row = wp.zeros((self.batch, rows), dtype=contact.mat34d, device=self.device)
        self._pair_room, self._row_room = pairs, rows

    def _size_lagged(self, lagged: Any, pairs: int) -> None:
        for name, dtype in {
            "verts": wp.vec4i,
            "coef": wp.vec4d,
            "normal": wp.vec3d,
            "limit": wp.float64,
            "pair": wp.int32,
        }.items():
            setattr(lagged, name, wp.zeros((self.batch, pairs), dtype=dtype, device=self.device))

    # --- broad phase -----------------------------------------------------------------------------------------------------------

    def forget(self, envs: np.ndarray) -> None:
        """Drop the lists of the environments of the mask (B,): their vertices were moved by hand."""
        low = self._low.numpy()
        low[envs] = np.inf
        self._low.assign(low)

    def refresh(self, x: wp.array, dx: wp.array, active: wp.array) -> None:
        """Make the candidate lists hold for every position on the way from x to x + dx (B, V)."""
        if not self._searches:
            return
        self._stale.zero_()
        wp.launch(
            broad.leaves_box,
            dim=x.shape,
            inputs=[x, dx, self._low, self._high, active],
            outputs=[self._stale],
            device=self.device,
        )
        if not self._stale.numpy().any():
            return
        self.rebuilds += 1
        dim = (self.batch, self._body_low.shape[1])
        wp.launch(
            broad.vertex_boxes,
            dim=x.shape,
            inputs=[x, dx, self.margin, self._stale],
            outputs=[self._low, self._high],
            device=self.device,
        )
        wp.launch(broad.clear_body_boxes, dim=dim, inputs=[self._stale, self._body_low, self._body_high], device=self.device)
        wp.launch(
            broad.body_boxes,
            dim=x.shape,
            inputs=[self._low, self._high, self.vert_body, self._stale],
            outputs=[self._body_low, self._body_high],
            device=self.device,
        )
        while True:
            wp.launch(
                broad.reset_lists, dim=self.batch, inputs=[self._stale, self._list_count, self.candidates], device=self.device
            )
            wp.launch(
                broad.select_prims,
                dim=(self.batch, self._prims),
                inputs=[
                    *(self._low, self._high, self._body_low, self._body_high, self.surface),
                    *(self._prim_kind, self._prim_index, self._prim_other, self._prim_list, self._list_start, self._stale),
                ],
                outputs=[self._list_count, self._members],
                device=self.device,
            )
            for kind, first, second, pair, size in self._searches:
                wp.launch(
                    broad.find_pt if kind == "pt" else broad.find_ee,
                    dim=(self.batch, size),
                    inputs=[
                        *(self._low, self._high, self.surface, self._members, self._list_start, self._list_count),
                        *(first, second, pair, self._stale),
                    ],
                    outputs=[self.candidates],
                    device=self.device,
                )
            self.pt_most, self.ee_most = int(self.candidates.pt_count.numpy().max()), int(self.candidates.ee_count.numpy().max())
            if self.pt_most <= self._pt_room and self.ee_most <= self._ee_room:
                return
            # Lists of environments that were not stale are lost with the old buffers, so all are made again.
            self._size_candidates(max(self._pt_room, int(_GROW * self.pt_most)), max(self._ee_room, int(_GROW * self.ee_most)))
            self._stale.fill_(1)

    # --- contact ---------------------------------------------------------------------------------------------------------------

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
        """Contacts, rows, ``gradient`` (B, V) [N] and barrier ``energy`` (B,) [J] at x; lagged friction against ``start``."""
        while True:
            gradient.zero_()
            energy.zero_()
            self.contacts.count.zero_()
            self.contacts.row_count.zero_()
            outputs = [gradient, energy, self.contacts]
            for kernel, most in ((contact.contact_pt, self.pt_most), (contact.contact_ee, self.ee_most)):
                if most:
                    inputs = [x, self.surface, self.candidates, kappa, active]
                    wp.launch(kernel, dim=(self.batch, most), inputs=inputs, outputs=outputs, device=self.device)
            if self.planes:
                inputs = [x, self.surface, R, t, kappa, active]
                wp.launch(
                    contact.contact_plane, dim=(self.batch, self.planes), inputs=inputs, outputs=outputs, device=self.device
                )
            if self._lag_most:
                inputs = [x, start, self.lagged, friction_eps, active]
                dim = (self.batch, self._lag_most)
                wp.launch(friction.friction_rows, dim=dim, inputs=inputs, outputs=[gradient, self.contacts], device=self.device)
            self.contact_most, self.row_most = int(self.contacts.count.numpy().max()), int(self.contacts.row_count.numpy().max())
            if self.contact_most <= self._pair_room and self.row_most <= self._row_room:
                return
            self._size_contacts(
                max(self._pair_room, int(_GROW * self.contact_most)), max(self._row_room, int(_GROW * self.row_most))
            )

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
        for kernel, most in ((contact.energy_pt, self.pt_most), (contact.energy_ee, self.ee_most)):
            if most:
                inputs = [x0, x1, self.surface, self.candidates, kappa, active]
                wp.launch(kernel, dim=(self.batch, most), inputs=inputs, outputs=[change], device=self.device)
        if self.planes:
            inputs = [x0, x1, self.surface, R, t, kappa, active]
            wp.launch(contact.energy_plane, dim=(self.batch, self.planes), inputs=inputs, outputs=[change], device=self.device)
        if self._lag_most:
            inputs = [x0, x1, start, self.lagged, friction_eps, active]
            dim = (self.batch, self._lag_most)
            wp.launch(friction.friction_change, dim=dim, inputs=inputs, outputs=[change], device=self.device)

    def limit_step(
        self,
        x: wp.array,
        dx: wp.array,
        frames0: tuple[wp.array, wp.array],
        frames1: tuple[wp.array, wp.array],
        slack: float,
        floor: float,
        active: wp.array,
        alpha: wp.array,
    ) -> None:
        """Lower ``alpha`` (B,) to the share of dx at which some distance falls to ``slack`` of what it is, or to ``floor`` [m]."""
        for kernel, most in ((ccd.ccd_pt, self.pt_most), (ccd.ccd_ee, self.ee_most)):
            if most:
                inputs = [x, dx, self.surface, self.candidates, slack, floor, active]
                wp.launch(kernel, dim=(self.batch, most), inputs=inputs, outputs=[alpha], device=self.device)
        if self.planes:
            inputs = [x, dx, self.surface, *frames0, *frames1, slack, floor, active]
            wp.launch(ccd.ccd_plane, dim=(self.batch, self.planes), inputs=inputs, outputs=[alpha], device=self.device)

    # --- friction --------------------------------------------------------------------------------------------------------------

    def lag(self, active: wp.array) -> np.ndarray:
        """Freeze the contacts of the active environments for friction.

        Returns:
            By how much the friction limits μ λ n changed, as a share of their sum; shape (B,), zero without friction.
        """
        if not self.friction:
            return np.zeros(self.batch)
        self.lagged, self._old, self._old_most = self._old, self.lagged, self._lag_most
        self._lag_most = max(self.contact_most, 0 if bool(active.numpy().all()) else self._old_most)
        if self.lagged.limit.shape[1] < self._lag_most:
            self._size_lagged(self.lagged, int(_GROW * self._lag_most))
        if self._lag_most == 0:
            self.lagged.count.zero_()
        else:
            wp.launch(
                friction.lag_contacts,
                dim=(self.batch, self._lag_most),
                inputs=[self.contacts, self.pair_mu, self._old, active],
                outputs=[self.lagged],
                device=self.device,
            )
        self._force_scratch.zero_()
        self._size_scratch.zero_()
        for lagged, most, sign in ((self.lagged, self._lag_most, 1.0), (self._old, self._old_most, -1.0)):
            if most:
                wp.launch(
                    friction.lag_difference,
                    dim=(self.batch, most),
                    inputs=[lagged, sign, active],
                    outputs=[self._force_scratch, self._size_scratch],
                    device=self.device,
                )
        changed = np.linalg.norm(self._force_scratch.numpy(), axis=-1).sum(axis=1)
        return changed / np.maximum(self._size_scratch.numpy(), 1e-300)

    def drop_lag(self, envs: np.ndarray) -> None:
        """Forget the lagged pairs of the environments of the mask (B,)."""
        count = self.lagged.count.numpy()
        count[envs] = 0
        self.lagged.count.assign(count)
