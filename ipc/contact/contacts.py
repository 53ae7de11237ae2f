"""Buffers of contacts and of the rows of their Hessian; counts may exceed what fits."""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, VecArray2d

wp.set_module_options({"enable_backward": False})


class mat34d(wp.types.matrix(shape=(3, 4), dtype=wp.float64)):
    """Four vectors of three, one for each vertex of a pair."""


@wp.struct
class Contacts:
    """Pairs within d̂ and the rows of their Hessian; a vertex of −1 is unused.

    ``concave``: 1 where q qᵀ of a row is subtracted, unless the matrix must be definite.
    The same rows over unknowns (``ipc.solver.linear.turn_row``): ``node_row`` at the nodes ``row_nodes``, −1 for none, and ``body_row`` at
    the four nodes of an affine body from ``row_body`` on, −1 for none. ``scaled_row``: work space of a preconditioner.
    ``open_row``: the ``open_count`` rows that ``ipc.solver.halves.fold_rows`` could not add to blocks of the matrix.
    """

    verts: wp.array2d(dtype=wp.vec4i)
    coef: wp.array2d(dtype=wp.vec4d)
    normal: VecArray2d
    force: FloatArray2d
    gap: FloatArray2d
    pair: IntArray2d
    count: IntArray
    row_verts: wp.array2d(dtype=wp.vec4i)
    row: wp.array2d(dtype=mat34d)
    row_count: IntArray
    concave: IntArray2d
    row_nodes: wp.array2d(dtype=wp.vec4i)
    node_row: wp.array2d(dtype=mat34d)
    row_body: IntArray2d
    body_row: wp.array2d(dtype=mat34d)
    scaled_row: wp.array2d(dtype=mat34d)
    open_row: IntArray2d
    open_count: IntArray


@wp.func
def rows_of(contacts: Contacts, env: wp.int32) -> wp.int32:
    """Rows of an environment that are stored."""
    return wp.min(contacts.row_count[env], contacts.row.shape[1])


@wp.func
def push_matrix(out: Contacts, env: wp.int32, verts: wp.vec4i, row: mat34d, concave: wp.int32):
    """Add a row; a ``concave`` one (1) is subtracted."""
    slot = wp.atomic_add(out.row_count, env, 1)
    if slot < out.row.shape[1]:
        out.row_verts[env, slot] = verts
        out.row[env, slot] = row
        out.concave[env, slot] = concave


@wp.func
def push_row(out: Contacts, env: wp.int32, verts: wp.vec4i, q0: wp.vec3d, q1: wp.vec3d, q2: wp.vec3d, q3: wp.vec3d):
    push_matrix(out, env, verts, wp.matrix_from_cols(q0, q1, q2, q3), 0)


@wp.func
def push_contact(
    out: Contacts, env: wp.int32, verts: wp.vec4i, coef: wp.vec4d, n: wp.vec3d, d: wp.float64, force: wp.float64, pair: wp.int32
):
    slot = wp.atomic_add(out.count, env, 1)
    if slot < out.force.shape[1]:
        out.verts[env, slot] = verts
        out.coef[env, slot] = coef
        out.normal[env, slot] = n
        out.force[env, slot] = force
        out.gap[env, slot] = d
        out.pair[env, slot] = pair


@wp.kernel
def clear(active: IntArray, gradient: VecArray2d, energy: FloatArray, out: Contacts):
    """No forces, contacts or rows in the active environments."""
    env, v = wp.tid()
    if active[env] == 0:
        return
    gradient[env, v] = wp.vec3d()
    if v == 0:
        energy[env] = wp.float64(0.0)
        out.count[env] = 0
        out.row_count[env] = 0


@wp.kernel
def check_contacts(contacts: Contacts, overflow: IntArray):
    """Raise the flag if contacts or rows did not fit."""
    env = wp.tid()
    if contacts.count[env] > contacts.force.shape[1] or contacts.row_count[env] > contacts.row.shape[1]:
        overflow[0] = 1
