"""A preconditioner for bonded pads: the inverse of the rest matrix, corrected for contacts.

A bonded body has, in its own frame, one rest matrix K_0 = M/h² + K(rest) for every environment and step. It is inverted once
(``substructure.py``), in single precision, and the contacts are added as a low-rank part (``low_rank.py``): M is exact as long as
the body is at rest, and PCG deals with what deformation changes. Affine bodies are part of it with their own matrices, so that what
a pad presses against moves with it. Free soft bodies, and environments with more contacts than there is room for, have block-Jacobi.
Across a batch the application is a product of matrices that every environment shares. On CUDA
everything is a launch of fixed size on arrays of fixed address, so that it can be part of a graph.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.arrays import IntArray, MatArray2d, SingleArray2d, SingleArray3d, VecArray2d, filled
from ipc.blocks import THREADS as BLOCK_THREADS
from ipc.bodies.layout import Layout
from ipc.contact.contacts import Contacts
from ipc.settings import Settings
from ipc.solver.affine_elimination import affine_nodes
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.linear import SystemView
from ipc.solver.preconditioners.affine_factor import affine_motion, scaled_force
from ipc.solver.preconditioners.contact_nodes import Rest, Small, fits, rest_entry
from ipc.solver.preconditioners.low_rank import LANES, LowRank, eliminate_where_full, sum_of_parts
from ipc.solver.preconditioners.rest_stiffness import bonded_bodies, rest_blocks
from ipc.solver.preconditioners.substructure import Patch, choose_partition, condense

wp.set_module_options({"enable_backward": False})

TILE_ENVS, TILE_OUT, TILE_IN = 32, 64, 32
"""Tile of the product of matrices: environments × outputs, inputs summed at a time."""
TILES = 3000
"""Tiles of a product that are computed at the same time; few alone wait for memory."""
TILED_FROM = 8
"""Number of environments from which tiles are used instead of products with vectors."""
_TOGETHER = 4
vec4i = wp.types.vector(length=_TOGETHER, dtype=wp.int32)
mat43 = wp.types.matrix(shape=(_TOGETHER, 3), dtype=wp.float32)
THREADS = 200_000
"""Threads of a product with vectors; a GPU needs many to read memory at its full rate."""
MAX_CONTACTS = 200
"""Most contact nodes that an environment may have; factoring costs their number cubed."""
_PAIR_BYTES = 3 * 72
"""Memory for two contact nodes: a 3 × 3 block of three matrices."""
CONTACT_BYTES = 2**32
"""Most memory that the contacts of all environments may take."""
CONTACT_SHARE = 1 / 16
"""The same as a share of the device's memory."""


@wp.kernel
def multiply_vectors(
    matrix: SingleArray3d,
    x: SingleArray2d,
    x_first: wp.int32,
    y_first: wp.int32,
    length: wp.int32,
    running: IntArray,
    # outputs
    y: SingleArray3d,
):
    """y[c] = the share of ``length`` inputs in matrixᵀ x, patch by patch."""
    c, env, e = wp.tid()
    if running[env] == 0:
        return
    inputs, outputs = matrix.shape[1], matrix.shape[2]
    patch = e / outputs
    i = e - patch * outputs
    first = x_first + patch * inputs
    total = wp.float32(0.0)
    for j in range(c * length, wp.min((c + 1) * length, inputs)):
        total += matrix[patch, j, i] * x[env, first + j]
    y[c, env, y_first + e] = total


@wp.kernel
def place_running(running: IntArray, threads: wp.int32, place: IntArray, total_running: IntArray):
    """Numbers the running environments, so that products have no gaps; −1 for others.

    One block of threads.
    """
    lane = wp.tid()
    before = wp.int32(0)
    for first in range(0, running.shape[0], threads):
        env = first + lane
        runs = wp.int32(0)
        if env < running.shape[0]:
            runs = running[env]
        flags = wp.tile(runs)
        earlier = before + wp.untile(wp.tile_scan_exclusive(flags))
        if env < running.shape[0]:
            place[env] = wp.where(runs != 0, earlier, -1)
        before += wp.tile_extract(wp.tile_sum(flags), 0)
    if lane == 0:
        total_running[0] = before


@wp.kernel
def multiply_tiles(
    matrix: SingleArray3d, x: SingleArray2d, x_first: wp.int32, y_first: wp.int32, total_running: IntArray, y: SingleArray3d
):
    """y = x · matrix in tiles, patch by patch, with a sum y[c] for each part of the inputs.

    Of the environments that run, which come first.
    """
    both, i, j = wp.tid()
    part, patch = both / matrix.shape[0], both % matrix.shape[0]
    if i * TILE_ENVS >= total_running[0]:
        return
    inputs, outputs = matrix.shape[1], matrix.shape[2]
    block, steps = matrix[patch], inputs / TILE_IN
    length = (steps + y.shape[0] - 1) / y.shape[0]
    total = wp.tile_zeros(shape=(TILE_ENVS, TILE_OUT), dtype=wp.float32)
    for k in range(part * length, wp.min((part + 1) * length, steps)):
        a = wp.tile_load(x, shape=(TILE_ENVS, TILE_IN), offset=(i * TILE_ENVS, x_first + patch * inputs + k * TILE_IN))
        b = wp.tile_load(block, shape=(TILE_IN, TILE_OUT), offset=(k * TILE_IN, j * TILE_OUT))
        wp.tile_matmul(a, b, total)
    wp.tile_store(y[part], total, offset=(i * TILE_ENVS, y_first + patch * outputs + j * TILE_OUT))


class Product:
    """A matrix for each patch times a vector for each environment: y = Σ_c y[c] = matrixᵀ x.

    Args:
        matrix: shape (patches, inputs, outputs), both a multiple of the tile.
        x: (B or more, …) and y: (parts, B or more, …), where patch p has inputs from x_first + p·inputs and outputs likewise.
        total_running: how many environments run (1,); with tiles they have the first rows of x and y.
    """

    def __init__(
        self, matrix: wp.array, x: wp.array, y: wp.array, x_first: int, y_first: int, batch: int, total_running: wp.array
    ) -> None:
        self.matrix, self.x, self.y, self.batch, self.total_running = matrix, x, y, batch, total_running
        self.x_first, self.y_first = x_first, y_first
        self.y_whole = y[0]

    def compute(self, running: wp.array) -> None:
        """Compute the products of the running environments."""
        patches, inputs, outputs = self.matrix.shape
        common = [self.matrix, self.x, self.x_first, self.y_first]
        device = wp.get_device(self.matrix.device)
        if not device.is_cuda:
            for p in range(patches):
                x = self.x.numpy()[:, self.x_first + p * inputs :][:, :inputs]
                y = self.y_whole.numpy()[:, self.y_first + p * outputs :][:, :outputs]
                np.matmul(x, self.matrix.numpy()[p], out=y)
        elif tiled(self.batch, device):
            dim = (self.y.shape[0] * patches, self.x.shape[0] // TILE_ENVS, outputs // TILE_OUT)
            inputs = [*common, self.total_running]
            wp.launch_tiled(multiply_tiles, dim=dim, inputs=inputs, outputs=[self.y], block_dim=LANES, device=device)
        else:
            parts = self.y.shape[0]
            inputs_of = [*common, -(-inputs // parts), running]
            wp.launch(
                multiply_vectors, dim=(parts, self.batch, patches * outputs), inputs=inputs_of, outputs=[self.y], device=device
            )


def tiled(batch: int, device: wp.Device) -> bool:
    """True if products are computed in tiles."""
    return device.is_cuda and batch >= TILED_FROM


@wp.struct
class Inside:
    """Positions of nodes in the vectors of the patches.

    ``unknown`` (N,): first unknown of a node inside a patch, or −1.    ``patch_out`` (N,): where the first product leaves K_pp⁻¹ r of it.
    ``twin_start`` (N + 1,): the patches that an interface node borders on; ``twin_out`` is where the first product leaves Eᵀ r,
    ``twin_in`` where the second one reads x_Γ.
    """

    unknown: IntArray
    patch_out: IntArray
    twin_start: IntArray
    twin_out: IntArray
    twin_in: IntArray


@wp.kernel
def gather_inside(inside: Inside, r: VecArray2d, running: IntArray, place: IntArray, x: SingleArray2d):
    """r_p of every patch, in single precision."""
    env, i = wp.tid()
    u = inside.unknown[i]
    if running[env] != 0 and u >= 0:
        for c in range(3):
            x[place[env], u + c] = wp.float32(r[env, i][c])


@wp.kernel
def gather_interface(
    rest: Rest,
    inside: Inside,
    r: VecArray2d,
    y_inside: SingleArray3d,
    small: Small,
    jacobi: MatArray2d,
    running: IntArray,
    place: IntArray,
    # outputs
    x: SingleArray2d,
    z: VecArray2d,
):
    """r_Γ − Σ E_pᵀ r_p on the interface.

    z of nodes that have block-Jacobi, and L⁻¹ r in the place of z of affine bodies.
    """
    env, i = wp.tid()
    if running[env] == 0:
        return
    u = rest.unknown[i]
    if rest.affine[i] >= 0 and fits(small, env):
        z[env, i] = scaled_force(rest, small, env, rest.affine[i], r)
        return
    if (u < 0 and inside.unknown[i] < 0) or not fits(small, env):
        z[env, i] = jacobi[env, i] * r[env, i]
        return
    if u < 0:
        return
    for c in range(3):
        value = wp.float32(r[env, i][c])
        for k in range(inside.twin_start[i], inside.twin_start[i + 1]):
            value -= sum_of_parts(y_inside, place[env], inside.twin_out[k] + c)
        x[place[env], u + c] = value


@wp.kernel
def scatter_interface(
    rest: Rest,
    inside: Inside,
    small: Small,
    r: VecArray2d,
    y: SingleArray3d,
    running: IntArray,
    place: IntArray,
    # outputs
    z: VecArray2d,
    x_back: SingleArray2d,
):
    """x_Γ = S⁻¹ g − S⁻¹ Jᵀ W J S⁻¹ g, with a copy for every patch that borders on the node.

    x of affine bodies. Some contact nodes are read at once, since memory is what is waited for.
    """
    env, i = wp.tid()
    if running[env] == 0 or not fits(small, env):
        return
    if rest.affine[i] >= 0:
        z[env, i] = affine_motion(rest, small, env, rest.affine[i], r)
        return
    u = rest.unknown[i]
    if u < 0:
        return
    part, at = rest.part[i], place[env]
    value = wp.vec3(sum_of_parts(y, at, u), sum_of_parts(y, at, u + 1), sum_of_parts(y, at, u + 2))
    pads = small.pads[env]
    for first in range(0, pads, _TOGETHER):
        unknowns, forces = vec4i(), mat43()
        for j in range(_TOGETHER):
            k = wp.min(first + j, pads - 1)
            node = small.node[env, k]
            same = rest.part[node] == part and first + j < pads
            unknowns[j] = wp.where(same, rest.unknown[node], u)
            for c in range(3):
                forces[j, c] = wp.where(same, wp.float32(small.force[env, 3 * k + c]), wp.float32(0.0))
        for j in range(_TOGETHER):
            for c in range(3):
                for d in range(3):
                    value[d] = value[d] - forces[j, c] * rest_entry(rest, part, unknowns[j] + c, u + d)
    z[env, i] = wp.vec3d(wp.float64(value[0]), wp.float64(value[1]), wp.float64(value[2]))
    for k in range(inside.twin_start[i], inside.twin_start[i + 1]):
        for d in range(3):
            x_back[at, inside.twin_in[k] + d] = value[d]


@wp.kernel
def scatter_inside(
    inside: Inside,
    y_inside: SingleArray3d,
    y_back: SingleArray3d,
    small: Small,
    running: IntArray,
    place: IntArray,
    # outputs
    z: VecArray2d,
):
    """x_p = K_pp⁻¹ r_p − E_p x_Γ."""
    env, i = wp.tid()
    u = inside.unknown[i]
    if running[env] == 0 or u < 0 or not fits(small, env):
        return
    at = inside.patch_out[i]
    value = wp.vec3d()
    for c in range(3):
        value[c] = wp.float64(sum_of_parts(y_inside, place[env], at + c) - sum_of_parts(y_back, place[env], u + c))
    z[env, i] = value


def room(batch: int, device: wp.Device) -> int:
    """Contact nodes for which each of so many environments has memory."""
    memory = min(CONTACT_BYTES, CONTACT_SHARE * device.total_memory) if device.is_cuda else CONTACT_BYTES
    return int(min(MAX_CONTACTS, (memory / (_PAIR_BYTES * batch)) ** 0.5))


def padded(n: int) -> int:
    """The next multiple of a tile."""
    return -(-n // TILE_OUT) * TILE_OUT


class RestInverse:
    """K_0⁻¹ of the bonded and the affine bodies with their contacts, and block-Jacobi elsewhere.

    Args:
        layout: with a bonded body at least.
        lanes: threads that share the contact rows of an environment.
        max_contacts: contact nodes that an environment may have; with more it has block-Jacobi. None: as many as :func:`room` says.
        patches: into how many the inside of every body is cut, a power of two; 0 for none; None: as few operations as possible.

    Raises:
        numpy.linalg.LinAlgError: if a rest matrix is too ill-conditioned for single precision.
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        batch: int,
        lanes: int,
        device: wp.Device,
        max_contacts: int | None = None,
        patches: int | None = None,
    ) -> None:
        self.batch, self.device, self.on_host = batch, device, not device.is_cuda
        self._place = wp.array(np.arange(batch), dtype=wp.int32, device=device)
        self._total = wp.zeros(1, dtype=wp.int32, device=device)
        count = len(layout.node_rest)
        blocks = rest_blocks(layout, settings)
        bodies = [condense(layout, blocks, *choose_partition(layout, body, patches)) for body in bonded_bodies(layout)]
        unknown, part, surface = np.full(count, -1), np.full(count, -1), np.full(count, -1)
        widths = [padded(len(body.inverse)) for body in bodies]
        firsts, starts = np.cumsum([0, *widths]), np.cumsum([0, *(w * w for w in widths)])
        matrices = []
        for p, body in enumerate(bodies):
            unknown[body.interface], part[body.interface] = firsts[p] + 3 * np.arange(len(body.interface)), p
            padding = widths[p] - len(body.inverse)
            matrices.append(np.pad(body.inverse, ((0, padding), (0, padding))).ravel())
        on_surface = np.unique(layout.vert_nodes[layout.vert_count == 1, 0])
        on_surface = on_surface[unknown[on_surface] >= 0]
        affine_node = affine_nodes(layout)
        affine = np.full(count, -1)
        affine[affine_node] = np.arange(len(affine_node))
        touching = np.concatenate([on_surface, affine_node])
        surface[touching] = np.arange(len(touching))

        parts = {"inverse": np.concatenate(matrices), "start": starts[:-1], "first": firsts[:-1], "width": widths}
        numbers = {"unknown": unknown, "part": part, "surface": surface, "surface_node": touching}
        numbers |= {"affine": affine, "affine_node": affine_node}
        self.rest = rest = filled(Rest, device, parts | numbers)
        self.low_rank = LowRank(rest, batch, room(batch, device) if max_contacts is None else max_contacts, lanes, device)
        self.x, self.y = self._vectors(int(firsts[-1]), int(firsts[-1]))
        views = [rest.inverse[int(s) : int(s) + w * w].reshape((1, w, w)) for s, w in zip(starts, widths, strict=False)]
        self.products = [
            Product(view, self.x, self.y, int(first), int(first), batch, self._total)
            for view, first in zip(views, firsts, strict=False)
        ]
        self._lay_out_patches([patch for body in bodies for patch in body.patches], count)
        self.jacobi = BlockJacobi(layout, batch, lanes, device)
        self._free = bool(np.any((layout.node_free != 0) & (part < 0) & (affine < 0) & (self._inner < 0)))
        """Some unknowns, those of free soft bodies, always have block-Jacobi."""

    def _vectors(self, inputs: int, outputs: int) -> tuple[wp.array, wp.array]:
        """Padded inputs (B, inputs) and parts of outputs (parts, B, outputs) of a product."""
        parts, rows = 1, self.batch
        if tiled(self.batch, self.device):
            rows = -(-rows // TILE_ENVS) * TILE_ENVS
            parts = int(np.clip(TILES * TILE_ENVS * TILE_OUT // max(1, rows * outputs), 1, 8))
        elif self.device.is_cuda:
            parts = int(np.clip(THREADS // max(1, rows * outputs), 1, 64))
        x, y = (rows, inputs), (parts, rows, outputs)
        return tuple(wp.zeros(shape, dtype=wp.float32, device=self.device) for shape in (x, y))  # pyright: ignore[reportReturnType]

    def _lay_out_patches(self, patches: list[Patch], count: int) -> None:
        """The two products of the patches, all of one padded size: [K_pp⁻¹, E_p] and E_pᵀ."""
        inner = padded(max((3 * len(p.nodes) for p in patches), default=0))
        border = padded(max((3 * len(p.border) for p in patches), default=0))
        forward = np.zeros((len(patches), inner, inner + border), np.float32)
        backward = np.zeros((len(patches), border, inner), np.float32)
        unknown, patch_out = np.full(count, -1), np.full(count, -1)
        twins, outs, ins = [], [], []
        for p, patch in enumerate(patches):
            n, g = patch.extension.shape
            forward[p, :n, :n], forward[p, :n, inner : inner + g] = patch.inverse, patch.extension
            backward[p, :g, :n] = patch.extension.T
            unknown[patch.nodes] = p * inner + 3 * np.arange(len(patch.nodes))
            patch_out[patch.nodes] = p * (inner + border) + 3 * np.arange(len(patch.nodes))
            twins.append(patch.border)
            outs.append(p * (inner + border) + inner + 3 * np.arange(len(patch.border)))
            ins.append(p * border + 3 * np.arange(len(patch.border)))
        nodes = np.concatenate([np.zeros(0, int), *twins])
        order = np.argsort(nodes, kind="stable")

        twin_start = np.concatenate([[0], np.cumsum(np.bincount(nodes, minlength=count))])
        twin_out, twin_in = (np.concatenate([np.zeros(0, int), *places])[order] for places in (outs, ins))
        places = {"unknown": unknown, "patch_out": patch_out, "twin_start": twin_start, "twin_out": twin_out, "twin_in": twin_in}
        self.inside, self._inner = filled(Inside, self.device, places), unknown
        self.patched = bool(patches)
        self.x_inside, self.y_inside = self._vectors(len(patches) * inner, len(patches) * (inner + border))
        self.x_back, self.y_back = self._vectors(len(patches) * border, len(patches) * inner)
        if patches:
            matrices = [wp.array(m, dtype=wp.float32, device=self.device) for m in (forward, backward)]
            self.to_interface = Product(matrices[0], self.x_inside, self.y_inside, 0, 0, self.batch, self._total)
            self.from_interface = Product(matrices[1], self.x_back, self.y_back, 0, 0, self.batch, self._total)

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in the contacts of the active environments, and the diagonal where it is used."""
        self.low_rank.find_contacts(system, contacts, rows, active)
        self.jacobi.update(system, contacts, rows, active if self._free else self.low_rank.full)
        self.low_rank.update(system, contacts, rows, active)

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r for the running environments; arrays (B, N) of vec3d."""
        rest, inside, small, place = self.rest, self.inside, self.low_rank.small, self._place
        if tiled(self.batch, self.device):
            inputs, outputs = [running, BLOCK_THREADS], [place, self._total]
            wp.launch(place_running, BLOCK_THREADS, inputs, outputs, device=self.device, block_dim=BLOCK_THREADS)
        if self.patched:
            self._launch(gather_inside, r.shape, [inside, r, running, place], [self.x_inside])
            self.to_interface.compute(running)
        inputs = [rest, inside, r, self.y_inside, small, self.jacobi.inverse, running, place]
        self._launch(gather_interface, r.shape, inputs, [self.x, z])
        if self.jacobi.affine:
            threads = self.jacobi.affine.threads
            inputs = [self.jacobi.elimination, self.jacobi.inverse, small, r, running, threads]
            wp.launch(eliminate_where_full, (self.batch, threads), inputs, [z], device=self.device, block_dim=BLOCK_THREADS)
        for product in self.products:
            product.compute(running)
        self.low_rank.find_forces(self.y, z, running, place)
        self._launch(scatter_interface, r.shape, [rest, inside, small, r, self.y, running, place], [z, self.x_back])
        if self.patched:
            self.from_interface.compute(running)
            self._launch(scatter_inside, r.shape, [inside, self.y_inside, self.y_back, small, running, place], [z])
