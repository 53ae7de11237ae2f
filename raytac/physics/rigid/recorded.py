"""Launches of kernels recorded as one graph, on the CPU and on CUDA."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from raytac.physics.rigid.warp_cache import start_warp


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
        wp.capture_launch(self._graph)
