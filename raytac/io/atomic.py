"""Whole files: nobody sees half of one, even after a power failure; regular ones only."""

from __future__ import annotations

import errno
import io
import os
import secrets
import stat
from pathlib import Path

PARTIAL = ".partial"
"""End of the names of files that are being written; they begin with a dot."""


def write_atomic(path: Path, data: bytes) -> None:
    """Write ``data`` beside ``path``, synchronise it with the disk, and rename it to ``path``.

    A file of that name is replaced, and a symbolic link too: what it points to stays as it is. The folder must exist. An error or an
    interrupt leaves ``path`` as it was.

    Raises ``OSError``: the folder cannot be written, or the disk is full.
    """
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        # A mode as the user's umask has it: a cache may be shared by a group.
        with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666), "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the names in ``folder`` to the disk, so that a rename outlasts a loss of power."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that know no such thing
            raise
    finally:
        os.close(handle)


def open_regular(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; ``OSError`` for a pipe, a device, or nothing."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return os.fdopen(handle, "rb")


def read_regular(path: Path) -> bytes:
    """Contents of a regular file. Raises as ``open_regular``."""
    with open_regular(path) as stream:
        return stream.read()
