"""Products of small matrices on the calling thread."""

from __future__ import annotations

import numpy as np

_ONE_THREAD = 250_000
"""Multiply-adds in one product: OpenBLAS wakes its threads above 262,144.

For work so small that costs more than it saves. Below it the result does not depend on the number of threads either."""


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a @ b, float32 or float64, in pieces small enough to stay on the calling thread."""
    (rows, inner), columns = a.shape, b.shape[1]
    if rows * inner * columns <= _ONE_THREAD:
        return a @ b
    out = np.empty((rows, columns), a.dtype)
    if rows >= columns:
        step = max(_ONE_THREAD // (inner * columns), 1)
        for start in range(0, rows, step):
            np.matmul(a[start : start + step], b, out=out[start : start + step])
    else:
        step = max(_ONE_THREAD // (inner * rows), 1)
        for start in range(0, columns, step):
            np.matmul(a, b[:, start : start + step], out=out[:, start : start + step])
    return out


def sandwich(rows: np.ndarray, core: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """rows @ core @ columns, float32."""
    return product(product(rows, core.astype(np.float32)), columns)
