"""Resting shape of a pad from a file: a map of heights, or the upper side of a closed mesh."""

from __future__ import annotations

import hashlib
import io
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import SpecError
from raytac.specs.files import is_file
from raytac.specs.mesh import MESH_SUFFIXES, load_mesh

MAP_SUFFIXES = (".npy", ".csv", ".png", ".tif", ".tiff")
"""Files that hold a map of heights, one number or one grey level a node."""
_FEWEST = 4
"""Fewest nodes along an axis: a cubic needs as many."""
_MOST = 4096
"""Most nodes along an axis."""
_LARGEST_FILE = 2**28
"""Longest file of a map that is read [byte]."""
_MESH_PITCH = 0.1e-3
"""Spacing of the nodes at which a mesh is sampled, unless another is given [m]."""
_SAME_HEIGHT = 1e-6
"""Heights of two triangles over one node that count as one [m]."""
_CENTRED = 1e-9
"""Height of the middle that counts as zero [m]."""
_CHUNK = 1 << 20
"""Pairs of a triangle and a node that are looked at together."""


@dataclass(frozen=True, eq=False, repr=False)
class HeightMap:
    """Heights on a regular grid about the pad's centre, C¹ between its nodes.

    Bicubic convolution (R. G. Keys, IEEE Trans. Acoust. Speech Signal Process. 29, 1981, a = −1/2) is of third order, at the rim too:
    there the map goes on as a parabola through its last three nodes. Beyond the last node the height is that at the edge. Two maps of
    the same numbers are equal.
    """

    heights: np.ndarray
    """z [m], shape (Ny, Nx), float64; rows along y (image down), columns along x (image right)."""
    spacing: tuple[float, float]
    """Distance of nodes along x and y [m]."""

    def __post_init__(self) -> None:
        heights = np.array(self.heights, np.float64)
        heights.setflags(write=False)
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "spacing", tuple(round(1e3 * float(step), 9) / 1e3 for step in self.spacing))
        if heights.ndim != 2 or min(heights.shape) < _FEWEST or max(heights.shape) > _MOST:
            rule = f"a map of heights must have {_FEWEST} to {_MOST} rows and columns"
            raise SpecError(rule, key="gelpad.surface", value=heights.shape)
        bad = np.argwhere(~np.isfinite(heights))
        if len(bad):
            row, column = (int(k) for k in bad[0])
            rule = f"heights must be finite: row {row}, column {column} is not, of {len(bad)} such nodes"
            raise SpecError(rule, key="gelpad.surface", value=float(heights[row, column]))
        if not all(math.isfinite(step) and step > 0.0 for step in self.spacing):
            raise SpecError("distances of nodes must be > 0", key="gelpad.surface_pitch_mm", value=self.spacing)

    @cached_property
    def digest(self) -> str:
        """Hash of heights and spacing."""
        return hashlib.sha256(self.heights.tobytes() + repr((self.heights.shape, self.spacing)).encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HeightMap) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        (rows, columns), (dx, dy) = self.heights.shape, self.spacing
        return f"HeightMap({columns} x {rows} nodes, {1e3 * dx:.4g} x {1e3 * dy:.4g} mm apart, sha256 {self.digest[:16]})"

    @property
    def half(self) -> tuple[float, float]:
        """Half of its extent along x and y [m]."""
        rows, columns = self.heights.shape
        return 0.5 * (columns - 1) * self.spacing[0], 0.5 * (rows - 1) * self.spacing[1]

    @cached_property
    def padded(self) -> np.ndarray:
        """Heights with one more node on every side [m], (Ny + 2, Nx + 2)."""
        z = self.heights
        for _ in range(2):
            before, after = 3.0 * (z[:1] - z[1:2]) + z[2:3], 3.0 * (z[-1:] - z[-2:-1]) + z[-3:-2]
            z = np.concatenate([before, z, after]).T
        return np.ascontiguousarray(z)

    def centred(self) -> HeightMap:
        """The same map with z = 0 at its middle."""
        middle = float(self.height(0.0, 0.0))
        return self if abs(middle) < _CENTRED else HeightMap(self.heights - middle, self.spacing)

    def height(self, x: Any, y: Any) -> np.ndarray:
        """z [m] at ``x``, ``y`` [m] of shapes that broadcast."""
        return self._sums(x, y, ((_weights, _weights),))[0]

    def slope(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """∂z/∂x and ∂z/∂y at ``x``, ``y`` [m]; 0 across an edge beyond it."""
        zx, zy = self._sums(x, y, ((_rises, _weights), (_weights, _rises)))
        beyond_x, beyond_y = (np.abs(at) > half * (1.0 + 1e-12) for at, half in zip((x, y), self.half, strict=True))
        return np.where(beyond_x, 0.0, zx / self.spacing[0]), np.where(beyond_y, 0.0, zy / self.spacing[1])

    def _sums(self, x: Any, y: Any, kinds: Any) -> list[np.ndarray]:
        places = []
        for at, half, step, count in zip((x, y), self.half, self.spacing, self.heights.shape[::-1], strict=True):
            t = np.clip((np.asarray(at, float) + half) / step, 0.0, count - 1.0)
            first = np.minimum(t.astype(int), count - 2)
            places.append((first, t - first))
        (i, u), (j, v) = places
        sums = []
        for along_x, along_y in kinds:
            wx, wy = along_x(u), along_y(v)
            sums.append(sum(wy[m] * wx[k] * self.padded[j + m, i + k] for m in range(4) for k in range(4)))
        return sums


def _weights(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Weights of the nodes −1, 0, 1, 2 at the share ``t`` between nodes 0 and 1."""
    return (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    )


def _rises(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Derivatives of ``_weights`` by ``t``."""
    return -0.5 + t * (2.0 - 1.5 * t), t * (-5.0 + 4.5 * t), 0.5 + t * (4.0 - 4.5 * t), t * (-1.0 + 1.5 * t)


def read_height_map(path: Path, unit: float, pitch: tuple[float, ...], size: tuple[float, float]) -> HeightMap:
    """The outer surface of a gel from a file, z = 0 in its middle.

    Args:
        path: a map (``MAP_SUFFIXES``): rows along y, columns along x, its middle over the pad's centre; or a closed mesh of the gel
            (``MESH_SUFFIXES``) in the pad's axes, whose upper side is sampled.
        unit: length of one unit of the file [m], of a grey level in a picture.
        pitch: distance of a map's nodes along x and y [m], or at which a mesh is sampled. Empty: a map spans the pad from edge to edge,
            a mesh is sampled every 0.1 mm.
        size: extent of the pad along x and y [m].

    Raises:
        SpecError: no such file, another suffix, unreadable, not a finite table of numbers; a mesh that does not lie under the whole pad
            or has an undercut.
        MeshError: a mesh that is not the closed surface of a solid.
    """
    suffix = path.suffix.lower()
    if suffix not in MAP_SUFFIXES + MESH_SUFFIXES:
        raise SpecError("unknown format", file=path, key="gelpad.surface", value=suffix, choices=MAP_SUFFIXES + MESH_SUFFIXES)
    if not is_file(path):
        raise SpecError("the file does not exist", file=path, key="gelpad.surface")
    try:
        if suffix in MESH_SUFFIXES:
            return _sampled(*load_mesh(path, unit), pitch or (_MESH_PITCH, _MESH_PITCH), size).centred()
        values = _read(path)
        if values.ndim == 2 and not pitch and min(values.shape) > 1:
            pitch = tuple(side / (count - 1) for side, count in zip(size, values.shape[::-1], strict=True))
        return HeightMap(unit * values, pitch or (1.0, 1.0)).centred()  # type: ignore[arg-type]
    except SpecError as error:
        if error.file is not None:
            raise
        raise SpecError(error.rule, file=path, key=error.key, value=error.value) from error


def _read(path: Path) -> np.ndarray:
    """Numbers of a map."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError(f"it must be at most {_LARGEST_FILE} bytes long")
        data = path.read_bytes()
        if path.suffix.lower() == ".npy":
            values = np.load(io.BytesIO(data), allow_pickle=False)
        elif path.suffix.lower() == ".csv":
            values = np.loadtxt(io.StringIO(data.decode()), delimiter=",", ndmin=2)
        else:
            from PIL import Image

            with Image.open(io.BytesIO(data)) as picture:
                if picture.mode not in ("L", "I", "I;16", "F"):
                    raise ValueError(f"it must be a grey picture, not of mode {picture.mode}")
                values = np.asarray(picture)
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
            raise ValueError("it must hold real numbers")
    except Exception as error:  # the readers raise whatever their format makes them stumble over
        rule = f"the file cannot be read as a map of heights ({str(error)[:200]})"
        raise SpecError(rule, file=path, key="gelpad.surface") from error
    return values.astype(np.float64)


def _sampled(vertices: np.ndarray, faces: np.ndarray, pitch: tuple[float, ...], size: tuple[float, float]) -> HeightMap:
    """Upper side of a closed surface (V, 3) [m] over a pad of ``size`` [m]."""
    counts = [max(math.ceil(side / step - 1e-6), _FEWEST - 1) + 1 for side, step in zip(size, pitch, strict=True)]
    if max(counts) > _MOST:
        raise SpecError(f"must leave at most {_MOST} nodes along an axis", key="gelpad.surface_pitch_mm", value=pitch)
    x, y = (np.linspace(-0.5 * side, 0.5 * side, count) for side, count in zip(size, counts, strict=True))
    highest, lowest = _upper_side(vertices[faces], x, y)
    for missing, rule in (
        (~np.isfinite(highest), "the mesh does not lie under the whole pad"),
        (highest - lowest > _SAME_HEIGHT, "the mesh has an undercut or an upright wall: two heights over one place"),
    ):
        if missing.any():
            row, column = (int(k) for k in np.argwhere(missing)[0])
            raise SpecError(
                f"{rule}, at x = {1e3 * x[column]:.4g}, y = {1e3 * y[row]:.4g} mm and {missing.sum() - 1} other nodes",
                key="gelpad.surface",
            )
    return HeightMap(highest, (x[1] - x[0], y[1] - y[0]))


def _upper_side(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Highest and lowest z (Ny, Nx) of the triangles (F, 3, 3) that look up; −inf, inf off them."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(b, c)
    up = normal[:, 2] > 1e-9 * np.linalg.norm(normal, axis=1)
    a, b, c, area = a[up], b[up], c[up], normal[up, 2]
    spans = []
    for k, nodes in enumerate((x, y)):
        step, low, high = nodes[1] - nodes[0], corners[up][:, :, k].min(axis=1), corners[up][:, :, k].max(axis=1)
        first = np.clip(np.ceil((low - nodes[0]) / step - 1e-6), 0, len(nodes)).astype(np.int64)
        last = np.clip(np.floor((high - nodes[0]) / step + 1e-6), -1, len(nodes) - 1).astype(np.int64)
        spans.append((first, np.maximum(last - first + 1, 0)))
    (i0, nx), (j0, ny) = spans
    highest, lowest = np.full(len(y) * len(x), -np.inf), np.full(len(y) * len(x), np.inf)
    ends = np.cumsum(nx * ny)
    start = 0
    while start < len(ends):
        stop = max(int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _CHUNK)), start + 1)
        count = (nx * ny)[start:stop]
        which = np.repeat(np.arange(start, stop), count)
        order = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        i, j = i0[which] + order % np.maximum(nx[which], 1), j0[which] + order // np.maximum(nx[which], 1)
        dx, dy = x[i] - a[which, 0], y[j] - a[which, 1]
        s = (dx * c[which, 1] - dy * c[which, 0]) / area[which]
        t = (dy * b[which, 0] - dx * b[which, 1]) / area[which]
        inside = (s >= -1e-6) & (t >= -1e-6) & (s + t <= 1.0 + 1e-6)
        node, z = (j * len(x) + i)[inside], (a[which, 2] + s * b[which, 2] + t * c[which, 2])[inside]
        np.maximum.at(highest, node, z)
        np.minimum.at(lowest, node, z)
        start = stop
    return highest.reshape(len(y), len(x)), lowest.reshape(len(y), len(x))
