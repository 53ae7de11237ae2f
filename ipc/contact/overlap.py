"""Surfaces that cross, touch or contain each other, by primitives. NumPy, on the host.

Edges are tested against triangles exactly: every result is the sign of a determinant of the coordinates. A sign of which float64 leaves
no doubt is taken (after Shewchuk 1997, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates"). The few others
are computed in integers of any length. Nothing depends on how thin a triangle or how small an angle is.
"""

from __future__ import annotations

from hashlib import blake2b
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipc.bodies.body import rotation_matrix
from ipc.bodies.layout import Layout
from ipc.errors import OverlapError
from ipc.state import State

Floats = NDArray[np.float64]
Signs = NDArray[np.int8]

APART, TOUCHING, CROSSING = 0, 1, 2

_ROUNDING = 16 * 2.0**-53
"""Bound of the relative error of a determinant against the sum of its terms' sizes."""
_UNDERFLOW = 1e-280
"""Terms below this may have lost digits to underflow."""
_CHUNK = 64
"""Boxes that are compared with others at once."""
_KNOWN = 2**14
"""Most pairs that are remembered to be apart."""


def _whole(x: Floats) -> NDArray[np.object_]:
    """Coordinates (n, k, dim) as integers, each of the n sets times a power of two."""
    mantissa, exponent = np.frexp(x)
    digits = np.ldexp(mantissa, 53).astype(np.int64)
    exponent = np.where(digits == 0, np.iinfo(exponent.dtype).max, exponent)
    shift = np.where(digits == 0, 0, exponent - exponent.min(axis=(1, 2), keepdims=True))
    return np.left_shift(digits.astype(object), shift.astype(object))


def _terms(x: NDArray) -> tuple[NDArray, ...]:
    """Terms (n,) of the determinant of the last points (n, dim + 1, dim) less the first."""
    d = [x[:, k] - x[:, 0] for k in range(1, x.shape[1])]
    if len(d) == 2:
        return d[0][:, 0] * d[1][:, 1], -(d[0][:, 1] * d[1][:, 0])
    return tuple(
        sign * (d[0][:, i] * (d[1][:, j] * d[2][:, k]))
        for i, j, k, sign in ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (0, 2, 1, -1), (1, 0, 2, -1), (2, 1, 0, -1))
    )


def orientation(*points: Floats) -> Signs:
    """Exact sign of the area of triangles in the plane, or of (b − a) × (c − a) · (d − a).

    Args:
        points: three arrays (n, 2), or four (n, 3), of finite float64.
    """
    x = np.stack(points, axis=1)
    terms = _terms(x)
    total, size = np.sum(terms, axis=0), np.sum(np.abs(terms), axis=0)
    signs = np.sign(total).astype(np.int8)
    doubtful = ~(np.abs(total) > _ROUNDING * size + _UNDERFLOW)
    if doubtful.any():
        exact = np.sum(_terms(_whole(x[doubtful])), axis=0)
        signs[doubtful] = np.sign(exact).astype(np.int8)
    return signs


def meet(p: Floats, q: Floats, a: Floats, b: Floats, c: Floats) -> NDArray[np.int8]:
    """``APART``, ``TOUCHING`` or ``CROSSING`` (n,) for segments pq and triangles abc, exactly.

    Crossing is to pass from one side of the triangle to the other through its inside; all else that meets is touching. A triangle without
    area meets nothing: its edges are those of others.

    Args:
        p, q, a, b, c: float64 [m], shape (n, 3) each.
    """
    result = np.full(len(p), APART, np.int8)
    side_p, side_q = orientation(a, b, c, p), orientation(a, b, c, q)
    near = np.flatnonzero((side_p * side_q <= 0) & ((side_p != 0) | (side_q != 0)))
    if len(near):
        p_, q_, a_, b_, c_ = (x[near] for x in (p, q, a, b, c))
        turns = np.stack([orientation(p_, q_, a_, b_), orientation(p_, q_, b_, c_), orientation(p_, q_, c_, a_)])
        inside = (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
        through = inside & (turns != 0).all(axis=0) & (side_p[near] * side_q[near] < 0)
        result[near] = np.where(through, CROSSING, np.where(inside, TOUCHING, APART))
    flat = np.flatnonzero((side_p == 0) & (side_q == 0))
    if len(flat):
        result[flat] = np.where(_meet_in_plane(*(x[flat] for x in (p, q, a, b, c))), TOUCHING, APART)
    return result


def _meet_in_plane(p: Floats, q: Floats, a: Floats, b: Floats, c: Floats) -> NDArray[np.bool_]:
    """True for segments that meet triangles of their plane: no side separates the two."""
    meeting, done = np.zeros(len(p), bool), np.zeros(len(p), bool)
    for axes in ((0, 1), (1, 2), (2, 0)):  # a triangle with area has one in the projection on some coordinate plane
        rows = np.flatnonzero(~done)
        p_, q_, a_, b_, c_ = (x[rows][:, axes] for x in (p, q, a, b, c))
        turn = orientation(a_, b_, c_)
        rows, turn = rows[turn != 0], turn[turn != 0]
        p_, q_, a_, b_, c_ = (x[rows][:, axes] for x in (p, q, a, b, c))
        beyond = np.zeros(len(rows), bool)
        for u, v in ((a_, b_), (b_, c_), (c_, a_)):
            beyond |= (turn * orientation(u, v, p_) < 0) & (turn * orientation(u, v, q_) < 0)
        sides = np.stack([orientation(p_, q_, corner) for corner in (a_, b_, c_)])
        beyond |= (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
        meeting[rows], done[rows] = ~beyond, True
    return meeting


def world_vertices(layout: Layout, y: Floats, rotation: Floats, position: Floats) -> Floats:
    """World positions [m] of all vertices (V, 3) of an environment, from nodes and frames."""
    local = np.where(
        (layout.vert_count == 0)[:, None], layout.vert_local, np.einsum("vk,vki->vi", layout.vert_weight, y[layout.vert_nodes])
    )
    R = rotation_matrix(rotation)
    return np.einsum("vij,vj->vi", R[layout.vert_body], local) + position[layout.vert_body]


def _reach(a_low: Floats, a_high: Floats, b_low: Floats, b_high: Floats) -> NDArray[np.bool_]:
    """True where boxes overlap; shapes (..., 3) that fit each other."""
    x, y, z = ((a_low[..., k] <= b_high[..., k]) & (a_high[..., k] >= b_low[..., k]) for k in range(3))
    return x & y & z


def _box_pairs(a_low: Floats, a_high: Floats, b_low: Floats, b_high: Floats) -> tuple[NDArray, NDArray]:
    """Indices of overlapping boxes, ordered by the first and then by the second."""
    ia = np.flatnonzero(_reach(a_low, a_high, b_low.min(axis=0), b_high.max(axis=0)))
    ib = np.flatnonzero(_reach(b_low, b_high, a_low.min(axis=0), a_high.max(axis=0)))
    first, second = [np.zeros(0, int)], [np.zeros(0, int)]
    if len(ia):
        ia = ia[np.argsort(a_low[ia, np.ptp(a_low[ia], axis=0).argmax()])]
    # Boxes that follow each other lie in one slab, which few of the others reach.
    for chunk in np.array_split(ia, max(1, len(ia) // _CHUNK)) if len(ia) else ():
        low, high = a_low[chunk], a_high[chunk]
        near = ib[_reach(b_low[ib], b_high[ib], low.min(axis=0), high.max(axis=0))]
        i, j = np.nonzero(_reach(low[:, None], high[:, None], b_low[near], b_high[near]))
        first.append(chunk[i])
        second.append(near[j])
    i, j = np.concatenate(first), np.concatenate(second)
    order = np.lexsort((j, i))
    return i[order], j[order]


def _edge_face_hits(x: Floats, edges: NDArray, faces: NDArray) -> tuple[int, int, float | None] | None:
    """The deepest crossing: edge, face, and depth behind the face [m], None for a touch."""
    ends, corners = x[edges], x[faces]
    i, j = _box_pairs(ends.min(axis=1), ends.max(axis=1), corners.min(axis=1), corners.max(axis=1))
    apart = (edges[i][:, :, None] != faces[j][:, None, :]).all(axis=(1, 2))
    i, j = i[apart], j[apart]
    relation = meet(ends[i, 0], ends[i, 1], *(corners[j, k] for k in range(3)))
    if (relation == APART).all():
        return None
    if not (relation == CROSSING).any():
        first = int(np.argmax(relation))
        return int(i[first]), int(j[first]), None
    i, j = i[relation == CROSSING], j[relation == CROSSING]
    a, b, c = (corners[j, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    depth = -((ends[i] - a[:, None]) * normal[:, None]).sum(axis=-1).min(axis=1)
    worst = int(np.argmax(depth))
    return int(i[worst]), int(j[worst]), abs(float(depth[worst]))


def _contains(x: Floats, faces: NDArray, point: Floats) -> bool:
    """True if a closed surface winds around the point (van Oosterom, Strackee 1983)."""
    a, b, c = (x[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    top = (a * np.cross(b, c)).sum(axis=1)
    bottom = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return abs(2 * np.arctan2(top, bottom).sum()) > 3 * np.pi


def _is_closed(faces: NDArray) -> bool:
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(sides, axis=0, return_counts=True)[1] == 2).all())


def find_overlap(layout: Layout, x: Floats, normal: Floats, origin: Floats) -> str | None:
    """Describe the first overlap of one environment, or None.

    Args:
        x: surface vertices in the world [m] (V, 3).
        normal, origin: of the half-spaces among the bodies, world frame, (bodies, 3) and [m] (bodies, 3).
    """
    for a, b in layout.pairs:
        overlap = _find_pair_overlap(layout, int(a), int(b), x, normal, origin)
        if overlap is not None:
            return overlap
    return None


def _find_pair_overlap(layout: Layout, a: int, b: int, x: Floats, normal: Floats, origin: Floats) -> str | None:
    """The first overlap of two bodies, or of one with itself; arguments as of ``find_overlap``."""
    na, nb = layout.names[a], layout.names[b]
    va = slice(layout.vert_start[a], layout.vert_start[a + 1])
    if layout.half_space[b]:
        height = (x[va] - origin[b]) @ normal[b]
        low = int(np.argmin(height))
        if height[low] <= 0:
            where = f"lies {-height[low]:.3g} m inside" if height[low] < 0 else "touches"
            return f"vertex {low} of {na!r} {where} the half-space {nb!r}"
        return None
    for first, second in ((a, b), (b, a)) if a != b else ((a, b),):
        edges = layout.edges[layout.edge_start[first] : layout.edge_start[first + 1]]
        faces = layout.faces[layout.face_start[second] : layout.face_start[second + 1]]
        hit = _edge_face_hits(x, edges, faces)
        if hit is not None:
            e, f = edges[hit[0]] - layout.vert_start[first], hit[1]
            meets = "touches" if hit[2] is None else f"goes {hit[2]:.3g} m through"
            return (
                f"edge {hit[0]} (vertices {e[0]}, {e[1]}) of {layout.names[first]!r} {meets} triangle {f} of "
                f"{layout.names[second]!r}"
            )
    if a != b:
        for inner, outer in ((a, b), (b, a)):
            faces = layout.faces[layout.face_start[outer] : layout.face_start[outer + 1]]
            if _is_closed(faces) and _contains(x, faces, x[layout.vert_start[inner]]):
                return f"{layout.names[inner]!r} lies inside {layout.names[outer]!r}"
    return None


class OverlapCheck:
    """Refusal of states in which surfaces cross; no pair is tested again once it was apart.

    A body alone is known by the shape of its own surface, wherever its frame is; two bodies by their shapes and frames.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._clear: dict[bytes, None] = {}
        """Digests of pairs that are apart, the latest last."""

    def __call__(self, state: State, mask: NDArray[np.bool_]) -> None:
        """Refuse surfaces that cross in the mask's environments: OverlapError."""
        layout = self._layout
        for env in np.flatnonzero(mask):
            if state.failed[env] or not np.isfinite(state.y[env]).all():
                continue
            y, rotation, position = state.y[env], state.frame_rotation[env], state.frame_position[env]
            unknown = [(key, a, b) for key, a, b in self._keys(y, rotation, position) if key not in self._clear]
            if not unknown:
                continue
            x, normal = world_vertices(layout, y, rotation, position), rotation_matrix(rotation)[:, :, 2]
            for key, a, b in unknown:
                overlap = _find_pair_overlap(layout, a, b, x, normal, position)
                if overlap is not None:
                    raise OverlapError(f"environment {env}: {overlap}: start with the surfaces apart")
                self._clear[key] = None
        while len(self._clear) > _KNOWN:
            del self._clear[next(iter(self._clear))]

    def _keys(self, y: Floats, rotation: Floats, position: Floats) -> list[tuple[bytes, int, int]]:
        """Digest of every pair of bodies that may touch, and their numbers."""
        layout = self._layout
        shapes = [y[first:last].tobytes() for first, last in pairwise(layout.node_start)]
        frames = [rotation[k].tobytes() + position[k].tobytes() for k in range(len(layout.names))]
        keys = []
        for index, (a, b) in enumerate(layout.pairs.tolist()):
            parts = [shapes[a]] if a == b else [shapes[a], frames[a], shapes[b], frames[b]]
            keys.append((blake2b(b"".join([str(index).encode(), *parts]), digest_size=16).digest(), a, b))
        return keys
