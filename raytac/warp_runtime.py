"""Warp for the package's own kernels: its start, and launches that are recorded as one graph, on the CPU and on CUDA."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import warp as wp

from raytac.installation import foreign_ipc

LAUNCH = Lock()
"""Held by a launch of kernels with tiles. On a CPU Warp keeps these in one place of the process, where two threads would meet."""


def start_warp() -> None:
    """``wp.init()``, with a temporary folder for compiled kernels where the user's cannot be written; ``ipc`` warns then.

    Where another package hides ``ipc``, Warp takes the user's folder as it is.
    """
    if foreign_ipc() is None:
        from ipc import use_writable_cache

        use_writable_cache()
    wp.init()


class Recorded:
    """Kernels that are always launched together, with the same arguments: repeating all costs less than one launch."""

    def __init__(self, *launches: Callable[[], object], device: Any = "cpu") -> None:
        """Record what functions launch; it does not run. Of the arrays of a launch they must hold a reference, as a ``partial`` does."""
        start_warp()
        self._launches = launches  # the graph itself keeps no array alive
        with wp.ScopedCapture(device=device) as capture:
            for launch in launches:
                launch()
        self._graph: Any = capture.graph

    def __call__(self) -> None:
        """Launch them."""
        with LAUNCH:
            wp.capture_launch(self._graph)
