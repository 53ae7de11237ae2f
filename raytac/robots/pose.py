"""Poses as 4 × 4 matrices, checked, and what MuJoCo's data say about a site."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.checks import check_numbers
from raytac.errors import InputError
from raytac.se3 import rotation_vector

__all__ = ["body_poses", "check_pose", "pose", "pose_error", "site_poses", "world_from_site"]

_ORTHONORMAL = 1e-6
"""How far RᵀR of a rotation may be from 1."""


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """``target_from_source`` (4, 4) from a rotation matrix (3, 3) and a position (3,) [m]."""
    matrix = np.zeros((4, 4))  # np.eye takes three times as long
    matrix[:3, :3], matrix[:3, 3], matrix[3, 3] = rotation, position, 1.0
    return matrix


def check_pose(name: str, value: np.ndarray) -> np.ndarray:
    """``value`` as a float64 (4, 4) rigid transform. Raises ``InputError``, naming ``name``, if it is none."""
    matrix = check_numbers(name, value, (4, 4), finite=True)
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ORTHONORMAL:
        raise InputError(name, value=matrix[3].tolist(), rule="must have the last row 0, 0, 0, 1")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise InputError(name, value=rotation.tolist(), rule="must hold a rotation: orthonormal columns, determinant +1")
    return matrix


def world_from_site(data: mujoco.MjData, site: int) -> np.ndarray:
    """Pose (4, 4) of a site by its index, as the last ``mj_kinematics`` (or step) left it."""
    return pose(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])


def site_poses(datas: Sequence[mujoco.MjData], site: int | np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) of a site in many states, as the last ``mj_kinematics`` (or step) left them; (B, n, 4, 4) of n sites."""
    return _poses([data.site_xmat[site] for data in datas], [data.site_xpos[site] for data in datas])


def body_poses(datas: Sequence[mujoco.MjData], body: int | np.ndarray) -> np.ndarray:
    """The same of a body, or of several."""
    return _poses([data.xmat[body] for data in datas], [data.xpos[body] for data in datas])


def _poses(rotations: Sequence[np.ndarray], positions: Sequence[np.ndarray]) -> np.ndarray:
    place = np.array(positions)
    found = np.zeros((*place.shape[:-1], 4, 4))
    found[..., :3, :3] = np.reshape(rotations, (*place.shape, 3))
    found[..., :3, 3] = place
    found[..., 3, 3] = 1.0
    return found


def pose_error(world_from_a: np.ndarray, world_from_b: np.ndarray) -> np.ndarray:
    """What leads from b to a (…, 6), in world axes: p_a − p_b [m] and the rotation vector log(R_a R_bᵀ) [rad], at most π long.

    Poses (…, 4, 4) that broadcast.
    """
    turn = rotation_vector(world_from_a[..., :3, :3] @ np.swapaxes(world_from_b[..., :3, :3], -1, -2))
    return np.concatenate([world_from_a[..., :3, 3] - world_from_b[..., :3, 3], turn], axis=-1)
