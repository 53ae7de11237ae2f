"""The underside of an object over the pad, as a height field in the pad frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.gel.part import Part
from raytac.gel.primitives import UNDERSIDES, bounds
from raytac.gel.rasterize import lowest_of_triangles
from raytac.gel.relief import looks_down, relief_underside

__all__ = ["object_bounds", "object_height"]


def object_height(
    parts: Sequence[Part], pad_from_object: np.ndarray, x: np.ndarray, y: np.ndarray, *, below: float = np.inf
) -> np.ndarray:
    """Lowest z [m] of the object above each node, pad frame, shape (B, Ny, Nx), float64; ``inf`` where nothing is above.

    ``pad_from_object``: poses (B, 4, 4). ``x`` (Nx,), ``y`` (Ny,) [m]: evenly spaced, ascending. The object is the union of its
    ``parts``: the minimum of their undersides (exact for primitives, exact linear interpolation for meshes). ``below`` [m] saves
    work: parts and triangles that lie wholly above it may be left out (their nodes read ``inf``). Nothing is cut off at the pad:
    a part that reaches through it still shows its underside. A pose that is not finite gives NaN in its environment alone.
    Raises ``InputError`` for poses of another shape.
    """
    poses = np.asarray(pad_from_object, float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError("pad_from_object", value=poses.shape, rule="must have shape (B, 4, 4)")
    height = np.full((len(poses), len(y), len(x)), np.inf)
    for pose, lowest in zip(poses, height, strict=True):
        if not np.isfinite(pose).all():
            lowest[...] = np.nan
            continue
        for part in parts:
            _lower_onto(lowest, part, pose @ part.object_from_part, x, y, below)
    return height


def object_bounds(parts: Sequence[Part], pad_from_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned box (lower, upper), each (3,) [m], in the pad frame, that holds the object at one pose (4, 4)."""
    boxes = [_part_bounds(part, pad_from_object @ part.object_from_part) for part in parts]
    return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def _part_bounds(part: Part, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if part.kind == "mesh":
        assert part.vertices is not None
        placed = part.vertices @ pose[:3, :3].T + pose[:3, 3]
        return placed.min(axis=0), placed.max(axis=0)
    if part.kind == "relief":
        assert part.elevation is not None
        thickness = 0.5 * float(part.elevation.max())
        shifted = pose.copy()
        shifted[:3, 3] -= thickness * pose[:3, 2]
        return bounds("box", (part.size[0], part.size[0], thickness), shifted)
    return bounds(part.kind, part.size, pose)


def _lower_onto(lowest: np.ndarray, part: Part, pose: np.ndarray, x: np.ndarray, y: np.ndarray, below: float) -> None:
    """Take the minimum of ``lowest`` (Ny, Nx) and the part's underside, in place, within the part's bounding box."""
    corners: np.ndarray | None = None
    if part.kind == "mesh" or (part.kind == "relief" and not looks_down(part, pose)):
        assert part.vertices is not None
        placed = part.vertices @ pose[:3, :3].T + pose[:3, 3]
        low, high = placed.min(axis=0), placed.max(axis=0)
    else:
        placed = None
        low, high = _part_bounds(part, pose)
    columns = slice(*np.searchsorted(x, (low[0], high[0]), side="left") + np.array([0, 1]))
    rows = slice(*np.searchsorted(y, (low[1], high[1]), side="left") + np.array([0, 1]))
    window = lowest[rows, columns]
    if low[2] > below or window.size == 0:
        return
    if placed is not None:
        assert part.faces is not None
        corners = _candidates(placed, part.faces, part.closed, below)
        np.minimum(window, lowest_of_triangles(corners, x, y)[rows, columns], out=window)
        return
    local_x, local_y = x[columns][None, :], y[rows][:, None]
    if part.kind == "relief":
        underside = relief_underside(part, pose, local_x, local_y)
    else:
        underside = UNDERSIDES[part.kind](part.size, pose, local_x, local_y)
    np.minimum(window, underside, out=window)


def _candidates(placed: np.ndarray, faces: np.ndarray, closed: bool, below: float) -> np.ndarray:
    """Corners (T, 3, 3) of the triangles that can be part of the underside."""
    if np.isfinite(below):
        faces = faces[placed[:, 2][faces].min(axis=1) <= below]
    if closed:
        a, b, c = (placed[faces[:, k], :2] for k in range(3))
        looks_down = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0.0
        faces = faces[looks_down]
    return placed[faces]
