"""Environments that take a step, and those that forget what they went through, in Warp."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.shear_kernels import clear_shear
from raytac.physics.rigid.world_kernels import Shear, Steps

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_NAN = wp.constant(wp.float64(float("nan")))


@wp.kernel
def choose_active(active: wp.array(dtype=wp.bool), steps: Steps):
    """Let row i of the next step be environment i where ``active``, else none, at tick 0."""
    i = wp.tid()
    steps.envs[i] = wp.where(active[i], i, -1)
    steps.done[i] = 0


@wp.kernel
def clear_environments(
    mask: wp.array(dtype=wp.bool),
    # outputs
    shear: Shear,
    before: wp.array3d(dtype=wp.mat44d),
    acceleration: wp.array3d(dtype=wp.float64),
    rolling: wp.array3d(dtype=wp.vec2d),
    wrenches: wp.array2d(dtype=wp.spatial_vectord),
):
    """Forget contacts, poses of the last step and wrenches of the environments of a mask (B,)."""
    env, pad, body = wp.tid()
    if not mask[env]:
        return
    clear_shear(shear, env, pad, body)
    acceleration[env, pad, body] = _0
    rolling[env, pad, body] = wp.vec2d()
    if body < before.shape[2]:
        pose = wp.mat44d()
        for k in range(4):
            for m in range(4):
                pose[k, m] = _NAN
        before[env, pad, body] = pose
    if body == 0:
        wrenches[env, pad] = wp.spatial_vectord()
