"""Tetrahedra inside a closed surface, by pytetwild, kept on disk.

Each file holds the surface and a digest: what is damaged or fills another surface is not used. This package stands alone, so it writes
its one kind of file itself.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import secrets
import stat
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

from ipc.errors import IpcError
from ipc.meshes.mesh import TetMesh, TriMesh, tet_volumes

_DIGEST = hashlib.sha256().digest_size
_FILL = """
import sys
import numpy as np, pytetwild
given = np.load("surface.npz")
found = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(sys.argv[1]), quiet=True)
np.savez("tets.npz", vertices=np.asarray(found[0], np.float64), tets=np.asarray(found[1], np.int32))
"""


def tetrahedralize(surface: TriMesh, edge_length: float, cache: Path | None = None) -> TetMesh:
    """Tetrahedra of about ``edge_length`` [m] in a closed surface (fTetWild, Hu et al. 2020).

    Args:
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
    kept = read_tets(path, surface, edge_length)
    if kept is not None:
        return kept
    vertices, tets = _fill(surface, edge_length)
    negative = tet_volumes(vertices, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    mesh = TetMesh(vertices, tets)
    write_tets(path, mesh, surface, edge_length)
    return mesh


def _fill(surface: TriMesh, edge_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and tetrahedra, from a child process: fTetWild writes a file and may abort."""
    if importlib.util.find_spec("pytetwild") is None:
        raise IpcError('tetrahedralize needs pytetwild: pip install "raytac[ipc]", or pass tetrahedra')
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "surface.npz", vertices=surface.vertices, faces=surface.faces.astype(np.int32))
        done = subprocess.run([sys.executable, "-c", _FILL, repr(float(edge_length))], cwd=folder, capture_output=True, text=True)
        if done.returncode != 0:
            last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
            raise IpcError(f"pytetwild could not fill the surface with an edge length of {edge_length} m: {last[0]}")
        with np.load(Path(folder) / "tets.npz") as mesh:
            return mesh["vertices"], mesh["tets"]


def default_cache() -> Path | None:
    """``raytac-ipc/tets`` in ``XDG_CACHE_HOME`` or ``~/.cache``; None without a home folder."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "raytac-ipc" / "tets"
    except RuntimeError:
        return None


def tets_name(surface: TriMesh, edge_length: float) -> str:
    """Name of the file that holds tetrahedra of about ``edge_length`` [m] in ``surface``."""
    digest = hashlib.sha256(b"tetwild-2")
    for part in _request(surface, edge_length).values():
        digest.update(part.tobytes())
    return f"{digest.hexdigest()[:32]}.npz"


def read_tets(path: Path | None, surface: TriMesh, edge_length: float) -> TetMesh | None:
    """The mesh stored at ``path``; None without one, and with a warning for a wrong one."""
    if path is None:
        return None
    try:
        data = _read_regular(path)
        if len(data) < _DIGEST or hashlib.sha256(data[:-_DIGEST]).digest() != data[-_DIGEST:]:
            raise ValueError("contents differ from their checksum")
        with np.load(io.BytesIO(data[:-_DIGEST]), allow_pickle=False) as kept:
            if not all(np.array_equal(kept[name], given) for name, given in _request(surface, edge_length).items()):
                raise ValueError("it was made for another surface or edge length")
            return TetMesh(kept["vertices"], kept["tets"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, IpcError) as error:
        if os.path.lexists(path):  # else the folder cannot be used at all, and `write_tets` warns
            warnings.warn(f"{path} in the cache cannot be used and is made again: {error}", RuntimeWarning, stacklevel=3)
        return None


def write_tets(path: Path | None, mesh: TetMesh, surface: TriMesh, edge_length: float) -> None:
    """Write a mesh to ``path`` by way of a partial file; warns where that fails."""
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, vertices=mesh.vertices, tets=mesh.tets, **_request(surface, edge_length))
    data = stream.getvalue()
    try:
        if path is None:
            raise OSError("there is no home folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        try:
            with partial.open("xb") as file:
                file.write(data + hashlib.sha256(data).digest())
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        where = "the cache" if path is None else f"the cache {path.parent}"
        text = f"{where} cannot be written ({error.strerror or error}): tetrahedra are not kept"
        warnings.warn(text, RuntimeWarning, stacklevel=3)


def _request(surface: TriMesh, edge_length: float) -> dict[str, np.ndarray]:
    return {
        "surface_vertices": np.ascontiguousarray(surface.vertices),
        "surface_faces": np.ascontiguousarray(surface.faces),
        "edge_length": np.array([edge_length]),
    }


def _read_regular(path: Path) -> bytes:
    """Contents of a regular file; a pipe of that name is not waited for."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as stream:
        if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
            raise OSError("it is no regular file")
        return stream.read()
