"""The underside of a relief: a raised pattern on a face that looks (about) straight down."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.shapes.part import Part
from raytac.shapes.primitives import line_in_part

_STEPS = 60
_LIMIT = 0.7
"""Greatest slope · tan τ for the iteration: the factor on the error in each step, at worst."""


def relief_part(elevation: np.ndarray, half_width: float, object_from_part: np.ndarray | None = None) -> Part:
    """A relief from its elevation [m], (N, N), over a square of a half width [m]."""
    data = np.array(elevation, float)
    if data.ndim != 2 or data.shape[0] != data.shape[1] or len(data) < 4 or not np.isfinite(data).all() or data.min() < 0.0:
        raise InputError("elevation", value=data.shape, rule="must be square (N, N), N >= 4, finite and >= 0")
    if not (np.isfinite(half_width) and half_width > 0.0):
        raise InputError("half_width", value=half_width, rule="must be finite and > 0 [m]")
    spacing = 2.0 * half_width / (len(data) - 1)
    slope = np.hypot(*np.gradient(data, spacing)).max()
    pose = np.eye(4) if object_from_part is None else np.array(object_from_part, float)
    vertices, faces = _facets(data, half_width)
    return Part("relief", (float(half_width),), pose, vertices, faces, elevation=data, max_slope=float(slope))


def looks_down(part: Part, pose: np.ndarray) -> bool:
    """True if ``relief_underside`` converges at this tilt; if not, use the triangles."""
    tangent = float(np.hypot(pose[2, 0], pose[2, 1]))
    return bool(pose[2, 2] > 0.0 and tangent * part.max_slope <= _LIMIT * pose[2, 2])


def relief_underside(part: Part, pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z [m] of the relief's underside (Ny, Nx), ``inf`` off the pattern; see ``primitives``.

    On the line o + t d (part frame) the underside solves p_z + e(p_x, p_y) = 0. Face down the line is vertical in the part frame
    too and t is read off. Tilted by τ, t ← t − (p_z + e) / d_z is iterated; it converges while slope · tan τ < 1, which
    ``looks_down`` checks.
    """
    o, d = line_in_part(pose, x, y)
    half_width = part.size[0]
    t = -o[2] / d[2]
    elevation = np.zeros_like(t)
    upright = d[0] == 0.0 and d[1] == 0.0
    for _ in range(1 if upright else _STEPS):
        elevation = _sample(part, o[0] + t * d[0], o[1] + t * d[1])
        change = -(o[2] + t * d[2] + elevation) / d[2]
        t = t + change
        if np.abs(change).max() < 1e-10:
            break
    inside = (np.maximum(np.abs(o[0] + t * d[0]), np.abs(o[1] + t * d[1])) <= half_width) & (elevation > 0.0)
    return np.where(inside, pose[2, 3] + t, np.inf)


def _facets(elevation: np.ndarray, half_width: float) -> tuple[np.ndarray, np.ndarray]:
    """The raised pattern as triangles: vertices (N², 3) [m], and faces (F, 3) above the plane."""
    n = len(elevation)
    line = np.linspace(-half_width, half_width, n)
    x, y = np.meshgrid(line, line)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    flat = elevation.ravel()
    raised = (flat[a] + flat[b] + flat[c] + flat[d]) > 0.0
    a, b, c, d = (v[raised] for v in (a, b, c, d))
    return np.stack([x, y, -elevation], axis=-1).reshape(-1, 3), np.concatenate([np.stack([a, d, b], 1), np.stack([a, c, d], 1)])


def _sample(part: Part, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Elevation at part-frame x, y [m] by bilinear interpolation, clamped to the square."""
    assert part.elevation is not None
    data, n = part.elevation, len(part.elevation)
    scale = (n - 1) / (2.0 * part.size[0])
    column = np.clip((x + part.size[0]) * scale, 0.0, n - 1.000001)
    row = np.clip((y + part.size[0]) * scale, 0.0, n - 1.000001)
    i, j = column.astype(np.int64), row.astype(np.int64)
    u, v = column - i, row - j
    flat, at = data.ravel(), j * n + i
    near = (1.0 - u) * flat[at] + u * flat[at + 1]
    far = (1.0 - u) * flat[at + n] + u * flat[at + n + 1]
    return (1.0 - v) * near + v * far
