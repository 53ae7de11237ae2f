"""Products of small matrices of many environments, on the CPU or on CUDA."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.gel import product_kernels as kernels
from raytac.warp_runtime import start_warp


@dataclass(frozen=True)
class Matrices:
    """Matrices of B environments, or one for all of them; float32, padded with zeros."""

    packets: wp.array
    """(B, padded rows, packets)."""
    padded: wp.array
    """The same number by number, (B, padded rows, padded columns)."""
    numbers: wp.array
    """The same without the padding, (B, rows, columns)."""
    shape: tuple[int, int]
    """Rows and columns."""

    @property
    def transposed(self) -> wp.array:
        """The padded matrices with rows and columns exchanged, in the same memory.

        They are for the left of a product.
        """
        return self.padded.transpose((0, 2, 1))


class Products:
    """Matrices of one device and their products; one may be common to all."""

    def __init__(self, num_envs: int, device: Any) -> None:
        start_warp()
        self.num_envs, self.device = num_envs, wp.get_device(device)
        self.lanes = kernels.CPU_LANES if self.device.is_cpu else kernels.CUDA_LANES
        self._spans: dict[int, wp.array] = {}
        self.all = wp.full(num_envs, value=1, dtype=wp.int32, device=self.device)
        """Mask in which every environment is active."""

    def zeros(self, rows: int, columns: int, num_envs: int | None = None) -> Matrices:
        """Matrices of zeros."""
        return self._matrices(np.zeros((self.num_envs if num_envs is None else num_envs, rows, columns), np.float32))

    def constant(self, matrix: np.ndarray) -> Matrices:
        """One matrix (rows, columns) for all environments."""
        return self._matrices(np.asarray(matrix, np.float32)[None])

    def blocks(self, field: Matrices) -> tuple[int, int, int]:
        """Threads of a kernel that computes ``ROWS`` rows together, and how many share a row."""
        count, lines, packets = field.packets.shape
        return count, lines // kernels.ROWS, 1 if self.device.is_cpu else packets

    def _matrices(self, values: np.ndarray) -> Matrices:
        count, rows, columns = values.shape
        lines, width = -(-rows // kernels.ROWS) * kernels.ROWS, -(-columns // self.lanes) * self.lanes
        filled = np.zeros((count, lines, width), np.float32)
        filled[:, :rows, :columns] = values
        padded: Any = wp.array(filled, dtype=wp.float32, device=self.device)
        packets: Any = wp.array(
            ptr=padded.ptr, shape=(count, lines, width // self.lanes), dtype=kernels.PACKETS[self.lanes], device=self.device
        )
        packets._numbers = padded  # whose memory it is
        return Matrices(packets, padded, padded[:, :rows, :columns], (rows, columns))

    def span(self, count: int) -> wp.array:
        """The whole of ``count`` rows or columns, for every environment."""
        if count not in self._spans:
            self._spans[count] = self.part(0, count)
        return self._spans[count]

    def part(self, first: int, end: int) -> wp.array:
        """Rows or columns from ``first`` to before ``end``, for every environment."""
        return wp.array(np.tile([first, end], (self.num_envs, 1)), dtype=wp.vec2i, device=self.device)

    def multiply(
        self,
        left: Matrices | wp.array,
        right: Matrices,
        out: Matrices,
        *,
        rows: wp.array | None = None,
        inner: wp.array | None = None,
        columns: wp.array | None = None,
        active: wp.array | None = None,
        adds: bool = False,
    ) -> None:
        """Launch out = left @ right, or out += left @ right.

        ``rows``, ``columns``: the part of ``out`` that is asked for; ``inner``: the part of the columns of ``left`` that is not 0, each
        (B,) of ``vec2i``, None for all. ``active``: environments (B,) that are computed. A ``transposed`` may be at the left.
        """
        dim = self.blocks(out)
        numbers: Any = left.padded if isinstance(left, Matrices) else left
        asked = (rows, out.shape[0]), (inner, right.shape[0]), (columns, out.shape[1])
        spans = [self.span(size) if one is None else one for one, size in asked]
        wp.launch(
            kernels.multiply,
            dim=dim,
            inputs=[self.all if active is None else active, numbers, right.packets, *spans, int(adds), dim[2], out.packets],
            device=self.device,
        )

    def sandwich(
        self, left: Matrices, core: Matrices, right: Matrices, spare: Matrices, out: Matrices, active: wp.array | None = None
    ) -> None:
        """Launch out = left @ core @ right, of all environments or of those ``active`` (B,).

        ``spare`` (rows of left, columns of core) is overwritten.
        """
        self.multiply(left, core, spare, active=active)
        self.multiply(spare, right, out, active=active)
