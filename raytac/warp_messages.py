"""Messages of Warp, in which contacts, gel surfaces and the solver are computed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from raytac.device import cuda_device_count
from raytac.installation import foreign_ipc


def quiet_warp() -> None:
    """Let Warp print only warnings and errors in this process.

    Warp otherwise lists devices and every module that it loads. The level belongs to the process, so ``ipc`` and ``TactileSensor`` leave it
    alone: this is for programs, such as the ``raytac`` command. Call it before contacts are first computed. Nothing happens without
    raytac's own ``ipc``.
    """
    if foreign_ipc() is not None:
        return
    import warp as wp

    from ipc import use_writable_cache

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    use_writable_cache()
    with _no_standard_error() if cuda_device_count() == 0 else contextlib.nullcontext():
        wp.init()


def has_compiled_kernels() -> bool:
    """True if Warp's cache holds kernels of raytac, of any version; after ``quiet_warp``."""
    if foreign_ipc() is not None:
        return True
    import warp as wp

    return any(Path(wp.config.kernel_cache_dir or "").glob("wp_raytac*"))


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
