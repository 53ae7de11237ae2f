"""Poses of sites and bodies in MuJoCo's states, of the last ``mj_kinematics`` or step."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.se3 import pose


def world_from_site(data: mujoco.MjData, site: int) -> np.ndarray:
    """Pose (4, 4) of a site by its index."""
    return pose(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])


def site_poses(datas: Sequence[mujoco.MjData], site: int | np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) of a site in B states; (B, n, 4, 4) of n sites."""
    return _poses([data.site_xmat[site] for data in datas], [data.site_xpos[site] for data in datas])


def body_poses(datas: Sequence[mujoco.MjData], body: int | np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) of a body in B states; (B, n, 4, 4) of n bodies."""
    return _poses([data.xmat[body] for data in datas], [data.xpos[body] for data in datas])


def _poses(rotations: Sequence[np.ndarray], positions: Sequence[np.ndarray]) -> np.ndarray:
    position = np.array(positions)
    result = np.zeros((*position.shape[:-1], 4, 4))
    result[..., :3, :3] = np.reshape(rotations, (*position.shape, 3))
    result[..., :3, 3] = position
    result[..., 3, 3] = 1.0
    return result
