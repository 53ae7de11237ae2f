"""Elimination of the unknowns of affine bodies in block-Jacobi, with all their contacts.

With soft nodes s and the nodes a of affine bodies, four a body, block-Jacobi of H = [H_ss C; Cᵀ A] would forget C and all but the diagonal
blocks of A. A stiff contact then holds each side in place, and conjugate gradients take an iteration for every motion that both sides
make together. Here M keeps C and A as they are:

    M = [D C; Cᵀ A],    x_a = S⁻¹ (r_a − Cᵀ D⁻¹ r_s),    x_s = D⁻¹ (r_s − C x_a),    S = A − Cᵀ D⁻¹ C,

which is a block LDLᵀ factorisation (Golub, Van Loan 2013, section 4.1.5), with D of 3×3 blocks. D has to be large enough for the couplings
between soft nodes that it lacks. A row q = (s_1, …, s_m; g) of the contact Hessian, s_i at soft nodes and g at an affine body,
is replaced by

    Σ_i β_i (s_i·x_i/β_i + g·x_a)² ≥ (Σ_i s_i·x_i + g·x_a)²,    β_i = ‖s_i‖ / Σ_j ‖s_j‖,

by Jensen's inequality: a spring from each soft node to the body. That leaves C and A unchanged, and gives node i the block
s_i s_iᵀ/β_i; M is positive definite wherever the elastic blocks are. A world of affine bodies alone has M = H.

S is factored as L D_S Lᵀ in 3×3 blocks, one block of threads an environment; columns of bodies that do not touch are skipped.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.arrays import IntArray, IntArray2d, MatArray2d, VecArray2d, filled
from ipc.blocks import THREADS, wait_for_block
from ipc.bodies.layout import Layout
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.linear import SystemView, row_column

wp.set_module_options({"enable_backward": False})

MOST_BYTES = 2**30
"""Memory that S and C of all environments may take; worlds that need more keep block-Jacobi."""
_PARTS = 16
"""Threads that add up one entry of Cᵀ D⁻¹ r."""
_BLOCK_BYTES = 72


@wp.struct
class Elimination:
    """Work space of the elimination: A affine nodes, s soft nodes that may touch them.

    ``node`` (A,): affine nodes, body by body.    ``place`` (N,): a node's number among them or −1.
    ``soft_node`` (s,): soft surface nodes that are unknowns.    ``soft_place`` (N,): a node's number among them or −1.
    ``touched`` (B, s): mark of a soft node in a row with an affine body.    ``count`` (B,), ``touching`` (B, s): their list.
    ``coupling`` (B, A, s): blocks of C, rows at the soft node.    ``schur`` (B, A, A): S, then L below its diagonal.
    ``pivot`` (B, A): inverses of the pivots.    ``column``, ``lower`` (B, A), ``filled`` (B, A): work space of the factorisation.
    ``part`` (B, A, parts), ``g`` (B, A): work space of an application.
    """

    node: IntArray
    place: IntArray
    soft_node: IntArray
    soft_place: IntArray
    touched: IntArray2d
    count: IntArray
    touching: IntArray2d
    coupling: wp.array3d(dtype=wp.mat33d)
    schur: wp.array3d(dtype=wp.mat33d)
    pivot: MatArray2d
    column: MatArray2d
    lower: MatArray2d
    filled: IntArray2d
    part: wp.array3d(dtype=wp.vec3d)
    g: VecArray2d


@wp.func
def soft_part(system: SystemView, v: wp.int32) -> wp.int32:
    """The free node that vertex v follows alone, or −1."""
    if v < 0:
        return -1
    if system.verts.count[v] != 1:
        return -1
    node = system.verts.nodes[v, 0]
    if system.free[node] == 0:
        return -1
    return node


@wp.func
def is_affine(system: SystemView, v: wp.int32) -> wp.bool:
    """True if vertex v follows the four nodes of an affine body."""
    if v < 0:
        return False
    return system.verts.count[v] == 4


@wp.func
def soft_share(system: SystemView, verts: wp.vec4i, row: mat34d) -> wp.float64:
    """Σ ‖s_i‖ of a row that couples soft nodes with an affine body; 0 of other rows."""
    total = wp.float64(0.0)
    mixed = wp.int32(0)
    for k in range(4):
        if is_affine(system, verts[k]):
            mixed = 1
        elif soft_part(system, verts[k]) >= 0:
            total += wp.length(row_column(row, k))
    if mixed == 0:
        return wp.float64(0.0)
    return total


@wp.func
def affine_part(system: SystemView, verts: wp.vec4i, row: mat34d, env: wp.int32, first: wp.int32) -> mat34d:
    """The row at the four nodes of the affine body whose first node is ``first``, in its frame."""
    g = mat34d()
    for k in range(4):
        if is_affine(system, verts[k]):
            if system.verts.nodes[verts[k], 0] == first:
                q = wp.transpose(system.R[env, system.verts.body[verts[k]]]) * row_column(row, k)
                for m in range(4):
                    w = system.verts.weight[verts[k], m]
                    for c in range(3):
                        g[c, m] = g[c, m] + w * q[c]
    return g


@wp.func
def affine_first(system: SystemView, verts: wp.vec4i, after: wp.int32) -> wp.int32:
    """First node of an affine body of the row, of another one than ``after`` begins; or −1."""
    for k in range(4):
        if is_affine(system, verts[k]):
            first = system.verts.nodes[verts[k], 0]
            if first != after:
                return first
    return -1


@wp.kernel
def clear_elimination(e: Elimination, system: SystemView, active: IntArray):
    """Clear the couplings; S begins as the affine bodies' own blocks."""
    env, a, s = wp.tid()
    if active[env] == 0:
        return
    if s < e.soft_node.shape[0]:
        e.coupling[env, a, s] = wp.mat33d()
        if a == 0:
            e.touched[env, s] = 0
    if s < e.node.shape[0]:
        block = wp.mat33d()
        if s / 4 == a / 4:
            i = e.node[a]
            k = system.row_base[i]
            for _ in range(system.row_length[i]):
                if system.col[k] == e.node[s]:
                    block = system.blocks[env, k]
                k += system.stride
        e.schur[env, a, s] = block


@wp.kernel
def couple_rows(e: Elimination, system: SystemView, contacts: Contacts, active: IntArray, lanes: wp.int32):
    """Add the rows' shares of A and C."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        one = affine_first(system, verts, -1)
        if one >= 0:
            other = affine_first(system, verts, one)
            g = affine_part(system, verts, row, env, one)
            a = e.place[one]
            for m in range(4):
                for n in range(4):
                    wp.atomic_add(e.schur, env, a + m, a + n, wp.outer(row_column(g, m), row_column(g, n)))
            if other >= 0:
                h = affine_part(system, verts, row, env, other)
                b = e.place[other]
                for m in range(4):
                    for n in range(4):
                        wp.atomic_add(e.schur, env, b + m, b + n, wp.outer(row_column(h, m), row_column(h, n)))
                        wp.atomic_add(e.schur, env, a + m, b + n, wp.outer(row_column(g, m), row_column(h, n)))
                        wp.atomic_add(e.schur, env, b + m, a + n, wp.outer(row_column(h, m), row_column(g, n)))
            for k in range(4):
                node = soft_part(system, verts[k])
                if node >= 0:
                    s = e.soft_place[node]
                    q = wp.transpose(system.R[env, system.verts.body[verts[k]]]) * row_column(row, k)
                    e.touched[env, s] = 1
                    for m in range(4):
                        wp.atomic_add(e.coupling, env, a + m, s, wp.outer(q, row_column(g, m)))


@wp.kernel
def list_touching(e: Elimination, active: IntArray):
    """Soft nodes that touch affine bodies, in order."""
    env = wp.tid()
    if active[env] == 0:
        return
    n = wp.int32(0)
    for s in range(e.soft_node.shape[0]):
        if e.touched[env, s] != 0:
            e.touching[env, n] = s
            n += 1
    e.count[env] = n


@wp.func
def positive_inverse(A: wp.mat33d) -> wp.mat33d:
    """The inverse of a block; of its mean diagonal where it is not positive definite."""
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    det = wp.determinant(A)
    size = wp.trace(A) / wp.float64(3.0)
    zero = wp.float64(0.0)
    if A[0, 0] > zero and minor > zero and det > wp.float64(1.0e-12) * size * size * size:
        B = wp.inverse(A)
        return wp.float64(0.5) * (B + wp.transpose(B))
    return (wp.float64(1.0) / wp.max(wp.abs(size), wp.float64(1.0e-30))) * wp.identity(n=3, dtype=wp.float64)


@wp.func
def is_zero(A: wp.mat33d) -> wp.bool:
    """True if all entries are 0."""
    return wp.ddot(A, A) == wp.float64(0.0)


@wp.kernel
def factor_schur(e: Elimination, inverse: MatArray2d, active: IntArray, threads: wp.int32):
    """S = A − Cᵀ D⁻¹ C and its factors, one block of threads an environment."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    size = e.node.shape[0]
    for k in range(lane, size * size, threads):
        a = k / size
        b = k - a * size
        total = wp.mat33d()
        for m in range(e.count[env]):
            s = e.touching[env, m]
            C = e.coupling[env, b, s]
            if not is_zero(C):
                total += wp.transpose(e.coupling[env, a, s]) * inverse[env, e.soft_node[s]] * C
        e.schur[env, a, b] = e.schur[env, a, b] - total
    wait_for_block()
    for k in range(size):
        P = positive_inverse(e.schur[env, k, k])
        for i in range(k + 1 + lane, size, threads):
            column = e.schur[env, i, k]
            e.filled[env, i] = 1
            if is_zero(column):
                e.filled[env, i] = 0
            e.column[env, i] = column
            e.lower[env, i] = column * P
        wait_for_block()
        if lane == 0:
            e.pivot[env, k] = P
        for i in range(k + 1 + lane, size, threads):
            if e.filled[env, i] != 0:
                for j in range(k + 1, i + 1):
                    if e.filled[env, j] != 0:
                        e.schur[env, i, j] = e.schur[env, i, j] - e.lower[env, i] * wp.transpose(e.column[env, j])
                e.schur[env, i, k] = e.lower[env, i]
        wait_for_block()


@wp.func
def finish_elimination(
    e: Elimination, inverse: MatArray2d, env: wp.int32, lane: wp.int32, threads: wp.int32, r: VecArray2d, z: VecArray2d
):
    """z = M⁻¹ r, where z holds D⁻¹ r on the soft nodes; all threads of a block do this together."""
    size = e.node.shape[0]
    parts = e.part.shape[2]
    for k in range(lane, size * parts, threads):
        a = k / parts
        c = k - a * parts
        g = wp.vec3d()
        for m in range(c, e.count[env], parts):
            s = e.touching[env, m]
            g += wp.transpose(e.coupling[env, a, s]) * z[env, e.soft_node[s]]
        e.part[env, a, c] = g
    wait_for_block()
    for a in range(lane, size, threads):
        g = r[env, e.node[a]]
        for c in range(parts):
            g -= e.part[env, a, c]
        e.g[env, a] = g
    wait_for_block()
    for k in range(size):
        g = e.g[env, k]
        for i in range(k + 1 + lane, size, threads):
            e.g[env, i] = e.g[env, i] - e.schur[env, i, k] * g
        wait_for_block()
    for a in range(lane, size, threads):
        e.g[env, a] = e.pivot[env, a] * e.g[env, a]
    wait_for_block()
    for step in range(size):
        k = size - 1 - step
        g = e.g[env, k]
        for i in range(lane, k, threads):
            e.g[env, i] = e.g[env, i] - wp.transpose(e.schur[env, k, i]) * g
        wait_for_block()
    for a in range(lane, size, threads):
        z[env, e.node[a]] = e.g[env, a]
    for m in range(lane, e.count[env], threads):
        s = e.touching[env, m]
        node = e.soft_node[s]
        f = wp.vec3d()
        for a in range(size):
            f += e.coupling[env, a, s] * e.g[env, a]
        z[env, node] = z[env, node] - inverse[env, node] * f
    wait_for_block()


@wp.kernel
def eliminate(e: Elimination, inverse: MatArray2d, r: VecArray2d, running: IntArray, threads: wp.int32, z: VecArray2d):
    """z = M⁻¹ r of the running environments, where z holds D⁻¹ r."""
    env, lane = wp.tid()
    if running[env] != 0:
        finish_elimination(e, inverse, env, lane, threads, r, z)


class AffineElimination:
    """The affine bodies of a world in the preconditioner of :mod:`ipc.solver.block_jacobi`.

    Args:
        layout: bodies of the world.
        batch: number of environments B.
        lanes: threads that share the contact rows of an environment.
        device: that holds S and C.
    """

    def __init__(self, layout: Layout, batch: int, lanes: int, device: wp.Device) -> None:
        self.batch, self.lanes, self.device = batch, lanes, device
        self.threads = THREADS if device.is_cuda else 1
        count = len(layout.node_rest)
        nodes, soft = affine_nodes(layout), _soft_nodes(layout)
        place, soft_place = np.full(count, -1), np.full(count, -1)
        place[nodes], soft_place[soft] = np.arange(len(nodes)), np.arange(len(soft))
        numbers = {"node": nodes, "place": place, "soft_node": soft, "soft_place": soft_place}
        self.view = view = filled(Elimination, device, numbers)
        a, s = len(nodes), len(soft)

        def zeros(*shape: int, dtype: type = wp.mat33d) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        view.touched, view.touching = zeros(batch, s, dtype=wp.int32), zeros(batch, s, dtype=wp.int32)
        view.count, view.filled = zeros(batch, dtype=wp.int32), zeros(batch, a, dtype=wp.int32)
        view.coupling, view.schur = zeros(batch, a, s), zeros(batch, a, a)
        view.pivot, view.column, view.lower = zeros(batch, a), zeros(batch, a), zeros(batch, a)
        parts = min(_PARTS, max(1, self.threads // max(1, a)))
        view.part, view.g = zeros(batch, a, parts, dtype=wp.vec3d), zeros(batch, a, dtype=wp.vec3d)

    def update(self, system: SystemView, contacts: Contacts, rows: int, inverse: wp.array, active: wp.array) -> None:
        """Factor S of the active environments; ``inverse`` (B, N) is D⁻¹."""
        e, device = self.view, self.device
        a, s = e.coupling.shape[1:]
        wp.launch(clear_elimination, dim=(self.batch, a, max(a, s)), inputs=[e, system, active], device=device)
        if rows:
            inputs = [e, system, contacts, active, self.lanes]
            wp.launch(couple_rows, dim=(self.batch, self.lanes), inputs=inputs, device=device)
        wp.launch(list_touching, dim=self.batch, inputs=[e, active], device=device)
        inputs = [e, inverse, active, self.threads]
        wp.launch(factor_schur, dim=(self.batch, self.threads), inputs=inputs, device=device, block_dim=THREADS)

    def finish(self, inverse: wp.array, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r from z = D⁻¹ r for the running environments."""
        inputs = [self.view, inverse, r, running, self.threads]
        wp.launch(eliminate, dim=(self.batch, self.threads), inputs=inputs, outputs=[z], device=self.device, block_dim=THREADS)


def affine_nodes(layout: Layout) -> np.ndarray:
    """Nodes of affine bodies, body by body."""
    return np.unique(layout.vert_nodes[layout.vert_count == 4])


def _soft_nodes(layout: Layout) -> np.ndarray:
    """Soft unknowns on surfaces."""
    nodes = np.unique(layout.vert_nodes[layout.vert_count == 1, 0])
    return nodes[layout.node_free[nodes] != 0]


def fits(layout: Layout, batch: int) -> bool:
    """True if the world has affine bodies, and S and C of all environments fit into memory."""
    a, s = len(affine_nodes(layout)), len(_soft_nodes(layout))
    return 0 < batch * a * (a + s) * _BLOCK_BYTES <= MOST_BYTES
