"""Memory of the device: what a computation with Dr.Jit takes at its peak, and how large a batch may be."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from raytac.errors import InputError

__all__ = ["ROUNDING", "check_batch", "largest_batch", "peak_bytes"]

ROUNDING = 2
"""Dr.Jit's allocator rounds every array up to a power of two of bytes, so that it takes at most twice its size."""
_LARGEST_ARRAY = 2**32 - 1
"""Dr.Jit indexes with 32 bits."""


def largest_batch(memory: int, per_env: int, values_per_env: int) -> int:
    """Most environments that one call may render.

    ``memory`` of the device and ``per_env`` that an environment takes at most [byte]; ``values_per_env``: length of its longest array.
    """
    return min(memory // per_env, _LARGEST_ARRAY // values_per_env)


def check_batch(envs: int, most: int, *, per_env: int, memory: int, device: str) -> None:
    """Refuse a batch that would not fit, before Dr.Jit ends the process over it.

    Raises:
        InputError: more than ``most`` environments; the message gives ``per_env`` and ``memory`` [byte].
    """
    if envs > most:
        rule = (
            f"must be at most {most}: an environment takes {per_env / 1e6:.1f} MB, this {device} has {memory / 1e9:.1f} GB "
            "and an array at most 2^32 values; render in parts"
        )
        raise InputError("number of environments", value=envs, rule=rule)


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
