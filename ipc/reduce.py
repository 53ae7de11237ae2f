"""Sums, minima and maxima of each environment's numbers, in a fixed order.

On CUDA a block of threads takes a strided share and adds it up in shared memory, and a second kernel adds the shares; on a CPU, where
Warp runs one thread after the other, one thread adds everything.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray

wp.set_module_options({"enable_backward": False})

BLOCK = 256
"""Threads of a block."""
SUM, MIN, MAX = 0, 1, 2
_MOST_CHUNKS = 16


def chunks_of(n: int) -> int:
    """Blocks that share n numbers of one environment."""
    return max(1, min(_MOST_CHUNKS, -(-n // BLOCK)))


@wp.func
def total_of(partial: FloatArray2d, env: wp.int32) -> wp.float64:
    """Sum of one row, in order."""
    total = wp.float64(0.0)
    for c in range(partial.shape[1]):
        total += partial[env, c]
    return total


@wp.func
def combined(a: wp.float64, b: wp.float64, kind: wp.int32) -> wp.float64:
    if kind == 1:
        return wp.min(a, b)
    if kind == 2:
        return wp.max(a, b)
    return a + b


@wp.func
def neutral(kind: wp.int32) -> wp.float64:
    if kind == 1:
        return wp.float64(wp.inf)
    if kind == 2:
        return -wp.float64(wp.inf)
    return wp.float64(0.0)


@wp.kernel
def reduce_in_order(values: FloatArray2d, count: IntArray, active: IntArray, kind: wp.int32, out: FloatArray):
    """One thread an environment: out ← out ∘ values[0] ∘ values[1] …"""
    env = wp.tid()
    if active[env] == 0:
        return
    total = neutral(kind)
    for i in range(wp.min(count[env], values.shape[1])):
        total = combined(total, values[env, i], kind)
    out[env] = combined(out[env], total, kind)


@wp.kernel
def reduce_blocks(values: FloatArray2d, count: IntArray, active: IntArray, kind: wp.int32, partial: FloatArray2d):
    """One block a share of an environment's numbers."""
    env, c, lane = wp.tid()
    total = neutral(kind)
    if active[env] != 0:
        n = wp.min(count[env], values.shape[1])
        i = c * BLOCK + lane
        while i < n:
            total = combined(total, values[env, i], kind)
            i += partial.shape[1] * BLOCK
    tile = wp.tile(total)
    if kind == 1:
        wp.tile_store(partial[env], wp.tile_min(tile), offset=c)
    elif kind == 2:
        wp.tile_store(partial[env], wp.tile_max(tile), offset=c)
    else:
        wp.tile_store(partial[env], wp.tile_sum(tile), offset=c)


@wp.kernel
def raise_if_any(flags: IntArray, flag: IntArray):
    """flag[0] = 1 if any of the flags is set; the caller has cleared it."""
    if flags[wp.tid()] != 0:
        flag[0] = 1


class Reducer:
    """Reductions over rows of ``longest`` numbers or fewer; calls allocate nothing.

    Args:
        longest: largest row.
    """

    def __init__(self, batch: int, longest: int, device: wp.Device) -> None:
        self.batch, self.device, self.longest = batch, device, longest
        self._partial = {
            c: wp.zeros((batch, c), dtype=wp.float64, device=device) for c in range(1, chunks_of(longest) + 1) if device.is_cuda
        }
        self._counts: dict[int, wp.array] = {}
        self.prepare(*self._partial)

    def _whole(self, n: int) -> wp.array:
        if n not in self._counts:
            self._counts[n] = wp.full(self.batch, n, dtype=wp.int32, device=self.device)
        return self._counts[n]

    def prepare(self, *lengths: int) -> None:
        """Prepare for rows of these lengths without a count, so that no recording allocates."""
        for n in lengths:
            self._whole(n)

    def __call__(self, values: wp.array, active: wp.array, kind: int, out: wp.array, count: wp.array | None = None) -> None:
        """out (B,) ← out ∘ the reduction of the first ``count`` (B,) of ``values`` (B, n), or all."""
        n = values.shape[1]
        if n == 0:
            return
        count = self._whole(n) if count is None else count
        if self.device.is_cuda:
            partial = self._partial[min(chunks_of(n), chunks_of(self.longest))]
            inputs, dim = [values, count, active, kind], (*partial.shape, BLOCK)
            wp.launch(reduce_blocks, dim=dim, inputs=inputs, outputs=[partial], device=self.device, block_dim=BLOCK)
            values, count = partial, self._whole(partial.shape[1])
        wp.launch(reduce_in_order, dim=self.batch, inputs=[values, count, active, kind], outputs=[out], device=self.device)
