"""What callers may pass for every environment: values, poses, and which environments are meant."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipc.errors import IpcError

__all__ = ["env_mask", "per_env", "unit_pose"]

Floats = NDArray[np.float64]


def per_env(values: ArrayLike, shape: tuple[int, ...], what: str, num_envs: int) -> NDArray:
    """Finite values of a shape, the same for every environment or with the environment first; (B, \\*shape)."""
    array = np.asarray(values, dtype=float)
    if array.shape not in (shape, (num_envs, *shape)):
        raise IpcError(f"{what} has shape {array.shape}: it must be {shape} or {(num_envs, *shape)}")
    if not np.isfinite(array).all():
        raise IpcError(f"{what} = {array}: it must be finite")
    return np.broadcast_to(array, (num_envs, *shape))


def unit_pose(position: ArrayLike | None, rotation: ArrayLike | None, num_envs: int) -> tuple[Floats | None, Floats | None]:
    """Position (B, 3) and unit quaternion (w, x, y, z) (B, 4) of every environment, where given."""
    p = None if position is None else per_env(position, (3,), "position", num_envs)
    if rotation is None:
        return p, None
    q = per_env(rotation, (4,), "rotation", num_envs)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.allclose(length, 1, atol=1e-6):
        raise IpcError(f"rotation = {rotation}: a quaternion (w, x, y, z) must have length 1")
    return p, q / length


def env_mask(envs: ArrayLike | None, num_envs: int) -> NDArray[np.bool_]:
    """A mask (B,) from a mask, a list of environments, or None for all."""
    if envs is None:
        return np.ones(num_envs, bool)
    chosen = np.asarray(envs)
    if chosen.dtype == bool:
        if chosen.shape != (num_envs,):
            raise IpcError(f"envs is a mask of shape {chosen.shape}: it must be ({num_envs},)")
        return chosen.copy()
    if chosen.size and not np.issubdtype(chosen.dtype, np.integer):
        raise IpcError(f"envs = {envs}: give a mask or whole numbers")
    if chosen.size and (chosen.min() < 0 or chosen.max() >= num_envs):
        raise IpcError(f"envs names environments {chosen.min()} to {chosen.max()}: there are {num_envs}")
    mask = np.zeros(num_envs, bool)
    mask[chosen.astype(int)] = True
    return mask
