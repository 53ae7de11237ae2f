"""Broad phase: pairs of primitives whose boxes overlap, until a vertex leaves its box.

Every vertex has a box around the last motion that was checked, widened by a margin; a primitive's box is the union of its vertices'
boxes widened by d̂/2. Two primitives whose boxes do not overlap stay farther apart than d̂ as long as their vertices stay inside their
boxes. So the list holds until a vertex leaves its box (checked for every Newton step; most steps need no new list).

The search by lists: per body pair, primitives outside the other body's box are dropped first; the rest are tested all against all, which
for a pad and a tool is a few hundred against a few hundred. :mod:`ipc.broad_phase.trees` finds the same pairs where there are more.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, VecArray2d

wp.set_module_options({"enable_backward": False})


@wp.struct
class Surface:
    """The surfaces of all bodies, which every environment shares."""

    edges: IntArray2d
    faces: IntArray2d
    vert_area: FloatArray
    edge_area: FloatArray
    edge_rest2: FloatArray
    plane_vert: IntArray
    plane_body: IntArray
    plane_pair: IntArray
    d_hat: wp.float64


@wp.struct
class Candidates:
    """Pairs (first, second, body pair) that may come within d̂; counts may exceed what fits.

    ``pt_gap``, ``ee_gap``: their distances [m], or lower bounds of them, at positions from which no vertex is farther than ``moved`` [m]
    (:mod:`ipc.contact.reach`).
    On a CPU ``pt_near`` and ``ee_near`` list those nearer than ``near`` [m] at these positions, ``near_count`` (2, B) of them.
    """

    pt: wp.array2d(dtype=wp.vec3i)
    ee: wp.array2d(dtype=wp.vec3i)
    pt_count: IntArray
    ee_count: IntArray
    pt_gap: FloatArray2d
    ee_gap: FloatArray2d
    moved: FloatArray
    near: wp.float64
    near_count: IntArray2d
    pt_near: IntArray2d
    ee_near: IntArray2d


@wp.func
def pairs_of(candidates: Candidates, ee: wp.bool, env: wp.int32) -> wp.int32:
    """Number of stored candidates of two edges (``ee``) or of a vertex and a face."""
    if ee:
        return wp.min(candidates.ee_count[env], candidates.ee.shape[1])
    return wp.min(candidates.pt_count[env], candidates.pt.shape[1])


@wp.func
def pair_at(candidates: Candidates, ee: wp.bool, env: wp.int32, i: wp.int32) -> wp.vec3i:
    """Candidate i of two edges (``ee``) or of a vertex and a face."""
    if ee:
        return candidates.ee[env, i]
    return candidates.pt[env, i]


@wp.func
def bounds_of(candidates: Candidates, env: wp.int32, gap: wp.float64):
    """Least and largest distance [m] of a pair measured at ``gap``, in the motion checked last.

    With room for rounding.
    """
    moved = wp.float64(2.0 + 1.0e-8) * candidates.moved[env]
    return wp.float64(1.0 - 1.0e-9) * gap - moved, wp.float64(1.0 + 1.0e-9) * gap + moved


@wp.func
def only_near(candidates: Candidates, env: wp.int32, reach: wp.float64) -> wp.bool:
    """True if the list of near candidates has all that may come within ``reach`` [m]."""
    least, _most = bounds_of(candidates, env, candidates.near)
    return candidates.near_count.shape[0] > 0 and least > reach


@wp.func
def listed(candidates: Candidates, ee: wp.bool, env: wp.int32, near: wp.bool) -> wp.int32:
    """Number of candidates, or of the ``near`` ones."""
    if near:
        return candidates.near_count[wp.where(ee, 1, 0), env]
    return pairs_of(candidates, ee, env)


@wp.func
def listed_at(candidates: Candidates, ee: wp.bool, env: wp.int32, near: wp.bool, k: wp.int32) -> wp.int32:
    """Candidate k of :func:`listed`."""
    if near:
        if ee:
            return candidates.ee_near[env, k]
        return candidates.pt_near[env, k]
    return k


@wp.func
def gap_bounds(candidates: Candidates, ee: wp.bool, env: wp.int32, i: wp.int32):
    """Least and largest distance [m] of candidate i in the motion that was checked last.

    Both of a lower bound where the candidate is away (:mod:`ipc.contact.reach`), and not of its distance.
    """
    gap = wp.float64(0.0)
    if ee:  # a conditional expression would read both lists, of which one may be shorter
        gap = candidates.ee_gap[env, i] + wp.float64(0.0)
    if not ee:
        gap = candidates.pt_gap[env, i] + wp.float64(0.0)
    return bounds_of(candidates, env, gap)


@wp.func
def pair_vertices(surface: Surface, ee: wp.bool, pair: wp.vec3i) -> wp.vec4i:
    """Vertices of two edges (``ee``) or of a vertex and a face."""
    a, b = pair[0], pair[1]
    if ee:
        return wp.vec4i(surface.edges[a, 0], surface.edges[a, 1], surface.edges[b, 0], surface.edges[b, 1])
    return wp.vec4i(a, surface.faces[b, 0], surface.faces[b, 1], surface.faces[b, 2])


@wp.struct
class Boxes:
    """Corners [m] of the boxes of vertices (B, V) and of bodies (B, bodies)."""

    low: VecArray2d
    high: VecArray2d
    body_low: VecArray2d
    body_high: VecArray2d


@wp.kernel
def leaves_box(x: VecArray2d, dx: VecArray2d, boxes: Boxes, active: IntArray, stale: IntArray, any_stale: IntArray):
    """Mark environments in which x or x + dx lies outside its vertex's box."""
    env, v = wp.tid()
    if active[env] == 0:
        return
    p, q = x[env, v], x[env, v] + dx[env, v]
    lo, hi = boxes.low[env, v], boxes.high[env, v]
    a, b = wp.min(p, q), wp.max(p, q)
    if not (a[0] >= lo[0] and a[1] >= lo[1] and a[2] >= lo[2] and b[0] <= hi[0] and b[1] <= hi[1] and b[2] <= hi[2]):
        stale[env] = 1
        any_stale[0] = 1


@wp.kernel
def check_candidates(candidates: Candidates, overflow: IntArray):
    """Raise the flag if a list did not fit."""
    env = wp.tid()
    if candidates.pt_count[env] > candidates.pt.shape[1] or candidates.ee_count[env] > candidates.ee.shape[1]:
        overflow[0] = 1


@wp.kernel
def clear_body_boxes(stale: IntArray, boxes: Boxes):
    """Empty boxes."""
    env, body = wp.tid()
    if stale[env] != 0:
        far = wp.float64(1.0e300)
        boxes.body_low[env, body] = wp.vec3d(far, far, far)
        boxes.body_high[env, body] = -wp.vec3d(far, far, far)


@wp.kernel
def fill_boxes(x: VecArray2d, dx: VecArray2d, margin: wp.float64, vert_body: IntArray, stale: IntArray, boxes: Boxes):
    """Boxes of the vertices around [x, x + dx], widened by the margin, and their unions."""
    env, v = wp.tid()
    if stale[env] == 0:
        return
    p, q = x[env, v], x[env, v] + dx[env, v]
    m = wp.vec3d(margin, margin, margin)
    lo, hi = wp.min(p, q) - m, wp.max(p, q) + m
    boxes.low[env, v] = lo
    boxes.high[env, v] = hi
    wp.atomic_min(boxes.body_low, env, vert_body[v], lo)
    wp.atomic_max(boxes.body_high, env, vert_body[v], hi)


@wp.kernel
def reset_lists(stale: IntArray, list_count: IntArray2d, candidates: Candidates):
    """Empties the lists of the stale environments."""
    env = wp.tid()
    if stale[env] == 0:
        return
    for k in range(list_count.shape[1]):
        list_count[env, k] = 0
    candidates.pt_count[env] = 0
    candidates.ee_count[env] = 0


@wp.func
def prim_vertices(surface: Surface, kind: wp.int32, i: wp.int32) -> wp.vec3i:
    """Vertices of vertex (kind 0), edge (1) or face (2) i; the last is repeated."""
    if kind == 0:
        return wp.vec3i(i, i, i)
    if kind == 1:
        return wp.vec3i(surface.edges[i, 0], surface.edges[i, 1], surface.edges[i, 1])
    return wp.vec3i(surface.faces[i, 0], surface.faces[i, 1], surface.faces[i, 2])


@wp.func
def prim_box(boxes: Boxes, surface: Surface, env: wp.int32, kind: wp.int32, i: wp.int32):
    """Lower and upper corner of the box of a primitive."""
    v = prim_vertices(surface, kind, i)
    lo = wp.min(wp.min(boxes.low[env, v[0]], boxes.low[env, v[1]]), boxes.low[env, v[2]])
    hi = wp.max(wp.max(boxes.high[env, v[0]], boxes.high[env, v[1]]), boxes.high[env, v[2]])
    return lo, hi


@wp.func
def overlap(lo: wp.vec3d, hi: wp.vec3d, lo2: wp.vec3d, hi2: wp.vec3d, reach: wp.float64) -> wp.bool:
    return (
        lo[0] <= hi2[0] + reach
        and lo2[0] <= hi[0] + reach
        and lo[1] <= hi2[1] + reach
        and lo2[1] <= hi[1] + reach
        and lo[2] <= hi2[2] + reach
        and lo2[2] <= hi[2] + reach
    )


@wp.func
def add_pair(
    boxes: Boxes,
    lo: wp.vec3d,
    hi: wp.vec3d,
    surface: Surface,
    env: wp.int32,
    ee: wp.bool,
    pair: wp.vec3i,
    candidates: Candidates,
):
    """Add edges (``ee``) or vertex and face if their boxes (``lo``, ``hi``: first's) overlap."""
    lo2, hi2 = prim_box(boxes, surface, env, 2 - wp.int32(ee), pair[1])
    if not overlap(lo, hi, lo2, hi2, surface.d_hat):
        return
    v = pair_vertices(surface, ee, pair)
    if v[0] == v[2] or v[0] == v[3]:
        return
    if ee:
        if v[1] != v[2] and v[1] != v[3]:
            slot = wp.atomic_add(candidates.ee_count, env, 1)
            if slot < candidates.ee.shape[1]:
                candidates.ee[env, slot] = pair
    elif v[0] != v[1]:
        slot = wp.atomic_add(candidates.pt_count, env, 1)
        if slot < candidates.pt.shape[1]:
            candidates.pt[env, slot] = pair


@wp.kernel
def select_prims(
    boxes: Boxes,
    surface: Surface,
    prim_kind: IntArray,
    prim_index: IntArray,
    prim_other: IntArray,
    prim_list: IntArray,
    list_start: IntArray,
    stale: IntArray,
    # outputs
    list_count: IntArray2d,
    members: IntArray2d,
):
    """Keep the primitives of each list that reach the box of the body they may touch."""
    env, i = wp.tid()
    if stale[env] == 0:
        return
    index, other, which = prim_index[i], prim_other[i], prim_list[i]
    lo, hi = prim_box(boxes, surface, env, prim_kind[i], index)
    if overlap(lo, hi, boxes.body_low[env, other], boxes.body_high[env, other], surface.d_hat):
        slot = wp.atomic_add(list_count, env, which, 1)
        members[env, list_start[which] + slot] = index


@wp.kernel
def find_pairs(
    boxes: Boxes,
    surface: Surface,
    members: IntArray2d,
    list_start: IntArray,
    list_count: IntArray2d,
    ee: wp.bool,
    first: wp.int32,
    second: wp.int32,
    pair: wp.int32,
    stale: IntArray,
    # outputs
    candidates: Candidates,
):
    """Edges (``ee``) or vertices of list ``first`` with those or faces of ``second``, once each."""
    env, i = wp.tid()
    if stale[env] == 0 or i >= list_count[env, first]:
        return
    a = members[env, list_start[first] + i]
    lo, hi = prim_box(boxes, surface, env, wp.int32(ee), a)
    for k in range(list_count[env, second]):
        b = members[env, list_start[second] + k]
        if first != second or a < b:
            add_pair(boxes, lo, hi, surface, env, ee, wp.vec3i(a, b, pair), candidates)


@wp.func
def comes_before(a: wp.vec3i, b: wp.vec3i) -> wp.bool:
    return a[0] < b[0] or (a[0] == b[0] and a[1] < b[1])


@wp.kernel
def rank_candidates(items: wp.array2d(dtype=wp.vec3i), count: IntArray, stale: IntArray, ordered: wp.array2d(dtype=wp.vec3i)):
    """Sorts the pairs, which are unique, so that their order does not depend on scheduling."""
    env, i = wp.tid()
    if stale[env] == 0 or i >= count[env]:
        return
    rank = wp.int32(0)
    for k in range(wp.min(count[env], items.shape[1])):
        if comes_before(items[env, k], items[env, i]):
            rank += 1
    ordered[env, rank] = items[env, i]


@wp.kernel
def put_back(ordered: wp.array2d(dtype=wp.vec3i), count: IntArray, stale: IntArray, items: wp.array2d(dtype=wp.vec3i)):
    env, i = wp.tid()
    if stale[env] != 0 and i < count[env]:
        items[env, i] = ordered[env, i]
