"""Preconditioned conjugate gradients for a batch of systems at once, each with its own end.

An iteration is six launches that can be recorded: sums are taken by blocks of threads, and every thread adds the few shares of its
environment itself instead of waiting for a launch that does. On a CPU a block is one thread. With block-Jacobi small systems, and all on
a CPU, go to :mod:`ipc.solver.pcg_block`.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

from typing import Any, TypeGuard

import warp as wp

from ipc.arrays import FloatArray2d, IntArray, VecArray2d
from ipc.blocks import THREADS
from ipc.contact.contacts import Contacts
from ipc.reduce import BLOCK, chunks_of, raise_if_any, total_of
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.linear import Preconditioner, SystemView, find_volume_motions, multiply_blocks, multiply_rows
from ipc.solver.pcg_block import Scalars, solve_in_one_block
from ipc.solver.pcg_serial import Vectors, make_vectors, solve_serially

wp.set_module_options({"enable_backward": False})

ROUNDS = 2
"""Iterations between two looks at whether any environment still runs; an even number."""
ONE_BLOCK_NODES = 3000
"""Nodes up to which one block of threads solves a system."""
ONE_BLOCK_TOTAL = 600_000
"""The same for all environments: on an H200 304,000 gained, 1,160,000 lost a third."""


@wp.kernel
def dots(r: VecArray2d, z: VecArray2d, running: IntArray, threads: wp.int32, rr: FloatArray2d, rz: FloatArray2d):
    """Shares of r·r and r·z; blocks of threads (B, chunks, ``threads``)."""
    env, c, lane = wp.tid()
    a, b = wp.float64(0.0), wp.float64(0.0)
    if running[env] != 0:
        for i in range(c * threads + lane, r.shape[1], rr.shape[1] * threads):
            a += wp.length_sq(r[env, i])
            b += wp.dot(r[env, i], z[env, i])
    wp.tile_store(rr[env], wp.tile_sum(wp.tile(a)), offset=c)
    wp.tile_store(rz[env], wp.tile_sum(wp.tile(b)), offset=c)


@wp.kernel
def start(z: VecArray2d, rr: FloatArray2d, rz: FloatArray2d, active: IntArray, s: Scalars, p: VecArray2d, running: IntArray):
    """p = z, and which environments have anything to solve."""
    env, i = wp.tid()
    if active[env] == 0:
        if i == 0:
            running[env] = 0
        return
    p[env, i] = z[env, i]
    if i == 0:
        square = total_of(rr, env)
        s.rr0[env] = square
        s.rz[0, env] = total_of(rz, env)
        s.iterations[env] = 0
        s.negative[env] = 0
        running[env] = 0
        if square > wp.float64(0.0):
            running[env] = 1


@wp.kernel
def update_iterate(
    p: VecArray2d,
    Ap: VecArray2d,
    by_blocks: FloatArray2d,
    by_rows: FloatArray2d,
    parity: wp.int32,
    # outputs
    s: Scalars,
    running: IntArray,
    x: VecArray2d,
    r: VecArray2d,
):
    """x += α p, r −= α H p with α = r·z / p·Hp, the same in every thread of an environment."""
    env, i = wp.tid()
    if running[env] == 0:
        return
    curvature = total_of(by_blocks, env) + total_of(by_rows, env)
    if not (curvature > wp.float64(0.0)):
        # Not positive (or not finite): the caller makes the matrix definite and solves again.
        if i == 0:
            s.negative[env] = 1
            running[env] = 0
        return
    if i == 0:
        s.iterations[env] = s.iterations[env] + 1
    alpha = s.rz[parity, env] / curvature
    x[env, i] = x[env, i] + alpha * p[env, i]
    r[env, i] = r[env, i] - alpha * Ap[env, i]


@wp.kernel
def next_direction(
    z: VecArray2d,
    rr: FloatArray2d,
    rz: FloatArray2d,
    parity: wp.int32,
    tolerance: wp.float64,
    max_iterations: wp.int32,
    # outputs
    s: Scalars,
    running: IntArray,
    p: VecArray2d,
):
    """p = z + β p, unless ‖r‖ is small enough or the iterations are used up."""
    env, i = wp.tid()
    if running[env] == 0:
        return
    square = total_of(rr, env)
    if not (square > tolerance * tolerance * s.rr0[env]) or s.iterations[env] >= max_iterations:
        if i == 0:
            running[env] = 0
        return
    new = total_of(rz, env)
    p[env, i] = z[env, i] + (new / s.rz[parity, env]) * p[env, i]
    if i == 0:
        s.rz[1 - parity, env] = new


class Pcg:
    """Preconditioned conjugate gradients (Hestenes, Stiefel 1952).

    Args:
        batch, nodes: environments, B, and unknowns of each, N, three numbers each.
        lanes: threads that share the contact rows of an environment.
    """

    def __init__(self, batch: int, nodes: int, lanes: int, device: wp.Device) -> None:
        self.batch, self.nodes, self.lanes, self.device = batch, nodes, lanes, device
        # With one lane the sums, and so the choice between the two forms, must not depend on the batch.
        few = nodes <= ONE_BLOCK_NODES and (lanes == 1 or batch * nodes <= ONE_BLOCK_TOTAL)
        self.one_block = few or not device.is_cuda
        self._p, self._Ap, self._z = (wp.zeros((batch, nodes), dtype=wp.vec3d, device=device) for _ in range(3))
        self._threads = BLOCK if device.is_cuda else 1
        chunks = chunks_of(nodes) if device.is_cuda else 1
        self._by_blocks, self._rr, self._rz = (wp.zeros((batch, chunks), dtype=wp.float64, device=device) for _ in range(3))
        self._by_rows = wp.zeros((batch, -(-lanes // BLOCK)), dtype=wp.float64, device=device)
        self._running = wp.zeros(batch, dtype=wp.int32, device=device)
        self._any = wp.zeros(1, dtype=wp.int32, device=device)
        self._vectors = Vectors()
        self.scalars = Scalars()
        self.scalars.rz = wp.zeros((2, batch), dtype=wp.float64, device=device)
        self.scalars.rr0 = wp.zeros(batch, dtype=wp.float64, device=device)
        self.scalars.iterations = wp.zeros(batch, dtype=wp.int32, device=device)
        self.scalars.negative = wp.zeros(batch, dtype=wp.int32, device=device)

    def use_lines(self) -> None:
        """Prepare for a preconditioner with lines alone (:mod:`ipc.solver.pcg_serial`).

        The work space of the others is given back.
        """
        self._vectors = make_vectors(self.batch, self.nodes, self.device)
        del self._p, self._Ap, self._z

    def is_in_one_block(self, preconditioner: Preconditioner) -> TypeGuard[BlockJacobi]:
        """True if :mod:`ipc.solver.pcg_block` solves with this preconditioner."""
        return isinstance(preconditioner, BlockJacobi) and self.one_block

    def solve(
        self,
        system: SystemView,
        contacts: Contacts,
        preconditioner: Preconditioner,
        residual: wp.array,
        x: wp.array,
        tolerance: float,
        max_iterations: int,
        active: wp.array,
    ) -> None:
        """Add the solution of H δ = residual to x; ``scalars`` has iterations.

        Args:
            system, contacts: the matrix.
            preconditioner: already updated.
            residual: of x as it is (B, N); overwritten by the new one.
            x: solution so far (B, N), zero at first.
            tolerance: on ‖r‖/‖r_0‖.
            max_iterations: after these the solution so far stands (it is a descent direction).
            active: mask (B,).
        """
        if self.is_in_one_block(preconditioner) and preconditioner.lines is not None:
            inputs = [
                *(system, contacts, preconditioner.inverse, preconditioner.lines, preconditioner.elimination),
                *(tolerance, max_iterations, active, self._vectors),
            ]
            wp.launch(solve_serially, dim=self.batch, inputs=inputs, outputs=[residual, x, self.scalars], device=self.device)
        elif self.is_in_one_block(preconditioner):
            threads = THREADS if self.device.is_cuda else 1
            inputs = [
                *(system, contacts, preconditioner.inverse, preconditioner.elimination, tolerance, max_iterations),
                *(threads, min(self.lanes, threads), active),
                *(self._p, self._Ap),
            ]
            size, outputs = (self.batch, threads), [residual, x, self.scalars]
            wp.launch(solve_in_one_block, dim=size, inputs=inputs, outputs=outputs, device=self.device, block_dim=THREADS)
        else:
            self._solve_by_launches(system, contacts, preconditioner, residual, x, tolerance, max_iterations, active)

    def _solve_by_launches(
        self,
        system: SystemView,
        contacts: Contacts,
        preconditioner: Preconditioner,
        r: wp.array,
        x: wp.array,
        tolerance: float,
        max_iterations: int,
        active: wp.array,
    ) -> None:
        s, running, z, threads = self.scalars, self._running, self._z, self._threads
        blocks, row_blocks = (*self._rr.shape, threads), (*self._by_rows.shape, threads)
        volumes = system.volume_motion.shape

        def launch(kernel: Any, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=BLOCK)

        def look() -> None:
            self._any.zero_()
            launch(raise_if_any, (self.batch,), [running], [self._any])

        def iterate() -> None:
            for k in range(ROUNDS):
                parity = k % 2
                if volumes[1]:
                    launch(find_volume_motions, volumes, [system, self._p, running], [])
                launch(multiply_blocks, blocks, [system, self._p, running, threads], [self._Ap, self._by_blocks])
                inputs = [system, contacts, self._p, running, self.lanes, threads]
                launch(multiply_rows, row_blocks, inputs, [self._Ap, self._by_rows])
                launch(update_iterate, r.shape, [self._p, self._Ap, self._by_blocks, self._by_rows, parity], [s, running, x, r])
                preconditioner.apply(r, running, z)
                launch(dots, blocks, [r, z, running, threads], [self._rr, self._rz])
                inputs = [z, self._rr, self._rz, parity, tolerance, max_iterations]
                launch(next_direction, r.shape, inputs, [s, running, self._p])
            look()

        preconditioner.apply(r, active, z)
        launch(dots, blocks, [r, z, active, threads], [self._rr, self._rz])
        launch(start, r.shape, [z, self._rr, self._rz, active], [s, self._p, running])
        look()
        wp.capture_while(self._any, iterate)
