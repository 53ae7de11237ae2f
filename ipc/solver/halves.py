"""Products with the upper half of the Newton matrix, by one thread an environment.

They are for a CPU, and worlds without free bodies. A block above the diagonal is read once and multiplies twice. Conjugate gradients
would multiply by each contact row many times; a row at nodes of one face or edge of a pad fits the matrix, and is added to its blocks
instead.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, VecArray2d
from ipc.contact.contacts import Contacts, rows_of
from ipc.solver.linear import SystemView, add_row, row_column, row_weight

wp.set_module_options({"enable_backward": False})


@wp.func
def place_above(system: SystemView, i: wp.int32, j: wp.int32) -> wp.int32:
    """Place of the block of unknowns i < j, −1 where the pattern has none."""
    for k in range(system.above_start[i], system.above_start[i + 1]):
        if system.col[system.above[k]] == j:
            return system.above[k]
    return -1


@wp.func
def fits_blocks(system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32, nodes: wp.vec4i) -> wp.bool:
    """True if the pattern has a block for every two nodes of a row, and no affine body is in it."""
    if contacts.row_body[env, r] >= 0:
        return False
    for a in range(4):
        for b in range(4):
            if nodes[a] >= 0 and nodes[b] > nodes[a]:
                if place_above(system, nodes[a], nodes[b]) < 0:
                    return False
    return True


@wp.func
def add_outer(
    system: SystemView,
    contacts: Contacts,
    env: wp.int32,
    first: wp.int32,
    end: wp.int32,
    a: wp.int32,
    b: wp.int32,
    place: wp.int32,
):
    """Block += Σ w q_a q_bᵀ of the rows from ``first`` to before ``end``."""
    total = wp.mat33d()
    for r in range(first, end):
        row = contacts.node_row[env, r]
        total += wp.outer(row_weight(system, contacts, env, r) * row_column(row, a), row_column(row, b))
    system.blocks[env, place] = system.blocks[env, place] + total


@wp.kernel
def fold_rows(system: SystemView, contacts: Contacts, active: IntArray):
    """Add turned rows to the blocks on and above the diagonal, and list those that do not fit.

    Rows of one pair follow each other, and are added together.
    """
    env = wp.tid()
    if active[env] == 0:
        return
    n, first, count = rows_of(contacts, env), wp.int32(0), wp.int32(0)
    while first < n:
        nodes = contacts.row_nodes[env, first]
        fits, end = fits_blocks(system, contacts, env, first, nodes), first + 1
        if fits:
            while (
                end < n
                and contacts.row_nodes[env, wp.min(end, n - 1)] == nodes
                and contacts.row_body[env, wp.min(end, n - 1)] < 0
            ):
                end += 1
            for a in range(4):
                for b in range(4):
                    if nodes[a] >= 0 and nodes[b] >= nodes[a]:
                        place = system.diagonal[nodes[a]]
                        if nodes[b] > nodes[a]:
                            place = place_above(system, nodes[a], nodes[b])
                        add_outer(system, contacts, env, first, end, a, b, place)
        else:
            contacts.open_row[env, count] = first
            count += 1
        first = end
    contacts.open_count[env] = count


@wp.func
def multiply_half(system: SystemView, contacts: Contacts, env: wp.int32, p: VecArray2d, out: VecArray2d) -> wp.float64:
    """out = H p on the unknowns, else 0, after :func:`fold_rows`; returns p·out.

    p is 0 elsewhere.
    """
    total = wp.float64(0.0)
    blocks, volume_row, x, y = system.blocks[env], system.volume_row[env], p[env], out[env]
    for i in range(x.shape[0]):
        y[i] = blocks[system.diagonal[i]] * x[i]
    for i in range(x.shape[0]):
        here, f = x[i] + wp.vec3d(), y[i] + wp.vec3d()
        for m in range(system.above_start[i], system.above_start[i + 1]):
            k = system.above[m]
            j = system.col[k]
            f += blocks[k] * x[j]
            y[j] = y[j] + wp.transpose(blocks[k]) * here
        y[i] = f
        total += wp.dot(here, f)
    for b in range(system.volume_motion.shape[1]):
        s = wp.float64(0.0)
        for k in range(system.block_pair_start[b], system.block_pair_start[b + 1]):
            s += wp.dot(volume_row[k], x[system.pair_node[k]])
        for k in range(system.block_pair_start[b], system.block_pair_start[b + 1]):
            i = system.pair_node[k]
            if system.free[i] != 0:
                y[i] = y[i] + s * volume_row[k]
        total += s * s
    for k in range(contacts.open_count[env]):
        total += add_row(system, contacts, env, contacts.open_row[env, k], p, out)
    return total
