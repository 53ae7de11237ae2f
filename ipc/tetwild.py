"""Tetrahedra inside a closed surface, by pytetwild, cached by the content of the request."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ipc.errors import IpcError
from ipc.meshes import TetMesh, TriMesh, tet_volumes
from ipc.tet_cache import default_cache, keep_tets, kept_tets, tets_name

__all__ = ["tetrahedralize"]

_FILL = """
import sys
import numpy as np, pytetwild
given = np.load("surface.npz")
found = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(sys.argv[1]), quiet=True)
np.savez("tets.npz", vertices=np.asarray(found[0], np.float64), tets=np.asarray(found[1], np.int32))
"""


def tetrahedralize(surface: TriMesh, edge_length: float, cache: Path | None = None) -> TetMesh:
    """Fill a closed surface with tetrahedra of about ``edge_length`` [m] (fTetWild, Hu et al. 2020).

    Args:
        surface: the closed surface.
        edge_length: target edge length [m].
        cache: folder of finished meshes, named by the SHA-256 of surface and target; by default under the user's cache folder. A mesh
            there that is damaged or of another surface is made again, and a folder that cannot be written is left out, with a warning.

    Raises:
        IpcError: without pytetwild (``pip install "raytac[ipc]"``), if the target is not positive, or if pytetwild fails.
    """
    if not edge_length > 0:
        raise IpcError(f"edge_length = {edge_length} m: it must be positive")
    folder = cache or default_cache()
    path = None if folder is None else folder / tets_name(surface, edge_length)
    kept = kept_tets(path, surface, edge_length)
    if kept is not None:
        return kept
    vertices, tets = _fill(surface, edge_length)
    negative = tet_volumes(vertices, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    mesh = TetMesh(vertices, tets)
    keep_tets(path, mesh, surface, edge_length)
    return mesh


def _fill(surface: TriMesh, edge_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and tetrahedra, from a process of its own: fTetWild leaves a file in the working directory and may abort."""
    if importlib.util.find_spec("pytetwild") is None:
        raise IpcError('tetrahedralize needs pytetwild: pip install "raytac[ipc]", or pass tetrahedra')
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "surface.npz", vertices=surface.vertices, faces=surface.faces.astype(np.int32))
        done = subprocess.run([sys.executable, "-c", _FILL, repr(float(edge_length))], cwd=folder, capture_output=True, text=True)
        if done.returncode != 0:
            last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise IpcError(f"pytetwild could not fill the surface with an edge length of {edge_length} m: {last[0]}")
        with np.load(Path(folder) / "tets.npz") as found:
            return found["vertices"], found["tets"]
