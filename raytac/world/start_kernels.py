"""Kernels that put environments on the device to where an episode starts, and hand on masks."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def place_body(
    poses: wp.array3d(dtype=wp.float64),
    address: wp.int32,
    # outputs
    qpos: wp.array2d(dtype=wp.float32),
):
    """Write poses (B, 4, 4) of a free body from ``address`` on, as place and quaternion."""
    i = wp.tid()
    turn = wp.mat33d()
    for row in range(3):
        qpos[i, address + row] = wp.float32(poses[i, row, 3])
        for column in range(3):
            turn[row, column] = poses[i, row, column]
    q = wp.quat_from_matrix(turn)
    qpos[i, address + 3] = wp.float32(q[3])
    for k in range(3):
        qpos[i, address + 4 + k] = wp.float32(q[k])


@wp.kernel
def aim_at_positions(
    chosen: wp.array(dtype=wp.bool),
    joints: wp.array(dtype=wp.int32),
    qpos: wp.array2d(dtype=wp.float32),
    # outputs
    target: wp.array2d(dtype=wp.float64),
    target_speed: wp.array2d(dtype=wp.float64),
):
    """Let joints (n,), by address, of ``chosen`` environments hold where ``qpos`` has them."""
    i, k = wp.tid()
    if chosen[i]:
        target[i, k] = wp.float64(qpos[i, joints[k]])
        target_speed[i, k] = wp.float64(0.0)


@wp.kernel
def set_columns(
    chosen: wp.array(dtype=wp.bool),
    values: wp.array(dtype=wp.float64),
    # outputs
    rows: wp.array2d(dtype=wp.float64),
):
    """Set rows (B, n) of the environments that are ``chosen`` to ``values`` (n,)."""
    i, k = wp.tid()
    if chosen[i]:
        rows[i, k] = values[k]


@wp.kernel
def lose_marked(marked: wp.array(dtype=wp.int32), active: wp.array(dtype=wp.bool)):
    """Environments that are marked (B,) are no longer active."""
    i = wp.tid()
    if marked[i] != 0:
        active[i] = False
