"""The Newton matrix H = blocks ± Σ q qᵀ.

It is a block matrix of one pattern, with rows of volume blocks and of contacts.

Products with it, and what approximates its inverse. Everything here can be recorded in a CUDA graph: launches have fixed
dimensions, counts are read on the device.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import FloatArray2d, IntArray, MatArray2d, Vec4Array2d, VecArray2d
from ipc.contact.contacts import Contacts, mat34d, rows_of
from ipc.solver.frames import VertexMap

wp.set_module_options({"enable_backward": False})


@wp.struct
class SystemView:
    """Arrays that a product with H reads.

    ``free`` is 1 on the unknowns, ``project`` where H must be definite.

    Block s of row i lies at ``row_base[i] + s·stride``: rows are dealt out in slices of ``stride``, so that threads of neighbouring rows
    read neighbouring blocks (Monakov et al. 2010, sliced ELLPACK); with a stride of 1 the rows lie one after the other.

    Volume block b has a row q: ``volume_row`` (B, S) at the nodes ``pair_node`` from ``block_pair_start[b]`` on. Node i is in the pairs
    ``node_pair`` from ``node_pair_start[i]`` on. ``volume_motion`` (B, Q) is work space for q·p.

    For the products of :mod:`ipc.solver.halves`, and empty without them, ``above`` are the blocks above the diagonal between unknowns,
    those of row i from ``above_start[i]`` on (N+1,). ``half_rows`` (B, 3 U), ``half_diagonal`` (B, 3 N) are rows of these U blocks and of
    those on the diagonal, with contact rows, ``half_volume`` (B, S) those of volume blocks; four numbers each, the last 0.
    """

    row_base: IntArray
    row_length: IntArray
    stride: wp.int32
    col: IntArray
    diagonal: IntArray
    free: IntArray
    project: IntArray
    verts: VertexMap
    blocks: MatArray2d
    R: MatArray2d
    block_pair_start: IntArray
    pair_block: IntArray
    pair_node: IntArray
    node_pair_start: IntArray
    node_pair: IntArray
    volume_row: VecArray2d
    volume_motion: FloatArray2d
    above_start: IntArray
    above: IntArray
    half_rows: Vec4Array2d
    half_diagonal: Vec4Array2d
    half_volume: Vec4Array2d


def slice_rows(row_start: NDArray[np.int32], width: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Deal the blocks of a sparse matrix out in slices of ``width`` rows.

    Args:
        row_start: first block of each row and the total, (N+1,).
        width: rows that are interleaved.

    Returns:
        Position of each row's first block (N,), and of each block (K,); the largest position may exceed K.
    """
    length = np.diff(row_start)
    rows = np.arange(len(length))
    longest = np.array([length[a : a + width].max() for a in range(0, len(length), width)])
    base = np.concatenate([[0], np.cumsum(longest * width)])[rows // width] + rows % width
    inside = np.arange(row_start[-1]) - np.repeat(row_start[:-1], length)
    return base.astype(np.int32), (np.repeat(base, length) + inside * width).astype(np.int32)


@wp.func
def find_volume_motion(system: SystemView, env: wp.int32, b: wp.int32, p: VecArray2d):
    """``volume_motion`` = q·p of volume block b, which :func:`block_row` reads."""
    s = wp.float64(0.0)
    for k in range(system.block_pair_start[b], system.block_pair_start[b + 1]):
        s += wp.dot(system.volume_row[env, k], p[env, system.pair_node[k]])
    system.volume_motion[env, b] = s


@wp.kernel
def find_volume_motions(system: SystemView, p: VecArray2d, active: IntArray):
    env, b = wp.tid()
    if active[env] != 0:
        find_volume_motion(system, env, b, p)


@wp.func
def block_row(system: SystemView, env: wp.int32, i: wp.int32, p: VecArray2d) -> wp.vec3d:
    """Row i of (blocks + Σ q qᵀ of volume blocks) · p; needs ``volume_motion`` of the same p."""
    f = wp.vec3d()
    k = system.row_base[i]
    for _ in range(system.row_length[i]):
        f += system.blocks[env, k] * p[env, system.col[k]]
        k += system.stride
    for m in range(system.node_pair_start[i], system.node_pair_start[i + 1]):
        pair = system.node_pair[m]
        f += system.volume_motion[env, system.pair_block[pair]] * system.volume_row[env, pair]
    return f


@wp.kernel
def multiply_blocks(
    system: SystemView, p: VecArray2d, active: IntArray, threads: wp.int32, out: VecArray2d, partial: FloatArray2d
):
    """out = (blocks + volume rows) p on the unknowns, else 0, and shares of p·out.

    Shares are (B, chunks, n).
    """
    env, c, lane = wp.tid()
    total = wp.float64(0.0)
    if active[env] != 0:
        for i in range(c * threads + lane, p.shape[1], partial.shape[1] * threads):
            f = wp.vec3d()
            if system.free[i] != 0:
                f = block_row(system, env, i, p)
                total += wp.dot(p[env, i], f)
            out[env, i] = f
    wp.tile_store(partial[env], wp.tile_sum(wp.tile(total)), offset=c)


@wp.func
def row_column(row: mat34d, k: wp.int32) -> wp.vec3d:
    return wp.vec3d(row[0, k], row[1, k], row[2, k])


@wp.func
def spread_row(system: SystemView, verts: wp.vec4i, row: mat34d, env: wp.int32, s: wp.float64, out: VecArray2d):
    """out += s q on the unknowns."""
    for k in range(4):
        v = verts[k]
        if v >= 0:
            if system.verts.count[v] > 0:
                q = s * (wp.transpose(system.R[env, system.verts.body[v]]) * row_column(row, k))
                for m in range(system.verts.count[v]):
                    node = system.verts.nodes[v, m]
                    if system.free[node] != 0:
                        wp.atomic_add(out, env, node, system.verts.weight[v, m] * q)


@wp.func
def turn_row(system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32):
    """Write row r over the unknowns, in bodies' frames.

    A vertex follows one node, or the four of an affine body. The second affine body of a row is among its nodes, which are free then.
    """
    verts, row = contacts.row_verts[env, r], contacts.row[env, r]
    nodes, turned = wp.vec4i(-1, -1, -1, -1), mat34d()
    body, g = wp.int32(-1), mat34d()
    for k in range(4):
        v = verts[k]
        if v >= 0:
            if system.verts.count[v] > 0:
                q = wp.transpose(system.R[env, system.verts.body[v]]) * row_column(row, k)
                node = system.verts.nodes[v, 0] + 0
                if system.verts.count[v] == 1:
                    if system.free[node] != 0:
                        nodes[k] = node
                        w = system.verts.weight[v, 0] + wp.float64(0.0)
                        for i in range(3):
                            turned[i, k] = w * q[i]
                else:
                    if body < 0:
                        body = node
                    for m in range(4):
                        w = system.verts.weight[v, m] + wp.float64(0.0)
                        if node == body:
                            for i in range(3):
                                g[i, m] = g[i, m] + w * q[i]
                        else:
                            nodes[m] = node + m
                            for i in range(3):
                                turned[i, m] = turned[i, m] + w * q[i]
    contacts.row_nodes[env, r] = nodes
    contacts.node_row[env, r] = turned
    contacts.row_body[env, r] = body
    contacts.body_row[env, r] = g


@wp.kernel
def turn_rows(system: SystemView, contacts: Contacts, active: IntArray, lanes: wp.int32):
    env, lane = wp.tid()
    if active[env] != 0:
        for r in range(lane, rows_of(contacts, env), lanes):
            turn_row(system, contacts, env, r)


@wp.func
def add_motion(env: wp.int32, first: wp.int32, f: mat34d, out: VecArray2d):
    """out += f at the four nodes of an affine body whose first node is ``first``; −1 for none."""
    if first >= 0:
        for m in range(4):
            wp.atomic_add(out, env, first + m, row_column(f, m))


@wp.func
def row_weight(system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32) -> wp.float64:
    """1, or of a concave row −1; 0 where the matrix must be definite."""
    if contacts.concave[env, r] != 0:
        return wp.float64(system.project[env] - 1)
    return wp.float64(1.0)


@wp.func
def row_motion(row: mat34d, nodes: wp.vec4i, body: wp.int32, g: mat34d, env: wp.int32, p: VecArray2d) -> wp.float64:
    """q·p of a turned row."""
    s = wp.float64(0.0)
    for k in range(4):
        if nodes[k] >= 0:
            s += wp.dot(row_column(row, k), p[env, nodes[k]])
    if body >= 0:
        for m in range(4):
            s += wp.dot(row_column(g, m), p[env, body + m])
    return s


@wp.func
def add_row(system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32, p: VecArray2d, out: VecArray2d) -> wp.float64:
    """out += w q (q·p) of the turned row r on the unknowns, with weight w; returns w (q·p)²."""
    nodes, row = contacts.row_nodes[env, r], contacts.node_row[env, r]
    body, g = contacts.row_body[env, r] + 0, contacts.body_row[env, r]
    s = row_motion(row, nodes, body, g, env, p)
    w = row_weight(system, contacts, env, r)
    for k in range(4):
        if nodes[k] >= 0:
            wp.atomic_add(out, env, nodes[k], (w * s) * row_column(row, k))
    add_motion(env, body, (w * s) * g, out)
    return w * s * s


@wp.kernel
def multiply_rows(
    system: SystemView,
    contacts: Contacts,
    p: VecArray2d,
    active: IntArray,
    lanes: wp.int32,
    threads: wp.int32,
    # outputs
    out: VecArray2d,
    partial: FloatArray2d,
):
    """out += Σ q (q·p) of turned rows, and the shares of Σ (q·p)².

    Threads as in multiply_blocks, of which ``lanes`` in all share the rows of an environment. A thread adds up what its rows give to one
    affine body.
    """
    env, c, lane = wp.tid()
    total = wp.float64(0.0)
    first = c * threads + lane
    if active[env] != 0 and first < lanes:
        last, affine = wp.int32(-1), mat34d()
        for r in range(first, rows_of(contacts, env), lanes):
            nodes, row = contacts.row_nodes[env, r], contacts.node_row[env, r]
            body, g = contacts.row_body[env, r] + 0, contacts.body_row[env, r]
            s = row_motion(row, nodes, body, g, env, p)
            w = row_weight(system, contacts, env, r)
            total += w * s * s
            for k in range(4):
                if nodes[k] >= 0:
                    wp.atomic_add(out, env, nodes[k], (w * s) * row_column(row, k))
            if body >= 0:
                if body != last:
                    add_motion(env, last, affine, out)
                    last, affine = body, mat34d()
                affine += (w * s) * g
        add_motion(env, last, affine, out)
    wp.tile_store(partial[env], wp.tile_sum(wp.tile(total)), offset=c)


@wp.kernel
def push_rows(system: SystemView, contacts: Contacts, dx: VecArray2d, active: IntArray, lanes: wp.int32, residual: VecArray2d):
    """residual −= Σ q (q·dx) with vertex motions dx in the world, on the unknowns."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        s = wp.float64(0.0)
        for k in range(4):
            if verts[k] >= 0:
                s += wp.dot(row_column(row, k), dx[env, verts[k]])
        spread_row(system, verts, row, env, -s * row_weight(system, contacts, env, r), residual)


@wp.kernel
def push_blocks(system: SystemView, lift: VecArray2d, active: IntArray, residual: VecArray2d):
    """residual −= (blocks + volume rows) · lift on the unknowns.

    The lift is the prescribed motion of gripped nodes.
    """
    env, i = wp.tid()
    if active[env] != 0 and system.free[i] != 0:
        residual[env, i] = residual[env, i] - block_row(system, env, i, lift)


class Preconditioner(Protocol):
    """Approximates H⁻¹, symmetric and positive definite."""

    on_host: bool
    """Some of its work is NumPy's, which no recording takes in."""

    def update(self, system: SystemView, contacts: Contacts, rows: int, active: wp.array) -> None:
        """Take in the matrix of the active environments; ``rows`` is the largest row count."""
        ...

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        """z = M⁻¹ r for the running environments; arrays (B, N) of vec3d."""
        ...
