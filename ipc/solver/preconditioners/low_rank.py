"""The contacts of the moment as a low-rank part of a preconditioner.

The rows q of the contact Hessian add Jᵀ S J at m contact nodes (J picks their 3m unknowns, S = Σ q qᵀ between them) to a matrix whose
inverse C = K_0⁻¹ is known: between all nodes of a pad's surface, and between the four nodes of an affine body, whose own 12 × 12 matrix
A = L Lᵀ is factored in each Newton iteration. By Woodbury's identity

    (K_0 + Jᵀ S J)⁻¹ = C − C Jᵀ W J C,      W = (S⁻¹ + J C Jᵀ)⁻¹ = K − K (K + S)⁻¹ K,      K = (J C Jᵀ)⁻¹.

The second form needs no inverse of S, which is not regular where friction is missing. K stays while the contact nodes do, and is inverted;
K + S changes in each Newton iteration, for few products, and is only factored. Both in double precision by one block of threads an
environment (``dense.py``). Affine bodies have unknowns Lᵀ x and rows L⁻¹ q here (``affine_factor.py``), for which K = 1.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray2d, FloatArray3d, IntArray, MatArray2d, SingleArray3d, VecArray2d
from ipc.blocks import wait_for_block
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.affine_elimination import Elimination, finish_elimination
from ipc.solver.linear import SystemView, row_column
from ipc.solver.preconditioners.affine_factor import factor_affine, scaled_row
from ipc.solver.preconditioners.contact_nodes import (
    Rest,
    Small,
    fits,
    forget_contacts,
    mark_contacts,
    mark_full,
    place_contacts,
    rest_entry,
    slot_of,
)
from ipc.solver.preconditioners.dense import PAIR, PANEL, factor, invert, read_panel, solve, vec6d

wp.set_module_options({"enable_backward": False})

LANES = 256
"""Threads on CUDA for the small system of an environment; the size of all blocks."""
_APART = 64
"""Threads a body, of which one works: few then share a cache, since registers do not do."""
_BODY_THREADS = 1024
"""Threads on CUDA that add up the rows of a body."""
_ENTRIES = 78
"""Of the upper half of a body's 12 × 12 matrix."""


@wp.func
def add_block(env: wp.int32, small: Small, i: wp.int32, j: wp.int32, q: wp.vec3d, g: wp.vec3d):
    """S += q gᵀ between the unknowns of contact nodes i <= j."""
    for c in range(3):
        for d in range(3):
            wp.atomic_add(small.s, env, 3 * i + c, 3 * j + d, q[c] * g[d])


@wp.kernel
def add_rows(contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """The upper half of S = Σ q qᵀ between the contact nodes, without Σ g gᵀ of affine bodies.

    ``scaled_row`` of the contacts becomes L⁻¹ g at the row's affine body; a second one is among the row's nodes.
    """
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        nodes, row, first = contacts.row_nodes[env, r], contacts.node_row[env, r] + mat34d(), contacts.row_body[env, r] + 0
        a, g = wp.int32(-1), mat34d()
        if first >= 0:
            a = slot_of(env, rest, small, first)
            g = scaled_row(contacts.body_row[env, r], env, rest, small, first)
        contacts.scaled_row[env, r] = g
        if nodes[0] >= 0:
            if rest.affine[nodes[0]] >= 0:
                row = scaled_row(row, env, rest, small, nodes[0])
        for k in range(4):
            if nodes[k] >= 0:
                q = row_column(row, k)
                if rest.surface[nodes[k]] >= 0 and wp.length_sq(q) > wp.float64(0.0):
                    i = small.slot[env, rest.surface[nodes[k]]]
                    for m in range(4):
                        if nodes[m] >= 0:
                            h = row_column(row, m)
                            if rest.surface[nodes[m]] >= 0 and wp.length_sq(h) > wp.float64(0.0):
                                j = small.slot[env, rest.surface[nodes[m]]]
                                if i <= j:
                                    add_block(env, small, i, j, q, h)
                    if a >= 0:
                        for m in range(4):
                            if i < a + m:
                                add_block(env, small, i, a + m, q, row_column(g, m))
                            else:
                                add_block(env, small, a + m, i, row_column(g, m), q)


@wp.kernel
def add_bodies(contacts: Contacts, rows_g: FloatArray3d, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """S += the upper half of Σ g gᵀ of each affine body's rows.

    ``rows_g`` (B, rows, 12) has the numbers of their g. Nearly all rows belong to a body: its twelve unknowns are added up by entries of
    S, and not by rows, which would all meet there.
    """
    env, body, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    first = rest.affine_node[4 * body]
    if small.touched[env, rest.surface[first]] == 0:
        return
    place, rows = 3 * small.slot[env, rest.surface[first]], rows_of(contacts, env)
    # Threads take an entry of the upper half each, several the same one with some of the rows.
    parts = wp.max(1, lanes / _ENTRIES)
    for e in range(lane, parts * _ENTRIES, lanes):
        part = e / _ENTRIES
        i, j = wp.int32(0), e - part * _ENTRIES
        while j >= 12 - i:
            j -= 12 - i
            i += 1
        j += i
        a, b = 4 * (i % 3) + i / 3, 4 * (j % 3) + j / 3
        total = wp.float64(0.0)
        for r in range(part, rows, parts):
            if contacts.row_body[env, r] == first and contacts.concave[env, r] == 0:
                total += rows_g[env, r, a] * rows_g[env, r, b]
        wp.atomic_add(small.s, env, place + i, place + j, total)


@wp.func
def padded_size(nodes: wp.int32) -> wp.int32:
    """Unknowns of contact nodes, and up to the next multiple of ``PAIR``."""
    return PAIR * ((3 * nodes + PAIR - 1) / PAIR)


@wp.func
def forget_rows(small: Small, env: wp.int32, lane: wp.int32, lanes: wp.int32):
    """S = 0, for the next S."""
    size = padded_size(small.count[env])
    for e in range(lane, size * size, lanes):
        small.s[env, e / size, e % size] = wp.float64(0.0)


@wp.func
def give_up(small: Small, env: wp.int32, lane: wp.int32, lanes: wp.int32):
    """Do without contacts, which is still a preconditioner: something is not finite."""
    forget_rows(small, env, lane, lanes)
    wait_for_block()
    if lane == 0:
        small.count[env] = 0
        small.pads[env] = 0
        small.known[env] = -1


@wp.kernel(launch_bounds=(LANES, 1))
def find_stiffness(rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """K = (J C Jᵀ)⁻¹ where the pads' contact nodes have changed.

    One block of threads an environment.
    """
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env) or small.known[env] == small.pads[env]:
        return
    n = 3 * small.pads[env]
    size = padded_size(small.pads[env])
    for e in range(lane, size * size, lanes):
        i = e / size
        j = e - size * i
        value = wp.float64(0.0)
        if i == j:
            value = wp.float64(1.0)
        if i < n and j < n:
            value = wp.float64(0.0)
            a, b = small.node[env, i / 3], small.node[env, j / 3]
            if rest.part[a] == rest.part[b]:
                value = wp.float64(rest_entry(rest, rest.part[a], rest.unknown[a] + i % 3, rest.unknown[b] + j % 3))
        small.k[env, i, j] = value
    if invert(small.k, small.factor, env, size, lane, lanes):
        if lane == 0:
            small.known[env] = small.pads[env]
    else:
        give_up(small, env, lane, lanes)


@wp.kernel(launch_bounds=(LANES, 1))
def factor_contacts(active: IntArray, lanes: wp.int32, small: Small):
    """K + S = Uᵀ U, one block of threads an environment."""
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    size, pads = padded_size(small.count[env]), 3 * small.pads[env]
    for e in range(lane, size * size, lanes):
        i = e / size
        j = e - size * i
        if i <= j:
            value = small.s[env, i, j]
            if j < pads:
                value += small.k[env, i, j]
            elif i == j:
                value += wp.float64(1.0)
            small.factor[env, i, j] = value
    if factor(small.factor, env, size, lane, lanes):
        forget_rows(small, env, lane, lanes)
    else:
        give_up(small, env, lane, lanes)


@wp.func
def sum_of_parts(y: SingleArray3d, place: wp.int32, u: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for c in range(y.shape[0]):
        total += y[c, place, u]
    return total


@wp.func
def column_sums(a: FloatArray3d, x: FloatArray2d, env: wp.int32, c: wp.int32, d: wp.int32, size: wp.int32) -> wp.vec2d:
    """Σ_k a[k, j] x[k] of two columns j = c, d over ``size`` rows, whole panels.

    A panel's numbers are read at once, since memory is what is waited for.
    """
    total = wp.vec2d()
    for row in range(0, size, PANEL):
        v, w = read_panel(a, env, row, c, d), vec6d()
        for k in range(PANEL):
            w[k] = x[env, row + k]
        for k in range(PANEL):
            for j in range(2):
                total[j] = total[j] + v[k, j] * w[k]
    return total


@wp.func
def stiffness_rows(small: Small, env: wp.int32, c: wp.int32, d: wp.int32, x: FloatArray2d) -> wp.vec2d:
    """Rows c < d, or c = d, of K x; K is 1 for affine bodies."""
    pads = 3 * small.pads[env]
    rows = wp.vec2d(x[env, c], x[env, d])
    if c < pads:
        total = column_sums(small.k, x, env, c, d, padded_size(small.pads[env]))
        rows[0] = total[0]
        if d < pads:
            rows[1] = total[1]
    return rows


@wp.kernel
def contact_forces(
    rest: Rest, y: SingleArray3d, z: VecArray2d, running: IntArray, place: IntArray, lanes: wp.int32, small: Small
):
    """W t; y holds K_0⁻¹ r of pads at an environment's ``place``, z L⁻¹ r of affine nodes.

    One block of threads an environment.
    """
    env, lane = wp.tid()
    if running[env] == 0 or not fits(small, env):
        return
    n = 3 * small.count[env]
    for i in range(lane, n, lanes):
        node = small.node[env, i / 3]
        if rest.affine[node] >= 0:
            small.t[env, i] = z[env, node][i % 3]
        else:
            small.t[env, i] = wp.float64(sum_of_parts(y, place[env], rest.unknown[node] + i % 3))
    size = padded_size(small.count[env])
    for i in range(n + lane, size, lanes):
        small.t[env, i] = wp.float64(0.0)
        small.force[env, i] = wp.float64(0.0)
    wait_for_block()
    for c in range(lane, n, 2 * lanes):
        d = wp.where(c + lanes < n, c + lanes, c)
        rows = stiffness_rows(small, env, c, d, small.t)
        small.force[env, c] = rows[0]
        small.force[env, d] = rows[1]
    wait_for_block()
    for i in range(lane, size, lanes):
        small.t[env, i] = small.force[env, i]
    wait_for_block()
    solve(small.factor, small.t, small.half, env, size, lane, lanes)
    for c in range(lane, n, 2 * lanes):
        d = wp.where(c + lanes < n, c + lanes, c)
        rows = stiffness_rows(small, env, c, d, small.t)
        first, second = small.force[env, c] - rows[0], small.force[env, d] - rows[1]
        small.force[env, c] = first
        small.force[env, d] = second


@wp.kernel
def eliminate_where_full(
    e: Elimination, inverse: MatArray2d, small: Small, r: VecArray2d, running: IntArray, threads: wp.int32, z: VecArray2d
):
    """Affine bodies eliminated from 3×3 blocks, in environments that do not fit."""
    env, lane = wp.tid()
    if running[env] != 0 and not fits(small, env):
        finish_elimination(e, inverse, env, lane, threads, r, z)


def whole_pairs(room: int) -> int:
    """Contact nodes, at least ``room``, whose unknowns fill whole pairs of panels."""
    return room + -room % (PAIR // 3)


def _numbers(rows: wp.array) -> wp.array:
    """The twelve numbers of each matrix, (B, rows, 12), in the same memory."""
    return wp.array(ptr=rows.ptr, dtype=wp.float64, shape=(*rows.shape, 12), device=rows.device)


class LowRank:
    """Contact nodes, their small systems, and products with W.

    Args:
        room: contact nodes that an environment may have.
        row_lanes: threads that share the contact rows of an environment; one adds them in order.
    """

    def __init__(self, rest: Rest, batch: int, room: int, row_lanes: int, device: wp.Device) -> None:
        self.rest, self.batch, self.row_lanes, self.device = rest, batch, row_lanes, device
        self.lanes = LANES if device.is_cuda else 1
        nodes = max(1, len(rest.surface_node))
        room = whole_pairs(max(1, min(room, nodes)))

        def zeros(*shape: int, dtype: type = wp.float32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        small = Small()
        small.touched, small.slot = zeros(batch, nodes, dtype=wp.int32), zeros(batch, nodes, dtype=wp.int32)
        small.count, small.pads = zeros(batch, dtype=wp.int32), zeros(batch, dtype=wp.int32)
        small.node = zeros(batch, room, dtype=wp.int32)
        small.known = wp.full(batch, -1, dtype=wp.int32, device=device)
        small.s, small.k, small.factor = (zeros(batch, 3 * room, 3 * room, dtype=wp.float64) for _ in range(3))
        small.t, small.half, small.force = (zeros(batch, 3 * room, dtype=wp.float64) for _ in range(3))
        self.bodies = len(rest.affine_node) // 4
        small.root = zeros(batch, 4 * self.bodies, 4, dtype=wp.mat33d)
        self.small, self.full = small, zeros(batch, dtype=wp.int32)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, block_dim: int = 256) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)

    def find_contacts(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Number the contact nodes; ``full`` (B,) is 1 where an active environment has no room."""
        rest, small = self.rest, self.small
        self._launch(forget_contacts, small.touched.shape, [active, small])
        if rows:
            inputs = [system, contacts, rest, active, self.row_lanes, small]
            self._launch(mark_contacts, (self.batch, self.row_lanes), inputs)
            self._launch(place_contacts, small.touched.shape, [rest, active, small])
        self._launch(mark_full, self.batch, [active, small, self.full])

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in affine bodies and rows, after ``find_contacts``."""
        rest, small = self.rest, self.small
        if self.bodies:
            apart = _APART if self.device.is_cuda else 1
            self._launch(factor_affine, (self.batch, self.bodies, apart), [rest, system, active, small])
        if rows:
            self._launch(add_rows, (self.batch, self.row_lanes), [contacts, rest, active, self.row_lanes, small])
            if self.bodies:
                threads = _BODY_THREADS if self.device.is_cuda else 1
                inputs = [contacts, _numbers(contacts.scaled_row), rest, active, threads, small]
                self._launch(add_bodies, (self.batch, self.bodies, threads), inputs)
            self._launch(find_stiffness, (self.batch, self.lanes), [rest, active, self.lanes, small], self.lanes)
            self._launch(factor_contacts, (self.batch, self.lanes), [active, self.lanes, small], self.lanes)

    def find_forces(self, y: wp.array, z: wp.array, running: wp.array, place: wp.array) -> None:
        """Compute ``small.force`` = W t for the running environments.

        y (parts, B, n) holds K_0⁻¹ r of pads at an environment's ``place`` (B,), z (B, N) L⁻¹ r of affine nodes.
        """
        inputs = [self.rest, y, z, running, place, self.lanes, self.small]
        self._launch(contact_forces, (self.batch, self.lanes), inputs, self.lanes)
