"""The Newton system and its solution by preconditioned conjugate gradients, all environments at once.

H = blocks + Σ q qᵀ: a block matrix of one pattern for every environment, and the contact rows. Warp's own conjugate gradients take
10 ms for one dot product of 9,450 numbers on a CPU, so this loop has its own; every environment has its own step lengths and stops
by itself. Sums are taken in chunks of nodes in a fixed order: the result does not depend on scheduling.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from ipc.contact import Contacts, mat34d

__all__ = ["BlockJacobi", "Pcg", "Preconditioner", "SystemView", "row_column", "row_sum"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sum_rows(values: wp.array2d(dtype=wp.float64), active: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.float64)):
    """Adds the values of each active environment, in order."""
    env = wp.tid()
    if active[env] == 0:
        return
    total = wp.float64(0.0)
    for i in range(values.shape[1]):
        total += values[env, i]
    out[env] = out[env] + total


@wp.kernel
def sum_chunks(
    values: wp.array2d(dtype=wp.float64), chunk: wp.int32, active: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.float64)
):
    env, c = wp.tid()
    if active[env] == 0:
        return
    total = wp.float64(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, values.shape[1])):
        total += values[env, i]
    out[env, c] = total


def row_sum(values: wp.array, active: wp.array, out: wp.array) -> None:
    """Add the sums of ``values`` (B, n) over the active environments to ``out`` (B,)."""
    batch, n = values.shape
    if n == 0:
        return
    if wp.get_device(values.device).is_cuda and n > 64:
        chunk = int(n**0.5) + 1
        partial = wp.empty((batch, -(-n // chunk)), dtype=wp.float64, device=values.device)
        wp.launch(sum_chunks, dim=partial.shape, inputs=[values, chunk, active], outputs=[partial], device=values.device)
        values = partial
    wp.launch(sum_rows, dim=batch, inputs=[values, active], outputs=[out], device=out.device)


@wp.struct
class SystemView:
    """What a product with H reads; ``free`` is 1 on the unknowns."""

    row_start: wp.array(dtype=wp.int32)
    col: wp.array(dtype=wp.int32)
    diagonal: wp.array(dtype=wp.int32)
    free: wp.array(dtype=wp.int32)
    node_body: wp.array(dtype=wp.int32)
    vert_body: wp.array(dtype=wp.int32)
    vert_count: wp.array(dtype=wp.int32)
    vert_nodes: wp.array2d(dtype=wp.int32)
    vert_weight: wp.array2d(dtype=wp.float64)
    blocks: wp.array2d(dtype=wp.mat33d)
    R: wp.array2d(dtype=wp.mat33d)


@wp.kernel
def multiply_blocks(
    system: SystemView, p: wp.array2d(dtype=wp.vec3d), active: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.vec3d)
):
    """out = blocks p on the unknowns, zero elsewhere."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    f = wp.vec3d()
    if system.free[i] != 0:
        for k in range(system.row_start[i], system.row_start[i + 1]):
            f += system.blocks[env, k] * p[env, system.col[k]]
    out[env, i] = f


@wp.func
def row_column(row: mat34d, k: wp.int32) -> wp.vec3d:
    return wp.vec3d(row[0, k], row[1, k], row[2, k])


@wp.func
def add_row(
    system: SystemView,
    contacts: Contacts,
    env: wp.int32,
    r: wp.int32,
    p: wp.array2d(dtype=wp.vec3d),
    out: wp.array2d(dtype=wp.vec3d),
):
    """out += q (q·p) of row r, on the unknowns."""
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    s = wp.float64(0.0)
    for k in range(4):
        v = verts[k]
        if v >= 0:
            if system.vert_count[v] > 0:
                local = wp.vec3d()
                for m in range(system.vert_count[v]):
                    local += system.vert_weight[v, m] * p[env, system.vert_nodes[v, m]]
                s += wp.dot(row_column(row, k), system.R[env, system.vert_body[v]] * local)
    for k in range(4):
        v = verts[k]
        if v >= 0:
            if system.vert_count[v] > 0:
                q = s * (wp.transpose(system.R[env, system.vert_body[v]]) * row_column(row, k))
                for m in range(system.vert_count[v]):
                    node = system.vert_nodes[v, m]
                    if system.free[node] != 0:
                        wp.atomic_add(out, env, node, system.vert_weight[v, m] * q)


@wp.kernel
def multiply_rows(
    system: SystemView,
    contacts: Contacts,
    p: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    # outputs
    out: wp.array2d(dtype=wp.vec3d),
):
    """out += Σ q (q·p); bonded nodes have p = 0 and get nothing."""
    env, r = wp.tid()
    if active[env] == 0 or r >= contacts.row_count[env]:
        return
    add_row(system, contacts, env, r, p, out)


@wp.kernel
def diagonal_blocks(system: SystemView, active: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.mat33d)):
    env, i = wp.tid()
    if active[env] != 0:
        out[env, i] = system.blocks[env, system.diagonal[i]]


@wp.kernel
def diagonal_rows(system: SystemView, contacts: Contacts, active: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.mat33d)):
    """Adds the diagonal blocks of Σ q qᵀ."""
    env, r = wp.tid()
    if active[env] == 0 or r >= contacts.row_count[env]:
        return
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    for k in range(4):
        v = verts[k]
        if v >= 0:
            q = wp.transpose(system.R[env, system.vert_body[v]]) * row_column(row, k)
            for m in range(system.vert_count[v]):
                w = system.vert_weight[v, m]
                wp.atomic_add(out, env, system.vert_nodes[v, m], (w * w) * wp.outer(q, q))


@wp.kernel
def invert_blocks(free: wp.array(dtype=wp.int32), active: wp.array(dtype=wp.int32), blocks: wp.array2d(dtype=wp.mat33d)):
    """Inverts in place; a block that is not positive (an unprojected Hessian may hold one) becomes the inverse of its mean diagonal."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    A = blocks[env, i]
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    det = wp.determinant(A)
    size = wp.trace(A) / wp.float64(3.0)
    zero = wp.float64(0.0)
    if free[i] == 0:
        blocks[env, i] = wp.mat33d()
    elif A[0, 0] > zero and minor > zero and det > wp.float64(1.0e-12) * size * size * size:
        B = wp.inverse(A)
        blocks[env, i] = wp.float64(0.5) * (B + wp.transpose(B))
    else:
        blocks[env, i] = (wp.float64(1.0) / wp.max(wp.abs(size), wp.float64(1.0e-30))) * wp.identity(n=3, dtype=wp.float64)


@wp.kernel
def apply_blocks(
    inverse: wp.array2d(dtype=wp.mat33d),
    r: wp.array2d(dtype=wp.vec3d),
    running: wp.array(dtype=wp.int32),
    z: wp.array2d(dtype=wp.vec3d),
):
    env, i = wp.tid()
    if running[env] != 0:
        z[env, i] = inverse[env, i] * r[env, i]


@wp.kernel
def dot_chunks(
    a: wp.array2d(dtype=wp.vec3d),
    b: wp.array2d(dtype=wp.vec3d),
    chunk: wp.int32,
    running: wp.array(dtype=wp.int32),
    # outputs
    partial: wp.array2d(dtype=wp.float64),
):
    env, c = wp.tid()
    if running[env] == 0:
        return
    total = wp.float64(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, a.shape[1])):
        total += wp.dot(a[env, i], b[env, i])
    partial[env, c] = total


@wp.struct
class Scalars:
    """Per environment: r·z, step length, its ratio, ‖r‖² at the start, iterations, and the negative-curvature flag."""

    rz: wp.array(dtype=wp.float64)
    alpha: wp.array(dtype=wp.float64)
    beta: wp.array(dtype=wp.float64)
    rr0: wp.array(dtype=wp.float64)
    rr: wp.array(dtype=wp.float64)
    iterations: wp.array(dtype=wp.int32)
    negative: wp.array(dtype=wp.int32)


@wp.func
def total_of(partial: wp.array2d(dtype=wp.float64), env: wp.int32) -> wp.float64:
    total = wp.float64(0.0)
    for c in range(partial.shape[1]):
        total += partial[env, c]
    return total


@wp.kernel
def start_scalars(
    rr: wp.array2d(dtype=wp.float64),
    rz: wp.array2d(dtype=wp.float64),
    active: wp.array(dtype=wp.int32),
    s: Scalars,
    running: wp.array(dtype=wp.int32),
):
    env = wp.tid()
    running[env] = 0
    if active[env] == 0:
        return
    s.rr0[env] = total_of(rr, env)
    s.rr[env] = s.rr0[env]
    s.rz[env] = total_of(rz, env)
    s.beta[env] = wp.float64(0.0)
    s.iterations[env] = 0
    s.negative[env] = 0
    if s.rr0[env] > wp.float64(0.0):
        running[env] = 1


@wp.kernel
def step_length(pap: wp.array2d(dtype=wp.float64), s: Scalars, running: wp.array(dtype=wp.int32)):
    env = wp.tid()
    if running[env] == 0:
        return
    curvature = total_of(pap, env)
    if curvature > wp.float64(0.0):
        s.alpha[env] = s.rz[env] / curvature
        s.iterations[env] = s.iterations[env] + 1
    else:
        # Not positive (or not finite): the caller makes the matrix definite and solves again.
        s.alpha[env] = wp.float64(0.0)
        s.negative[env] = 1
        running[env] = 0


@wp.kernel
def update_iterate(
    p: wp.array2d(dtype=wp.vec3d),
    Ap: wp.array2d(dtype=wp.vec3d),
    s: Scalars,
    running: wp.array(dtype=wp.int32),
    # outputs
    x: wp.array2d(dtype=wp.vec3d),
    r: wp.array2d(dtype=wp.vec3d),
):
    env, i = wp.tid()
    if running[env] != 0:
        x[env, i] = x[env, i] + s.alpha[env] * p[env, i]
        r[env, i] = r[env, i] - s.alpha[env] * Ap[env, i]


@wp.kernel
def next_scalars(
    rr: wp.array2d(dtype=wp.float64),
    rz: wp.array2d(dtype=wp.float64),
    tolerance: wp.float64,
    max_iterations: wp.int32,
    s: Scalars,
    # outputs
    running: wp.array(dtype=wp.int32),
):
    env = wp.tid()
    if running[env] == 0:
        return
    new = total_of(rz, env)
    s.rr[env] = total_of(rr, env)
    s.beta[env] = new / s.rz[env]
    s.rz[env] = new
    if not (s.rr[env] > tolerance * tolerance * s.rr0[env]) or s.iterations[env] >= max_iterations:
        running[env] = 0


@wp.kernel
def next_direction(z: wp.array2d(dtype=wp.vec3d), s: Scalars, running: wp.array(dtype=wp.int32), p: wp.array2d(dtype=wp.vec3d)):
    env, i = wp.tid()
    if running[env] != 0:
        p[env, i] = z[env, i] + s.beta[env] * p[env, i]


@wp.kernel
def solve_in_one_thread(
    system: SystemView,
    contacts: Contacts,
    inverse: wp.array2d(dtype=wp.mat33d),
    tolerance: wp.float64,
    max_iterations: wp.int32,
    active: wp.array(dtype=wp.int32),
    p: wp.array2d(dtype=wp.vec3d),
    Ap: wp.array2d(dtype=wp.vec3d),
    # outputs
    r: wp.array2d(dtype=wp.vec3d),
    x: wp.array2d(dtype=wp.vec3d),
    s: Scalars,
):
    """All iterations of one environment, one after the other: what a CPU does anyway, without a launch for every vector operation."""
    env = wp.tid()
    if active[env] == 0:
        return
    zero = wp.float64(0.0)
    n = r.shape[1]
    s.iterations[env] = 0
    s.negative[env] = 0
    rr0 = wp.float64(0.0)
    rz = wp.float64(0.0)
    for i in range(n):
        z = inverse[env, i] * r[env, i]
        p[env, i] = z
        rr0 += wp.length_sq(r[env, i])
        rz += wp.dot(r[env, i], z)
    if rr0 == zero:
        return
    rows = wp.min(contacts.row_count[env], contacts.row.shape[1])
    for it in range(max_iterations):
        for i in range(n):
            f = wp.vec3d()
            if system.free[i] != 0:
                for k in range(system.row_start[i], system.row_start[i + 1]):
                    f += system.blocks[env, k] * p[env, system.col[k]]
            Ap[env, i] = f
        for row in range(rows):
            add_row(system, contacts, env, row, p, Ap)
        curvature = wp.float64(0.0)
        for i in range(n):
            curvature += wp.dot(p[env, i], Ap[env, i])
        if not (curvature > zero):
            s.negative[env] = 1
            return
        alpha = rz / curvature
        rr = wp.float64(0.0)
        new = wp.float64(0.0)
        for i in range(n):
            x[env, i] = x[env, i] + alpha * p[env, i]
            left = r[env, i] - alpha * Ap[env, i]
            r[env, i] = left
            rr += wp.length_sq(left)
            new += wp.dot(left, inverse[env, i] * left)
        s.iterations[env] = it + 1
        if not (rr > tolerance * tolerance * rr0):
            return
        beta = new / rz
        rz = new
        for i in range(n):
            p[env, i] = inverse[env, i] * r[env, i] + beta * p[env, i]


class Preconditioner(Protocol):
    """Approximates H⁻¹, symmetric and positive definite."""

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in the matrix of the active environments; ``rows`` is the largest row count."""
        ...

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r for the running environments; arrays (B, N) of vec3d."""
        ...


class BlockJacobi:
    """Inverses of the 3×3 diagonal blocks, contact rows included."""

    def __init__(self, batch: int, nodes: int, device: wp.Device) -> None:
        self.inverse = wp.zeros((batch, nodes), dtype=wp.mat33d, device=device)

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        device, dim = self.inverse.device, self.inverse.shape
        wp.launch(diagonal_blocks, dim=dim, inputs=[system, active], outputs=[self.inverse], device=device)
        if rows:
            wp.launch(diagonal_rows, dim=(dim[0], rows), inputs=[system, contacts, active], outputs=[self.inverse], device=device)
        wp.launch(invert_blocks, dim=dim, inputs=[system.free, active], outputs=[self.inverse], device=device)

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        wp.launch(apply_blocks, dim=r.shape, inputs=[self.inverse, r, running], outputs=[z], device=r.device)


@dataclass(frozen=True)
class PcgResult:
    """Iterations and whether negative curvature was met, per environment, shape (B,)."""

    iterations: np.ndarray
    negative: np.ndarray


GRAPH_ITERATIONS = 8
"""PCG iterations between two looks at the flags on CUDA."""


def any_set(flags: wp.array) -> bool:
    """Whether any flag is set; waits for the device."""
    return bool(flags.numpy().any())


class Pcg:
    """Preconditioned conjugate gradients (Hestenes, Stiefel 1952) for a batch of systems."""

    def __init__(self, batch: int, nodes: int, device: wp.Device) -> None:
        self.device = device
        self.batch, self.nodes = batch, nodes
        # One chunk of nodes a thread: on a CPU the kernels are sequential, and one chunk has the least overhead.
        self.chunk = int(nodes**0.5) + 1 if device.is_cuda else nodes
        self._p, self._Ap, self._z = (wp.zeros((batch, nodes), dtype=wp.vec3d, device=device) for _ in range(3))
        chunks = -(-nodes // self.chunk)
        self._a, self._b = (wp.zeros((batch, chunks), dtype=wp.float64, device=device) for _ in range(2))
        self._running = wp.zeros(batch, dtype=wp.int32, device=device)
        self._graph: wp.Graph | None = None
        self._graph_key: tuple = ()
        self._scalars = Scalars()
        for name in ("rz", "alpha", "beta", "rr0", "rr"):
            setattr(self._scalars, name, wp.zeros(batch, dtype=wp.float64, device=device))
        for name in ("iterations", "negative"):
            setattr(self._scalars, name, wp.zeros(batch, dtype=wp.int32, device=device))

    def _dot(self, a: wp.array, b: wp.array, mask: wp.array, out: wp.array) -> None:
        wp.launch(dot_chunks, dim=out.shape, inputs=[a, b, self.chunk, mask], outputs=[out], device=self.device)

    def multiply(self, system: SystemView, contacts: Contacts, rows: int, mask: wp.array, p: wp.array, out: wp.array) -> None:
        """out = H p for the environments of the mask."""
        wp.launch(multiply_blocks, dim=p.shape, inputs=[system, p, mask], outputs=[out], device=self.device)
        if rows:
            wp.launch(
                multiply_rows, dim=(self.batch, rows), inputs=[system, contacts, p, mask], outputs=[out], device=self.device
            )

    def _iterate(
        self,
        system: SystemView,
        contacts: Contacts,
        rows: int,
        preconditioner: Preconditioner,
        residual: wp.array,
        x: wp.array,
        tolerance: float,
        max_iterations: int,
    ) -> None:
        """One iteration of the running environments."""
        s, run, device = self._scalars, self._running, self.device
        wp.launch(next_direction, dim=x.shape, inputs=[self._z, s, run], outputs=[self._p], device=device)
        self.multiply(system, contacts, rows, run, self._p, self._Ap)
        self._dot(self._p, self._Ap, run, self._a)
        wp.launch(step_length, dim=self.batch, inputs=[self._a, s], outputs=[run], device=device)
        wp.launch(update_iterate, dim=x.shape, inputs=[self._p, self._Ap, s, run], outputs=[x, residual], device=device)
        preconditioner.apply(residual, run, self._z)
        self._dot(residual, residual, run, self._a)
        self._dot(residual, self._z, run, self._b)
        inputs = [self._a, self._b, tolerance, max_iterations, s]
        wp.launch(next_scalars, dim=self.batch, inputs=inputs, outputs=[run], device=device)

    def solve(
        self,
        system: SystemView,
        contacts: Contacts,
        rows: int,
        preconditioner: Preconditioner,
        residual: wp.array,
        x: wp.array,
        tolerance: float,
        max_iterations: int,
        active: wp.array,
    ) -> PcgResult:
        """Solve H x = residual for the active environments, from x = 0.

        Args:
            system, contacts, rows: the matrix.
            preconditioner: already updated.
            residual: right-hand side (B, N); overwritten by what is left of it.
            x: solution (B, N); must be zero for the active environments.
            tolerance: on ‖r‖/‖r_0‖.
            max_iterations: after these the solution so far stands (it is a descent direction).
            active: mask (B,).
        """
        s, run, device = self._scalars, self._running, self.device
        if not device.is_cuda and isinstance(preconditioner, BlockJacobi):
            inputs = [system, contacts, preconditioner.inverse, tolerance, max_iterations, active, self._p, self._Ap]
            wp.launch(solve_in_one_thread, dim=self.batch, inputs=inputs, outputs=[residual, x, s], device=device)
            return PcgResult(s.iterations.numpy().copy(), s.negative.numpy().astype(bool))
        preconditioner.apply(residual, active, self._z)
        self._dot(residual, residual, active, self._a)
        self._dot(residual, self._z, active, self._b)
        wp.launch(start_scalars, dim=self.batch, inputs=[self._a, self._b, active, s], outputs=[run], device=device)
        if not device.is_cuda:
            while any_set(run):
                self._iterate(system, contacts, rows, preconditioner, residual, x, tolerance, max_iterations)
            return PcgResult(s.iterations.numpy().copy(), s.negative.numpy().astype(bool))
        # A look at the flags costs a synchronisation and a launch costs more than most of these kernels, so several iterations are
        # recorded once as a graph and replayed; environments that are done do nothing. Recorded again when a buffer has grown.
        room = contacts.row.shape[1]
        key = (contacts.row.ptr, room, residual.ptr, x.ptr, tolerance, max_iterations, id(preconditioner))
        if self._graph is None or self._graph_key != key:
            # Once as plain launches, which loads every kernel; recording must not.
            self._iterate(system, contacts, room, preconditioner, residual, x, tolerance, max_iterations)
            with wp.ScopedCapture(device=device) as capture:
                for _ in range(GRAPH_ITERATIONS):
                    self._iterate(system, contacts, room, preconditioner, residual, x, tolerance, max_iterations)
            self._graph, self._graph_key = capture.graph, key
        while any_set(run):
            wp.capture_launch(self._graph)
        return PcgResult(s.iterations.numpy().copy(), s.negative.numpy().astype(bool))
