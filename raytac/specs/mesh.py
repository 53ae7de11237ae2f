"""Triangle meshes of objects from STL, OBJ and PLY files, refused unless they bound a solid."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import MeshError
from raytac.specs.files import is_file

MESH_SUFFIXES = (".stl", ".obj", ".ply")
_FARTHEST = 1e9
"""Farthest that a vertex may be [file units]: beyond it vertices cannot be distinguished."""
SIZE_RANGE = (1e-4, 0.5)
"""Largest extent that an object may have [m]; outside it, the scale is almost surely wrong."""


def load_mesh(path: str | Path, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a closed surface.

    Args:
        path: STL, OBJ or PLY file.
        scale: metres per file unit: 0.001 for a file in millimetres.

    Returns:
        ``vertices`` [m], shape (V, 3), float64, object frame (the axes and origin of the file); ``faces``, shape (F, 3), int32,
        counter-clockwise seen from outside. Corners that coincide exactly are merged (an STL stores each face on its own).

    Raises:
        MeshError: missing file, unknown suffix, unreadable or empty file, vertices that are not finite, a surface that is not
            watertight or not oriented the same way throughout, faces that look inwards, or a size outside ``SIZE_RANGE``.
    """
    path = Path(path)
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError("must be a finite number of metres per file unit > 0", file=path, key="scale", value=scale)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError("unknown mesh format", file=path, key="suffix", value=path.suffix, choices=MESH_SUFFIXES)
    if not is_file(path):
        raise MeshError("the mesh file does not exist", file=path)
    mesh = _read(path)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(vertices) or not len(faces):
        raise MeshError(f"the mesh is empty: {len(vertices)} vertices, {len(faces)} faces", file=path)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise MeshError("vertices must have three coordinates and faces three corners", file=path, value=vertices.shape)
    bad = np.flatnonzero(~(np.abs(vertices) < _FARTHEST).all(axis=1))
    if len(bad):
        rule = f"every vertex must be finite and within {_FARTHEST:g} file units"
        raise MeshError(rule, file=path, key=f"vertex {bad[0]}", value=vertices[bad[0]].tolist())
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"faces must index vertices 0 to {len(vertices) - 1}", file=path, value=int(faces.max()))
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)  # without normals and texture coordinates, which may be anything
    mesh.merge_vertices()
    _require_solid(mesh, path)
    extent = float(np.ptp(mesh.vertices, axis=0).max()) * scale
    if not SIZE_RANGE[0] <= extent <= SIZE_RANGE[1]:
        low, high = (1e3 * s for s in SIZE_RANGE)
        rule = f"the object is {extent * 1e3:.4g} mm long, must be {low:g} to {high:g} mm: scale is metres per file unit"
        # The other unit that files have.
        other = {0.001: 1.0, 1.0: 0.001}.get(scale)
        if other is not None and SIZE_RANGE[0] <= extent * other / scale <= SIZE_RANGE[1]:
            rule += f"; try {other:g} for a file in {'metres' if other == 1.0 else 'millimetres'}"
        raise MeshError(rule, file=path, key="scale", value=scale)
    return np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces, np.int32)


def _read(path: Path) -> Any:
    import trimesh

    try:
        # As bytes, so that no other file is read that this one names: materials and textures do not matter, and may be anything.
        # process=False: trimesh would otherwise drop vertices that are not finite without a word.
        data = io.BytesIO(path.read_bytes())
        mesh = trimesh.load_mesh(data, file_type=path.suffix.lower()[1:], process=False, maintain_order=True)
    except Exception as error:  # the parsers raise whatever their format makes them stumble over
        raise MeshError(f"the mesh file cannot be read ({type(error).__name__}: {error})", file=path) from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh):
        raise MeshError("the mesh is empty: the file holds no faces", file=path)
    return mesh


def _require_solid(mesh: Any, path: Path) -> None:
    if not mesh.is_watertight:
        edges, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
        odd = int((counts != 2).sum())
        raise MeshError(f"the mesh must be watertight: {odd} of {len(edges)} edges do not join exactly two faces", file=path)
    if not mesh.is_winding_consistent:
        raise MeshError("the faces of the mesh must all be oriented the same way", file=path)
    volume = float(mesh.volume)
    if not volume > 0:
        raise MeshError(f"the faces of the mesh must look outwards: its volume is {volume:.4g} file units³", file=path)
