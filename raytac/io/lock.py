"""Keep two runs out of one folder."""

from __future__ import annotations

import fcntl
import os
import stat
from pathlib import Path
from types import TracebackType

from raytac.errors import InputError

__all__ = ["LOCK", "FolderLock"]

LOCK = ".lock"
"""File in a folder that is locked; it is empty and stays."""
_KIND = "must be a file that can be written, and no link: it is the lock of the folder"


class FolderLock:
    """A folder to oneself, made if need be, until ``release``, the end of a ``with`` block, or the end of the process, however it ends.

    Only runs that ask for the lock are kept out. Where the folder did not exist and nothing is written to it, it is removed again.
    """

    def __init__(self, folder: str | Path) -> None:
        """Take the lock.

        Raises:
            InputError: another run has it, the folder cannot be written, or ``.lock`` in it is a link or no file.
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
            rule = f"must be a folder that can be written ({error.strerror})"
            raise InputError("out", value=folder, rule=rule) from error
        try:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError("out", value=folder / LOCK, rule=_KIND)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not self._is_there(handle):  # the run that had the lock has just removed the folder that it made
                raise BlockingIOError
        except BlockingIOError as error:
            os.close(handle)
            raise InputError("out", value=folder, rule="is in use by another run") from error
        except OSError as error:
            os.close(handle)
            raise InputError("out", value=folder, rule=f"cannot be locked ({error.strerror})") from error
        except InputError:
            os.close(handle)
            raise
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
