"""Kernels that read and write numbers in the memory of MuJoCo's states."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

_MANY = wp.constant(0x7FFFFFFF)


@wp.struct
class Entries:
    """Places of numbers in B states, and in the result, as one structure, which launches faster."""

    places: wp.array2d(dtype=wp.uint64)
    """Addresses (B, members) of arrays of float64."""
    member: wp.array(dtype=wp.int32)
    """Of every entry; negative: the index itself is the number."""
    index: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.int32)
    stride: wp.array(dtype=wp.int32)
    """With ``start``, place of the entry of environment b: start + stride b."""
    values: wp.array(dtype=wp.float64)


@wp.kernel
def read_numbers(entries: Entries):
    """Copy entries of the members of B states to ``values``."""
    env = wp.tid()
    for k in range(entries.index.shape[0]):
        value = wp.float64(entries.index[k])
        if entries.member[k] >= 0:
            place = entries.places[env, entries.member[k]]
            value = wp.array(ptr=place, shape=(_MANY,), dtype=wp.float64)[entries.index[k]]
        entries.values[entries.start[k] + env * entries.stride[k]] = value


@wp.kernel
def write_numbers(
    places: wp.array(dtype=wp.uint64),
    index: wp.array(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
    chosen: wp.array(dtype=wp.int32),
):
    """Copy ``values`` (B, n) to entries of the arrays at ``places`` (B,) where ``chosen``."""
    env, k = wp.tid()
    if chosen[env] != 0:
        target = wp.array(ptr=places[env], shape=(_MANY,), dtype=wp.float64)
        target[index[k]] = values[env, k]
