"""How much memory of the device a computation with Dr.Jit needs at its peak."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

__all__ = ["peak_bytes"]


def peak_bytes(call: Callable[[], object], device: str) -> int:
    """Most bytes that Dr.Jit's arrays took during ``call`` beyond those that it held before; 0 if ``call`` uses no Dr.Jit.

    The allocator's cache is emptied first, so that memory kept from earlier work does not hide what the call needs; that makes the next
    calls slower. Acceleration structures of the ray tracer (Embree, OptiX) are not Dr.Jit arrays and not counted.
    """
    backend = dr.JitBackend.CUDA if device == "cuda" else dr.JitBackend.LLVM
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(backend)
    call()
    dr.sync_thread()
    return dr.detail.malloc_watermark(backend) - before
