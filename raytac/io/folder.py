"""Write a folder of results so that an interrupt or a full disk leaves nothing half-written."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from raytac.errors import InputError, RaytacError

__all__ = ["DISK_ERRORS", "result_folder"]

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""Numbers of the errors of a disk, or of what standard output goes to."""


@contextmanager
def result_folder(out: Path, owned: Iterable[str] = ()) -> Iterator[Path]:
    """Give a temporary folder; when the block ends well, move its files into ``out``, else delete them and leave ``out`` as it was.

    A file of the same name in ``out`` is replaced. ``owned`` names every file that the command may write: those of an earlier run
    that this one does not write are removed, so that a folder never mixes two runs. All others stay. ``metrics.json`` goes first and
    comes last: where it is, the rest is complete.

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
    """Whether the file that the error names lies in one of the folders; if it names none, whether it is one of a disk."""
    if not isinstance(error.filename, str | bytes | os.PathLike):  # none, or the number of an open file
        return error.errno in DISK_ERRORS
    place = Path(os.path.abspath(os.fsdecode(error.filename)))
    return any(place.is_relative_to(os.path.abspath(folder)) for folder in folders)


def _check_no_folders(out: Path, names: Iterable[str]) -> None:
    for name in names:
        if (out / name).is_dir() and not (out / name).is_symlink():
            raise InputError("out", value=out, rule=f"holds a folder {name!r}, where a file of that name is to be written")


def _move(work: Path, old: Path, out: Path, owned: tuple[str, ...]) -> None:
    """Put the files of ``work`` into ``out``; if one cannot be put there, all that was there before goes back from ``old``."""
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
