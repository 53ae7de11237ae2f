"""Forces on vertices in contact that hold a linear mesh, in B pads."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.products import Products
from raytac.physics.soft.correction import force_kernels as kernels


class VertexForces:
    """Linear systems over the unknowns in contact, a part of one matrix that all pads share.

    Attributes:
        unknowns: to choose: how many are in contact, and which.
        can_move: 1 where an unknown moves at all under a force, (n,), int32.
        wanted: displacements to reach [m], (B, n), float64.
        forces: that reach them [N], (B, n), float64; 0 where nothing is in contact.
    """

    def __init__(self, matrix: np.ndarray, products: Products) -> None:
        """``matrix``: compliance (n, n) [m/N], symmetric."""
        self._device, (n, _), count = products.device, matrix.shape, products.num_envs
        self._matrix = wp.array(np.ascontiguousarray(matrix), dtype=wp.float64, device=self._device)
        self.can_move = wp.array(np.diagonal(matrix) > 0.0, dtype=wp.int32, device=self._device)
        unknowns: Any = kernels.Unknowns()
        unknowns.count = wp.zeros(count, dtype=wp.int32, device=self._device)
        unknowns.index = wp.zeros((count, n), dtype=wp.int32, device=self._device)
        self.unknowns = unknowns
        self.wanted, self.forces, self._r, self._p, self._Ap, self._moved = (
            wp.zeros((count, n), dtype=wp.float64, device=self._device) for _ in range(6)
        )

    def wanted_from(self, values: wp.array, component: int) -> None:
        """Launch that one component of ``values`` (B, C, n) [m] is wanted."""
        inputs = [values, component, self.wanted]
        wp.launch(kernels.take_component, dim=self.wanted.shape, inputs=inputs, device=self._device)

    def solve(self, tolerance: float, most: int) -> None:
        """Launch the solution, to a residual below ``tolerance`` [m], in at most so many steps."""
        threads = 1 if self._device.is_cpu else kernels.THREADS
        wp.launch(
            kernels.solve_in_one_block,
            dim=(len(self.wanted), threads),
            inputs=[self._matrix, self.unknowns, self.wanted, tolerance, most, threads, self._r, self._p, self._Ap, self.forces],
            device=self._device,
            block_dim=threads,
        )

    def response(self) -> wp.array:
        """Launch what the mesh does under ``forces`` [m], (B, n), float64."""
        inputs = [self._matrix, self.unknowns, self.forces, self._moved]
        wp.launch(kernels.respond, dim=self._moved.shape, inputs=inputs, device=self._device)
        return self._moved
