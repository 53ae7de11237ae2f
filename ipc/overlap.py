"""Finds surfaces that cross, touch or contain each other, and says which primitives and how deep. Plain NumPy, on the host.

Whether an edge meets a triangle is decided exactly (:mod:`ipc.crossing`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipc.crossing import APART, CROSSING, meet
from ipc.errors import OverlapError
from ipc.layout import Layout, rotation_matrix
from ipc.state import State

__all__ = ["check_overlap", "find_overlap", "world_vertices"]

Floats = NDArray[np.float64]


def world_vertices(layout: Layout, y: Floats, rotation: Floats, position: Floats) -> Floats:
    """World positions [m] of all surface vertices (V, 3) of one environment: nodes y (N, 3), frames (bodies, 4) and (bodies, 3)."""
    local = np.where(
        (layout.vert_count == 0)[:, None], layout.vert_local, np.einsum("vk,vki->vi", layout.vert_weight, y[layout.vert_nodes])
    )
    R = rotation_matrix(rotation)
    return np.einsum("vij,vj->vi", R[layout.vert_body], local) + position[layout.vert_body]


def _box_pairs(a_low: Floats, a_high: Floats, b_low: Floats, b_high: Floats) -> tuple[NDArray, NDArray]:
    """Indices of overlapping boxes."""
    reach_a = (a_low <= b_high.max(axis=0)).all(axis=1) & (a_high >= b_low.min(axis=0)).all(axis=1)
    reach_b = (b_low <= a_high.max(axis=0)).all(axis=1) & (b_high >= a_low.min(axis=0)).all(axis=1)
    ia, ib = np.flatnonzero(reach_a), np.flatnonzero(reach_b)
    first, second = [np.zeros(0, int)], [np.zeros(0, int)]
    for chunk in np.array_split(ia, max(1, len(ia) * len(ib) // 1_000_000)):
        hit = (a_low[chunk, None] <= b_high[None, ib]).all(-1) & (a_high[chunk, None] >= b_low[None, ib]).all(-1)
        i, j = np.nonzero(hit)
        first.append(chunk[i])
        second.append(ib[j])
    return np.concatenate(first), np.concatenate(second)


def _edge_face_hits(x: Floats, edges: NDArray, faces: NDArray) -> tuple[int, int, float | None] | None:
    """The deepest crossing of an edge and a triangle: edge, face, and how far it ends behind the face [m], None if they only touch."""
    ends, corners = x[edges], x[faces]
    i, j = _box_pairs(ends.min(axis=1), ends.max(axis=1), corners.min(axis=1), corners.max(axis=1))
    apart = (edges[i][:, :, None] != faces[j][:, None, :]).all(axis=(1, 2))
    i, j = i[apart], j[apart]
    how = meet(ends[i, 0], ends[i, 1], *(corners[j, k] for k in range(3)))
    if (how == APART).all():
        return None
    if not (how == CROSSING).any():
        first = int(np.argmax(how))
        return int(i[first]), int(j[first]), None
    i, j = i[how == CROSSING], j[how == CROSSING]
    a, b, c = (corners[j, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    depth = -((ends[i] - a[:, None]) * normal[:, None]).sum(axis=-1).min(axis=1)
    worst = int(np.argmax(depth))
    return int(i[worst]), int(j[worst]), abs(float(depth[worst]))


def _contains(x: Floats, faces: NDArray, point: Floats) -> bool:
    """Whether a closed surface winds around the point (van Oosterom, Strackee 1983); false for an open surface seen from outside."""
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
        layout: the flat arrays.
        x: surface vertices in the world [m] (V, 3).
        normal, origin: of the half-spaces among the bodies, world frame, (bodies, 3) and [m] (bodies, 3).
    """
    for a, b in layout.pairs:
        na, nb = layout.names[a], layout.names[b]
        va = slice(layout.vert_start[a], layout.vert_start[a + 1])
        if layout.half_space[b]:
            height = (x[va] - origin[b]) @ normal[b]
            low = int(np.argmin(height))
            if height[low] <= 0:
                where = f"lies {-height[low]:.3g} m inside" if height[low] < 0 else "touches"
                return f"vertex {low} of {na!r} {where} the half-space {nb!r}"
            continue
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


def check_overlap(layout: Layout, state: State, mask: NDArray[np.bool_]) -> None:
    """Refuse surfaces that cross in the environments of the mask; those that look alike are checked once.

    Raises:
        OverlapError: names the environment and the surfaces.
    """
    seen: set[bytes] = set()
    for env in np.flatnonzero(mask):
        key = state.y[env].tobytes() + state.frame_rotation[env].tobytes() + state.frame_position[env].tobytes()
        if key in seen or state.failed[env] or not np.isfinite(state.y[env]).all():
            continue
        seen.add(key)
        rotation, position = state.frame_rotation[env], state.frame_position[env]
        x = world_vertices(layout, state.y[env], rotation, position)
        found = find_overlap(layout, x, rotation_matrix(rotation)[:, :, 2], position)
        if found is not None:
            raise OverlapError(f"environment {env}: {found}: start with the surfaces apart")
