"""Messages of Warp, in which contacts, gel surfaces and the solver are computed."""

from __future__ import annotations

from pathlib import Path

from raytac.installation import foreign_ipc


def quiet_warp(quiet: bool = True) -> None:
    """Start Warp, and let it print only warnings and errors; or with False what it does.

    It then lists devices and every module that it loads. Without a call raytac is quiet from the first time that it computes, unless
    ``warp.config.log_level`` was set before. The level belongs to the process. Nothing happens without raytac's own ``ipc``.
    """
    if foreign_ipc() is not None:
        return
    from ipc.warp_start import choose_messages, start_warp

    choose_messages(quiet=quiet)
    start_warp()


def has_compiled_kernels(*, solver: bool = False) -> bool:
    """True if Warp's cache holds kernels of raytac, of any version; after ``quiet_warp``.

    ``solver``: also those of the soft pad's contact solver.
    """
    if foreign_ipc() is not None:
        return True
    import warp as wp

    cache = Path(wp.config.kernel_cache_dir or "")
    return all(any(cache.glob(f"wp_{package}*")) for package in ("raytac", "ipc")[: 1 + solver])
