"""Copies of large batches by several threads.

Fresh memory takes longer to get than to write; threads get it side by side.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from raytac.device import cpu_cores

LARGE = 1 << 23
"""Bytes from which a copy is divided."""
MOST_THREADS = 8


def copy_of(values: np.ndarray) -> np.ndarray:
    """A contiguous copy of a batch, whose first axis is divided among threads if it is large."""
    if values.nbytes < LARGE or len(values) < 2:
        return np.array(values, order="C")
    out = np.empty(values.shape, values.dtype)
    parts = min(cpu_cores(), MOST_THREADS, len(values))
    edges = np.linspace(0, len(values), parts + 1).astype(int)
    with ThreadPoolExecutor(parts) as pool:  # NumPy copies without Python's lock
        for done in [pool.submit(np.copyto, out[a:b], values[a:b]) for a, b in pairwise(edges)]:
            done.result()
    return out
