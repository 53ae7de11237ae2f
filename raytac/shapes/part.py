"""One rigid part of an object, as plain numbers and arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from raytac.checks import check_numbers
from raytac.errors import InputError

_SIZES = {
    "plane": 0,
    "sphere": 1,
    "capsule": 2,
    "ellipsoid": 3,
    "cylinder": 2,
    "box": 3,
    "cone": 3,
    "torus": 2,
}
_LONGEST = 1e3
"""Greatest length and offset of a part [m]; beyond, rounding hides a pad's details."""
_BLOCKS = 16
"""Blocks of triangles along the longest edge of a mesh."""
PART_KINDS = (*_SIZES, "mesh", "relief")
"""Kinds of ``Part``; MuJoCo's ``hfield`` becomes a ``mesh`` by ``hfield_part``."""


@dataclass(frozen=True)
class Part:
    """A shape and its place in the object.

    Sizes [m] follow MuJoCo, part frame: ``plane`` () the half-space z <= 0; ``sphere`` (radius); ``capsule`` (radius, half length
    of the straight piece, axis z); ``ellipsoid`` (three semi-axes); ``cylinder`` (radius, half length, axis z); ``box`` (three
    half edges); and two that MuJoCo lacks: ``cone`` (base radius, height, tip radius: apex down, the rounded tip touches z = 0),
    ``torus`` (major radius, minor radius, axis z). ``mesh`` has ``vertices`` [m], (V, 3), and ``faces``, (F, 3). ``relief`` is a
    raised pattern under a plane z = 0: the solid 0 >= z >= −``elevation``(x, y), size (half width), with ``elevation`` [m],
    (N, N), rows along y, over the square |x|, |y| <= half width, and its triangles; it has no underside where it does not rise.
    """

    kind: str
    size: tuple[float, ...] = ()
    object_from_part: np.ndarray = field(default_factory=lambda: np.eye(4))
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    closed: bool = False
    """Mesh only: watertight with outward faces, so that faces that look up are no underside."""
    elevation: np.ndarray | None = None
    max_slope: float = 0.0
    """Relief only: greatest slope of the elevation."""
    joined: bool = False
    """True if it is one solid with the first part, from that part's flat lower face (z = 0) on."""

    @cached_property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres and half edges (n, 3) [m] of boxes that hold all triangles of a mesh or relief."""
        assert self.vertices is not None and self.faces is not None
        corners = self.vertices[self.faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        start = low.min(axis=0)
        size = max(float((high.max(axis=0) - start).max()) / _BLOCKS, 1e-12)
        cell = ((0.5 * (low + high) - start) / size).astype(np.int64) @ np.array([1, _BLOCKS + 1, (_BLOCKS + 1) ** 2])
        order = np.argsort(cell)
        first = np.flatnonzero(np.append(True, np.diff(cell[order]) > 0))
        low, high = np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)
        return 0.5 * (low + high), 0.5 * (high - low)


def primitive(kind: str, size: tuple[float, ...] = (), object_from_part: np.ndarray | None = None) -> Part:
    """A part without arrays; ``InputError`` for an unknown kind or a size that cannot be."""
    if not isinstance(kind, str) or kind not in _SIZES:
        raise InputError("kind", value=kind, rule="must be a primitive (mesh: mesh_part, hfield: hfield_part)", choices=_SIZES)
    given, size = size, tuple(check_numbers("size", size, (None,))[: _SIZES[kind]].tolist())
    positive = size[:2] if kind == "cone" else size
    if (
        len(size) != _SIZES[kind]
        or not np.isfinite(size).all()
        or max(size, default=0.0) > _LONGEST
        or min(positive, default=1.0) <= 0.0
        or min(size, default=0.0) < 0.0
    ):
        rule = f"a {kind} takes {_SIZES[kind]} lengths in (0, {_LONGEST:g}] m (a cone's tip may be 0)"
        raise InputError("size", value=given, rule=rule)
    if kind == "torus" and size[1] >= size[0]:
        raise InputError("size", value=given, rule="a torus's minor radius must be less than its major radius")
    if kind == "cone" and (size[2] >= size[0] or size[2] >= np.hypot(size[0], size[1] - size[2])):
        raise InputError("size", value=given, rule="a cone's tip must be narrower than its base and fit inside the rim")
    return Part(kind, size, _pose(object_from_part))


def mesh_part(vertices: np.ndarray, faces: np.ndarray, object_from_part: np.ndarray | None = None) -> Part:
    """A triangle mesh; a watertight one is turned right side out. ``InputError`` for bad arrays."""
    vertices = check_numbers("vertices", vertices, (None, 3))
    faces = check_numbers("faces", faces, (None, 3), finite=True).astype(np.int64)
    far = ~(np.abs(vertices) <= _LONGEST).all(axis=1)
    if far.any():
        raise InputError("vertices", value=vertices[far][0], rule=f"must be finite and within {_LONGEST:g} m of the origin")
    if len(faces) == 0:
        raise InputError("faces", value=faces.shape, rule="must have shape (F, 3) with F > 0")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("faces", value=(int(faces.min()), int(faces.max())), rule=f"must index {len(vertices)} vertices")
    closed = _is_closed(faces, len(vertices))
    if closed:
        a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
        if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
            faces = faces[:, ::-1].copy()
    return Part("mesh", (), _pose(object_from_part), vertices=vertices, faces=faces, closed=closed)


def hfield_part(size: tuple[float, ...], elevation: np.ndarray, object_from_part: np.ndarray | None = None) -> Part:
    """A MuJoCo height field as the closed mesh that MuJoCo collides with.

    ``size`` [m]: half widths along x and y, elevation at data value 1, depth of the base below z = 0. ``elevation``: MuJoCo's
    normalised data in [0, 1], shape (nrow, ncol), rows along y.
    """
    size = tuple(check_numbers("size", size, (4,), finite=True).tolist())
    data = check_numbers("elevation", elevation, (None, None))
    if min(data.shape) < 2 or not np.isfinite(data).all():
        raise InputError("elevation", value=data.shape, rule="must be finite, with at least 2 rows and 2 columns")
    rows, columns = data.shape
    x, y = np.meshgrid(np.linspace(-size[0], size[0], columns), np.linspace(-size[1], size[1], rows))
    top = np.stack([x, y, data * size[2]], axis=-1).reshape(-1, 3)
    base = top * [1.0, 1.0, 0.0] - [0.0, 0.0, size[3]]
    index = np.arange(rows * columns).reshape(rows, columns)
    p00, p01, p10, p11 = (a.ravel() for a in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    # As in MuJoCo, a cell's two triangles share the diagonal from (column, row) to (column + 1, row + 1).
    upper = np.concatenate([np.stack([p00, p01, p11], 1), np.stack([p00, p11, p10], 1)])
    ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    after = np.roll(ring, -1)
    n = rows * columns
    walls = np.concatenate([np.stack([ring, ring + n, after + n], 1), np.stack([ring, after + n, after], 1)])
    return mesh_part(np.concatenate([top, base]), np.concatenate([upper, upper[:, ::-1] + n, walls]), object_from_part)


def _pose(object_from_part: np.ndarray | None) -> np.ndarray:
    if object_from_part is None:
        return np.eye(4)
    pose = check_numbers("object_from_part", object_from_part, (4, 4), finite=True)
    if np.abs(pose[:3, 3]).max() > _LONGEST:
        raise InputError("object_from_part", value=pose[:3, 3].tolist(), rule=f"must be within {_LONGEST:g} m of the origin")
    return pose


def _is_closed(faces: np.ndarray, vertices: int) -> bool:
    """True if every directed edge has exactly one opposite edge."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward, backward = start * vertices + end, end * vertices + start
    unique = np.unique(forward)
    return len(unique) == len(forward) and bool(np.array_equal(unique, np.sort(backward)))
