"""Broad phase by bounding volume hierarchies over faces and edges, a subtree for each body.

A vertex searches the faces of every body that it may touch, and an edge that body's edges. Time grows with n log n and with the number of
pairs, that of :mod:`ipc.broad_phase.lists` with the product of the lengths. Two launches serve all pairs of bodies.

A hierarchy is built once, from the shapes at rest, and only refitted afterwards: primitives that are neighbours on a surface stay
neighbours however the body moves, and every body has a subtree of its own, so that where bodies are to each other does not matter.
Refitting neither allocates nor waits, so it may be part of a recorded step. Boxes are single precision rounded outward; what overlaps
there is tested again in double precision, which makes the pairs the same as those of the lists.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import IntArray, IntArray2d, filled
from ipc.bodies.layout import Layout
from ipc.broad_phase.lists import Boxes, Candidates, Surface, add_pair, overlap, prim_box, prim_vertices

wp.set_module_options({"enable_backward": False})

ROUNDING = wp.constant(wp.float32(2.4e-7))
"""Two to four units in the last place: conversion and the sum lose one at most."""
TINY = wp.constant(wp.float32(1e-37))
FAR = wp.constant(wp.float64(1e37))
WIDER = wp.constant(wp.float64(1.0 + 1e-6))
"""Queries reach a little farther than d̂, so that rounding never hides a pair."""


@wp.func
def round_down(value: wp.float64) -> wp.float32:
    """A number below ``value``; far below for one that is none."""
    kept = wp.min(value, FAR)
    if not (value >= -FAR):
        kept = -FAR
    near = wp.float32(kept)
    return near - wp.abs(near) * ROUNDING - TINY


@wp.func
def round_up(value: wp.float64) -> wp.float32:
    """A number above ``value``; far above for one that is none."""
    kept = wp.max(value, -FAR)
    if not (value <= FAR):
        kept = FAR
    near = wp.float32(kept)
    return near + wp.abs(near) * ROUNDING + TINY


@wp.func
def corner_down(corner: wp.vec3d) -> wp.vec3:
    return wp.vec3(round_down(corner[0]), round_down(corner[1]), round_down(corner[2]))


@wp.func
def corner_up(corner: wp.vec3d) -> wp.vec3:
    return wp.vec3(round_up(corner[0]), round_up(corner[1]), round_up(corner[2]))


@wp.struct
class Tree:
    """A hierarchy over n primitives an environment; item env·n + k is primitive ``prim[k]``."""

    id: wp.uint64
    prim: IntArray  # (n,)
    root: IntArray2d  # node above all primitives of a body (B, bodies)


@wp.struct
class Partners:
    """Queries of the primitives ``asking`` to each ``body`` from a body's ``start`` on."""

    asking: IntArray
    start: IntArray  # (bodies + 1,)
    body: IntArray
    pair: IntArray


@wp.kernel
def find_roots(id: wp.uint64, group: IntArray, groups: wp.int32, root: IntArray2d):
    env, body = wp.tid()
    if group[body] >= 0:
        root[env, body] = wp.bvh_get_group_root(id, env * groups + group[body])


@wp.kernel
def fill_boxes(
    boxes: Boxes,
    surface: Surface,
    kind: wp.int32,
    tree: Tree,
    stale: IntArray,
    # outputs
    lower: wp.array2d(dtype=wp.vec3),
    upper: wp.array2d(dtype=wp.vec3),
):
    """Boxes of the edges (kind 1) or faces (2) of a tree, rounded outward."""
    env, k = wp.tid()
    if stale[env] != 0:
        lo, hi = prim_box(boxes, surface, env, kind, tree.prim[k])
        lower[env, k] = corner_down(lo)
        upper[env, k] = corner_up(hi)


@wp.kernel
def query(
    boxes: Boxes,
    surface: Surface,
    vert_body: IntArray,
    ee: wp.bool,
    tree: Tree,
    partners: Partners,
    stale: IntArray,
    # outputs
    candidates: Candidates,
):
    """Vertices against faces, or edges (``ee``), of bodies that may touch; each pair once."""
    env, i = wp.tid()
    if stale[env] == 0:
        return
    a = partners.asking[i]
    own = vert_body[prim_vertices(surface, wp.int32(ee), a)[0]]
    lo, hi = prim_box(boxes, surface, env, wp.int32(ee), a)
    reach = WIDER * surface.d_hat
    margin = wp.vec3d(reach, reach, reach)
    lower, upper = corner_down(lo - margin), corner_up(hi + margin)
    for k in range(partners.start[own], partners.start[own + 1]):
        other = partners.body[k]
        if overlap(lo, hi, boxes.body_low[env, other], boxes.body_high[env, other], surface.d_hat):
            query = wp.bvh_query_aabb(tree.id, lower, upper, tree.root[env, other])
            item = wp.int32(0)
            while wp.bvh_query_next(query, item):
                b = tree.prim[item - env * tree.prim.shape[0]]
                if not ee or other != own or a < b:
                    add_pair(boxes, lo, hi, surface, env, ee, wp.vec3i(a, b, partners.pair[k]), candidates)


_EDGES, _FACES = 1, 2

# Where hierarchies begin to pay: edges of a body that touches itself, product of two bodies' edges, number of body pairs.
_CPU, _CUDA = (300, 2e6, 3), (700, 3e6, 10)


def trees_pay(layout: Layout, pairs: Sequence[tuple[int, int, int]], cuda: bool) -> bool:
    """Expect hierarchies to be faster than lists for the body pairs (index, a, b)."""
    own, product, most = _CUDA if cuda else _CPU
    edges = np.diff(layout.edge_start).astype(float)
    return len(pairs) >= most or any(edges[a] >= own if a == b else edges[a] * edges[b] >= product for _, a, b in pairs)


def _span(start: NDArray[np.int32], body: int) -> NDArray[np.int32]:
    return np.arange(start[body], start[body + 1], dtype=np.int32)


class _Side:
    """A hierarchy over primitives of one kind, and the queries to it.

    Args:
        kind: 1 for edges, 2 for faces.
        asks: (asking body, asked body, body pair).
    """

    def __init__(self, kind: int, layout: Layout, asks: list[tuple[int, int, int]], batch: int, device: wp.Device) -> None:
        self.kind = kind
        bodies = len(layout.names)
        prims, start = (layout.edges, layout.edge_start) if kind == _EDGES else (layout.faces, layout.face_start)
        asked = sorted({b for _, b, _ in asks})
        lower, upper, group = [], [], []
        for number, body in enumerate(asked):
            # The shape at rest, scaled to a unit, so that clusters are as fine for small bodies as for large ones.
            ids, verts = prims[_span(start, body)], slice(layout.vert_start[body], layout.vert_start[body + 1])
            size = np.ptp(layout.vert_local[verts], axis=0).max()
            corners = (layout.vert_local[ids] - layout.vert_local[verts].min(axis=0)) / size
            lower.append(corners.min(axis=1))
            upper.append(corners.max(axis=1))
            group.append(np.full(len(ids), number))
        low, high, groups = (np.concatenate(parts) for parts in (lower, upper, group))
        self.shape = (batch, len(groups))
        self._lower, self._upper = (
            wp.array(np.broadcast_to(values, (batch, *values.shape)), dtype=wp.vec3, device=device) for values in (low, high)
        )
        everyone = (len(asked) * np.arange(batch)[:, None] + groups).ravel()
        members = wp.array(everyone, dtype=wp.int32, device=device)
        self._bvh = wp.Bvh(self._lower.flatten(), self._upper.flatten(), groups=members)
        self.tree = Tree()
        self.tree.id = self._bvh.id
        self.tree.prim = wp.array(np.concatenate([_span(start, body) for body in asked]), dtype=wp.int32, device=device)
        self.tree.root = wp.zeros((batch, bodies), dtype=wp.int32, device=device)
        numbers = np.full(bodies, -1)
        numbers[asked] = np.arange(len(asked))
        inputs = [self._bvh.id, wp.array(numbers, dtype=wp.int32, device=device), len(asked)]
        wp.launch(find_roots, dim=(batch, bodies), inputs=inputs, outputs=[self.tree.root], device=device)
        self._bvh.refit()  # changes nothing: its kernel shall be loaded before a step is recorded

        order = sorted(asks)
        from_start = layout.edge_start if kind == _EDGES else layout.vert_start
        asking = np.concatenate([_span(from_start, body) for body in sorted({a for a, _, _ in asks})])
        counts = np.bincount([a for a, _, _ in order], minlength=bodies)
        starts, (_, body, pair) = np.concatenate([[0], np.cumsum(counts)]), zip(*order, strict=True)
        self.partners = filled(Partners, device, {"asking": asking, "start": starts, "body": body, "pair": pair})
        self.asking = len(asking)

    def refit(self, boxes: Boxes, surface: Surface, stale: wp.array) -> None:
        inputs, outputs = [boxes, surface, self.kind, self.tree, stale], [self._lower, self._upper]
        wp.launch(fill_boxes, dim=self.shape, inputs=inputs, outputs=outputs, device=stale.device)
        self._bvh.refit()


class Trees:
    """The hierarchies of a batch of environments and the searches in them.

    Args:
        pairs: body pairs (index, a, b) to look at; a = b for a body that touches itself. At least one.
    """

    def __init__(self, layout: Layout, pairs: Sequence[tuple[int, int, int]], batch: int, device: wp.Device) -> None:
        both = {(a, b, i) for i, a, b in pairs} | {(b, a, i) for i, a, b in pairs}
        self._faces = _Side(_FACES, layout, sorted(both), batch, device)
        self._edges = _Side(_EDGES, layout, [(a, b, i) for i, a, b in pairs], batch, device)

    def find(self, boxes: Boxes, surface: Surface, vert_body: wp.array, stale: wp.array, candidates: Candidates) -> None:
        """Add pairs of environments in ``stale`` (B,), without a wait; ``vert_body`` (V,): bodies."""
        for side in (self._faces, self._edges):
            side.refit(boxes, surface, stale)
            inputs = [boxes, surface, vert_body, side.kind == _EDGES, side.tree, side.partners, stale]
            dim = (stale.shape[0], side.asking)
            wp.launch(query, dim=dim, inputs=inputs, outputs=[candidates], device=stale.device)
