"""Block-Jacobi: 3×3 diagonal blocks with contacts, and the affine bodies eliminated."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import IntArray, MatArray2d, VecArray2d
from ipc.bodies.layout import Layout
from ipc.contact.contacts import Contacts, rows_of
from ipc.solver.affine_elimination import AffineElimination, Elimination, fits, positive_inverse, soft_part, soft_share
from ipc.solver.linear import SystemView, row_column
from ipc.solver.lines import factor_lines, make_lines

wp.set_module_options({"enable_backward": False})


@wp.kernel
def diagonal_blocks(system: SystemView, active: IntArray, out: MatArray2d):
    """Diagonal blocks of the matrix without contacts."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    D = system.blocks[env, system.diagonal[i]]
    for m in range(system.node_pair_start[i], system.node_pair_start[i + 1]):
        q = system.volume_row[env, system.node_pair[m]]
        D += wp.outer(q, q)
    out[env, i] = D


@wp.kernel
def diagonal_rows(system: SystemView, contacts: Contacts, spread: wp.bool, active: IntArray, lanes: wp.int32, out: MatArray2d):
    """Add the diagonal blocks of Σ q qᵀ.

    With ``spread`` they are s sᵀ/β in rows that couple soft nodes with an affine body.
    """
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        share = wp.float64(0.0)
        if spread:
            share = soft_share(system, verts, row)
        for k in range(4):
            v = verts[k]
            if v >= 0:
                q = wp.transpose(system.R[env, system.verts.body[v]]) * row_column(row, k)
                scale = wp.float64(1.0)
                size = wp.length(q)
                if share > wp.float64(0.0) and size > wp.float64(0.0):
                    if soft_part(system, v) >= 0:
                        scale = share / size
                for m in range(system.verts.count[v]):
                    w = system.verts.weight[v, m]
                    wp.atomic_add(out, env, system.verts.nodes[v, m], (scale * w * w) * wp.outer(q, q))


@wp.kernel
def invert_blocks(free: IntArray, active: IntArray, blocks: MatArray2d):
    """Invert in place; a block that is not positive becomes the inverse of its mean diagonal."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    if free[i] == 0:
        blocks[env, i] = wp.mat33d()
    else:
        blocks[env, i] = positive_inverse(blocks[env, i])


@wp.kernel
def apply_blocks(inverse: MatArray2d, r: VecArray2d, running: IntArray, z: VecArray2d):
    """z = D⁻¹ r."""
    env, i = wp.tid()
    if running[env] != 0:
        z[env, i] = inverse[env, i] * r[env, i]


class BlockJacobi:
    """Inverses of the 3×3 diagonal blocks with contact rows, and affine bodies eliminated.

    Where the elimination would take too much memory, the nodes of affine bodies have 3×3 blocks too.

    Args:
        layout: bodies of the world.
        batch: number of environments B.
        lanes: threads that share the contact rows of an environment.
        device: that holds the inverses.
    """

    on_host = False

    def __init__(self, layout: Layout, batch: int, lanes: int, device: wp.Device) -> None:
        self.lanes = lanes
        self.inverse = wp.zeros((batch, len(layout.node_rest)), dtype=wp.mat33d, device=device)
        self.affine = AffineElimination(layout, batch, lanes, device) if fits(layout, batch) else None
        self.elimination = self.affine.view if self.affine else Elimination()
        """Arrays for :mod:`ipc.solver.pcg_block`, empty where nothing is eliminated."""
        self.lines: Any = None
        """Lines of nodes, where one thread solves a system (:mod:`ipc.solver.pcg_serial`)."""

    def use_lines(self, layout: Layout, where: NDArray[np.integer]) -> None:
        """Take lines of nodes together; ``where`` (K,): place of every block of the matrix."""
        self.lines = make_lines(layout, where, len(self.inverse), self.inverse.device)

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in the matrix of the active environments; ``rows`` is the largest row count."""
        device, dim = self.inverse.device, self.inverse.shape
        wp.launch(diagonal_blocks, dim=dim, inputs=[system, active], outputs=[self.inverse], device=device)
        if rows:
            inputs = [system, contacts, self.affine is not None, active, self.lanes]
            wp.launch(diagonal_rows, dim=(dim[0], self.lanes), inputs=inputs, outputs=[self.inverse], device=device)
        if self.lines is None:
            wp.launch(invert_blocks, dim=dim, inputs=[system.free, active], outputs=[self.inverse], device=device)
        else:
            wp.launch(factor_lines, dim=dim[0], inputs=[self.lines, system, active], outputs=[self.inverse], device=device)
        if self.affine:
            self.affine.update(system, contacts, rows, self.inverse, active)

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r for the running environments; arrays (B, N) of vec3d.

        With lines :mod:`ipc.solver.pcg_serial` applies it instead.
        """
        assert self.lines is None, "with lines, inverse has the pivots of their factors, not inverses of diagonal blocks"
        wp.launch(apply_blocks, dim=r.shape, inputs=[self.inverse, r, running], outputs=[z], device=r.device)
        if self.affine:
            self.affine.finish(self.inverse, r, running, z)
