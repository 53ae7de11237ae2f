"""The contacts of the moment as a low-rank part of a preconditioner.

The rows q of the contact Hessian add Jᵀ S J at m contact nodes (J picks their 3m unknowns, S = Σ q qᵀ between them) to a matrix whose
inverse C = K_0⁻¹ is known: between all nodes of a pad's surface, and between the four nodes of an affine body, whose own 12 × 12 matrix
A = L Lᵀ is factored in each Newton iteration. By Woodbury's identity

    (K_0 + Jᵀ S J)⁻¹ = C − C Jᵀ W J C,      W = (S⁻¹ + J C Jᵀ)⁻¹ = K − K (K + S)⁻¹ K,      K = (J C Jᵀ)⁻¹.

The second form needs no inverse of S, which is not regular where friction is missing. An affine body is 10⁶ times as stiff against strain
as against motion: its unknowns are Lᵀ x and its rows L⁻¹ q here, for which K = 1; otherwise the difference would be lost to rounding.
W is computed in double precision by one block of threads an environment. An environment with more contact nodes than there is room
for is marked as one that does not fit: with part of its contacts the identity is of little use.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray2d, IntArray, IntArray2d, MatArray2d, SingleArray3d, VecArray2d
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.affine_elimination import Elimination, affine_first, affine_part, finish_elimination
from ipc.solver.blocks import wait_for_block
from ipc.solver.linear import SystemView, row_column

wp.set_module_options({"enable_backward": False})

mat1212d = wp.types.matrix(shape=(12, 12), dtype=wp.float64)
LANES = 256
"""Threads on CUDA for the small system of an environment; the size of all blocks."""


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
    ``a`` (B, m, m): the upper half of S, then (K + S)⁻¹.    ``k`` (B, m, m): K.
    ``product`` (B, m, m), ``row``, ``column`` (B, m): work space.
    ``w`` (B, 3m, 3m): W [N/m].
    ``t``, ``force`` (B, 3m): J K_0⁻¹ r [m], on affine nodes L⁻¹ r, and W t [N].
    ``root`` (B, A, 4): blocks of an affine node's row of L⁻¹, at the nodes of its body.
    """

    touched: IntArray2d
    slot: IntArray2d
    count: IntArray
    pads: IntArray
    node: IntArray2d
    known: IntArray
    a: wp.array3d(dtype=wp.mat33d)
    k: wp.array3d(dtype=wp.mat33d)
    product: wp.array3d(dtype=wp.mat33d)
    row: MatArray2d
    column: MatArray2d
    w: wp.array3d(dtype=wp.float64)
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
def scaled_part(
    system: SystemView, verts: wp.vec4i, row: mat34d, env: wp.int32, rest: Rest, small: Small, first: wp.int32
) -> mat34d:
    """L⁻¹ q of a row at the nodes of an affine body."""
    g, scaled = affine_part(system, verts, row, env, first), mat34d()
    for i in range(4):
        v = wp.vec3d()
        for j in range(i + 1):
            v += small.root[env, rest.affine[first] + i, j] * row_column(g, j)
        for c in range(3):
            scaled[c, i] = v[c]
    return scaled


@wp.func
def add_product(env: wp.int32, small: Small, i: wp.int32, q: wp.vec3d, a: wp.int32, g: mat34d):
    """S += q gᵀ between a node's unknowns and the nodes of an affine body, which come after it."""
    for m in range(4):
        wp.atomic_add(small.a, env, i, a + m, wp.outer(q, row_column(g, m)))


@wp.func
def add_own(env: wp.int32, small: Small, a: wp.int32, blocks: mat1212d):
    """S += the upper half of Σ g gᵀ of an affine body in slot a; −1 for none."""
    if a >= 0:
        for m in range(4):
            for n in range(m, 4):
                block = wp.mat33d()
                for i in range(3):
                    for j in range(3):
                        block[i, j] = blocks[3 * m + i, 3 * n + j]
                wp.atomic_add(small.a, env, a + m, a + n, block)


@wp.func
def own_product(g: mat34d) -> mat1212d:
    """The upper half of g gᵀ."""
    blocks = mat1212d()
    for m in range(4):
        for n in range(m, 4):
            for i in range(3):
                for j in range(3):
                    blocks[3 * m + i, 3 * n + j] = g[i, m] * g[j, n]
    return blocks


@wp.kernel
def add_rows(system: SystemView, contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """The upper half of S = Σ q qᵀ between the contact nodes, in the frames of their bodies.

    A thread sums what its rows give to one affine body, to which nearly all of them belong, and adds that at once.
    """
    env, lane = wp.tid()
    if active[env] == 0 or not fits(small, env):
        return
    place, own = wp.int32(-1), mat1212d()
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        one, other = affine_first(system, verts, -1), wp.int32(-1)
        if one >= 0:
            other = affine_first(system, verts, one)
        a, b = slot_of(env, rest, small, one), slot_of(env, rest, small, other)
        if a < 0:
            one, a, b = other, b, wp.int32(-1)
        g, h = mat34d(), mat34d()
        if a >= 0:
            g = scaled_part(system, verts, row, env, rest, small, one)
            if a != place:
                add_own(env, small, place, own)
                place, own = a, mat1212d()
            own += own_product(g)
        if b >= 0:
            h = scaled_part(system, verts, row, env, rest, small, other)
            add_own(env, small, b, own_product(h))
            for m in range(4):
                if a < b:
                    add_product(env, small, a + m, row_column(g, m), b, h)
                else:
                    add_product(env, small, b + m, row_column(h, m), a, g)
        for k in range(4):
            s = surface_of_vertex(system, rest, verts[k])
            if s >= 0:
                qi = wp.transpose(system.R[env, system.verts.body[verts[k]]]) * row_column(row, k)
                if wp.length_sq(qi) > wp.float64(0.0):
                    i = small.slot[env, s]
                    for m in range(4):
                        other_s = surface_of_vertex(system, rest, verts[m])
                        if other_s >= 0:
                            j = small.slot[env, other_s]
                            if i <= j:
                                qj = wp.transpose(system.R[env, system.verts.body[verts[m]]]) * row_column(row, m)
                                wp.atomic_add(small.a, env, i, j, wp.outer(qi, qj))
                    if a >= 0:
                        add_product(env, small, i, qi, a, g)
                    if b >= 0:
                        add_product(env, small, i, qi, b, h)
    add_own(env, small, place, own)


@wp.func
def invert_small(
    a: wp.array3d(dtype=wp.mat33d), small: Small, env: wp.int32, m: wp.int32, lane: wp.int32, lanes: wp.int32
) -> wp.bool:
    """Inverts the positive definite blocks ``a`` in place (Gauss-Jordan, without pivoting).

    All lanes of the environment work on it and get the same result: False where a pivot is not positive.
    """
    wait_for_block()
    for k in range(m):
        pivot = a[env, k, k]
        if not (wp.determinant(pivot) > wp.float64(0.0) and wp.trace(pivot) > wp.float64(0.0)):
            return False
        inverse = wp.inverse(pivot)
        for i in range(lane, m, lanes):
            small.column[env, i] = a[env, i, k]
            small.row[env, i] = inverse * a[env, k, i]
        wait_for_block()
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            if i == k and j == k:
                a[env, i, j] = inverse
            elif i == k:
                a[env, i, j] = small.row[env, j]
            elif j == k:
                a[env, i, j] = -(small.column[env, i] * inverse)
            else:
                a[env, i, j] = a[env, i, j] - small.column[env, i] * small.row[env, j]
        wait_for_block()
    return True


@wp.kernel
def factor_affine(rest: Rest, system: SystemView, active: IntArray, small: Small):
    """L⁻¹ of every affine body.

    Where its matrix is not positive definite, that of the mean diagonal of its blocks.
    """
    env, body = wp.tid()
    if active[env] == 0:
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
def rest_block(rest: Rest, a: wp.int32, b: wp.int32) -> wp.mat33d:
    """The block of K_0⁻¹ between two nodes of pads."""
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
    m, pads = small.count[env], small.pads[env]
    known = small.known[env] == pads
    for e in range(lane, m * m, lanes):
        i = e / m
        j = e - m * i
        if i < pads and j < pads:
            if not known:
                small.k[env, i, j] = rest_block(rest, small.node[env, i], small.node[env, j])
        elif i == j:
            small.k[env, i, j] = wp.identity(n=3, dtype=wp.float64)
        else:
            small.k[env, i, j] = wp.mat33d()
    good = wp.bool(True)
    if not known:
        good = invert_small(small.k, small, env, pads, lane, lanes)
    wait_for_block()
    if lane == 0:
        small.known[env] = pads
    if good:
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            if i <= j:
                T = small.a[env, i, j] + small.k[env, i, j]
                small.a[env, i, j] = T
                small.a[env, j, i] = wp.transpose(T)
        good = invert_small(small.a, small, env, m, lane, lanes)
    wait_for_block()
    if good:
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            if i < j:
                T = wp.float64(0.5) * (small.a[env, i, j] + wp.transpose(small.a[env, j, i]))
                small.a[env, i, j] = T
                small.a[env, j, i] = wp.transpose(T)
        wait_for_block()
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            total = wp.mat33d()
            for n in range(m):
                total += small.k[env, i, n] * small.a[env, n, j]
            small.product[env, i, j] = total
        wait_for_block()
        for e in range(lane, m * m, lanes):
            i = e / m
            j = e - m * i
            if i <= j:
                W = small.k[env, i, j]
                for n in range(m):
                    W -= small.product[env, i, n] * small.k[env, n, j]
                for p in range(3):
                    for q in range(3):
                        small.w[env, 3 * i + p, 3 * j + q] = W[p, q]
                        small.w[env, 3 * j + q, 3 * i + p] = W[p, q]
    elif lane == 0:
        # Something is not finite: without contacts it is still a preconditioner.
        small.count[env] = 0
        small.known[env] = -1
    wait_for_block()
    for e in range(lane, m * m, lanes):
        small.a[env, e / m, e % m] = wp.mat33d()


@wp.func
def sum_of_parts(y: SingleArray3d, place: wp.int32, u: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for c in range(y.shape[0]):
        total += y[c, place, u]
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
        total = wp.float64(0.0)
        for j in range(n):
            total += small.w[env, j, i] * small.t[env, j]
        small.force[env, i] = total


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
        if small.count[env] > 0 and small.touched[env, s] != 0:  # none are left where W could not be computed
            k = 3 * (small.slot[env, s] + i)
            f -= wp.vec3d(small.force[env, k], small.force[env, k + 1], small.force[env, k + 2])
        x += wp.transpose(small.root[env, first + i, a - first]) * f
    return x


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
        small.count, small.pads = zeros(batch, dtype=wp.int32), zeros(batch, dtype=wp.int32)
        small.node = zeros(batch, room, dtype=wp.int32)
        small.known = wp.full(batch, -1, dtype=wp.int32, device=device)
        small.a, small.k, small.product = (zeros(batch, room, room, dtype=wp.mat33d) for _ in range(3))
        small.row, small.column = zeros(batch, room, dtype=wp.mat33d), zeros(batch, room, dtype=wp.mat33d)
        small.w = zeros(batch, 3 * room, 3 * room, dtype=wp.float64)
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
            self._launch(factor_affine, (self.batch, self.bodies), [rest, system, active, small])
        if rows:
            inputs = [system, contacts, rest, active, self.row_lanes, small]
            self._launch(add_rows, (self.batch, self.row_lanes), inputs)
            self._launch(factor_small, (self.batch, self.lanes), [rest, active, self.lanes, small], self.lanes)

    def find_forces(self, y: wp.array, z: wp.array, running: wp.array, place: wp.array) -> None:
        """Compute ``small.force`` = W t for the running environments.

        y (parts, B, n) holds K_0⁻¹ r of pads at an environment's ``place`` (B,), z (B, N) L⁻¹ r of affine nodes.
        """
        inputs = [self.rest, y, z, running, place, self.lanes, self.small]
        self._launch(contact_forces, (self.batch, self.lanes), inputs, self.lanes)
