"""Undersides of primitive shapes: the exact first hit of vertical lines from below.

Each function takes the shape's size [m], its poses ``pad_from_part`` (B, 4, 4) and node positions ``x`` (B or 1, 1, Nx), ``y``
(B or 1, Ny, 1) [m], and returns the z [m], shape (B, Ny, Nx), of the solid's lowest point on each node's vertical line; ``inf`` where
the line misses. Nothing in one environment depends on the others.

A line through a node is (x, y, c_z) + t e_z with c the shape's origin; in the part frame it is o + t d. A convex solid is an
intersection of slabs and quadrics, each of which the line crosses in one interval of t; the underside is at the start of the
common interval. This has no seams between faces, unlike testing each face for a hit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Underside = Callable[[tuple[float, ...], np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Interval = tuple[np.ndarray, np.ndarray]
_ROOT_STEPS = 100
"""Most steps to a torus; bisection alone takes 55 to the last bit."""


def line_in_part(pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Vertical lines o + t d in the part frame: o three (…, Ny, Nx), d three (…, 1, 1)."""
    dx, dy = x - _entry(pose, 0, 3), y - _entry(pose, 1, 3)
    return [_entry(pose, 0, k) * dx + _entry(pose, 1, k) * dy for k in range(3)], [_entry(pose, 2, k) for k in range(3)]


def bounds(kind: str, size: tuple[float, ...], pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Box (lower, upper) [m], each (…, 3), pad frame, of the primitive at poses (…, 4, 4)."""
    rotation, centre = pose[..., :3, :3], pose[..., :3, 3]
    axis = rotation[..., :, 2]
    across = np.sqrt(np.clip(1.0 - axis**2, 0.0, None))
    if kind == "plane":
        return np.full(centre.shape, -np.inf), np.full(centre.shape, np.inf)
    if kind == "sphere":
        half = np.full(centre.shape, size[0])
    elif kind == "capsule":
        half = size[0] + size[1] * np.abs(axis)
    elif kind == "ellipsoid":
        half = np.sqrt((rotation**2) @ np.square(size))
    elif kind == "cylinder":
        half = size[0] * across + size[1] * np.abs(axis)
    elif kind == "box":
        half = np.abs(rotation) @ np.asarray(size)
    elif kind == "torus":
        half = size[0] * across + size[1]
    else:  # cone
        base = centre + size[1] * axis
        tip_low, tip_high = centre + size[2] * axis - size[2], centre + size[2] * axis + size[2]
        return np.minimum(tip_low, base - size[0] * across), np.maximum(tip_high, base + size[0] * across)
    return centre - half, centre + half


def radius_about_origin(kind: str, size: tuple[float, ...]) -> float:
    """Radius [m] of the smallest ball about a primitive's origin that holds it; inf for a plane."""
    if kind == "plane":
        return np.inf
    if kind in ("sphere", "ellipsoid"):
        return max(size)
    if kind in ("capsule", "torus"):
        return size[0] + size[1]
    if kind == "cone":  # its tip's sphere touches the origin and ends within the rim's ball
        return max(float(np.hypot(size[0], size[1])), 2.0 * size[2])
    return float(np.linalg.norm(size))  # cylinder, box


def _plane(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The half-space behind the plane has an underside only if the plane looks down (n_z < 0)."""
    n_x, n_y, n_z = (_entry(pose, k, 2) for k in range(3))
    down = n_z < 0.0
    slope = n_x * (x - _entry(pose, 0, 3)) + n_y * (y - _entry(pose, 1, 3))
    return np.where(down, _entry(pose, 2, 3) - slope / np.where(down, n_z, 1.0), np.inf)


def _sphere(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    across = (x - _entry(pose, 0, 3)) ** 2, (y - _entry(pose, 1, 3)) ** 2
    return _entry(pose, 2, 3) - _root(size[0] ** 2 - across[0] - across[1])


def _ellipsoid(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    o, d = line_in_part(pose, x, y)
    o, d = ([v[k] / size[k] for k in range(3)] for v in (o, d))
    a, b, c = (v[0] * w[0] + v[1] * w[1] + v[2] * w[2] for v, w in ((d, d), (o, d), (o, o)))
    return _entry(pose, 2, 3) + _quadric(a, b, c - 1.0)[0]


def _cylinder(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    o, d = line_in_part(pose, x, y)
    side = _quadric(d[0] ** 2 + d[1] ** 2, o[0] * d[0] + o[1] * d[1], o[0] ** 2 + o[1] ** 2 - size[0] ** 2)
    return _entry(pose, 2, 3) + _common(side, _slab(pose, 2, x, y, -size[1], size[1]))


def _capsule(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    low = _cylinder(size, pose, x, y)
    for end in (-size[1], size[1]):
        low = np.minimum(low, _sphere(size, _along_axis(pose, end), x, y))
    return low


def _box(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _entry(pose, 2, 3) + _common(*(_slab(pose, k, x, y, -size[k], size[k]) for k in range(3)))


def _cone(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sphere at the tip, joined tangentially to a frustum with the base ``height`` above it.

    With ρ the tangent of the half angle the flank is √(x² + y²) = ρ (z − z_a); the tip's centre lies at z_a + r √(1 + ρ²) / ρ
    and its sphere touches z = 0, so the virtual apex is at z_a = r − r √(1 + ρ²) / ρ.
    """
    height, tip = size[1], size[2]
    rho = _flank(size)
    apex = tip - tip * np.sqrt(1.0 + rho**2) / rho
    tangent = tip - tip * rho / np.sqrt(1.0 + rho**2)
    o, d = line_in_part(pose, x, y)
    above = o[2] - apex
    a = d[0] ** 2 + d[1] ** 2 - (rho * d[2]) ** 2
    a = np.where(np.abs(a) > 1e-12, a, 1e-12)
    b = o[0] * d[0] + o[1] * d[1] - rho**2 * above * d[2]
    c = o[0] ** 2 + o[1] ** 2 - (rho * above) ** 2
    slab = _slab(pose, 2, x, y, tangent, height)
    flat = _common(_quadric(np.where(a > 0.0, a, 1.0), b, c), slab)
    # Where the line is steeper than the flank it is inside before the first root (one nappe) and after the second (the other).
    root = np.sqrt(np.clip(b * b - a * c, 0.0, None))
    first, last = (-b + root) / a, (-b - root) / a
    steep = np.minimum(_common((np.full_like(first, -np.inf), first), slab), _common((last, np.full_like(last, np.inf)), slab))
    frustum = np.where(a > 0.0, flat, steep)
    return np.minimum(_entry(pose, 2, 3) + frustum, _sphere((tip,), _along_axis(pose, tip), x, y))


def _tori(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """One pose after the other, so that the search continues only where it has not converged."""
    lines = (np.broadcast_to(v, (len(pose), *v.shape[1:])) for v in (x, y))
    return np.stack([_torus(size, *one) for one in zip(pose, *lines, strict=True)])


def _torus(size: tuple[float, ...], pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """One pose: closed form if the axis is vertical; else the first root of g.

    g(t) = (|p|² + R² − r²)² − 4 R² (p_x² + p_y²) is negative inside. With t counted from the point of the line nearest to the centre, in
    units of R, |p|² = h² + t² and g has no cubic term. g falls from infinity to its first minimum, and from its maximum, if it has one, to
    its second: the first root lies on the first of these two stretches whose minimum is not positive. Searching inside a stretch cannot
    jump over a thin part of the tube.
    """
    major, minor = size
    if abs(pose[2, 2]) > 1.0 - 1e-14:
        rho = np.hypot(x - pose[0, 3], y - pose[1, 3])
        return pose[2, 3] - _root(minor**2 - (rho - major) ** 2)
    o, d = line_in_part(pose, x, y)[0], pose[2, :3]
    minor /= major
    origin = np.stack([v.ravel() for v in o], axis=-1) / major
    middle = -origin @ d
    nearest = origin + middle[:, None] * d
    square = (nearest**2).sum(axis=-1)
    at = np.flatnonzero(square <= (1.0 + minor) ** 2)  # the other lines miss the ball that holds the torus
    p, k = nearest[at], square[at] + 1.0 - minor**2
    a, b, c = d[0] ** 2 + d[1] ** 2, p[:, :2] @ d[:2], p[:, 0] ** 2 + p[:, 1] ** 2

    def g(t: np.ndarray) -> np.ndarray:
        return (t * t + k) ** 2 - 4.0 * ((a * t + 2.0 * b) * t + c)

    first, top, second = _cubic(k - 2.0 * a, -2.0 * b)  # g'/4 = t³ + (k − 2 a) t − 2 b
    early = g(first) <= 0.0
    hit = early | (g(second) <= 0.0)
    high = np.where(early, first, second)[hit]
    low = np.where(early, -(1.0 + minor), top)[hit]
    k, b, c, at = k[hit], b[hit], c[hit], at[hit]
    lowest = np.full(len(middle), np.inf)
    t = 0.5 * (low + high)
    for _ in range(_ROOT_STEPS):  # Newton's method, halving the stretch where it would leave it
        value, slope = g(t), 4.0 * (t * (t * t + k - 2.0 * a) - 2.0 * b)
        low, high = np.where(value > 0.0, t, low), np.where(value > 0.0, high, t)
        following = t - value / np.minimum(slope, -1e-300)
        following = np.where((following >= low) & (following <= high), following, 0.5 * (low + high))
        lowest[at] = following
        moving = np.abs(following - t) > 1e-15
        if not moving.any():
            break
        t, low, high, k, b, c = (v[moving] for v in (following, low, high, k, b, c))
        at = at[moving]
    return pose[2, 3] + major * (middle + lowest).reshape(o[0].shape)


def _cubic(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Real roots of t³ + p t + q, ascending, a single one three times (Viète, Cardano)."""
    square = np.maximum(-p / 3.0, 0.0)
    amplitude = np.sqrt(square)
    rest = q * q / 4.0 + (p / 3.0) ** 3
    three = rest < 0.0
    angle = np.arccos(np.clip(-q / 2.0 / np.where(three, amplitude * square, 1.0), -1.0, 1.0)) / 3.0
    u = -np.copysign(np.cbrt(np.abs(q) / 2.0 + np.sqrt(np.maximum(rest, 0.0))), q)
    one = u - p / 3.0 / np.where(u == 0.0, 1.0, u)
    low, middle, high = (2.0 * amplitude * np.cos(angle + turn) for turn in (2.0 * np.pi / 3.0, -2.0 * np.pi / 3.0, 0.0))
    return np.where(three, low, one), np.where(three, middle, one), np.where(three, high, one)


def _flank(size: tuple[float, ...]) -> float:
    """tan of the flank's half angle: tangent to the tip's sphere, through the base's rim."""
    radius, height, tip = size
    return float(np.tan(np.arctan2(radius, height - tip) - np.arcsin(tip / np.hypot(radius, height - tip))))


def _root(square: np.ndarray) -> np.ndarray:
    """√square, −inf where square < 0 (so that z − √ is a miss)."""
    return np.where(square >= 0.0, np.sqrt(np.maximum(square, 0.0)), -np.inf)


def _entry(pose: np.ndarray, row: int, column: int) -> np.ndarray:
    """One entry of poses (…, 4, 4), (…, 1, 1)."""
    return pose[..., row, column, None, None]


def _along_axis(pose: np.ndarray, distance: float) -> np.ndarray:
    """Poses moved along their own z axis."""
    moved = pose.copy()
    moved[..., :3, 3] += distance * pose[..., :3, 2]
    return moved


def _quadric(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> Interval:
    """Interval of t with a t² + 2 b t + c <= 0, a (…, 1, 1) >= 0; (inf, −inf) where empty."""
    flat = a < 1e-14
    a = np.where(flat, 1.0, a)
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0.0))
    interval = np.where(disc >= 0.0, (-b - root) / a, np.inf), np.where(disc >= 0.0, (-b + root) / a, -np.inf)
    return _where_flat(flat, c <= 0.0, interval) if flat.any() else interval


def _slab(pose: np.ndarray, k: int, x: np.ndarray, y: np.ndarray, low: float, high: float) -> Interval:
    """Interval of t with low <= o_k + t d_k <= high; o_k is a function of x plus one of y."""
    across, along = _entry(pose, 0, k) * (x - _entry(pose, 0, 3)), _entry(pose, 1, k) * (y - _entry(pose, 1, 3))
    d = _entry(pose, 2, k)
    flat = np.abs(d) < 1e-14
    inverse = 1.0 / np.where(flat, 1.0, d)
    start = (np.where(d > 0.0, low, high) - across) * inverse - along * inverse
    interval = start, start + (high - low) * np.abs(inverse)
    if not flat.any():
        return interval
    o = across + along
    return _where_flat(flat, (o >= low) & (o <= high), interval)


def _where_flat(flat: np.ndarray, inside: np.ndarray, interval: Interval) -> Interval:
    """``interval``; where ``flat``, the whole line if ``inside``, else none of it."""
    start, end = interval
    always = np.where(inside, -np.inf, np.inf)
    return np.where(flat, always, start), np.where(flat, -always, end)


def _common(first: Interval, *others: Interval) -> np.ndarray:
    """Start of the intersection of intervals, overwriting the first; inf where it is empty."""
    start, end = first
    for other_start, other_end in others:
        np.maximum(start, other_start, out=start)
        np.minimum(end, other_end, out=end)
    np.copyto(start, np.inf, where=start > end)
    return start


UNDERSIDES: dict[str, Underside] = {
    "plane": _plane,
    "sphere": _sphere,
    "capsule": _capsule,
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
    "box": _box,
    "cone": _cone,
    "torus": _tori,
}
"""Function of each primitive kind."""
