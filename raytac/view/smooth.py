"""Meshes that look smooth where they are round and sharp at their edges."""

from __future__ import annotations

import numpy as np

__all__ = ["split_creases"]

_SHARP = 35.0
"""Faces that meet at a larger angle than this [degrees] meet in an edge that is seen."""


def split_creases(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give both sides of every sharp edge vertices of their own, so that normals averaged over a vertex's faces are right.

    Args:
        vertices: shape (V, 3).
        faces: shape (F, 3), all of them turned alike.

    Returns:
        source: number of the old vertex of each new one, shape (W,); new vertices are ``vertices[source]``, now and when they move.
        faces: with the new numbers, shape (F, 3).
    """
    faces = np.asarray(faces)
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # Edge k of a face runs from corner k to the next one; its partner in the neighbour runs the other way.
    count = len(vertices)
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    order = np.argsort(start * count + end)
    keys = (start * count + end)[order]
    found = np.minimum(np.searchsorted(keys, end * count + start), len(keys) - 1)
    edge = np.flatnonzero(keys[found] == end * count + start)
    partner = order[found[edge]]
    face, other = edge // 3, partner // 3
    smooth = np.einsum("ij,ij->i", normal[face], normal[other]) >= np.cos(np.radians(_SHARP))
    edge, partner = edge[smooth], partner[smooth]
    # The start of an edge is the end of its partner: corners of one vertex that are joined across a smooth edge.
    after = 3 * (partner // 3) + (partner + 1) % 3
    group = _joined(len(start), edge, after)
    _, first, faces = np.unique(group, return_index=True, return_inverse=True)
    return start[first], faces.reshape(-1, 3)


def _joined(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Smallest number that each of ``count`` numbers is connected with through the pairs (a, b)."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[a], label[b])
        lowered = label.copy()
        np.minimum.at(lowered, a, least)
        np.minimum.at(lowered, b, least)
        lowered = lowered[lowered]  # a label's own label is as good: chains halve
        if (lowered == label).all():
            return label
        label = lowered
