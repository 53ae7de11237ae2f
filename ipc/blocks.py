"""Threads of a block, which share one environment; on a CPU a block is one thread."""

# pyright: reportArgumentType=false, reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

THREADS = 256
"""Threads of a block on CUDA; twice as many would not fit, for the registers they need."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block():
    """Every thread's writes are there for the whole block after this; on a CPU a block is one."""
    ...


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the threads of the block, in a fixed order; every thread gets it."""
    return wp.tile_extract(wp.tile_sum(wp.tile(value)), 0)


@wp.func
def block_max(value: wp.float64) -> wp.float64:
    """The largest of the threads' values."""
    return wp.tile_extract(wp.tile_max(wp.tile(value)), 0)
