"""Depth of points inside a simple solid."""

from __future__ import annotations

import numpy as np

from raytac.shapes.part import Part

SOLIDS = ("plane", "box", "sphere", "cylinder", "capsule")
"""Kinds of part that ``point_depth`` takes."""


def point_depth(part: Part, points: np.ndarray) -> np.ndarray:
    """Distance to the nearest face [m], (n,), positive inside.

    Outside it is negative and no further than the true distance. ``points``: (n, 3), in the frame of the part's body [m]. Raises
    ``ValueError`` for a kind that is not in ``SOLIDS``.
    """
    pose, size = part.object_from_part, part.size
    at = (points - pose[:3, 3]) @ pose[:3, :3]
    if part.kind == "plane":
        return -at[:, 2]
    if part.kind == "box":
        return (np.asarray(size) - np.abs(at)).min(axis=1)
    if part.kind == "sphere":
        return size[0] - np.linalg.norm(at, axis=1)
    if part.kind == "capsule":
        along = np.clip(at[:, 2], -size[1], size[1])
        return size[0] - np.linalg.norm(at - along[:, None] * [0.0, 0.0, 1.0], axis=1)
    if part.kind == "cylinder":
        return np.minimum(size[0] - np.hypot(at[:, 0], at[:, 1]), size[1] - np.abs(at[:, 2]))
    raise ValueError(f"no depth in a part of kind {part.kind!r}: known are {', '.join(SOLIDS)}")
