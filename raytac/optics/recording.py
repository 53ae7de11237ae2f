"""Calling frozen Dr.Jit functions safely."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["no_collection"]


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's garbage collector from running inside the block, where Dr.Jit may record kernels.

    An array made from NumPy memory on the CPU returns it by a host callback when it is freed. If the collector frees one while a frozen
    function is recorded, Dr.Jit 1.5 aborts the process ("enqueue_host_func(): this function cannot be recorded!"). Only reference
    cycles wait for the collector, and optical modes that are thrown away are such: they hold the recordings of their own methods.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
