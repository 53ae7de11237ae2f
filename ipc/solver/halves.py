"""Products with the upper half of the Newton matrix, by one thread an environment.

They are for a CPU, and worlds without free bodies. A block above the diagonal is read once and multiplies twice. Conjugate gradients
would multiply by each contact row many times; a row at nodes of one face or edge of a pad fits the matrix, and is added to its blocks
instead. Rows of blocks are copied out as vectors of four numbers, which a processor multiplies at once; so are vectors of unknowns.

What an iteration of conjugate gradients repeats is written in C++, here, in :mod:`ipc.solver.lines` and in :mod:`ipc.solver.pcg_serial`: in
Warp every index is compared with 0 and multiplied by a stride, which takes as long as the arithmetic.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, Vec4Array2d
from ipc.contact.contacts import Contacts, rows_of
from ipc.solver.linear import SystemView, row_column, row_weight

wp.set_module_options({"enable_backward": False})


@wp.func
def head(v: wp.vec4d) -> wp.vec3d:
    """The first three numbers."""
    return wp.vec3d(v[0], v[1], v[2])


@wp.func
def filled_up(v: wp.vec3d) -> wp.vec4d:
    """Three numbers and 0."""
    return wp.vec4d(v[0], v[1], v[2], wp.float64(0.0))


@wp.func
def row_of(A: wp.mat33d, a: wp.int32) -> wp.vec4d:
    return wp.vec4d(A[a, 0], A[a, 1], A[a, 2], wp.float64(0.0))


@wp.kernel
def copy_half(system: SystemView, active: IntArray):
    """Copy blocks and volume rows out, by node or pair."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    if i < system.half_volume.shape[1]:
        q = wp.vec3d()
        if system.free[system.pair_node[i]] != 0:
            q += system.volume_row[env, i]
        system.half_volume[env, i] = filled_up(q)
    if i < system.free.shape[0]:
        if system.free[i] == 0:
            return
        rows, diagonal, blocks = system.half_rows[env], system.half_diagonal[env], system.blocks[env]
        D = blocks[system.diagonal[i]]
        for a in range(3):
            diagonal[3 * i + a] = row_of(D, a)
        for m in range(system.above_start[i], system.above_start[i + 1]):
            A = blocks[system.above[m]]
            for a in range(3):
                rows[3 * m + a] = row_of(A, a)


@wp.func
def number_above(system: SystemView, i: wp.int32, j: wp.int32) -> wp.int32:
    """Number of the block of unknowns i < j among those above, −1 where the pattern has none."""
    for k in range(system.above_start[i], system.above_start[i + 1]):
        if system.col[system.above[k]] == j:
            return k
    return -1


@wp.func
def fits_blocks(system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32, nodes: wp.vec4i) -> wp.bool:
    """True if the pattern has a block for every two nodes of a row, and no affine body is in it."""
    if contacts.row_body[env, r] >= 0:
        return False
    for a in range(4):
        for b in range(4):
            if nodes[a] >= 0 and nodes[b] > nodes[a]:
                if number_above(system, nodes[a], nodes[b]) < 0:
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
    rows: Vec4Array2d,
):
    """Block ``place`` of ``rows`` += Σ w q_a q_bᵀ of the rows from ``first`` to before ``end``."""
    total = wp.mat33d()
    for r in range(first, end):
        row = contacts.node_row[env, r]
        total += wp.outer(row_weight(system, contacts, env, r) * row_column(row, a), row_column(row, b))
    for k in range(3):
        rows[env, 3 * place + k] = rows[env, 3 * place + k] + row_of(total, k)


@wp.kernel
def fold_rows(system: SystemView, contacts: Contacts, active: IntArray):
    """Add turned rows to the blocks of :func:`copy_half`, and list those that do not fit.

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
                    if nodes[a] >= 0 and nodes[b] == nodes[a]:
                        add_outer(system, contacts, env, first, end, a, b, nodes[a], system.half_diagonal)
                    elif nodes[a] >= 0 and nodes[b] > nodes[a]:
                        place = number_above(system, nodes[a], nodes[b])
                        add_outer(system, contacts, env, first, end, a, b, place, system.half_rows)
        else:
            contacts.open_row[env, count] = first
            count += 1
        first = end
    contacts.open_count[env] = count


@wp.func
def add_open_row(
    system: SystemView, contacts: Contacts, env: wp.int32, r: wp.int32, p: Vec4Array2d, out: Vec4Array2d
) -> wp.float64:
    """out += w q (q·p) of the turned row r with weight w; returns w (q·p)²."""
    nodes, row = contacts.row_nodes[env, r], contacts.node_row[env, r]
    body, g, s = contacts.row_body[env, r] + 0, contacts.body_row[env, r], wp.float64(0.0)
    for k in range(4):
        if nodes[k] >= 0:
            s += wp.dot(row_column(row, k), head(p[env, nodes[k]]))
        if body >= 0:
            s += wp.dot(row_column(g, k), head(p[env, body + k]))
    w = row_weight(system, contacts, env, r)
    for k in range(4):
        if nodes[k] >= 0:
            out[env, nodes[k]] = out[env, nodes[k]] + filled_up((w * s) * row_column(row, k))
        if body >= 0:
            out[env, body + k] = out[env, body + k] + filled_up((w * s) * row_column(g, k))
    return w * s * s


@wp.func_native("""
    using vec4 = wp::vec_t<4, wp::float64>;
    const int nodes = p.shape[1];
    const vec4* x = p.data + (long long)env * nodes;
    vec4* y = out.data + (long long)env * nodes;
    const vec4* rows = system.half_rows.data + (long long)env * system.half_rows.shape[1];
    const vec4* diagonal = system.half_diagonal.data + (long long)env * system.half_diagonal.shape[1];
    const int* start = system.above_start.data;
    const int* above = system.above.data;
    const int* col = system.col.data;
    for (int i = 0; i < nodes; ++i) {
        const vec4 h = x[i];
        y[i] = h[0] * diagonal[3 * i] + h[1] * diagonal[3 * i + 1] + h[2] * diagonal[3 * i + 2];
    }
    vec4 total;
    for (int i = 0; i < nodes; ++i) {
        const vec4 here = x[i];
        vec4 a, b, c;
        for (int m = start[i]; m < start[i + 1]; ++m) {
            const int j = col[above[m]];
            const vec4 there = x[j], r0 = rows[3 * m], r1 = rows[3 * m + 1], r2 = rows[3 * m + 2];
            a += wp::cw_mul(r0, there);
            b += wp::cw_mul(r1, there);
            c += wp::cw_mul(r2, there);
            y[j] += here[0] * r0 + here[1] * r1 + here[2] * r2;
        }
        const vec4 f = y[i] + vec4(a[0] + a[1] + a[2], b[0] + b[1] + b[2], c[0] + c[1] + c[2], 0.0);
        y[i] = f;
        total += wp::cw_mul(here, f);
    }
    double sum = total[0] + total[1] + total[2];
    const vec4* volume = system.half_volume.data + (long long)env * system.half_volume.shape[1];
    const int* first = system.block_pair_start.data;
    const int* node = system.pair_node.data;
    for (int b = 0; b < system.volume_motion.shape[1]; ++b) {
        vec4 even, odd;
        const int end = first[b + 1];
        int k = first[b];
        for (; k + 1 < end; k += 2) {
            even += wp::cw_mul(volume[k], x[node[k]]);
            odd += wp::cw_mul(volume[k + 1], x[node[k + 1]]);
        }
        if (k < end)
            even += wp::cw_mul(volume[k], x[node[k]]);
        const vec4 both = even + odd;
        const double s = both[0] + both[1] + both[2];
        for (k = first[b]; k < end; ++k)
            y[node[k]] += s * volume[k];
        sum += s * s;
    }
    return sum;
""")
def multiply_upper(system: SystemView, env: wp.int32, p: Vec4Array2d, out: Vec4Array2d) -> wp.float64:
    """out = (blocks + volume rows) p on the unknowns, else 0; returns p·out.

    After :func:`fold_rows`.
    """
    ...


@wp.func
def multiply_half(system: SystemView, contacts: Contacts, env: wp.int32, p: Vec4Array2d, out: Vec4Array2d) -> wp.float64:
    """out = H p on the unknowns, else 0, after :func:`fold_rows`; returns p·out.

    p is 0 elsewhere.
    """
    result = multiply_upper(system, env, p, out)
    for k in range(contacts.open_count[env]):
        result += add_open_row(system, contacts, env, contacts.open_row[env, k], p, out)
    return result
