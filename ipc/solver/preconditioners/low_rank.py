"""The contacts of the moment as a low-rank part of a preconditioner.

The rows q of the contact Hessian add Jᵀ S J at m contact nodes (J picks their 3m unknowns, S = Σ q qᵀ between them) to a matrix whose
inverse C = K_0⁻¹ is known: between all nodes of a pad's surface, and between the four nodes of an affine body, whose own 12 × 12 matrix
A = L Lᵀ is factored in each Newton iteration. By Woodbury's identity

    (K_0 + Jᵀ S J)⁻¹ = C − C Jᵀ W J C,      W = (S⁻¹ + J C Jᵀ)⁻¹ = K − K (K + S)⁻¹ K,      K = (J C Jᵀ)⁻¹.

The second form needs no inverse of S, which is not regular where friction is missing. An affine body is 10⁶ times as stiff against strain
as against motion: its unknowns are Lᵀ x and its rows L⁻¹ q here, for which K = 1; otherwise the difference would be lost to rounding.
Inverses are computed in double precision by one block of threads an environment (``dense.py``). W itself is not: it is needed for few
products in a Newton iteration, and three matrices times a vector have less arithmetic than a product of matrices.

An environment with more contact nodes than there is room for is marked as one that does not fit: with part of its contacts the identity is
of little use.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray2d, FloatArray3d, IntArray, IntArray2d, MatArray2d, SingleArray3d, VecArray2d
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.affine_elimination import Elimination, finish_elimination
from ipc.solver.blocks import wait_for_block
from ipc.solver.linear import SystemView, row_column
from ipc.solver.preconditioners.dense import PANEL, invert

wp.set_module_options({"enable_backward": False})

mat1212d = wp.types.matrix(shape=(12, 12), dtype=wp.float64)
LANES = 256
"""Threads on CUDA for the small system of an environment; the size of all blocks."""
_APART = 64
"""Threads a body, of which one works: few then share a cache, since registers do not do."""
_ENTRIES = 78
"""Of the upper half of a body's 12 × 12 matrix."""


@wp.struct
class Rest:
    """K_0⁻¹ between the interface nodes of a bonded body and the nodes of an affine one.

    ``inverse`` holds the matrices of bonded bodies one after the other, row by row; unknown u of part p is entry u − first[p] of a matrix
    of width[p] that starts at start[p]. ``unknown`` (N,) is a node's first unknown or −1, ``part`` (N,) its matrix. s nodes may touch
    something, those on bonded surfaces and of affine bodies: ``surface`` (N,) is a node's number among them or −1, ``surface_node`` (s,)
    the inverse of that. ``affine`` (N,) is a node's number among the affine nodes, body by body, or −1; ``affine_node`` (A,) the inverse.
    """

    inverse: wp.array(dtype=wp.float32)
    start: IntArray
    first: IntArray
    width: IntArray
    unknown: IntArray
    part: IntArray
    surface: IntArray
    surface_node: IntArray
    affine: IntArray
    affine_node: IntArray


@wp.struct
class Small:
    """The contact nodes of each environment and their systems; m is the room.

    ``touched``, ``slot`` (B, s): mark of a surface node that touches, and its place among the contact nodes.
    ``count`` (B,): contact nodes; more than m do not fit.    ``pads`` (B,): those of pads, the first ones.    ``node`` (B, m).
    ``known`` (B,): pad nodes of which ``k`` is K; −1 after ``node`` has changed.
    ``s`` (B, 3m, 3m): the upper half of S, zero after the inverse was computed.    ``k`` (B, 3m, 3m): K of pad nodes [N/m].
    ``inverse`` (B, 3m, 3m): (K + S)⁻¹ [m/N].
    ``t``, ``force`` (B, 3m): J K_0⁻¹ r [m], on affine nodes L⁻¹ r, later a product; and W t [N].
    ``root`` (B, A, 4): blocks of an affine node's row of L⁻¹, at the nodes of its body.
    """

    touched: IntArray2d
    slot: IntArray2d
    count: IntArray
    pads: IntArray
    node: IntArray2d
    known: IntArray
    s: FloatArray3d
    k: FloatArray3d
    inverse: FloatArray3d
    t: FloatArray2d
    force: FloatArray2d
    root: wp.array3d(dtype=wp.mat33d)


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
        small.pads[env] = 0
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
            v = verts[k]
            if v >= 0 and wp.length_sq(row_column(row, k)) > wp.float64(0.0):
                for m in range(system.verts.count[v]):
                    s = rest.surface[system.verts.nodes[v, m]]
                    if s >= 0:
                        small.touched[env, s] = 1


@wp.kernel
def place_contacts(rest: Rest, active: IntArray, small: Small):
    """Numbers the contact nodes as ``surface_node`` has them, those of pads first."""
    env, s = wp.tid()
    if active[env] == 0 or small.touched[env, s] == 0:
        return
    wp.atomic_add(small.count, env, 1)
    if rest.affine[rest.surface_node[s]] < 0:
        wp.atomic_add(small.pads, env, 1)
    place = wp.int32(0)
    for other in range(s):
        place += small.touched[env, other]
    small.slot[env, s] = place
    if place < small.node.shape[1]:
        if small.node[env, place] != rest.surface_node[s]:
            small.known[env] = -1
        small.node[env, place] = rest.surface_node[s]


@wp.kernel
def mark_full(active: IntArray, small: Small, full: IntArray):
    env = wp.tid()
    full[env] = 0
    if active[env] != 0 and not fits(small, env):
        full[env] = 1


@wp.func
def slot_of(env: wp.int32, rest: Rest, small: Small, first: wp.int32) -> wp.int32:
    """Place of an affine body's first node among the contact nodes, or −1.

    The other three follow. −1: nothing touches it.
    """
    if first >= 0:
        if small.touched[env, rest.surface[first]] != 0:
            return small.slot[env, rest.surface[first]]
    return -1


@wp.func
def add_block(env: wp.int32, small: Small, i: wp.int32, j: wp.int32, q: wp.vec3d, g: wp.vec3d):
    """S += q gᵀ between the unknowns of contact nodes i <= j."""
    for c in range(3):
        for d in range(3):
            wp.atomic_add(small.s, env, 3 * i + c, 3 * j + d, q[c] * g[d])


@wp.func
def scaled_row(g: mat34d, env: wp.int32, rest: Rest, small: Small, first: wp.int32) -> mat34d:
    """L⁻¹ g of a row at the nodes of the affine body whose first node is ``first``."""
    scaled = mat34d()
    for i in range(4):
        v = wp.vec3d()
        for j in range(i + 1):
            v += small.root[env, rest.affine[first] + i, j] * row_column(g, j)
        for c in range(3):
            scaled[c, i] = v[c]
    return scaled


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
def add_bodies(contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """S += the upper half of Σ g gᵀ of each affine body's rows, one block of threads a body.

    Nearly all rows belong to a body: its twelve unknowns are added up by entries of S, and not by rows, which would all meet there.
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
        total = wp.float64(0.0)
        for r in range(part, rows, parts):
            if contacts.row_body[env, r] == first and contacts.concave[env, r] == 0:
                g = contacts.scaled_row[env, r]
                total += g[i % 3, i / 3] * g[j % 3, j / 3]
        wp.atomic_add(small.s, env, place + i, place + j, total)


@wp.kernel
def factor_affine(rest: Rest, system: SystemView, active: IntArray, small: Small):
    """L⁻¹ of every affine body, by the first of some threads.

    Where its matrix is not positive definite, that of the mean diagonal of its blocks.
    """
    env, body, lane = wp.tid()
    if active[env] == 0 or lane > 0:
        return
    first = 4 * body
    A = mat1212d()
    for i in range(4):
        node = rest.affine_node[first + i]
        k = system.row_base[node]
        for _ in range(system.row_length[node]):
            j = rest.affine[system.col[k]] - first
            block = system.blocks[env, k]
            for p in range(3):
                for q in range(3):
                    A[3 * i + p, 3 * j + q] = block[p, q]
            k += system.stride
    good = wp.bool(True)
    for j in range(12):
        d = A[j, j]
        for n in range(j):
            d -= A[j, n] * A[j, n]
        if not (d > wp.float64(0.0)):
            good = wp.bool(False)
            d = wp.float64(1.0)
        d = wp.sqrt(d)
        A[j, j] = d
        for i in range(j + 1, 12):
            e = A[i, j]
            for n in range(j):
                e -= A[i, n] * A[j, n]
            A[i, j] = e / d
    # L⁻¹ in the place of L.
    for j in range(12):
        A[j, j] = wp.float64(1.0) / A[j, j]
        for i in range(j + 1, 12):
            e = wp.float64(0.0)
            for n in range(j, i):
                e -= A[i, n] * A[n, j]
            A[i, j] = e / A[i, i]
    for i in range(4):
        for j in range(4):
            block = wp.mat33d()
            if good:
                for p in range(3):
                    for q in range(3):
                        if 3 * i + p >= 3 * j + q:
                            block[p, q] = A[3 * i + p, 3 * j + q]
            elif i == j:
                node = rest.affine_node[first + i]
                size = wp.abs(wp.trace(system.blocks[env, system.diagonal[node]])) / wp.float64(3.0)
                block = (wp.float64(1.0) / wp.sqrt(wp.max(size, wp.float64(1.0e-30)))) * wp.identity(n=3, dtype=wp.float64)
            small.root[env, first + i, j] = block


@wp.func
def padded_size(nodes: wp.int32) -> wp.int32:
    """Unknowns of contact nodes, and up to the next multiple of ``PANEL``."""
    return PANEL * ((3 * nodes + PANEL - 1) / PANEL)


@wp.func
def find_stiffness(rest: Rest, small: Small, env: wp.int32, lane: wp.int32, lanes: wp.int32) -> wp.bool:
    """K = (J C Jᵀ)⁻¹ of the pads' contact nodes; False where a pivot is not positive."""
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
    return invert(small.k, small.inverse, env, size, lane, lanes)


@wp.kernel(launch_bounds=(LANES, 2))
def invert_small(rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """(K + S)⁻¹, one block of threads an environment.

    It leaves ``s`` zero for the next S.
    """
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    size, pads = padded_size(small.count[env]), 3 * small.pads[env]
    good = wp.bool(True)
    if small.known[env] != small.pads[env]:
        good = find_stiffness(rest, small, env, lane, lanes)
    wait_for_block()
    if good:
        if lane == 0:
            small.known[env] = small.pads[env]
        for e in range(lane, size * size, lanes):
            i = e / size
            j = e - size * i
            if i <= j:
                value = small.s[env, i, j]
                if j < pads:
                    value += small.k[env, i, j]
                elif i == j:
                    value += wp.float64(1.0)
                small.inverse[env, i, j] = value
        good = invert(small.inverse, small.s, env, size, lane, lanes)
    if not good:
        # Something is not finite: without contacts it is still a preconditioner.
        wait_for_block()
        if lane == 0:
            small.count[env] = 0
            small.known[env] = -1
    for e in range(lane, size * size, lanes):
        small.s[env, e / size, e % size] = wp.float64(0.0)


@wp.func
def sum_of_parts(y: SingleArray3d, place: wp.int32, u: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for c in range(y.shape[0]):
        total += y[c, place, u]
    return total


@wp.func
def stiffness_row(small: Small, env: wp.int32, i: wp.int32, x: FloatArray2d) -> wp.float64:
    """(K x)_i; K is 1 for affine bodies."""
    pads = 3 * small.pads[env]
    if i >= pads:
        return x[env, i]
    total = wp.float64(0.0)
    for j in range(pads):
        total += small.k[env, j, i] * x[env, j]
    return total


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
    wait_for_block()
    for i in range(lane, n, lanes):
        small.force[env, i] = stiffness_row(small, env, i, small.t)
    wait_for_block()
    for i in range(lane, n, lanes):
        total = wp.float64(0.0)
        for j in range(n):
            total += small.inverse[env, j, i] * small.force[env, j]
        small.t[env, i] = total
    wait_for_block()
    for i in range(lane, n, lanes):
        small.force[env, i] = small.force[env, i] - stiffness_row(small, env, i, small.t)


@wp.kernel
def eliminate_where_full(
    e: Elimination, inverse: MatArray2d, small: Small, r: VecArray2d, running: IntArray, threads: wp.int32, z: VecArray2d
):
    """Affine bodies eliminated from 3×3 blocks, in environments that do not fit."""
    env, lane = wp.tid()
    if running[env] != 0 and not fits(small, env):
        finish_elimination(e, inverse, env, lane, threads, r, z)


@wp.func
def scaled_force(rest: Rest, small: Small, env: wp.int32, a: wp.int32, r: VecArray2d) -> wp.vec3d:
    """L⁻¹ r at affine node a."""
    f = wp.vec3d()
    first = 4 * (a / 4)
    for j in range(a - first + 1):
        f += small.root[env, a, j] * r[env, rest.affine_node[first + j]]
    return f


@wp.func
def affine_motion(rest: Rest, small: Small, env: wp.int32, a: wp.int32, r: VecArray2d) -> wp.vec3d:
    """L⁻ᵀ (L⁻¹ r − W t) at affine node a.

    L⁻¹ r is computed again, since other threads overwrite z, where it stood.
    """
    x = wp.vec3d()
    first = 4 * (a / 4)
    s = rest.surface[rest.affine_node[first]]
    for i in range(a - first, 4):
        f = scaled_force(rest, small, env, first + i, r)
        if small.count[env] > 0 and small.touched[env, s] != 0:  # none are left where the inverse could not be computed
            k = 3 * (small.slot[env, s] + i)
            f -= wp.vec3d(small.force[env, k], small.force[env, k + 1], small.force[env, k + 2])
        x += wp.transpose(small.root[env, first + i, a - first]) * f
    return x


def even(room: int) -> int:
    """Contact nodes whose unknowns fill whole panels."""
    return room + room % 2


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
        room = even(max(1, min(room, nodes)))

        def zeros(*shape: int, dtype: type = wp.float32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        small = Small()
        small.touched, small.slot = zeros(batch, nodes, dtype=wp.int32), zeros(batch, nodes, dtype=wp.int32)
        small.count, small.pads = zeros(batch, dtype=wp.int32), zeros(batch, dtype=wp.int32)
        small.node = zeros(batch, room, dtype=wp.int32)
        small.known = wp.full(batch, -1, dtype=wp.int32, device=device)
        small.s, small.k, small.inverse = (zeros(batch, 3 * room, 3 * room, dtype=wp.float64) for _ in range(3))
        small.t, small.force = zeros(batch, 3 * room, dtype=wp.float64), zeros(batch, 3 * room, dtype=wp.float64)
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
                inputs = [contacts, rest, active, self.lanes, small]
                self._launch(add_bodies, (self.batch, self.bodies, self.lanes), inputs, self.lanes)
            self._launch(invert_small, (self.batch, self.lanes), [rest, active, self.lanes, small], self.lanes)

    def find_forces(self, y: wp.array, z: wp.array, running: wp.array, place: wp.array) -> None:
        """Compute ``small.force`` = W t for the running environments.

        y (parts, B, n) holds K_0⁻¹ r of pads at an environment's ``place`` (B,), z (B, N) L⁻¹ r of affine nodes.
        """
        inputs = [self.rest, y, z, running, place, self.lanes, self.small]
        self._launch(contact_forces, (self.batch, self.lanes), inputs, self.lanes)
