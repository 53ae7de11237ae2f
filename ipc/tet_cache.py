"""Tetrahedra on disk, each file with its surface and a digest: what is damaged or fills another surface is not used.

This package stands alone, so it writes its one kind of file itself.
"""

from __future__ import annotations

import hashlib
import io
import os
import secrets
import stat
import warnings
from pathlib import Path

import numpy as np

from ipc.errors import IpcError
from ipc.meshes import TetMesh, TriMesh

__all__ = ["default_cache", "keep_tets", "kept_tets", "tets_name"]

_DIGEST = hashlib.sha256().digest_size


def default_cache() -> Path | None:
    """``raytac-ipc/tets`` in ``XDG_CACHE_HOME`` or in ``~/.cache``; None for a user without a home folder."""
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


def kept_tets(path: Path | None, surface: TriMesh, edge_length: float) -> TetMesh | None:
    """The mesh kept at ``path``; None if there is none, or, with a warning, if it is damaged or of another surface or length."""
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
        if os.path.lexists(path):  # else the folder cannot be used at all, of which `keep_tets` tells
            warnings.warn(f"{path} in the cache cannot be used and is made again: {error}", RuntimeWarning, stacklevel=3)
        return None


def keep_tets(path: Path | None, mesh: TetMesh, surface: TriMesh, edge_length: float) -> None:
    """Write a mesh beside ``path``, synchronise it with the disk, and rename it; a warning where that cannot be."""
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
