"""Start Warp, also for a user whose cache folder is missing or cannot be written."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from threading import RLock

import warp as wp

LAUNCH = RLock()
"""Held by threads that step a world or record launches, one at a time.

On a CPU Warp has one recording a process, which takes in the loops and branches that another thread launches, and one place for the
tiles of a kernel. On CUDA threads share a device's stream, of which a recording takes in everything.
"""


_levels: list[int] = []
"""Levels of messages that were chosen, the last one holds; empty at first."""


def choose_messages(*, quiet: bool) -> None:
    """Let Warp print only warnings and errors, or also devices and every module that it loads."""
    _levels.append(wp.LOG_WARNING if quiet else wp.LOG_INFO)
    wp.config.log_level = _levels[-1]


def start_warp() -> None:
    """``wp.init()`` after ``use_writable_cache``, without messages unless a level was chosen.

    Chosen is what ``choose_messages`` was told, or any ``wp.config.log_level`` but Warp's own.
    """
    use_writable_cache()
    if not _levels and wp.config.log_level == wp.LOG_INFO:
        choose_messages(quiet=True)
    _init()


@functools.cache
def _init() -> None:
    is_quiet = wp.config.log_level > wp.LOG_INFO and not _may_have_gpu()
    with _no_standard_error() if is_quiet else contextlib.nullcontext():
        wp.init()


def _may_have_gpu() -> bool:
    return any(Path("/dev").glob("nvidia[0-9]*")) or Path("/dev/dxg").exists()


@contextlib.contextmanager
def _no_standard_error() -> Iterator[None]:
    """Drop native code's standard error: without a device, a missing driver is no news."""
    original = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)


@functools.cache
def use_writable_cache() -> None:
    """Give Warp a temporary folder for kernels where the user's cannot be written; warns.

    Warp itself stops at a read-only home, and for a user without one it makes a folder named ``~``.
    """
    folder = _kernel_folder()
    try:
        if folder.parts[0] == "~":
            raise OSError("there is no home folder")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        own = tempfile.mkdtemp(prefix="warp-kernels-")
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        wp.config.kernel_cache_dir = own
        text = (
            f"Warp's cache {folder} cannot be written ({error.strerror or error}): kernels are compiled for this process alone; "
            "WARP_CACHE_PATH names another folder"
        )
        warnings.warn(text, RuntimeWarning, stacklevel=2)


def _kernel_folder() -> Path:
    """Folder of compiled kernels: Warp's setting, ``WARP_CACHE_PATH``, or the user's cache."""
    chosen = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    folder = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "warp"
    return folder if folder.name == wp.config.version else folder / wp.config.version
