"""Folders of results: written as a whole or not at all, and locked while a run adds to them."""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from raytac.errors import InputError, RaytacError
from raytac.io.atomic import PARTIAL

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""Numbers of the errors of a disk, or of what standard output goes to."""


@contextmanager
def new_path(path: str | Path) -> Iterator[Path]:
    """A temporary name beside ``path`` for a file or folder, which takes its name at the end.

    After an error nothing of it stays. Raises ``InputError``: ``path`` exists, or the folder that it is in does not, or cannot be written.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise InputError("path", value=path, rule="must not exist: nothing is replaced")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise InputError("path", value=path, rule="must be in a folder that exists and can be written")
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        yield partial
        partial.rename(path)
    finally:
        if partial.is_dir():
            shutil.rmtree(partial)
        partial.unlink(missing_ok=True)


@contextmanager
def result_folder(out: Path, owned: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder, whose files move into ``out`` when the block ends well.

    Otherwise they are deleted, and ``out`` stays as it was. A file of the same name in ``out`` is replaced. ``owned`` names every file
    that the command may write: those of an earlier run that this one does not write are removed, so that a folder never mixes two runs.
    All others stay. ``metrics.json`` goes first and comes last: where it is, the rest is complete.

    Raises:
        InputError: ``out`` is a file or a link to nothing, its folder cannot be written, it holds a folder where a file is to be written
            (found before the block, for those that are ``owned``), or the disk is full or fails. What
            else the block raises stays what it is.
    """
    out, owned = Path(out), tuple(owned)
    try:
        if out.is_symlink() and not out.exists():
            raise InputError("out", value=out, rule=f"is a link to {os.readlink(out)}, which does not exist")
        if out.exists() and not out.is_dir():
            raise InputError("out", value=out, rule="must be a folder, and a file of that name exists")
        _check_no_folders(out, owned)
        out.parent.mkdir(parents=True, exist_ok=True)
        # Inside of a folder that exists, which may be a link or another disk, so that files need only be renamed.
        base = Path(tempfile.mkdtemp(prefix=".raytac.", suffix=".partial", dir=out if out.is_dir() else out.parent))
    except OSError as error:
        raise InputError("out", value=out, rule=f"must be a folder that can be written ({error.strerror})") from error
    work, old = base / "new", base / "old"
    try:
        try:
            work.mkdir()
            old.mkdir()
            yield work
            _check_no_folders(out, (path.name for path in work.iterdir()))
            out.mkdir(exist_ok=True)
            _move(work, old, out, owned)
        except OSError as error:
            if isinstance(error, RaytacError) or not _is_of_folder(error, (base, out)):
                raise
            reason = error.strerror or error
            raise InputError("out", value=out, rule=f"cannot be written ({reason}); nothing in it has changed") from error
    finally:
        shutil.rmtree(base, ignore_errors=True)


def _is_of_folder(error: OSError, folders: Iterable[Path]) -> bool:
    """True for an error of a file in one of the folders, or of the disk without a file."""
    if not isinstance(error.filename, str | bytes | os.PathLike):  # none, or the number of an open file
        return error.errno in DISK_ERRORS
    place = Path(os.path.abspath(os.fsdecode(error.filename)))
    return any(place.is_relative_to(os.path.abspath(folder)) for folder in folders)


def _check_no_folders(out: Path, names: Iterable[str]) -> None:
    for name in names:
        if (out / name).is_dir() and not (out / name).is_symlink():
            raise InputError("out", value=out, rule=f"holds a folder {name!r}, where a file of that name is to be written")


def _move(work: Path, old: Path, out: Path, owned: tuple[str, ...]) -> None:
    """Move the files of ``work`` into ``out``; an error moves all back, from ``old``."""
    written = sorted((path.name for path in work.iterdir()), key=lambda name: name == "metrics.json")
    try:
        for name in sorted({*written, *owned}, key=lambda name: name != "metrics.json"):
            if os.path.lexists(out / name):
                os.replace(out / name, old / name)
        for name in written:
            os.replace(work / name, out / name)
    except BaseException:
        for name in written:
            if not (work / name).exists():
                (out / name).unlink(missing_ok=True)
        for path in sorted(old.iterdir(), key=lambda path: path.name == "metrics.json"):
            os.replace(path, out / path.name)
        raise


LOCK = ".lock"
"""File in a folder that is locked; it is empty and stays."""
_KIND = "must be a file that can be written, and no link: it is the lock of the folder"


class FolderLock:
    """Lock of a folder, which is made if need be.

    It lasts until ``release``, the end of a ``with`` block, or the end of the process. Only runs that ask for the lock are kept out.
    Where the folder did not exist and nothing is written to it, it is removed again.
    """

    def __init__(self, folder: str | Path) -> None:
        """Take the lock.

        Raises ``InputError``: another run has it, the folder cannot be written, or ``.lock`` in it is a link or no file.
        """
        folder = Path(folder)
        self._folder, self._made = folder, not folder.exists()
        self._handle = -1
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # A link is not followed, a pipe not waited for, and nothing is emptied: the file may not be ours.
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            handle = os.open(folder / LOCK, flags, 0o666)
        except OSError as error:
            if os.path.lexists(folder / LOCK):
                raise InputError("out", value=folder / LOCK, rule=f"{_KIND} ({error.strerror})") from error
            raise InputError("out", value=folder, rule=f"must be a folder that can be written ({error.strerror})") from error
        try:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError("out", value=folder / LOCK, rule=_KIND)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not self._is_there(handle):  # the run that had the lock has just removed the folder that it made
                raise BlockingIOError
        except (OSError, InputError) as error:
            os.close(handle)
            if isinstance(error, InputError):
                raise
            in_use = isinstance(error, BlockingIOError)
            rule = "is in use by another run" if in_use else f"cannot be locked ({error.strerror})"
            raise InputError("out", value=folder, rule=rule) from error
        self._handle = handle

    def release(self) -> None:
        """Let others in; a second call does nothing."""
        if self._handle < 0:
            return
        handle, self._handle = self._handle, -1
        try:
            # Only while the lock in it is ours: another run may have made a folder of that name after ours was removed.
            if self._made and self._is_there(handle) and os.listdir(self._folder) == [LOCK]:
                (self._folder / LOCK).unlink()
                self._folder.rmdir()
        except OSError:  # the folder was removed or cannot be changed: an empty one that stays harms nobody
            pass
        finally:
            os.close(handle)

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.release()

    def _is_there(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.fstat(handle), os.lstat(self._folder / LOCK))
        except (FileNotFoundError, NotADirectoryError):
            return False
