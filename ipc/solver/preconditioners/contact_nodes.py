"""The nodes of pads and affine bodies that something touches, numbered in each environment.

A preconditioner adds the contacts of the moment to an inverse that is known between all nodes of a pad's surface (``low_rank.py``). It is
small because few of those nodes touch: they get numbers, those of pads first, and arrays of a fixed room are indexed by these.

An environment with more contact nodes than there is room for is marked as one that does not fit: with part of its contacts the identity is
of little use.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray2d, FloatArray3d, IntArray, IntArray2d
from ipc.contact.contacts import Contacts, rows_of
from ipc.solver.linear import SystemView, row_column

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rest:
    """K_0⁻¹ between the interface nodes of a bonded body and the nodes of an affine one.

    ``inverse`` holds the matrices of bonded bodies one after the other, row by row; unknown u of part p is entry u − first[p] of a matrix
    of width[p] that starts at start[p]. ``unknown`` (N,) is a node's first unknown or −1, ``part`` (N,) its matrix. s nodes may touch
    something, those on bonded surfaces and of affine bodies: ``surface`` (N,) is a node's number among them or −1, ``surface_node`` (s,)
    the inverse of that. ``affine`` (N,) is a node's number among the affine nodes, body by body, or −1; ``affine_node`` (A,) the inverse.
    """

    inverse: wp.array(dtype=wp.float32)
    start: IntArray
    first: IntArray
    width: IntArray
    unknown: IntArray
    part: IntArray
    surface: IntArray
    surface_node: IntArray
    affine: IntArray
    affine_node: IntArray


@wp.struct
class Small:
    """The contact nodes of each environment and their systems; m is the room.

    ``touched``, ``slot`` (B, s): mark of a surface node that touches, and its place among the contact nodes.
    ``count`` (B,): contact nodes; more than m do not fit.    ``pads`` (B,): those of pads, the first ones.    ``node`` (B, m).
    ``known`` (B,): pad nodes of which ``k`` is K; −1 after ``node`` has changed.
    ``s`` (B, 3m, 3m): the upper half of S, zero after it was used.    ``k`` (B, 3m, 3m): K of pad nodes [N/m].
    ``factor`` (B, 3m, 3m): U of K + S = Uᵀ U (``dense.py``).
    ``t``, ``force`` (B, 3m): J K_0⁻¹ r [m], on affine nodes L⁻¹ r, later (K + S)⁻¹ K of it; and W t [N].
    ``half`` (B, 3m): half of that solution, U⁻ᵀ K t.
    ``root`` (B, A, 4): blocks of an affine node's row of L⁻¹, at the nodes of its body.
    """

    touched: IntArray2d
    slot: IntArray2d
    count: IntArray
    pads: IntArray
    node: IntArray2d
    known: IntArray
    s: FloatArray3d
    k: FloatArray3d
    factor: FloatArray3d
    t: FloatArray2d
    half: FloatArray2d
    force: FloatArray2d
    root: wp.array3d(dtype=wp.mat33d)


@wp.func
def rest_entry(rest: Rest, part: wp.int32, u: wp.int32, v: wp.int32) -> wp.float32:
    """K_0⁻¹ between two unknowns of one part."""
    return rest.inverse[rest.start[part] + (u - rest.first[part]) * rest.width[part] + v - rest.first[part]]


@wp.func
def fits(small: Small, env: wp.int32) -> wp.bool:
    """True if there is room for the contact nodes of an environment."""
    return small.count[env] <= small.node.shape[1]


@wp.kernel
def forget_contacts(active: IntArray, small: Small):
    env, s = wp.tid()
    if active[env] == 0:
        return
    if s == 0:
        small.count[env] = 0
        small.pads[env] = 0
    small.touched[env, s] = 0


@wp.kernel
def mark_contacts(system: SystemView, contacts: Contacts, rest: Rest, active: IntArray, lanes: wp.int32, small: Small):
    """Marks the surface nodes that the rows act on."""
    env, lane = wp.tid()
    if active[env] == 0:
        return
    for r in range(lane, rows_of(contacts, env), lanes):
        if contacts.concave[env, r] != 0:
            continue
        verts, row = contacts.row_verts[env, r], contacts.row[env, r]
        for k in range(4):
            v = verts[k]
            if v >= 0 and wp.length_sq(row_column(row, k)) > wp.float64(0.0):
                for m in range(system.verts.count[v]):
                    s = rest.surface[system.verts.nodes[v, m]]
                    if s >= 0:
                        small.touched[env, s] = 1


@wp.kernel
def place_contacts(rest: Rest, active: IntArray, small: Small):
    """Numbers the contact nodes as ``surface_node`` has them, those of pads first."""
    env, s = wp.tid()
    if active[env] == 0 or small.touched[env, s] == 0:
        return
    wp.atomic_add(small.count, env, 1)
    if rest.affine[rest.surface_node[s]] < 0:
        wp.atomic_add(small.pads, env, 1)
    place = wp.int32(0)
    for other in range(s):
        place += small.touched[env, other]
    small.slot[env, s] = place
    if place < small.node.shape[1]:
        if small.node[env, place] != rest.surface_node[s]:
            small.known[env] = -1
        small.node[env, place] = rest.surface_node[s]


@wp.kernel
def mark_full(active: IntArray, small: Small, full: IntArray):
    env = wp.tid()
    full[env] = 0
    if active[env] != 0 and not fits(small, env):
        full[env] = 1


@wp.func
def slot_of(env: wp.int32, rest: Rest, small: Small, first: wp.int32) -> wp.int32:
    """Place of an affine body's first node among the contact nodes, or −1.

    The other three follow. −1: nothing touches it.
    """
    if first >= 0:
        if small.touched[env, rest.surface[first]] != 0:
            return small.slot[env, rest.surface[first]]
    return -1
