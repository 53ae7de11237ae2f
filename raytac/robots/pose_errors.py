"""Differences of many poses by one kernel: NumPy takes as long for dozens as MuJoCo's step."""

from __future__ import annotations

from functools import partial

import numpy as np
import warp as wp

from raytac.robots.arm_kernels import pose_errors
from raytac.warp_runtime import Recorded, start_warp


class PoseErrors:
    """``se3.pose_error`` of ``pairs`` times B poses, B fixed."""

    def __init__(self, count: int, pairs: int = 1) -> None:
        """Arrays of ``count`` B poses, ``pairs`` times."""
        start_warp()
        size = count * pairs
        a, b = (wp.zeros((size, 4, 4), dtype=wp.float64, device="cpu") for _ in range(2))
        error = wp.zeros((size, 6), dtype=wp.float64, device="cpu")
        self._a, self._b = (array.numpy().reshape(pairs, count, 4, 4) for array in (a, b))
        self._error = error.numpy().reshape(pairs, count, 6)
        self._launch = Recorded(partial(wp.launch, pose_errors, dim=size, inputs=[a, b], outputs=[error], device="cpu"))

    def __call__(self, *pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Displacements (pairs, B, 6) from the second pose of each pair to the first, world axes.

        Poses (B, 4, 4), or (4, 4) of one for all.
        """
        for k, (a, b) in enumerate(pairs):
            self._a[k], self._b[k] = a, b
        self._launch()
        return self._error.copy()
