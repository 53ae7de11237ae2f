"""``DeviceSurround``: the elastic surround of many small pads, without the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel import surround_kernels as kernels
from raytac.gel.gaussian import fast_gaussian_matrix
from raytac.gel.pyramid import FINAL_SIGMA, FINEST, PYRAMID_SIGMAS, ROUNDING
from raytac.gel.surface import PadGrid
from raytac.warp_runtime import start_warp

_NEGLIGIBLE = 1e-7
"""Weight over the peak's that is left out."""
_FACE = 1e-8
"""Rounding of a height in float32, and some [m]."""


class DeviceSurround:
    """``ElasticSurround`` with the unilateral rule on the CPU or on CUDA.

    Gaussians are products with matrices along both axes, as wide as their weights matter.

    Attributes:
        height: [m], (B, Ny, Nx), float32; at rest where nothing touches, and in environments that are not sound or are pierced.
        contact: 1 where a body touches, (B, Ny, Nx), uint8.
        pierced: 1 in environments whose gel would lie below its bonded face, (B,), int32.
    """

    def __init__(self, grid: PadGrid, thickness: float, *, num_envs: int, device: str = "cpu") -> None:
        """``grid``: nodes of the pad; ``thickness`` of its gel [m]."""
        start_warp()
        self.device, shape = wp.get_device(device), (num_envs, *grid.shape)
        finest = FINEST * min(grid.pitch)
        self._passes = [self._matrices(grid, sigma) for sigma in PYRAMID_SIGMAS if sigma > finest]
        self._final = [self._matrices(grid, FINAL_SIGMA)] if finest < FINAL_SIGMA else []
        self._rest = wp.array(grid.rest, dtype=wp.float64, device=self.device)
        self._lowest = float(-thickness - _FACE)
        self._overlap, self._field, self._spare, self.height = (
            wp.zeros(shape, dtype=wp.float32, device=self.device) for _ in range(4)
        )
        self._deepest = wp.zeros(num_envs, dtype=wp.float32, device=self.device)
        self.contact = wp.zeros(shape, dtype=wp.uint8, device=self.device)
        self.pierced = wp.zeros(num_envs, dtype=wp.int32, device=self.device)

    def launch(self, under: wp.array, depths: wp.array, sound: wp.array) -> None:
        """Launch the kernels; nothing waits for the device.

        Args:
            under: undersides (B, Ny, Nx) of bodies [m], float64, inf where there is none.
            depths: greatest overlap of each body with the resting gel (B, bodies) [m], float64; 0 or less without.
            sound: environments that have not broken down, (B,), bool.
        """
        begun = [under, self._rest, depths, sound, self._overlap, self._field, self._deepest, self.pierced]
        self._launch(kernels.begin, begun)
        for matrices in self._passes:
            self._smooth(matrices, imposes=True)
        self._launch(kernels.touch, [self._overlap, self._field, self._deepest, ROUNDING, self.contact])
        for matrices in self._final:
            self._smooth(matrices, imposes=False)
        self._launch(kernels.lift_off, [self._rest, self._field, self._deepest, self._lowest, self.height, self.pierced])
        self._launch(kernels.without_pierced, [self._rest, self.pierced, self.height, self.contact])

    def _smooth(self, matrices: list[tuple[wp.array, wp.array]], *, imposes: bool) -> None:
        (down, down_band), (across, across_band) = matrices
        self._launch(kernels.along_columns, [down, down_band, self._deepest, self._field, self._spare])
        rows = [across, across_band, self._deepest, self._spare, self._overlap, int(imposes), self._field]
        self._launch(kernels.along_rows, rows)

    def _matrices(self, grid: PadGrid, sigma: float) -> list[tuple[wp.array, wp.array]]:
        """Weights and their bands along y and, transposed, along x."""
        result = []
        for k, (nodes, pitch) in enumerate(zip(grid.shape, reversed(grid.pitch), strict=True)):
            matrix = fast_gaussian_matrix(nodes, sigma / pitch)
            used = np.abs(matrix) > _NEGLIGIBLE * np.abs(matrix).max()
            band = np.stack([used.argmax(axis=1), nodes - used[:, ::-1].argmax(axis=1)], axis=1)
            # Neighbouring threads read neighbouring weights.
            weights = np.ascontiguousarray(matrix.T if k else matrix, np.float32)
            arrays = wp.array(weights, dtype=wp.float32, device=self.device), wp.array(band, dtype=wp.vec2i, device=self.device)
            result.append(arrays)
        return result

    def _launch(self, kernel: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=self.height.shape, inputs=inputs, device=self.device)
