"""The user's cache: what can be made again, kept between processes.

A damaged entry is never used. A cache is a help and no need: one that cannot be written or read means work in memory, with a warning.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from raytac.io.seal import SealError, read_sealed, write_sealed


def cache_root() -> Path | None:
    """``RAYTAC_CACHE``, or ``raytac`` in ``XDG_CACHE_HOME`` or ``~/.cache``; None without home."""
    if chosen := os.environ.get("RAYTAC_CACHE"):
        return Path(chosen)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "raytac"
    except RuntimeError:
        return None


def cache_folder(kind: str) -> Path | None:
    """Folder of one kind of cached things; None for a user without a home folder."""
    root = cache_root()
    return None if root is None else root / kind


def read_cached(path: Path | None) -> bytes | None:
    """Contents that ``keep_cached`` kept; None if there are none, or damaged ones (warns)."""
    if path is None:
        return None
    try:
        return read_sealed(path)
    except SealError as error:
        warn_unusable(path, error)
    except FileNotFoundError:
        pass
    except OSError as error:
        if os.path.lexists(path):  # of a folder that cannot be used at all, `keep_cached` tells
            warn_unusable(path, error)
    return None


def keep_cached(path: Path | None, data: bytes) -> None:
    """Keep ``data``, sealed; a warning where it cannot be written."""
    try:
        if path is None:
            raise OSError("there is no home folder")
        write_sealed(path, data)
    except OSError as error:
        warn_not_kept(path, error)


def warn_unusable(path: Path, error: Exception) -> None:
    """Tell that an entry is not used and made again."""
    warnings.warn(f"{path} in the cache cannot be used and is made again: {error}", RuntimeWarning, stacklevel=3)


def warn_not_kept(path: Path | None, error: Exception) -> None:
    """Warn that an entry is not kept; once a folder, since the text is the same for all in it."""
    where = "the cache" if path is None else f"the cache {path.parent}"
    reason = getattr(error, "strerror", None) or error
    text = f"{where} cannot be written ({reason}): what is made is not kept; RAYTAC_CACHE names another folder"
    warnings.warn(text, RuntimeWarning, stacklevel=3)
