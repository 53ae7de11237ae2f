"""A relief, a raised pattern on a face that looks about straight down, such as a coin's."""

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


_SPACING = 0.03e-3
"""Sample spacing of the map [m]: finer than a sensor's pixel, so that no sample shows."""


def coin_elevation(radius: float, height: float) -> np.ndarray:
    """Elevation [m] of the coin's face (N, N), from 0 (field) to ``height``.

    Over the square of half edge ``radius`` [m]. Rows run along y, columns along x, seen through the coin from its back, so that the
    face-down coin reads the right way in the camera's image (x right, y down). Flanks rise smoothly over 0.035 radius.
    """
    n = min(max(2 * round(radius / _SPACING) + 1, 257), 1025)
    line = np.linspace(-1.0, 1.0, n)
    x, y = line[None, :], line[:, None]
    rho, angle = np.hypot(x, y), np.arctan2(y, x)

    rim = np.abs(rho - 0.93) - 0.045
    beads = 32
    sector = 2.0 * np.pi / beads
    folded = (angle + 0.5 * sector) % sector - 0.5 * sector
    bead = np.hypot(rho * np.cos(folded) - 0.80, rho * np.sin(folded)) - 0.028
    star = np.abs(_star(x, y + 0.16, 0.46, 0.19)) - 0.02
    inner = _star(x, y + 0.16, 0.30, 0.124)
    letters = np.minimum(_strokes(x, y - 0.44, _R, -0.17), _strokes(x, y - 0.44, _T, 0.17)) - 0.038
    raised = [_flank(d) for d in (rim, bead, star, letters)]
    raised.append(0.6 * _flank(inner))
    elevation = np.max(np.broadcast_arrays(*raised), axis=0)
    return height * np.where(rho < 1.0, elevation, 0.0)


_R = (((-0.5, 1.0), (-0.5, -1.0)), ((-0.5, -1.0), (0.3, -1.0)), ((0.3, -1.0), (0.5, -0.75)), ((0.5, -0.75), (0.5, -0.25)),
      ((0.5, -0.25), (0.3, 0.0)), ((0.3, 0.0), (-0.5, 0.0)), ((0.0, 0.0), (0.55, 1.0)))  # fmt: skip
_T = (((-0.6, -1.0), (0.6, -1.0)), ((0.0, -1.0), (0.0, 1.0)))
_LETTER = 0.16
"""Half height of a letter, in radii."""


def _flank(distance: np.ndarray) -> np.ndarray:
    """1 inside, 0 outside, a smooth step over 0.035 radius outside the outline."""
    s = np.clip(1.0 - distance / 0.035, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _star(x: np.ndarray, y: np.ndarray, outer: float, inner: float) -> np.ndarray:
    """Signed distance to a five-pointed star, one point towards −y (up in the image)."""
    sector = 2.0 * np.pi / 5.0
    angle = np.arctan2(x, -y)
    folded = np.abs((angle + 0.5 * sector) % sector - 0.5 * sector)
    rho = np.hypot(x, y)
    px, py = rho * np.cos(folded), rho * np.sin(folded)
    ax, ay = outer, 0.0
    bx, by = inner * np.cos(0.5 * sector), inner * np.sin(0.5 * sector)
    s = np.clip(((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2), 0.0, 1.0)
    distance = np.hypot(px - ax - s * (bx - ax), py - ay - s * (by - ay))
    inside = (bx - ax) * (py - ay) - (by - ay) * (px - ax) > 0.0
    return np.where(inside, -distance, distance)


def _strokes(x: np.ndarray, y: np.ndarray, letter: tuple, shift: float) -> np.ndarray:
    """Distance to the strokes of a letter centred at (``shift``, 0)."""
    nearest = np.full(np.broadcast_shapes(x.shape, y.shape), np.inf)
    for (ax, ay), (bx, by) in letter:
        ax, ay, bx, by = (_LETTER * v for v in (ax, ay, bx, by))
        dx, dy = bx - ax, by - ay
        px, py = x - shift - ax, y - ay
        s = np.clip((px * dx + py * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(px - s * dx, py - s * dy))
    return nearest
