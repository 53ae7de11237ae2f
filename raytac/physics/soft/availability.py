"""The contact solver's own needs: whether it is installed, and how much Warp, which it runs on, prints."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterator

from raytac.device import cuda_device_count
from raytac.errors import BackendError
from raytac.installation import foreign_ipc

__all__ = ["check_solver", "hush_solver"]


def check_solver(user: str) -> None:
    """Say now, in one line, that the solver is missing, instead of by an ``ImportError`` from its depths.

    Args:
        user: what needs the solver; the message begins with it.

    Raises:
        BackendError: Warp is not installed.
    """
    if importlib.util.find_spec("warp") is None:
        raise BackendError(f'{user} needs the contact solver, and Warp is not installed: `pip install "raytac[ipc]"`')


def hush_solver() -> None:
    """Let Warp print warnings and errors only, in this whole process; nothing happens without Warp or without raytac's own ``ipc``.

    Warp otherwise lists devices and every module that it loads. Its level belongs to the process, so neither ``ipc`` nor
    ``TactileSensor`` touches it: this is for programs, such as the ``raytac`` command. Call it before the solver is first used.
    """
    if importlib.util.find_spec("warp") is None or foreign_ipc() is not None:
        return
    import warp as wp

    from ipc import use_writable_cache

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    use_writable_cache()
    with _no_standard_error() if cuda_device_count() == 0 else contextlib.nullcontext():
        wp.init()


@contextlib.contextmanager
def _no_standard_error() -> Iterator[None]:
    """Drop what native code writes to standard error: that there is no CUDA driver is no news where no device was found."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
