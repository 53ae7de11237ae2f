"""Conjugate gradients of an environment by one thread (:mod:`ipc.solver.halves`)."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, MatArray2d, Vec4Array2d, VecArray2d
from ipc.contact.contacts import Contacts
from ipc.solver.affine_elimination import Elimination, finish_elimination
from ipc.solver.halves import filled_up, head, multiply_half
from ipc.solver.linear import SystemView
from ipc.solver.lines import Lines, apply_lines
from ipc.solver.pcg_block import Scalars

wp.set_module_options({"enable_backward": False})


@wp.struct
class Vectors:
    """Work space (B, N): r, p, H p or z; and of the elimination of affine bodies, r and z."""

    r: Vec4Array2d
    p: Vec4Array2d
    Ap: Vec4Array2d
    source: VecArray2d
    result: VecArray2d


def make_vectors(batch: int, nodes: int, device: wp.Device) -> Vectors:
    """Work space of zeros: bonded nodes stay 0."""
    vectors = Vectors()
    for name in ("r", "p", "Ap"):
        setattr(vectors, name, wp.zeros((batch, nodes), dtype=wp.vec4d, device=device))
    vectors.source, vectors.result = (wp.zeros((batch, nodes), dtype=wp.vec3d, device=device) for _ in range(2))
    return vectors


@wp.func
def precondition(lines: Lines, inverse: MatArray2d, affine: Elimination, env: wp.int32, w: Vectors, z: Vec4Array2d) -> wp.float64:
    """z = M⁻¹ r; returns r·z."""
    rz = apply_lines(lines, env, w.r, z)
    if affine.node.shape[0] > 0:
        for k in range(lines.node.shape[0]):
            i = lines.node[k]
            w.source[env, i] = head(w.r[env, i])
            w.result[env, i] = head(z[env, i])
        finish_elimination(affine, inverse, env, 0, 1, w.source, w.result)
        rz = wp.float64(0.0)
        for k in range(lines.node.shape[0]):
            i = lines.node[k]
            z[env, i] = filled_up(w.result[env, i])
            rz += wp.dot(w.source[env, i], w.result[env, i])
    return rz


@wp.func_native("""
    using vec4 = wp::vec_t<4, wp::float64>;
    const int n = lines.node.shape[0];
    const int* node = lines.node.data;
    const long long first = (long long)env * w.r.shape[1];
    vec4* residual = w.r.data + first;
    const vec4* direction = w.p.data + first;
    const vec4* product = w.Ap.data + first;
    wp::vec_t<3, wp::float64>* solution = x.data + (long long)env * x.shape[1];
    vec4 squares;
    for (int k = 0; k < n; ++k) {
        const int i = node[k];
        const vec4 step = alpha * direction[i];
        solution[i] += wp::vec_t<3, wp::float64>(step[0], step[1], step[2]);
        const vec4 rest = residual[i] - alpha * product[i];
        residual[i] = rest;
        squares += wp::cw_mul(rest, rest);
    }
    return squares[0] + squares[1] + squares[2];
""")
def update_iterate(lines: Lines, env: wp.int32, alpha: wp.float64, w: Vectors, x: VecArray2d) -> wp.float64:
    """x += α p, r −= α H p; returns r·r."""
    ...


@wp.func_native("""
    using vec4 = wp::vec_t<4, wp::float64>;
    const int n = lines.node.shape[0];
    const int* node = lines.node.data;
    const long long first = (long long)env * w.r.shape[1];
    vec4* direction = w.p.data + first;
    const vec4* z = w.Ap.data + first;
    for (int k = 0; k < n; ++k) {
        const int i = node[k];
        direction[i] = z[i] + beta * direction[i];
    }
""")
def next_direction(lines: Lines, env: wp.int32, beta: wp.float64, w: Vectors):
    """p = z + β p."""
    ...


@wp.kernel
def solve_serially(
    system: SystemView,
    contacts: Contacts,
    inverse: MatArray2d,
    lines: Lines,
    affine: Elimination,
    tolerance: wp.float64,
    max_iterations: wp.int32,
    active: IntArray,
    w: Vectors,
    # outputs
    r: VecArray2d,
    x: VecArray2d,
    s: Scalars,
):
    """Add the solution of H δ = r to x; r becomes the residual.

    Its norm and √(r·M⁻¹ r) fall to ``tolerance`` of those at the start: lines take out stiff motions first, and of what remains in soft
    ones the plain norm says little.
    """
    env = wp.tid()
    if active[env] == 0:
        return
    s.iterations[env] = 0
    s.negative[env] = 0
    n, rr0 = lines.node.shape[0], wp.float64(0.0)
    for k in range(n):
        v = r[env, lines.node[k]]
        w.r[env, lines.node[k]] = filled_up(v)
        rr0 += wp.length_sq(v)
    if rr0 == wp.float64(0.0):
        return
    rz = precondition(lines, inverse, affine, env, w, w.p)
    rz0 = rz + wp.float64(0.0)
    for it in range(max_iterations):
        curvature = multiply_half(system, contacts, env, w.p, w.Ap)
        if not (curvature > wp.float64(0.0)):
            s.negative[env] = 1
            break
        s.iterations[env] = it + 1
        rr, small = update_iterate(lines, env, rz / curvature, w, x), tolerance * tolerance
        new = precondition(lines, inverse, affine, env, w, w.Ap)
        if not (rr > small * rr0) and not (new > small * rz0):
            break
        next_direction(lines, env, new / rz, w)
        rz = new
    for k in range(n):
        r[env, lines.node[k]] = head(w.r[env, lines.node[k]])
