"""Triangle meshes of objects: read, repaired on request, refused unless they bound a solid."""

from __future__ import annotations

import hashlib
import io
import logging
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import MeshError
from raytac.io.progress import Progress
from raytac.specs.files import is_file

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb")
FILE_SCALE = {".glb": 1.0}
"""Metres per file unit of formats that say it; 0.001, millimetres, of the others."""
_FARTHEST = 1e9
"""Farthest that a vertex may be [file units]: beyond it vertices cannot be distinguished."""
SIZE_RANGE = (1e-4, 0.5)
"""Largest extent that an object may have [m]; outside it, the scale is almost surely wrong."""
_LARGE_FILE = 10_000_000
"""Bytes from which reading a file shows its progress: 200,000 triangles of a binary STL."""
_LOG = logging.getLogger("raytac")
_Solid = tuple[np.ndarray, np.ndarray, list[str]]


@dataclass(frozen=True, eq=False, repr=False)
class TriangleMesh:
    """Closed surface of an object in memory; two of the same arrays are equal."""

    vertices: np.ndarray
    """Corners [m], shape (V, 3), float64, object frame."""
    faces: np.ndarray
    """Corners of each triangle, (F, 3), int32, counter-clockwise seen from outside."""

    @cached_property
    def digest(self) -> str:
        """Hash of both arrays."""
        return hashlib.sha256(self.vertices.tobytes() + b"|" + self.faces.tobytes()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TriangleMesh) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def load_mesh(path: str | Path, scale: float, *, repair: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a closed surface.

    A file that has not changed since is read, checked and repaired once; what the repair did is logged at every call. Of a large file,
    progress is shown on standard error.

    Args:
        path: STL, OBJ, PLY, OFF or GLB file.
        scale: metres per file unit: 0.001 for a file in millimetres.
        repair: close the holes of an open surface, as ``closed_mesh`` does.

    Returns:
        As ``closed_mesh``, in the axes of the file.

    Raises:
        MeshError: missing file, unknown suffix, unreadable or empty file; and as ``closed_mesh``.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError("unknown mesh format", file=path, key="suffix", value=path.suffix, choices=MESH_SUFFIXES)
    _check_scale(scale, path)
    if not is_file(path):
        raise MeshError("the mesh file does not exist", file=path)
    try:
        state = path.stat()
    except OSError as error:  # removed since
        raise MeshError(f"the mesh file cannot be read ({type(error).__name__}: {error})", file=path) from error
    vertices, faces, done = _solid_of_file(path, scale, repair, (state.st_dev, state.st_ino, state.st_mtime_ns, state.st_size))
    _log(done, path)
    return vertices.copy(), faces.copy()


@lru_cache(maxsize=2)
def _solid_of_file(path: Path, scale: float, repair: bool, state: tuple[int, ...]) -> _Solid:
    """Closed surface of a file, kept while ``state`` (device, inode, time, size) is the same.

    ``path`` is as the caller gave it, for messages; the inode tells apart files that it means in different folders.
    """
    with Progress(desc=f"read {path.name}", total=2, unit="step", show=state[-1] >= _LARGE_FILE, leave=False) as bar:
        mesh = _read(path)
        bar.update()
        solid = _checked(mesh.vertices, mesh.faces, scale, path, repair)
        bar.update()
    return solid


def closed_mesh(
    vertices: Any, faces: Any, scale: float, *, file: Path | None = None, repair: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Checked vertices and faces of a closed surface.

    Args:
        vertices: corners [units of ``scale``], shape (V, 3).
        faces: indices of the corners of each triangle, shape (F, 3).
        scale: metres per unit.
        file: where they come from, for messages; None is a mesh made in code.
        repair: close every hole by triangles from its rim to the rim's mean, and turn a surface that looks inwards. What was done is
            logged. None of it happens to a surface that is closed and looks outwards.

    Returns:
        ``vertices`` [m], shape (V, 3), float64, object frame (the axes and origin of the mesh); ``faces``, shape (F, 3), int32,
        counter-clockwise seen from outside. Corners that coincide exactly are merged (an STL stores each face on its own).

    Raises:
        MeshError: no faces, vertices that are not finite, a surface that is not watertight or not oriented the same way throughout,
            faces that look inwards, a rim that ``repair`` cannot close, or a size outside ``SIZE_RANGE``.
    """
    vertices, faces, done = _checked(vertices, faces, scale, file, repair)
    _log(done, file)
    return vertices, faces


def _log(done: list[str], file: Path | None) -> None:
    for text in done:
        _LOG.warning("%s: %s", file or "mesh", text)


def _checked(vertices: Any, faces: Any, scale: float, file: Path | None, repair: bool) -> _Solid:
    """Vertices and faces of ``closed_mesh``, and what its repair did."""
    _check_scale(scale, file)
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(vertices) or not len(faces):
        raise MeshError(f"the mesh is empty: {len(vertices)} vertices, {len(faces)} faces", file=file)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise MeshError("vertices must have three coordinates and faces three corners", file=file, value=vertices.shape)
    bad = np.flatnonzero(~(np.abs(vertices) < _FARTHEST).all(axis=1))
    if len(bad):
        rule = f"every vertex must be finite and within {_FARTHEST:g} file units"
        raise MeshError(rule, file=file, key=f"vertex {bad[0]}", value=vertices[bad[0]].tolist())
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"faces must index vertices 0 to {len(vertices) - 1}", file=file, value=int(faces.max()))
    mesh, done = _merged(vertices, faces), []
    if repair:
        mesh, done = _repaired(mesh, scale, file)
    _require_solid(mesh, file, tried=repair)
    extent = float(np.ptp(mesh.vertices, axis=0).max()) * scale
    if not SIZE_RANGE[0] <= extent <= SIZE_RANGE[1]:
        low, high = (1e3 * s for s in SIZE_RANGE)
        rule = f"the object is {extent * 1e3:.6g} mm long, must be {low:g} to {high:g} mm: scale is metres per file unit"
        # The other unit that files have.
        other = {0.001: 1.0, 1.0: 0.001}.get(scale)
        if other is not None and SIZE_RANGE[0] <= extent * other / scale <= SIZE_RANGE[1]:
            rule += f"; try {other:g} for a file in {'metres' if other == 1.0 else 'millimetres'}"
        raise MeshError(rule, file=file, key="scale", value=scale)
    return np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int32), done


def _check_scale(scale: float, file: Path | None) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError("must be a finite number of metres per file unit > 0", file=file, key="scale", value=scale)


def _merged(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """The mesh with corners that coincide merged."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)  # without normals and texture coordinates, which may be anything
    mesh.merge_vertices()
    return mesh


def _read(path: Path) -> Any:
    import trimesh

    try:
        # As bytes, so that no other file is read that this one names: materials and textures do not matter, and may be anything.
        # process=False: trimesh would otherwise drop vertices that are not finite without a word.
        data = io.BytesIO(path.read_bytes())
        mesh = trimesh.load_mesh(data, file_type=path.suffix.lower()[1:], process=False, maintain_order=True)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
    except Exception as error:  # the parsers raise whatever their format makes them stumble over
        raise MeshError(f"the mesh file cannot be read ({type(error).__name__}: {error})", file=path) from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise MeshError("the mesh is empty: the file holds no faces", file=path)
    return mesh


def _repaired(mesh: Any, scale: float, file: Path | None) -> tuple[Any, list[str]]:
    """The mesh with its holes closed, and turned where it looks inwards; and what was done."""
    done: list[str] = []
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # a triangle without area joins nothing
    rims = _rims(faces, file) if len(faces) else []
    if rims:
        middles = np.array([vertices[rim].mean(axis=0) for rim in rims])
        fans = [np.stack([np.roll(rim, -1), rim, np.full(len(rim), len(vertices) + i)], axis=1) for i, rim in enumerate(rims)]
        widths = [f"{1e3 * scale * np.ptp(vertices[rim], axis=0).max():.3g} mm ({len(rim)} edges)" for rim in rims]
        more = f" and {len(rims) - 5} more" if len(rims) > 5 else ""
        done.append(f"closed {len(rims)} hole{'s' * (len(rims) > 1)}, width {', '.join(widths[:5])}{more}")
        vertices, faces = np.concatenate([vertices, middles]), np.concatenate([faces, *fans])
    mesh = _merged(vertices, faces)
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0:
        done.append("turned its faces, which looked inwards")
        mesh = _merged(vertices, faces[:, ::-1])
    return mesh, done


def _rims(faces: np.ndarray, file: Path | None) -> list[np.ndarray]:
    """Corners around each hole, in the direction of the faces beside it."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward, backward = (a * (int(faces.max()) + 1) + b for a, b in ((start, end), (end, start)))
    twice = len(forward) - len(np.unique(forward))
    if twice:
        rule = "cannot be repaired: faces overlap, or are oriented against each other; repair it in a mesh editor"
        raise MeshError(rule, file=file, key="mesh", value=f"{twice} edges with two faces on one side")
    alone = ~np.isin(forward, backward)
    after: dict[int, list[int]] = {}
    for corner, following in zip(start[alone].tolist(), end[alone].tolist(), strict=True):
        after.setdefault(corner, []).append(following)
    rims, path = [], []
    while after or path:
        if not path:
            path = [next(iter(after))]
        following = after[path[-1]].pop()
        if not after[path[-1]]:
            del after[path[-1]]
        if following in path:  # a hole is closed; where holes meet in a corner, the path goes on from there
            place = path.index(following)
            rims.append(np.array(path[place:]))
            path = path[:place] + ([following] if place else [])
        else:
            path.append(following)
    return rims


def _require_solid(mesh: Any, file: Path | None, *, tried: bool) -> None:
    if not mesh.is_watertight:
        _, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
        odd = int((counts != 2).sum())
        rule = f"the mesh must be watertight: {odd} of {len(counts)} edges do not join exactly two faces"
        if (counts < 2).any() and not tried:
            rule += "; raytac press FILE --repair (in Python repair=True) closes holes"
        raise MeshError(rule, file=file)
    if not mesh.is_winding_consistent:
        raise MeshError("the faces of the mesh must all be oriented the same way", file=file)
    volume = float(mesh.volume)
    if not volume > 0:
        rule = f"the faces of the mesh must look outwards: its volume is {volume:.4g} file units³"
        raise MeshError(f"{rule}; raytac press FILE --repair (in Python repair=True) turns them", file=file)
