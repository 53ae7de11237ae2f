"""Start of Warp for the pad's kernels, also for a user whose cache folder cannot be written."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import tempfile
import warnings
from pathlib import Path

import warp as wp


@functools.cache
def start_warp() -> None:
    """``wp.init()``, with a temporary folder for compiled kernels where the user's cannot be written; warns then.

    Warp itself stops at a read-only home, and for a user without one it makes a folder named ``~``. ``ipc``, which stands alone, does the
    same for itself.
    """
    chosen = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    folder = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "warp"
    folder = folder if folder.name == wp.config.version else folder / wp.config.version
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
    wp.init()
