"""Poses as 4 × 4 matrices, checked, and what MuJoCo's data say about a site."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module names its types at run time.)

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.errors import InputError

__all__ = ["body_poses", "check_pose", "pose", "pose_error", "quaternion", "rotation_vector", "site_poses", "world_from_site"]

_ORTHONORMAL = 1e-6
"""How far RᵀR of a rotation may be from 1."""


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """``target_from_source`` (4, 4) from a rotation matrix (3, 3) and a position (3,) [m]."""
    matrix = np.zeros((4, 4))  # np.eye takes three times as long
    matrix[:3, :3], matrix[:3, 3], matrix[3, 3] = rotation, position, 1.0
    return matrix


def check_pose(name: str, value: np.ndarray) -> np.ndarray:
    """``value`` as a float64 (4, 4) rigid transform. Raises ``InputError``, naming ``name``, if it is none."""
    try:
        matrix = np.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise InputError(name, value=value, rule="must be a 4 x 4 matrix target_from_source") from error
    if matrix.shape != (4, 4):
        raise InputError(name, value=matrix.shape, rule="must have the shape (4, 4) of a matrix target_from_source")
    if not np.isfinite(matrix).all():
        raise InputError(name, value=matrix.tolist(), rule="must be finite")
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ORTHONORMAL:
        raise InputError(name, value=matrix[3].tolist(), rule="must have the last row 0, 0, 0, 1")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise InputError(name, value=rotation.tolist(), rule="must hold a rotation: orthonormal columns, determinant +1")
    return matrix


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion w, x, y, z (4,) of a rotation matrix (3, 3)."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation, float).ravel())
    return result


def world_from_site(data: mujoco.MjData, site: int) -> np.ndarray:
    """Pose (4, 4) of a site by its index, as the last ``mj_kinematics`` (or step) left it."""
    return pose(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])


def site_poses(datas: Sequence[mujoco.MjData], site: int) -> np.ndarray:
    """Poses (B, 4, 4) of a site in many states, as the last ``mj_kinematics`` (or step) left them."""
    return _poses([data.site_xmat[site] for data in datas], [data.site_xpos[site] for data in datas])


def body_poses(datas: Sequence[mujoco.MjData], body: int) -> np.ndarray:
    """The same of a body."""
    return _poses([data.xmat[body] for data in datas], [data.xpos[body] for data in datas])


def _poses(rotations: Sequence[np.ndarray], positions: Sequence[np.ndarray]) -> np.ndarray:
    found = np.zeros((len(rotations), 4, 4))
    found[:, :3, :3] = np.reshape(rotations, (-1, 3, 3))
    found[:, :3, 3] = np.reshape(positions, (-1, 3))
    found[:, 3, 3] = 1.0
    return found


def pose_error(world_from_a: np.ndarray, world_from_b: np.ndarray) -> np.ndarray:
    """What leads from b to a (…, 6), in world axes: p_a − p_b [m] and the rotation vector log(R_a R_bᵀ) [rad], at most π long.

    Poses (…, 4, 4) that broadcast.
    """
    turn = rotation_vector(world_from_a[..., :3, :3] @ np.swapaxes(world_from_b[..., :3, :3], -1, -2))
    return np.concatenate([world_from_a[..., :3, 3] - world_from_b[..., :3, 3], turn], axis=-1)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """log R (…, 3) [rad] of rotation matrices (…, 3, 3), at most π long.

    By way of the unit quaternion, of which the component is rooted that is greatest (S. W. Shepperd, "Quaternion from rotation matrix",
    J. Guid. Control 1(3), 1978), so that it is as accurate at no turn as at half a turn.
    """
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    x, y, z = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, yz, zx = r[..., 0, 1] + r[..., 1, 0], r[..., 1, 2] + r[..., 2, 1], r[..., 2, 0] + r[..., 0, 2]
    # Row k is the quaternion (w, x, y, z) times four times its k-th component.
    rows = (
        (1.0 + xx + yy + zz, x, y, z),
        (x, 1.0 + xx - yy - zz, xy, zx),
        (y, xy, 1.0 - xx + yy - zz, yz),
        (z, zx, yz, 1.0 - xx - yy + zz),
    )
    products = np.stack([entry for row in rows for entry in row], axis=-1).reshape(*x.shape, 4, 4)
    greatest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(products, greatest[..., None, None], axis=-2)[..., 0, :]
    q = q * np.where(q[..., :1] < 0.0, -1.0, 1.0) / np.sqrt(np.square(q).sum(axis=-1, keepdims=True))
    sine = np.sqrt(np.square(q[..., 1:]).sum(axis=-1, keepdims=True))
    # θ / sin(θ/2), 2 where there is no turn
    factor = np.where(sine > 0.0, 2.0 * np.arctan2(sine, q[..., :1]) / np.where(sine > 0.0, sine, 1.0), 2.0)
    return factor * q[..., 1:]
