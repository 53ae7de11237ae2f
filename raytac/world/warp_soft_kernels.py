"""Kernels between MuJoCo Warp and the contact solver.

Wrenches on links, and poses of the solver's bodies.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def write_wrenches(
    bodies: wp.array(dtype=wp.int32), applied: wp.array3d(dtype=wp.float64),
    # outputs
    xfrc: wp.array2d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Copy wrenches (B, n, 6) about centres of mass to ``xfrc_applied`` of ``bodies`` (n,)."""
    env, k = wp.tid()
    w = wp.spatial_vector()
    for i in range(6):
        w[i] = wp.float32(applied[env, k, i])
    xfrc[env, bodies[k]] = w


@wp.kernel
def mirror_bodies(
    chosen: wp.array(dtype=wp.int32), solver: wp.array(dtype=wp.int32), mocap: wp.array(dtype=wp.int32),
    position: wp.array3d(dtype=wp.float64), rotation: wp.array4d(dtype=wp.float64),
    # outputs
    place: wp.array2d(dtype=wp.vec3), turn: wp.array2d(dtype=wp.quat),
):  # fmt: skip
    """Copy poses of the solver's bodies to mocap bodies, in the environments ``chosen`` (B,)."""
    env, k = wp.tid()
    if chosen[env] == 0:
        return
    body = solver[k] + 0
    matrix, at = wp.mat33d(), wp.vec3()
    for i in range(3):
        at[i] = wp.float32(position[env, body, i])
        for j in range(3):
            matrix[i, j] = rotation[env, body, i, j]
    q = wp.quat_from_matrix(matrix)
    place[env, mocap[k]] = at
    # MuJoCo's order is w, x, y, z.
    turn[env, mocap[k]] = wp.quat(wp.float32(q[3]), wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]))
