"""Tetrahedra inside a closed surface, by pytetwild, cached by the content of the request."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import numpy as np

from ipc.errors import IpcError
from ipc.meshes import TetMesh, TriMesh, tet_volumes

__all__ = ["tetrahedralize"]


def _default_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "raytac-ipc" / "tets"


def tetrahedralize(surface: TriMesh, edge_length: float, cache: Path | None = None) -> TetMesh:
    """Fill a closed surface with tetrahedra of about ``edge_length`` [m] (fTetWild, Hu et al. 2020).

    Args:
        surface: the closed surface.
        edge_length: target edge length [m].
        cache: folder of finished meshes, named by the SHA-256 of surface and target; by default under the user's cache folder.

    Raises:
        IpcError: without pytetwild (``pip install "raytac[ipc]"``), or if the target is not positive.
    """
    if not edge_length > 0:
        raise IpcError(f"edge_length = {edge_length} m: it must be positive")
    digest = hashlib.sha256(b"tetwild-1")
    for part in (surface.vertices, surface.faces, np.array([edge_length])):
        digest.update(np.ascontiguousarray(part).tobytes())
    folder = cache or _default_cache()
    path = folder / f"{digest.hexdigest()[:32]}.npz"
    if path.is_file():
        with np.load(path) as stored:
            return TetMesh(stored["vertices"], stored["tets"])
    try:
        import pytetwild
    except ImportError as error:
        raise IpcError('tetrahedralize needs pytetwild: pip install "raytac[ipc]", or pass tetrahedra') from error
    vertices, tets = pytetwild.tetrahedralize(  # pyright: ignore[reportPrivateImportUsage]
        surface.vertices, surface.faces.astype(np.int32), edge_length_abs=edge_length, quiet=True
    )[:2]
    vertices, tets = np.asarray(vertices, dtype=np.float64), np.asarray(tets, dtype=np.int32)
    negative = tet_volumes(vertices, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    mesh = TetMesh(vertices, tets)
    folder.mkdir(parents=True, exist_ok=True)
    # Written beside and renamed, so that a reader never sees half a file.
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".npz", delete=False) as handle:
        np.savez(handle, vertices=mesh.vertices, tets=mesh.tets)
    Path(handle.name).replace(path)
    return mesh
