"""The underside of an object over the pad, as a height field in the pad frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.shapes.part import Part
from raytac.shapes.primitives import UNDERSIDES, bounds, radius_about_origin
from raytac.shapes.relief import looks_down, relief_underside

_SLACK = 1e-9
"""Blocks are widened by this [m] against rounding."""
_NODES = 32768
"""Nodes of all environments that are processed at once, so that they stay in a core's cache."""


def object_height(
    parts: Sequence[Part], pad_from_object: np.ndarray, x: np.ndarray, y: np.ndarray, *, below: float = np.inf
) -> np.ndarray:
    """Lowest z [m] of the object above each node, pad frame, (B, Ny, Nx), float64.

    ``inf`` where nothing is above. ``pad_from_object``: poses (B, 4, 4). ``x`` (Nx,), ``y`` (Ny,) [m]: evenly spaced, ascending; (B,
    Nx), (B, Ny) where every environment has its own. The object is the union of its ``parts``: the minimum of their undersides (exact
    for primitives, exact linear interpolation for meshes). ``below`` [m] saves work: what lies above it may be left out (its nodes read
    ``inf``). Nothing is cut off at the pad: a part that reaches through it still shows its underside. A pose that is not finite gives
    NaN in its environment alone. Raises ``InputError`` for poses of another shape.
    """
    poses = np.asarray(pad_from_object, float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError("pad_from_object", value=poses.shape, rule="must have shape (B, 4, 4)")
    height = np.full((len(poses), y.shape[-1], x.shape[-1]), np.inf)
    failed = np.logical_not(np.isfinite(poses).all(axis=(1, 2)))
    if failed.any():
        poses = np.where(failed[:, None, None], np.eye(4), poses)
    count = max(_NODES // (height.shape[1] * height.shape[2]), 1)
    for start in range(0, len(poses), count):
        some = slice(start, start + count)
        own = (x, y) if x.ndim == 1 else (x[some], y[some])
        for part in parts:
            _lower_onto(height[some], part, poses[some] @ part.object_from_part, *own, below)
    height[failed] = np.nan
    return height


def object_bounds(parts: Sequence[Part], pad_from_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned box (lower, upper) [m], each (3,), that holds the object at one pose."""
    boxes = [_part_bounds(part, pad_from_object @ part.object_from_part) for part in parts]
    return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def object_radius(parts: Sequence[Part]) -> float:
    """Radius [m] of a ball about the object's origin that holds it; inf for a half-space."""
    return max(_part_radius(part) for part in parts)


def _part_radius(part: Part) -> float:
    if part.vertices is not None:
        placed = part.vertices @ part.object_from_part[:3, :3].T + part.object_from_part[:3, 3]
        return float(np.linalg.norm(placed, axis=1).max())
    return float(np.linalg.norm(part.object_from_part[:3, 3])) + radius_about_origin(part.kind, part.size)


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


def _may_show(part: Part, pose: np.ndarray, x: np.ndarray, y: np.ndarray, below: float) -> bool:
    """False where no block of triangles is over the nodes and below ``below``; moves no vertex."""
    centre, half = part.blocks
    middle, reach = centre @ pose[:3, :3].T + pose[:3, 3], half @ np.abs(pose[:3, :3]).T + _SLACK
    near, far = middle - reach, middle + reach
    is_over = (far[:, 0] >= x[0]) & (near[:, 0] <= x[-1]) & (far[:, 1] >= y[0]) & (near[:, 1] <= y[-1])
    return bool((is_over & (near[:, 2] <= below)).any())


def _lower_onto(lowest: np.ndarray, part: Part, poses: np.ndarray, x: np.ndarray, y: np.ndarray, below: float) -> None:
    """Take the minimum of ``lowest`` (B, Ny, Nx) and the part's underside, in place."""
    if part.kind in UNDERSIDES:
        low, high = bounds(part.kind, part.size, poses)
        chosen = np.flatnonzero(low[:, 2] <= below)
        if not len(chosen):
            return
        if len(chosen) < len(poses):
            poses, low, high = poses[chosen], low[chosen], high[chosen]
        rows, columns = slice(None), slice(None)
        if x.ndim == 1:
            near, far = _box_below(part, poses, low, high, below)
            rows, columns = _span(y, near[1], far[1]), _span(x, near[0], far[0])
            local_x, local_y = x[None, columns], y[None, rows]
        else:
            local_x, local_y = (x, y) if len(chosen) == len(lowest) else (x[chosen], y[chosen])
        if local_x.size and local_y.size:
            underside = UNDERSIDES[part.kind](part.size, poses, local_x[:, None, :], local_y[:, :, None])
            if len(chosen) == len(lowest):
                window = lowest[:, rows, columns]
                np.minimum(window, underside, out=window)
            else:
                lowest[chosen, rows, columns] = np.minimum(lowest[chosen, rows, columns], underside)
        return
    for b, (pose, window) in enumerate(zip(poses, lowest, strict=True)):
        own = (x, y) if x.ndim == 1 else (x[b], y[b])
        _lower_surface_onto(window, part, pose, *own, below)


def _box_below(part: Part, poses: np.ndarray, low: np.ndarray, high: np.ndarray, below: float) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest x, y (2,) [m] of what of a primitive at poses is below ``below``."""
    near, far = low[:, :2].min(axis=0), high[:, :2].max(axis=0)
    above = float(poses[:, 2, 3].min()) - below
    if above > 0.0:
        # In a ball about the origin, what is lower than a plane beneath its centre lies in a disc.
        reach = math.sqrt(max(radius_about_origin(part.kind, part.size) ** 2 - above * above, 0.0))
        centre = poses[:, :2, 3]
        near, far = np.maximum(near, centre.min(axis=0) - reach), np.minimum(far, centre.max(axis=0) + reach)
    return near, far


def _lower_surface_onto(lowest: np.ndarray, part: Part, pose: np.ndarray, x: np.ndarray, y: np.ndarray, below: float) -> None:
    """As ``_lower_onto``, of a mesh or relief in one environment, within its bounding box."""
    assert part.vertices is not None and part.faces is not None
    if not _may_show(part, pose, x, y, below):
        return
    as_triangles = part.kind == "mesh" or not looks_down(part, pose)
    placed = part.vertices @ pose[:3, :3].T + pose[:3, 3] if as_triangles else None
    low, high = _part_bounds(part, pose) if placed is None else np.array([[line.min(), line.max()] for line in placed.T]).T
    columns, rows = _span(x, low[0], high[0]), _span(y, low[1], high[1])
    window = lowest[rows, columns]
    if low[2] > below or window.size == 0:
        return
    if placed is None:
        underside = relief_underside(part, pose, x[columns][None, :], y[rows][:, None])
    else:
        underside = lowest_of_triangles(_candidates(placed, part.faces, part.closed, below), x, y)[rows, columns]
    np.minimum(window, underside, out=window)


def _span(line: np.ndarray, low: float, high: float) -> slice:
    """Slice of the nodes from ``low`` to ``high`` and one beyond."""
    return slice(*np.searchsorted(line, (low, high), side="left") + np.array([0, 1]))


def _candidates(placed: np.ndarray, faces: np.ndarray, closed: bool, below: float) -> np.ndarray:
    """Corners (T, 3, 3) of the triangles that can be part of the underside."""
    if np.isfinite(below):
        z = placed[:, 2]
        faces = faces[np.minimum(np.minimum(z[faces[:, 0]], z[faces[:, 1]]), z[faces[:, 2]]) <= below]
    if closed:
        a, b, c = (placed[faces[:, k], :2] for k in range(3))
        looks_down = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0.0
        faces = faces[looks_down]
    return placed[faces]


_BARELY_FLAT = 1e-12
"""Projected area over squared size below which a triangle counts as vertical."""


def lowest_of_triangles(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lowest z [m] of triangles above each node, shape (Ny, Nx); ``inf`` where there is none.

    ``corners`` [m], shape (T, 3, 3): triangle, corner, xyz in the pad frame. ``x`` (Nx,), ``y`` (Ny,): evenly spaced, ascending. Each
    triangle is cut into grid rows, each row into the run of nodes between its left and right edge; z is the triangle's own plane at the
    node (linear interpolation, exact), so the work is one step per covered row and one per covered node.
    """
    ny, nx = len(y), len(x)
    lowest = np.full(ny * nx, np.inf)
    p = np.asarray(corners, float)
    step_x, step_y = (x[-1] - x[0]) / (nx - 1), (y[-1] - y[0]) / (ny - 1)
    # A reduction over an axis of three is many times slower than two minima.
    low = np.minimum(np.minimum(p[:, 0], p[:, 1]), p[:, 2])
    high = np.maximum(np.maximum(p[:, 0], p[:, 1]), p[:, 2])
    keep = (high[:, 0] >= x[0] - step_x) & (low[:, 0] <= x[-1] + step_x) & (high[:, 1] >= y[0]) & (low[:, 1] <= y[-1])
    edge_a, edge_b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]
    keep &= np.abs(area) > _BARELY_FLAT * ((edge_a**2).sum(axis=1) + (edge_b**2).sum(axis=1))
    p, low, high, edge_a, edge_b, area = (v[keep] for v in (p, low, high, edge_a, edge_b, area))
    slope_x = (edge_a[:, 2] * edge_b[:, 1] - edge_b[:, 2] * edge_a[:, 1]) / area
    slope_y = (edge_b[:, 2] * edge_a[:, 0] - edge_a[:, 2] * edge_b[:, 0]) / area

    # A slack far below any length of interest closes the seam between neighbours that rounding could open at a node on an edge.
    slack = 1e-9
    row_first = np.maximum(np.ceil((low[:, 1] - y[0]) / step_y - slack), 0).astype(np.int64)
    row_last = np.minimum(np.floor((high[:, 1] - y[0]) / step_y + slack), ny - 1).astype(np.int64)
    triangle, offset = _runs(row_last - row_first + 1)
    row = row_first[triangle] + offset
    x_low, x_high = _row_span(p, triangle, y[0] + row * step_y, slack * step_y)
    column_first = np.maximum(np.ceil((x_low - x[0]) / step_x - slack), 0).astype(np.int64)
    column_last = np.minimum(np.floor((x_high - x[0]) / step_x + slack), nx - 1).astype(np.int64)
    span, offset = _runs(column_last - column_first + 1)
    column = column_first[span] + offset
    start = p[triangle, 0]
    at_left_axis = start[:, 2] + slope_y[triangle] * (y[row] - start[:, 1]) - slope_x[triangle] * start[:, 0]
    z = at_left_axis[span] + slope_x[triangle][span] * x[column]
    z = np.clip(z, low[triangle, 2][span], high[triangle, 2][span])
    np.minimum.at(lowest, row[span] * nx + column, z)
    return lowest.reshape(ny, nx)


def _row_span(p: np.ndarray, triangle: np.ndarray, y: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Left and right end [m] of each triangle on the horizontal line at its ``y``."""
    x_low, x_high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    corner_x, corner_y = p[:, :, 0], p[:, :, 1]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        rise = corner_y[:, b] - corner_y[:, a]
        level = np.abs(rise) <= slack
        per_rise = (corner_x[:, b] - corner_x[:, a]) / np.where(level, np.inf, rise)
        low, high = np.minimum(corner_y[:, a], corner_y[:, b]), np.maximum(corner_y[:, a], corner_y[:, b])
        cut_y = np.clip(y, low[triangle], high[triangle])
        cut = corner_x[triangle, a] + per_rise[triangle] * (cut_y - corner_y[triangle, a])
        crosses = np.abs(y - cut_y) <= slack
        x_low = np.where(crosses, np.minimum(x_low, cut), x_low)
        x_high = np.where(crosses, np.maximum(x_high, cut), x_high)
        # A level edge adds its other end too (its neighbours in the triangle carry it unless rounding skipped them).
        both = crosses & level[triangle]
        x_low = np.where(both, np.minimum(x_low, corner_x[triangle, b]), x_low)
        x_high = np.where(both, np.maximum(x_high, corner_x[triangle, b]), x_high)
    missed = x_low > x_high
    return np.where(missed, 0.0, x_low), np.where(missed, -1.0, x_high)


def _runs(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run of each element, and its place in it, of runs of these lengths laid end to end."""
    lengths = np.maximum(lengths, 0)
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
