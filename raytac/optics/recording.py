"""Calling frozen Dr.Jit functions safely.

A recording is replayed with other inputs, so what follows must be the same at every call of one recorded function:

- **The width of every array that it makes.** An array of one value is compiled as a scalar, and a replay reads it as one however long it
  has become. So there is no ``dr.compress`` in a recorded function, whose width comes from values; whatever else sets a width (number of
  environments, of markers, of contacts) is part of the key that recordings are kept by.
- **Which inputs lie on the same memory.** Dr.Jit tells arrays apart by their address, and on the CPU those made from NumPy arrays lie on
  NumPy's memory. So an input that is kept is a copy: a surface may lie on the same memory as the grid's heights at rest.

Dr.Jit itself makes another recording where an input is a literal, of another alignment, or where two inputs are one variable.
"""

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
