"""Start of Warp for the pad's kernels, also for a user whose cache folder cannot be written."""

from __future__ import annotations

import warp as wp

from raytac.installation import foreign_ipc


def start_warp() -> None:
    """``wp.init()``, with a temporary folder for compiled kernels where the user's cannot be written; ``ipc`` warns then.

    Where another package hides ``ipc``, Warp takes the user's folder as it is.
    """
    if foreign_ipc() is None:
        from ipc import use_writable_cache

        use_writable_cache()
    wp.init()
