"""Kernels of ``Products``: products of matrices of every environment, within windows.

A row is a row of packets, vectors of neighbouring numbers. A thread computes a packet in each of ``ROWS`` rows, so that what it reads is
used as often.

Here and in the kernels of soft pads, loops that take time count with ``while``, from a number that the compiler sees is not negative. On
the CPU Warp's ``for`` over a range that is known only when it runs takes longer than the arithmetic in it, and so does the test of every
index for a negative one.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

ROWS = 4
"""Rows that a thread computes together."""
CPU_LANES, CUDA_LANES = 16, 4
"""Numbers in a packet: two vector registers of AVX2, one load of CUDA."""
PACKETS = {lanes: wp.types.vector(length=lanes, dtype=wp.float32) for lanes in (CPU_LANES, CUDA_LANES)}
"""Types of packets.

Kernels for both are compiled together, since a recording does not outlive its module."""


@wp.kernel
def multiply(
    active: wp.array(dtype=wp.int32),
    left: wp.array3d(dtype=wp.float32),
    right: wp.array3d(dtype=Any),
    rows: wp.array(dtype=wp.vec2i),
    inner: wp.array(dtype=wp.vec2i),
    columns: wp.array(dtype=wp.vec2i),
    adds: wp.int32,
    threads: wp.int32,
    # outputs
    out: wp.array3d(dtype=Any),
):
    """Σ_k left[j, k] right[k, p] over the ``inner`` k, of ``ROWS`` rows j.

    By (environment, block of rows, thread).
    ``left`` or ``right`` may have one matrix for all environments. ``rows``, ``inner``, ``columns``: from and to, of each environment;
    at least these rows and columns of ``out`` are written. ``adds``: 1 to add to what is there.
    """
    env, block, thread = wp.tid()
    j = block * ROWS
    span = rows[env]
    if active[env] == 0 or j + ROWS <= span[0] or j >= span[1]:
        return
    none = out.dtype()
    lanes = wp.int32(len(none))
    a_env, b_env = wp.min(env, left.shape[0] - 1), wp.min(env, right.shape[0] - 1)
    first, last = columns[env][0] // lanes, (columns[env][1] + lanes - 1) // lanes
    low, high = wp.max(inner[env][0], 0), inner[env][1]
    for p in range(first + thread, last, threads):
        a, b, c, d = out.dtype(), out.dtype(), out.dtype(), out.dtype()
        if adds != 0:
            a += out[env, j, p]
            b += out[env, j + 1, p]
            c += out[env, j + 2, p]
            d += out[env, j + 3, p]
        k = low + 0
        while k < high:
            w = right[b_env, k, p]
            a += left[a_env, j, k] * w
            b += left[a_env, j + 1, k] * w
            c += left[a_env, j + 2, k] * w
            d += left[a_env, j + 3, k] * w
            k += 1
        out[env, j, p] = a
        out[env, j + 1, p] = b
        out[env, j + 2, p] = c
        out[env, j + 3, p] = d


for _packet in PACKETS.values():
    wp.overload(multiply, {"right": wp.array3d(dtype=_packet), "out": wp.array3d(dtype=_packet)})
