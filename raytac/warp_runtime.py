"""Warp for the package's kernels: its start, and launches recorded as one graph."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from threading import RLock
from typing import Any

import numpy as np
import warp as wp

from raytac.installation import foreign_ipc


def _shared_lock() -> Any:
    """The solver's lock of launches, or another where ``ipc`` cannot be imported."""
    if foreign_ipc() is not None:
        return RLock()
    from ipc.warp_start import LAUNCH as SHARED

    return SHARED


LAUNCH = _shared_lock()
"""Held by recordings, and by launches that are recorded or have tiles.

On the CPU Warp has one recording and one place for tiles a process, where threads would meet.
"""


@cache
def start_warp() -> None:
    """Start Warp as ``ipc`` does: quietly, and with a cache of kernels that can be written.

    Where another package hides ``ipc``, Warp starts as it does by itself. Once a process: that is asked of files.
    """
    if foreign_ipc() is None:
        from ipc import start_warp as start

        start()
    else:
        wp.init()


class Recorded:
    """Kernels that are always launched together: repeating all costs less than one launch."""

    def __init__(self, *launches: Callable[[], object], device: Any = "cpu") -> None:
        """Record what functions launch; they must hold its arrays, as a ``partial`` does."""
        start_warp()
        self._launches = launches  # the graph itself keeps no array alive
        with LAUNCH, wp.ScopedCapture(device=device) as capture:
            for launch in launches:
                launch()
        self._graph: Any = capture.graph

    def __call__(self) -> None:
        """Launch them."""
        with LAUNCH:
            wp.capture_launch(self._graph)


class HostArrays:
    """Warp arrays for NumPy: on the CPU the arrays themselves, on CUDA copies."""

    def __init__(self, *arrays: wp.array) -> None:
        self._arrays, self._on_cpu = arrays, all(wp.get_device(array.device).is_cpu for array in arrays)
        self.values: tuple[np.ndarray, ...] = tuple(array.numpy() for array in arrays)

    def read(self) -> tuple[np.ndarray, ...]:
        """Present ``values``."""
        if not self._on_cpu:
            self.values = tuple(array.numpy() for array in self._arrays)
        return self.values

    def write(self) -> None:
        """Bring what was written to ``values`` to the arrays."""
        if not self._on_cpu:
            for array, values in zip(self._arrays, self.values, strict=True):
                array.assign(values)
