"""A preconditioner made for bonded pads: the inverse of the rest matrix, corrected for the contacts of the moment.

A bonded body has, in its own frame, one rest matrix K_0 = M/h² + K(rest) for every environment and step. It is inverted once. The
contact rows add Jᵀ S J at m contact nodes (J picks their 3m unknowns, S = Σ q qᵀ there), and by Woodbury's identity

    M⁻¹ = (K_0 + Jᵀ S J)⁻¹ = K_0⁻¹ − K_0⁻¹ Jᵀ W J K_0⁻¹,      W = (S⁻¹ + J K_0⁻¹ Jᵀ)⁻¹,

is exact as long as the body is at rest; deformation and what W leaves out are left to PCG. S is not regular (friction may be missing),
so a share REGULAR of the elastic stiffness of each contact node is added to it. K_0 + Jᵀ S J is positive definite whichever nodes J
picks, so more contact nodes than there is room for only cost iterations: the stiffest are taken. Nodes of other bodies have
block-Jacobi.

K_0⁻¹ is dense and in single precision; across a batch its application is one product of matrices. On CUDA everything is a launch of
fixed size on arrays of fixed address: it can be part of a graph.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.contact import Contacts
from ipc.layout import Layout
from ipc.linear import BlockJacobi, SystemView, row_column
from ipc.rest_stiffness import bonded_bodies, rest_blocks, rest_inverse
from ipc.settings import Settings

__all__ = ["RestInverse"]

wp.set_module_options({"enable_backward": False})

REGULAR = 1e-6
"""Stiffness added to every contact node, as a share of its elastic one."""
LANES = 256
"""Threads that share the small system of an environment on CUDA."""
TILE_ENVS, TILE_ROWS, TILE_DEPTH = 32, 64, 32
"""Tile of the product of matrices: environments × rows, summed over this many columns at a time."""
TILED_FROM = 8
"""Number of environments from which tiles pay; fewer are as many products of matrix and vector, which only read the matrix."""
CHUNKS = 64
"""Parts into which the sums of a product of matrix and vector are split, or too few threads would run."""
MAX_CONTACTS = 64
"""Contact nodes an environment that are treated exactly; the factorisation costs their number cubed."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_lanes():
    """Every lane's writes are there for all lanes after this; on a CPU there is one lane."""
    ...


@wp.struct
class Rest:
    """K_0⁻¹ of all bonded bodies and where their nodes are in it; n unknowns with padding, s nodes on a free surface.

    ``inverse`` holds the matrices one after the other, row by row; unknown u of part p is entry u − first[p] of a matrix of width[p]
    that starts at start[p]. ``unknown`` (N,) is a node's first unknown or −1, ``part`` (N,) its matrix, ``surface`` (N,) its number among
    the surface nodes or −1, ``surface_node`` (s,) the other way round.
    """

    inverse: wp.array(dtype=wp.float32)
    start: wp.array(dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    width: wp.array(dtype=wp.int32)
    unknown: wp.array(dtype=wp.int32)
    part: wp.array(dtype=wp.int32)
    surface: wp.array(dtype=wp.int32)
    surface_node: wp.array(dtype=wp.int32)


@wp.struct
class Small:
    """The contact nodes of each environment and their systems; m is the room.

    ``strength`` (B, s): largest ‖q‖² of a surface node [N/m].    ``slot`` (B, s): its place among the contact nodes, or −1.
    ``count`` (B,): contact nodes, before they are limited to the room.    ``node`` (B, m).    ``a`` (B, m, m), ``row``, ``column`` (B, m):
    work space.    ``w`` (B, 3m, 3m): W [N/m].    ``t``, ``force`` (B, 3m): J K_0⁻¹ r [m] and W t [N].
    """

    strength: wp.array2d(dtype=wp.float64)
    slot: wp.array2d(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    node: wp.array2d(dtype=wp.int32)
    a: wp.array3d(dtype=wp.mat33d)
    row: wp.array2d(dtype=wp.mat33d)
    column: wp.array2d(dtype=wp.mat33d)
    w: wp.array3d(dtype=wp.float32)
    t: wp.array2d(dtype=wp.float32)
    force: wp.array2d(dtype=wp.float32)


@wp.func
def rest_entry(rest: Rest, part: wp.int32, u: wp.int32, v: wp.int32) -> wp.float32:
    """K_0⁻¹ between two unknowns of one part."""
    return rest.inverse[rest.start[part] + (u - rest.first[part]) * rest.width[part] + v - rest.first[part]]


@wp.func
def contacts_of(small: Small, env: wp.int32) -> wp.int32:
    return wp.min(small.count[env], small.node.shape[1])


@wp.kernel
def forget_contacts(active: wp.array(dtype=wp.int32), small: Small):
    env, s = wp.tid()
    if active[env] == 0:
        return
    if s == 0:
        small.count[env] = 0
    small.strength[env, s] = wp.float64(0.0)
    small.slot[env, s] = -1


@wp.func
def surface_of_vertex(system: SystemView, rest: Rest, v: wp.int32) -> wp.int32:
    """Surface number of the node that vertex v follows, or −1: other bodies' vertices follow four nodes or none."""
    if v < 0:
        return -1
    if system.vert_count[v] != 1:
        return -1
    return rest.surface[system.vert_nodes[v, 0]]


@wp.kernel
def measure_rows(system: SystemView, contacts: Contacts, rest: Rest, active: wp.array(dtype=wp.int32), small: Small):
    """The strength of every surface node."""
    env, r = wp.tid()
    if active[env] == 0 or r >= contacts.row_count[env]:
        return
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    for k in range(4):
        s = surface_of_vertex(system, rest, verts[k])
        if s >= 0:
            size = wp.length_sq(row_column(row, k))
            if size > wp.float64(0.0):
                wp.atomic_max(small.strength, env, s, size)


@wp.kernel
def choose_contacts(rest: Rest, active: wp.array(dtype=wp.int32), small: Small):
    """The places of the contact nodes: by strength, then by number, so that they do not depend on scheduling."""
    env, s = wp.tid()
    if active[env] == 0:
        return
    mine = small.strength[env, s]
    if not (mine > wp.float64(0.0)):
        return
    wp.atomic_add(small.count, env, 1)
    place = wp.int32(0)
    for other in range(small.strength.shape[1]):
        theirs = small.strength[env, other]
        if theirs > mine or (theirs == mine and other < s):
            place += 1
    if place < small.node.shape[1]:
        small.node[env, place] = rest.surface_node[s]
        small.slot[env, s] = place


@wp.kernel
def clear_small(active: wp.array(dtype=wp.int32), small: Small):
    env, i, j = wp.tid()
    if active[env] != 0 and wp.max(i, j) < contacts_of(small, env):
        small.a[env, i, j] = wp.mat33d()


@wp.kernel
def add_rows(system: SystemView, contacts: Contacts, rest: Rest, active: wp.array(dtype=wp.int32), small: Small):
    """S = Σ q qᵀ between the contact nodes, in the frames of their bodies."""
    env, r = wp.tid()
    if active[env] == 0 or r >= contacts.row_count[env]:
        return
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    for k in range(4):
        s = surface_of_vertex(system, rest, verts[k])
        if s >= 0:
            i = small.slot[env, s]
            if i >= 0:
                qi = wp.transpose(system.R[env, system.vert_body[verts[k]]]) * row_column(row, k)
                for m in range(4):
                    other = surface_of_vertex(system, rest, verts[m])
                    if other >= 0:
                        j = small.slot[env, other]
                        if j >= 0:
                            qj = wp.transpose(system.R[env, system.vert_body[verts[m]]]) * row_column(row, m)
                            wp.atomic_add(small.a, env, i, j, wp.outer(qi, qj))


@wp.func
def invert_small(small: Small, env: wp.int32, m: wp.int32, lane: wp.int32, lanes: wp.int32) -> wp.bool:
    """The inverse of the blocks ``a``, in place (Gauss-Jordan; no pivots are needed where a matrix is positive definite).

    All lanes of the environment work on it and get the same answer: False where a pivot is not positive.
    """
    wait_for_lanes()
    for k in range(m):
        pivot = small.a[env, k, k]
        if not (wp.determinant(pivot) > wp.float64(0.0) and wp.trace(pivot) > wp.float64(0.0)):
            return False
        inverse = wp.inverse(pivot)
        for i in range(lane, m, lanes):
            small.column[env, i] = small.a[env, i, k]
            small.row[env, i] = inverse * small.a[env, k, i]
        wait_for_lanes()
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
        wait_for_lanes()
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
def factor_small(rest: Rest, active: wp.array(dtype=wp.int32), lanes: wp.int32, small: Small):
    """W from S, one block of threads an environment."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    m = contacts_of(small, env)
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
    if not good:
        # Something is not finite: without contacts it is still a preconditioner.
        wait_for_lanes()
        if lane == 0:
            small.count[env] = 0
        return
    for e in range(lane, m * m, lanes):
        i = e / m
        j = e - m * i
        W = wp.float64(0.5) * (small.a[env, i, j] + wp.transpose(small.a[env, j, i]))
        for p in range(3):
            for q in range(3):
                small.w[env, 3 * i + p, 3 * j + q] = wp.float32(W[p, q])


@wp.kernel
def gather_unknowns(
    rest: Rest, r: wp.array2d(dtype=wp.vec3d), running: wp.array(dtype=wp.int32), x: wp.array2d(dtype=wp.float32)
):
    """r of the bonded bodies in single precision, in the order of K_0⁻¹."""
    env, i = wp.tid()
    u = rest.unknown[i]
    if running[env] != 0 and u >= 0:
        for c in range(3):
            x[env, u + c] = wp.float32(r[env, i][c])


@wp.kernel
def multiply_vectors(
    matrix: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    first: wp.int32,
    length: wp.int32,
    running: wp.array(dtype=wp.int32),
    # outputs
    y: wp.array3d(dtype=wp.float32),
):
    """y[c] = the part of matrix · x that ``length`` columns contribute; neighbouring threads read neighbouring entries."""
    c, env, i = wp.tid()
    if running[env] == 0:
        return
    total = wp.float32(0.0)
    for j in range(c * length, wp.min((c + 1) * length, matrix.shape[0])):
        total += matrix[j, i] * x[env, first + j]
    y[c, env, first + i] = total


@wp.kernel
def multiply_tiles(
    matrix: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    first: wp.int32,
    running: wp.array(dtype=wp.int32),
    # outputs
    y: wp.array2d(dtype=wp.float32),
):
    """y = x · matrix in tiles; tiles without a running environment are left out."""
    i, j = wp.tid()
    some = wp.int32(0)
    for env in range(i * TILE_ENVS, wp.min((i + 1) * TILE_ENVS, running.shape[0])):
        some += running[env]
    if some == 0:
        return
    total = wp.tile_zeros(shape=(TILE_ENVS, TILE_ROWS), dtype=wp.float32)
    for k in range(matrix.shape[0] / TILE_DEPTH):
        a = wp.tile_load(x, shape=(TILE_ENVS, TILE_DEPTH), offset=(i * TILE_ENVS, first + k * TILE_DEPTH))
        b = wp.tile_load(matrix, shape=(TILE_DEPTH, TILE_ROWS), offset=(k * TILE_DEPTH, j * TILE_ROWS))
        wp.tile_matmul(a, b, total)
    wp.tile_store(y, total, offset=(i * TILE_ENVS, first + j * TILE_ROWS))


@wp.func
def sum_of_parts(y: wp.array3d(dtype=wp.float32), env: wp.int32, u: wp.int32) -> wp.float32:
    total = wp.float32(0.0)
    for c in range(y.shape[0]):
        total += y[c, env, u]
    return total


@wp.kernel
def contact_forces(rest: Rest, y: wp.array3d(dtype=wp.float32), running: wp.array(dtype=wp.int32), lanes: wp.int32, small: Small):
    """W J K_0⁻¹ r, one block of threads an environment."""
    env, lane = wp.tid()
    if running[env] == 0:
        return
    n = 3 * contacts_of(small, env)
    for i in range(lane, n, lanes):
        small.t[env, i] = sum_of_parts(y, env, rest.unknown[small.node[env, i / 3]] + i % 3)
    wait_for_lanes()
    for i in range(lane, n, lanes):
        total = wp.float32(0.0)
        for j in range(n):
            total += small.w[env, j, i] * small.t[env, j]
        small.force[env, i] = total


@wp.kernel
def scatter_unknowns(
    rest: Rest,
    small: Small,
    y: wp.array3d(dtype=wp.float32),
    running: wp.array(dtype=wp.int32),
    # outputs
    z: wp.array2d(dtype=wp.vec3d),
):
    """z = K_0⁻¹ r − K_0⁻¹ Jᵀ W J K_0⁻¹ r on the bonded bodies."""
    env, i = wp.tid()
    u = rest.unknown[i]
    if running[env] == 0 or u < 0:
        return
    part = rest.part[i]
    value = wp.vec3(sum_of_parts(y, env, u), sum_of_parts(y, env, u + 1), sum_of_parts(y, env, u + 2))
    for k in range(contacts_of(small, env)):
        node = small.node[env, k]
        if rest.part[node] == part:
            v = rest.unknown[node]
            for c in range(3):
                f = small.force[env, 3 * k + c]
                for d in range(3):
                    value[d] = value[d] - f * rest_entry(rest, part, v + c, u + d)
    z[env, i] = wp.vec3d(wp.float64(value[0]), wp.float64(value[1]), wp.float64(value[2]))


class RestInverse:
    """K_0⁻¹ of the bonded bodies with the contacts of the moment; block-Jacobi for other nodes (a ``Preconditioner``).

    Args:
        layout: with a bonded body at least.
        settings: time step and integrator.
        batch: number of environments.
        device: Warp device.
        max_contacts: contact nodes an environment that are treated exactly.

    Raises:
        numpy.linalg.LinAlgError: if a rest matrix is too ill-conditioned for single precision.
    """

    def __init__(
        self, layout: Layout, settings: Settings, batch: int, device: wp.Device, max_contacts: int = MAX_CONTACTS
    ) -> None:
        self.batch, self.device = batch, device
        count = len(layout.node_rest)
        unknown, part, surface = np.full(count, -1), np.full(count, -1), np.full(count, -1)
        blocks = rest_blocks(layout, settings)
        matrices, firsts = [], [0]
        for p, body in enumerate(bonded_bodies(layout)):
            span = np.arange(layout.node_start[body], layout.node_start[body + 1])
            nodes = span[layout.node_free[span] != 0]
            unknown[nodes], part[nodes] = firsts[-1] + 3 * np.arange(len(nodes)), p
            inverse = rest_inverse(layout, blocks, nodes)
            padding = -len(inverse) % TILE_ROWS
            matrices.append(np.pad(inverse, ((0, padding), (0, padding))))
            firsts.append(firsts[-1] + len(matrices[-1]))
        on_surface = np.unique(layout.vert_nodes[layout.vert_count == 1, 0])
        on_surface = on_surface[unknown[on_surface] >= 0]
        surface[on_surface] = np.arange(len(on_surface))
        starts = np.cumsum([0] + [m.size for m in matrices])
        self.others = BlockJacobi(batch, count, device) if (layout.node_free != 0)[unknown < 0].any() else None

        def ints(values: np.ndarray | list[int]) -> wp.array:
            return wp.array(np.asarray(values), dtype=wp.int32, device=device)

        rest = Rest()
        rest.inverse = wp.array(np.concatenate([m.ravel() for m in matrices]), dtype=wp.float32, device=device)
        rest.start, rest.first = ints(starts[:-1]), ints(firsts[:-1])
        rest.width = ints([len(m) for m in matrices])
        rest.unknown, rest.part, rest.surface, rest.surface_node = ints(unknown), ints(part), ints(surface), ints(on_surface)
        self.rest, self.firsts = rest, firsts
        self.matrices = [
            rest.inverse[int(s) : int(s) + m.size].reshape(m.shape) for s, m in zip(starts[:-1], matrices, strict=True)
        ]

        room = max(1, min(max_contacts, len(on_surface)))

        def zeros(*shape: int, dtype: type = wp.float32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        small = Small()
        small.strength = zeros(batch, max(1, len(on_surface)), dtype=wp.float64)
        small.slot = zeros(batch, max(1, len(on_surface)), dtype=wp.int32)
        small.count, small.node = zeros(batch, dtype=wp.int32), zeros(batch, room, dtype=wp.int32)
        small.a = zeros(batch, room, room, dtype=wp.mat33d)
        small.row, small.column = zeros(batch, room, dtype=wp.mat33d), zeros(batch, room, dtype=wp.mat33d)
        small.w, small.t, small.force = zeros(batch, 3 * room, 3 * room), zeros(batch, 3 * room), zeros(batch, 3 * room)
        self.small = small

        self.lanes = LANES if device.is_cuda else 1
        self.tiled = device.is_cuda and batch >= TILED_FROM
        chunks = max(1, CHUNKS // batch) if device.is_cuda and not self.tiled else 1
        rows = -(-batch // TILE_ENVS) * TILE_ENVS if self.tiled else batch
        self.x, self.y = zeros(rows, firsts[-1]), zeros(chunks, rows, firsts[-1])

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, block_dim: int = 256) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Choose the contact nodes of the active environments and factor their small systems."""
        if self.others is not None:
            self.others.update(system, contacts, rows, active)
        rest, small = self.rest, self.small
        self._launch(forget_contacts, small.strength.shape, [active, small])
        if rows:
            self._launch(measure_rows, (self.batch, rows), [system, contacts, rest, active, small])
            self._launch(choose_contacts, small.strength.shape, [rest, active, small])
            self._launch(clear_small, small.a.shape, [active, small])
            self._launch(add_rows, (self.batch, rows), [system, contacts, rest, active, small])
            self._launch(factor_small, (self.batch, self.lanes), [rest, active, self.lanes, small], self.lanes)

    def _multiply(self, running: wp.array) -> None:
        """y = K_0⁻¹ x."""
        for matrix, first in zip(self.matrices, self.firsts, strict=False):
            width = matrix.shape[0]
            if self.tiled:
                wp.launch_tiled(
                    multiply_tiles,
                    dim=(self.x.shape[0] // TILE_ENVS, width // TILE_ROWS),
                    inputs=[matrix, self.x, first, running],
                    outputs=[self.y[0]],
                    block_dim=128,
                    device=self.device,
                )
            elif self.device.is_cuda:
                chunks = self.y.shape[0]
                inputs = [matrix, self.x, first, -(-width // chunks), running]
                self._launch(multiply_vectors, (chunks, self.batch, width), [*inputs, self.y])
            else:
                part = slice(first, first + width)
                np.matmul(self.x.numpy()[:, part], matrix.numpy(), out=self.y.numpy()[0, :, part])

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r for the running environments; arrays (B, N) of vec3d."""
        if self.others is not None:
            self.others.apply(r, running, z)
        self._launch(gather_unknowns, r.shape, [self.rest, r, running, self.x])
        self._multiply(running)
        inputs = [self.rest, self.y, running, self.lanes, self.small]
        self._launch(contact_forces, (self.batch, self.lanes), inputs, self.lanes)
        self._launch(scatter_unknowns, r.shape, [self.rest, self.small, self.y, running, z])
