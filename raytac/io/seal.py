"""Files that end with their own digest, so that damage is known before anything is used.

The last 32 bytes are the SHA-256 of the file's name and of what comes before them: neither damage nor another entry's file under this name
passes. ``numpy.load`` reads a sealed ``.npy`` or ``.npz`` all the same.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from raytac.io.atomic import read_regular, write_atomic

_SIZE = hashlib.sha256().digest_size


class SealError(ValueError):
    """A sealed file differs from its digest: empty, cut short, changed, or of another name."""


def write_sealed(path: Path, data: bytes) -> None:
    """Write ``data`` and its digest as a whole, and make the folder. Raises ``OSError``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data + _digest(path, data))


def read_sealed(path: Path) -> bytes:
    """Contents that ``write_sealed`` wrote.

    Raises:
        SealError: the contents differ from their digest.
        OSError: there is no such file, or it cannot be read.
    """
    kept = read_regular(path)
    data = kept[:-_SIZE]
    if len(kept) < _SIZE or kept[-_SIZE:] != _digest(path, data):
        raise SealError("contents differ from their checksum")
    return data


def _digest(path: Path, data: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + b"\0" + data).digest()
