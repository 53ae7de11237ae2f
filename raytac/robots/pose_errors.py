"""Differences of many poses by one kernel: NumPy takes as long for dozens as MuJoCo's step."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from raytac.robots.arm_kernels import pose_errors
from raytac.warp_runtime import Recorded, start_warp


class PoseErrors:
    """``se3.pose_error`` of ``pairs`` · B poses, B fixed; arrays of NumPy or PyTorch."""

    def __init__(self, count: int, pairs: int = 1, device: str | None = None) -> None:
        """Arrays of ``count`` B poses, ``pairs`` times.

        Args:
            device: None takes NumPy arrays. With a device, such as "cuda:0" or "cpu", poses and results are PyTorch tensors on it, and a
                call copies nothing to the host; its kernel runs in Warp's present stream.
        """
        start_warp()
        size, place = count * pairs, device or "cpu"
        a, b = (wp.zeros((size, 4, 4), dtype=wp.float64, device=place) for _ in range(2))
        error = wp.zeros((size, 6), dtype=wp.float64, device=place)
        view = wp.array.numpy if device is None else wp.to_torch
        self._a, self._b = (view(array).reshape(pairs, count, 4, 4) for array in (a, b))
        self._error = view(error).reshape(pairs, count, 6)
        launch = partial(wp.launch, pose_errors, dim=size, inputs=[a, b], outputs=[error], device=place)
        self._launch = Recorded(launch) if device is None else launch

    def __call__(self, *pairs: tuple[Any, Any]) -> Any:
        """Displacements (pairs, B, 6) from the second pose of each pair to the first, world axes.

        Poses (B, 4, 4), or (4, 4) of one for all. The results are float64.
        """
        for k, (a, b) in enumerate(pairs):
            self._a[k], self._b[k] = a, b
        self._launch()
        return self._error.copy() if isinstance(self._error, np.ndarray) else self._error.clone()
