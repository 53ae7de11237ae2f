"""Block-Jacobi with blocks of nodes on lines through a body's thickness.

Under a contact, the nodes below each other in a thin pad move together: lines in that direction couple strongest. Their part of H is block
tridiagonal, with 3×3 blocks, but for contact rows, of which only the diagonal blocks count. It is factored as L D Lᵀ with
D_k = A_kk − L_k A_{k,k−1}ᵀ and L_k = A_{k,k−1} D_{k−1}⁻¹ (Golub, Van Loan 2013, section 4.5).

They are for the worlds of :mod:`ipc.solver.halves`, where one thread goes along all lines. A node without neighbours on its line is a line
of its own, as are all nodes beside affine bodies, whose elimination takes 3×3 blocks.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import IntArray, MatArray2d, Vec4Array2d, filled
from ipc.bodies.layout import Layout
from ipc.solver.affine_elimination import positive_inverse
from ipc.solver.linear import SystemView

wp.set_module_options({"enable_backward": False})

_SAME = 1e-6
"""Distance of places, as a share of the body's size, up to which they lie on one line."""
_FIRST = wp.constant(-(2**31))


@wp.struct
class Lines:
    """Unknown nodes line by line, ``node`` (n,).

    ``link`` (n,): place of the block that couples a node with the one before, or of its transpose −1 less that, or −2³¹ for the first of a
    line.    ``shared_start`` (n+1,), ``own``, ``other``: pairs of a volume block and the node, and of the block and the node before.
    ``lower``, ``upper``, ``inverse`` (B, 3 n): columns of L, its rows, and rows of D⁻¹, four numbers each, the last 0.
    """

    node: IntArray
    link: IntArray
    shared_start: IntArray
    own: IntArray
    other: IntArray
    lower: Vec4Array2d
    upper: Vec4Array2d
    inverse: Vec4Array2d


@wp.kernel
def factor_lines(lines: Lines, system: SystemView, active: IntArray, inverse: MatArray2d):
    """Replace the diagonal blocks ``inverse`` (B, N) by D⁻¹, and fill the lines' factors."""
    env = wp.tid()
    if active[env] == 0:
        return
    for k in range(lines.node.shape[0]):
        D, L, place = inverse[env, lines.node[k]] + wp.mat33d(), wp.mat33d(), lines.link[k]
        if place != _FIRST:
            A = wp.mat33d()
            if place >= 0:
                A += system.blocks[env, place]
            else:
                A += wp.transpose(system.blocks[env, -1 - place])
            for m in range(lines.shared_start[k], lines.shared_start[k + 1]):
                A += wp.outer(system.volume_row[env, lines.own[m]], system.volume_row[env, lines.other[m]])
            L = A * inverse[env, lines.node[k - 1]]
            D -= L * wp.transpose(A)
        D = positive_inverse(D)
        inverse[env, lines.node[k]] = D
        for a in range(3):
            lines.lower[env, 3 * k + a] = wp.vec4d(L[0, a], L[1, a], L[2, a], wp.float64(0.0))
            lines.upper[env, 3 * k + a] = wp.vec4d(L[a, 0], L[a, 1], L[a, 2], wp.float64(0.0))
            lines.inverse[env, 3 * k + a] = wp.vec4d(D[a, 0], D[a, 1], D[a, 2], wp.float64(0.0))


@wp.func_native("""
    using vec4 = wp::vec_t<4, wp::float64>;
    const int FIRST = -2147483647 - 1;
    const int n = lines.node.shape[0];
    const int* node = lines.node.data;
    const vec4* lower = lines.lower.data + (long long)env * lines.lower.shape[1];
    const vec4* upper = lines.upper.data + (long long)env * lines.upper.shape[1];
    const vec4* inverse = lines.inverse.data + (long long)env * lines.inverse.shape[1];
    const vec4* source = r.data + (long long)env * r.shape[1];
    vec4* result = z.data + (long long)env * z.shape[1];
    const int* link = lines.link.data;
    vec4 y, total;
    for (int k = 0; k < n; ++k) {
        const int i = node[k];
        if (link[k] == FIRST)
            y = source[i];
        else
            y = source[i] - (y[0] * lower[3 * k] + y[1] * lower[3 * k + 1] + y[2] * lower[3 * k + 2]);
        result[i] = y;
    }
    y = vec4();
    for (int k = n - 1; k >= 0; --k) {
        const int i = node[k];
        vec4 v = result[i];
        v = v[0] * inverse[3 * k] + v[1] * inverse[3 * k + 1] + v[2] * inverse[3 * k + 2] - y;
        result[i] = v;
        total += wp::cw_mul(source[i], v);
        if (link[k] == FIRST)
            y = vec4();
        else
            y = v[0] * upper[3 * k] + v[1] * upper[3 * k + 1] + v[2] * upper[3 * k + 2];
    }
    return total[0] + total[1] + total[2];
""")
def apply_lines(lines: Lines, env: wp.int32, r: Vec4Array2d, z: Vec4Array2d) -> wp.float64:
    """z = M⁻¹ r on the unknowns; returns r·z."""
    ...


def make_lines(layout: Layout, where: NDArray[np.integer], batch: int, device: wp.Device) -> Lines:
    """Lines of the layout's unknowns; ``where`` (K,): place of every block of the matrix."""
    node, first = _order(layout)
    before = np.where(first, -1, np.roll(node, 1))
    rows = np.repeat(np.arange(len(layout.node_rest), dtype=np.int64), np.diff(layout.row_start))
    keys, count = rows * len(layout.node_rest) + layout.col, len(layout.node_rest)
    low, high = np.minimum(node, before).clip(0), np.maximum(node, before)
    at = np.searchsorted(keys, low * np.int64(count) + high).clip(max=len(keys) - 1)
    linked = ~first & (keys[at] == low * np.int64(count) + high)
    # The block above the diagonal has the row of the lower number.
    link = np.where(linked, np.where(before > node, where[at], -1 - where[at]), _FIRST)
    own, other, starts = [], [], [0]
    for i, j, is_linked in zip(node, before, linked, strict=True):
        if is_linked:
            mine, theirs = (layout.node_pair[slice(*layout.node_pair_start[n : n + 2])] for n in (i, j))
            _, a, b = np.intersect1d(layout.pair_block[mine], layout.pair_block[theirs], return_indices=True)
            own.extend(mine[a])
            other.extend(theirs[b])
        starts.append(len(own))
    values = {"node": node, "link": link, "shared_start": starts, "own": own, "other": other}
    lines = filled(Lines, device, {name: np.asarray(value, np.int32) for name, value in values.items()})
    for name in ("lower", "upper", "inverse"):
        setattr(lines, name, wp.zeros((batch, 3 * len(node)), dtype=wp.vec4d, device=device))
    return lines


def _order(layout: Layout) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Unknown nodes line by line, and which of them begin one, (n,) each."""
    nodes, firsts = [], []
    for body in range(len(layout.node_start) - 1):
        span = np.arange(*layout.node_start[body : body + 2])
        free = span[layout.node_free[span] != 0]
        if len(free) == 0:
            continue
        rest = layout.node_rest[free]
        size = np.ptp(layout.node_rest[span], axis=0)
        axis = int(size.argmin())
        across = np.delete(np.round(rest / (_SAME * size.max())), axis, axis=1)
        order = np.lexsort((rest[:, axis], across[:, 1], across[:, 0]))
        first = np.concatenate([[True], (across[order][1:] != across[order][:-1]).any(axis=1)])
        nodes.append(free[order])
        firsts.append(first)
    if not nodes:
        return np.zeros(0, np.int64), np.zeros(0, bool)
    node, first = np.concatenate(nodes), np.concatenate(firsts)
    return node, first | bool((layout.vert_count > 1).any())
