"""The underside of a relief: a raised pattern on a face that looks (about) straight down."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.part import Part
from raytac.gel.primitives import line_in_part

__all__ = ["relief_part", "relief_underside"]

_STEPS = 60
_LIMIT = 0.7
"""Greatest slope · tan τ that is accepted: the factor by which each step shrinks the error at worst."""


def relief_part(elevation: np.ndarray, half_width: float, object_from_part: np.ndarray | None = None) -> Part:
    """A relief from its elevation [m], (N, N), over a square of the given half width [m] (see ``Part``)."""
    data = np.array(elevation, float)
    if data.ndim != 2 or data.shape[0] != data.shape[1] or len(data) < 4 or not np.isfinite(data).all() or data.min() < 0.0:
        raise InputError("elevation", value=data.shape, rule="must be square (N, N), N >= 4, finite and >= 0")
    if not (np.isfinite(half_width) and half_width > 0.0):
        raise InputError("half_width", value=half_width, rule="must be finite and > 0 [m]")
    spacing = 2.0 * half_width / (len(data) - 1)
    slope = np.hypot(*np.gradient(data, spacing)).max()
    pose = np.eye(4) if object_from_part is None else np.array(object_from_part, float)
    return Part("relief", (float(half_width),), pose, elevation=data, max_slope=float(slope))


def relief_underside(part: Part, pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z [m] of the relief's underside, shape (Ny, Nx), ``inf`` off the pattern; arguments as in ``raytac.gel.primitives``.

    On the line o + t d (part frame) the underside solves p_z + e(p_x, p_y) = 0. Face down the line is vertical in the part frame
    too and t is read off. Tilted by τ, t ← t − (p_z + e) / d_z is iterated; it converges while slope · tan τ < 1; more tilt
    than slope · tan τ = 0.7 (at 1 the pattern would hide parts of itself) raises ``InputError``.
    """
    o, d = line_in_part(pose, x, y)
    half_width = part.size[0]
    if d[2] <= 0.0:  # face up: the plane behind the pattern is the underside, which the body in front of it owns
        return np.full(o[0].shape, np.inf)
    tangent = float(np.hypot(d[0], d[1]) / d[2])
    if tangent * part.max_slope >= _LIMIT:
        limit = np.rad2deg(np.arctan(_LIMIT / part.max_slope))
        raise InputError("tilt of the relief [deg]", value=float(np.rad2deg(np.arctan(tangent))), rule=f"must be < {limit:.1f}")
    t = -o[2] / d[2]
    elevation = np.zeros_like(t)
    for _ in range(1 if tangent == 0.0 else _STEPS):
        elevation = _sample(part, o[0] + t * d[0], o[1] + t * d[1])
        change = -(o[2] + t * d[2] + elevation) / d[2]
        t = t + change
        if np.abs(change).max() < 1e-10:
            break
    inside = (np.maximum(np.abs(o[0] + t * d[0]), np.abs(o[1] + t * d[1])) <= half_width) & (elevation > 0.0)
    return np.where(inside, pose[2, 3] + t, np.inf)


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
