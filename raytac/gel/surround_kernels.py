"""Kernels of ``DeviceSurround``, one thread a node.

They compute the overlap with the resting gel, Gaussians along rows and columns, contact and height. Environments without overlap are left
out of all but the last kernel.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TINY = wp.constant(wp.float32(1.1754944e-38))


@wp.kernel
def begin(
    under: wp.array3d(dtype=wp.float64),
    rest: wp.array2d(dtype=wp.float64),
    depths: wp.array2d(dtype=wp.float64),
    sound: wp.array(dtype=wp.bool),
    # outputs
    overlap: wp.array3d(dtype=wp.float32),
    field: wp.array3d(dtype=wp.float32),
    deepest: wp.array(dtype=wp.float32),
    pierced: wp.array(dtype=wp.int32),
):
    """Overlap u of bodies (greatest: ``depths``) and resting gel, and u⁺; 0 if not ``sound``."""
    env, j, i = wp.tid()
    if j == 0 and i == 0:
        most = wp.float64(0.0)
        if sound[env]:
            for body in range(depths.shape[1]):
                most = wp.max(most, depths[env, body])
        deepest[env] = wp.float32(most)
        pierced[env] = 0
    u = wp.float32(rest[j, i] - under[env, j, i])
    overlap[env, j, i] = u
    field[env, j, i] = wp.max(u, wp.float32(0.0))


@wp.kernel
def along_columns(
    weights: wp.array2d(dtype=wp.float32),
    band: wp.array(dtype=wp.vec2i),
    deepest: wp.array(dtype=wp.float32),
    field: wp.array3d(dtype=wp.float32),
    # outputs
    out: wp.array3d(dtype=wp.float32),
):
    """Σ_k weights[j, k] field[k, i] over the ``band`` of row j."""
    env, j, i = wp.tid()
    if deepest[env] <= wp.float32(0.0):
        return
    total, span = wp.float32(0.0), band[j]
    for k in range(span[0], span[1]):
        total += weights[j, k] * field[env, k, i]
    out[env, j, i] = total


@wp.kernel
def along_rows(
    weights: wp.array2d(dtype=wp.float32),
    band: wp.array(dtype=wp.vec2i),
    deepest: wp.array(dtype=wp.float32),
    field: wp.array3d(dtype=wp.float32),
    overlap: wp.array3d(dtype=wp.float32),
    imposes: wp.int32,
    # outputs
    out: wp.array3d(dtype=wp.float32),
):
    """Σ_k weights[k, i] field[j, k] over column i's ``band``, or more if it ``imposes`` contact."""
    env, j, i = wp.tid()
    if deepest[env] <= wp.float32(0.0):
        return
    total, span = wp.float32(0.0), band[i]
    for k in range(span[0], span[1]):
        total += weights[k, i] * field[env, j, k]
    if imposes != 0:
        total = wp.max(total, overlap[env, j, i])
    out[env, j, i] = total


@wp.kernel
def touch(
    overlap: wp.array3d(dtype=wp.float32),
    field: wp.array3d(dtype=wp.float32),
    deepest: wp.array(dtype=wp.float32),
    rounding: wp.float32,
    # outputs
    contact: wp.array3d(dtype=wp.uint8),
):
    """1 where the displacement is the overlap, up to ``rounding`` of the deepest."""
    env, j, i = wp.tid()
    u, result = overlap[env, j, i] + wp.float32(0.0), wp.uint8(0)
    if deepest[env] > wp.float32(0.0) and u > wp.float32(0.0):
        if field[env, j, i] <= u + wp.max(rounding * deepest[env], _TINY):
            result = wp.uint8(1)
    contact[env, j, i] = result


@wp.kernel
def lift_off(
    rest: wp.array2d(dtype=wp.float64),
    field: wp.array3d(dtype=wp.float32),
    deepest: wp.array(dtype=wp.float32),
    lowest: wp.float32,
    # outputs
    height: wp.array3d(dtype=wp.float32),
    pierced: wp.array(dtype=wp.int32),
):
    """Heights rest − w; ``pierced``: environments in which one is below ``lowest``."""
    env, j, i = wp.tid()
    z = wp.float32(rest[j, i])
    if deepest[env] > wp.float32(0.0):
        z = z - field[env, j, i]
        if z < lowest:
            pierced[env] = 1
    height[env, j, i] = z


@wp.kernel
def without_pierced(
    rest: wp.array2d(dtype=wp.float64),
    pierced: wp.array(dtype=wp.int32),
    # outputs
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
):
    """Environments that are ``pierced`` are at rest."""
    env, j, i = wp.tid()
    if pierced[env] != 0:
        height[env, j, i] = wp.float32(rest[j, i])
        contact[env, j, i] = wp.uint8(0)
