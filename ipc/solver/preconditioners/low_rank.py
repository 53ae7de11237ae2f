"""The contacts of the moment as a low-rank part of a preconditioner.

The rows q of the contact Hessian add Jᵀ S J at m contact nodes (J picks their 3m unknowns, S = Σ q qᵀ between them) to a matrix whose
inverse C = K_0⁻¹ is known between all nodes of a surface. By Woodbury's identity

    (K_0 + Jᵀ S J)⁻¹ = C − C Jᵀ W J C,      W = (S⁻¹ + J C Jᵀ)⁻¹.

S is not regular (friction may be missing), so a share REGULAR of the elastic stiffness of each contact node is added to it. W is computed
in double precision by one block of threads an environment. An environment with more contact nodes than there is room for is marked as
one that does not fit: with part of its contacts the identity is of little use.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, IntArray2d, MatArray2d, SingleArray2d, SingleArray3d
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.blocks import wait_for_block
from ipc.solver.linear import SystemView, row_column

wp.set_module_options({"enable_backward": False})

REGULAR = 1e-6
"""Stiffness added to every contact node, as a share of its elastic one."""
LANES = 256
"""Threads on CUDA for the small system of an environment; the size of all blocks."""


@wp.struct
class Rest:
    """K_0⁻¹ between the interface nodes of every bonded body, s of them on its surface.

    ``inverse`` holds the matrices one after the other, row by row; unknown u of part p is entry u − first[p] of a matrix of width[p]
    that starts at start[p]. ``unknown`` (N,) is a node's first unknown or −1, ``part`` (N,) its matrix, ``surface`` (N,) its number among
    the surface nodes or −1, ``surface_node`` (s,) the inverse of that.
    """

    inverse: wp.array(dtype=wp.float32)
    start: IntArray
    first: IntArray
    width: IntArray
    unknown: IntArray
    part: IntArray
    surface: IntArray
    surface_node: IntArray


@wp.struct
class Small:
    """The contact nodes of each environment and their systems; m is the room.

    ``touched``, ``slot`` (B, s): mark of a surface node that touches, and its place among the contact nodes.
    ``count`` (B,): contact nodes; more than m do not fit.    ``node`` (B, m).
    ``a`` (B, m, m), ``row``, ``column`` (B, m): work space.    ``w`` (B, 3m, 3m): W [N/m].
    ``t``, ``force`` (B, 3m): J K_0⁻¹ r [m] and W t [N].
    """

    touched: IntArray2d
    slot: IntArray2d
    count: IntArray
    node: IntArray2d
    a: wp.array3d(dtype=wp.mat33d)
    row: MatArray2d
    column: MatArray2d
    w: SingleArray3d
    t: SingleArray2d
    force: SingleArray2d


@wp.func
def rest_entry(rest: Rest, part: wp.int32, u: wp.int32, v: wp.int32) -> wp.float32:
    """K_0⁻¹ between two unknowns of one part."""
    return rest.inverse[rest.start[part] + (u - rest.first[part]) * rest.width[part] + v - rest.first[part]]


@wp.func
def fits(small: Small, env: wp.int32) -> wp.bool:
    """True if there is room for the contact nodes of an environment."""
    return small.count[env] <= small.node.shape[1]


@wp.kernel
def forget_contacts(active: IntArray, small: Small):
    env, s = wp.tid()
    if active[env] == 0:
        return
    if s == 0:
        small.count[env] = 0
    small.touched[env, s] = 0


@wp.func
def surface_of_vertex(system: SystemView, rest: Rest, v: wp.int32) -> wp.int32:
    """Surface number of the only node that vertex v follows, or −1."""
    if v < 0:
        return -1
    if system.verts.count[v] != 1:
        return -1
    return rest.surface[system.verts.nodes[v, 0]]


@wp.kernel
def mark_contacts(system: SystemView, contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """Marks the surface nodes that the rows act on."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        for k in range(4):
            s = surface_of_vertex(system, rest, verts[k])
            if s >= 0 and wp.length_sq(row_column(row, k)) > wp.float64(0.0):
                small.touched[env, s] = 1


@wp.kernel
def place_contacts(rest: Rest, active: IntArray, small: Small):
    """Numbers the contact nodes in the order of the surface."""
    env, s = wp.tid()
    if active[env] == 0 or small.touched[env, s] == 0:
        return
    wp.atomic_add(small.count, env, 1)
    place = wp.int32(0)
    for other in range(s):
        place += small.touched[env, other]
    small.slot[env, s] = place
    if place < small.node.shape[1]:
        small.node[env, place] = rest.surface_node[s]


@wp.func
def add_row(env: wp.int32, system: SystemView, verts: wp.vec4i, row: mat34d, rest: Rest, small: Small):
    """S += q qᵀ between the contact nodes, in the frames of their bodies."""
    for k in range(4):
        s = surface_of_vertex(system, rest, verts[k])
        if s >= 0:
            qi = wp.transpose(system.R[env, system.verts.body[verts[k]]]) * row_column(row, k)
            if wp.length_sq(qi) > wp.float64(0.0):
                for m in range(4):
                    other = surface_of_vertex(system, rest, verts[m])
                    if other >= 0:
                        qj = wp.transpose(system.R[env, system.verts.body[verts[m]]]) * row_column(row, m)
                        if wp.length_sq(qj) > wp.float64(0.0):
                            wp.atomic_add(small.a, env, small.slot[env, s], small.slot[env, other], wp.outer(qi, qj))


@wp.kernel
def add_rows(system: SystemView, contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """S = Σ q qᵀ."""
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] == 0:
            add_row(env, system, contacts.row_verts[env, r], contacts.row[env, r], rest, small)


@wp.func
def invert_small(small: Small, env: wp.int32, m: wp.int32, lane: wp.int32, lanes: wp.int32) -> wp.bool:
    """Inverts the positive definite blocks ``a`` in place (Gauss-Jordan, without pivoting).

    All lanes of the environment work on it and get the same result: False where a pivot is not positive.
    """
    wait_for_block()
    for k in range(m):
        pivot = small.a[env, k, k]
        if not (wp.determinant(pivot) > wp.float64(0.0) and wp.trace(pivot) > wp.float64(0.0)):
            return False
        inverse = wp.inverse(pivot)
        for i in range(lane, m, lanes):
            small.column[env, i] = small.a[env, i, k]
            small.row[env, i] = inverse * small.a[env, k, i]
        wait_for_block()
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            if i == k and j == k:
                small.a[env, i, j] = inverse
            elif i == k:
                small.a[env, i, j] = small.row[env, j]
            elif j == k:
                small.a[env, i, j] = -(small.column[env, i] * inverse)
            else:
                small.a[env, i, j] = small.a[env, i, j] - small.column[env, i] * small.row[env, j]
        wait_for_block()
    return True


@wp.func
def compliance(rest: Rest, a: wp.int32, b: wp.int32) -> wp.mat33d:
    """The block of K_0⁻¹ between two nodes."""
    block = wp.mat33d()
    part = rest.part[a]
    if part == rest.part[b]:
        for i in range(3):
            for j in range(3):
                block[i, j] = wp.float64(rest_entry(rest, part, rest.unknown[a] + i, rest.unknown[b] + j))
    return block


@wp.kernel
def factor_small(rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """W from S, one block of threads an environment; leaves ``a`` zero for the next S."""
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    m = small.count[env]
    for i in range(lane, m, lanes):
        C = compliance(rest, small.node[env, i], small.node[env, i])
        soft = wp.float64(3.0 * REGULAR) / wp.trace(C)
        small.a[env, i, i] = small.a[env, i, i] + soft * wp.identity(n=3, dtype=wp.float64)
    good = invert_small(small, env, m, lane, lanes)
    if good:
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            small.a[env, i, j] = small.a[env, i, j] + compliance(rest, small.node[env, i], small.node[env, j])
        good = invert_small(small, env, m, lane, lanes)
    wait_for_block()
    if good:
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            W = wp.float64(0.5) * (small.a[env, i, j] + wp.transpose(small.a[env, j, i]))
            for p in range(3):
                for q in range(3):
                    small.w[env, 3 * i + p, 3 * j + q] = wp.float32(W[p, q])
    elif lane == 0:
        # Something is not finite: without contacts it is still a preconditioner.
        small.count[env] = 0
    wait_for_block()
    for e in range(lane, m * m, lanes):
        small.a[env, e / m, e % m] = wp.mat33d()


@wp.func
def sum_of_parts(y: SingleArray3d, env: wp.int32, u: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for c in range(y.shape[0]):
        total += y[c, env, u]
    return total


@wp.kernel
def contact_forces(rest: Rest, y: SingleArray3d, running: IntArray, lanes: wp.int32, small: Small):
    """W J K_0⁻¹ r, one block of threads an environment."""
    env, lane = wp.tid()
    if running[env] == 0 or not fits(small, env):
        return
    n = 3 * small.count[env]
    for i in range(lane, n, lanes):
        small.t[env, i] = sum_of_parts(y, env, rest.unknown[small.node[env, i / 3]] + i % 3)
    wait_for_block()
    for i in range(lane, n, lanes):
        total = wp.float32(0.0)
        for j in range(n):
            total += small.w[env, j, i] * small.t[env, j]
        small.force[env, i] = total


class LowRank:
    """Contact nodes, their factored small systems W, and products with these.

    Args:
        room: contact nodes that an environment may have.
        row_lanes: threads that share the contact rows of an environment; one adds them in order.
    """

    def __init__(self, rest: Rest, batch: int, room: int, row_lanes: int, device: wp.Device) -> None:
        self.rest, self.batch, self.row_lanes, self.device = rest, batch, row_lanes, device
        self.lanes = LANES if device.is_cuda else 1
        nodes = max(1, len(rest.surface_node))
        room = max(1, min(room, nodes))

        def zeros(*shape: int, dtype: type = wp.float32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        small = Small()
        small.touched, small.slot = zeros(batch, nodes, dtype=wp.int32), zeros(batch, nodes, dtype=wp.int32)
        small.count, small.node = zeros(batch, dtype=wp.int32), zeros(batch, room, dtype=wp.int32)
        small.a = zeros(batch, room, room, dtype=wp.mat33d)
        small.row, small.column = zeros(batch, room, dtype=wp.mat33d), zeros(batch, room, dtype=wp.mat33d)
        small.w, small.t, small.force = zeros(batch, 3 * room, 3 * room), zeros(batch, 3 * room), zeros(batch, 3 * room)
        self.small = small

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, block_dim: int = 256) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in the rows of the active environments."""
        rest, small = self.rest, self.small
        self._launch(forget_contacts, small.touched.shape, [active, small])
        if rows:
            inputs = [system, contacts, rest, active, self.row_lanes, small]
            self._launch(mark_contacts, (self.batch, self.row_lanes), inputs)
            self._launch(place_contacts, small.touched.shape, [rest, active, small])
            self._launch(add_rows, (self.batch, self.row_lanes), inputs)
            self._launch(factor_small, (self.batch, self.lanes), [rest, active, self.lanes, small], self.lanes)

    def find_forces(self, y: wp.array, running: wp.array) -> None:
        """``small.force`` = W J y for the running environments; y is the sum of (parts, B, n)."""
        self._launch(contact_forces, (self.batch, self.lanes), [self.rest, y, running, self.lanes, self.small], self.lanes)
