"""Kernels of ``DeviceVariation``: numbers that factors multiply, and mountings of pads."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def scale_columns(
    chosen: wp.array(dtype=wp.bool),
    factors: wp.array2d(dtype=wp.float64),
    which: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    nominal: wp.array(dtype=wp.float64),
    divides: wp.int32,
    # outputs
    values: wp.array2d(dtype=Any),
):
    """Set columns (n,) of ``values`` (B, …): nominal (n,) times, or over, factors ``which``."""
    i, k = wp.tid()
    if chosen[i]:
        factor = factors[i, which[k]]
        value = wp.where(divides != 0, nominal[k] / factor, nominal[k] * factor)
        values[i, columns[k]] = values.dtype(value)


@wp.kernel
def mount_pads(
    chosen: wp.array(dtype=wp.bool),
    mounting: wp.array4d(dtype=wp.float64),
    bodies: wp.array(dtype=wp.int32),
    nominal: wp.array(dtype=wp.mat44d),
    # outputs
    place: wp.array2d(dtype=wp.vec3),
    turn: wp.array2d(dtype=wp.quat),
):
    """Poses of bodies (pads,) under pads: nominal ones times ``mounting`` (B, pads, 4, 4)."""
    i, k = wp.tid()
    if not chosen[i]:
        return
    shift = wp.mat44d()
    for row in range(4):
        for column in range(4):
            shift[row, column] = mounting[i, k, row, column]
    pose = nominal[k] * shift
    rotation = wp.mat33d()
    for row in range(3):
        for column in range(3):
            rotation[row, column] = pose[row, column]
    q = wp.quat_from_matrix(rotation)
    place[i, bodies[k]] = wp.vec3(wp.float32(pose[0, 3]), wp.float32(pose[1, 3]), wp.float32(pose[2, 3]))
    # MuJoCo's quaternions begin with the real part.
    turn[i, bodies[k]] = wp.quat(wp.float32(q[3]), wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]))
