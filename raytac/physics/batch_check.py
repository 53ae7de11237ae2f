"""Checks of what a batch is given: poses with or without the axis of environments."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from raytac.errors import InputError

__all__ = ["batch_of", "rigid_poses"]


def batch_of(world_from_pad: ArrayLike, axes: int, bodies: Mapping[str, ArrayLike]) -> int:
    """Environments that poses with a first axis speak of; 1 if none has one."""
    given = [np.shape(world_from_pad)] if np.ndim(world_from_pad) == axes else []
    given += [np.shape(pose) for pose in bodies.values() if np.ndim(pose) == axes - 1]
    return given[0][0] if given else 1


def rigid_poses(what: str, values: ArrayLike, batch: int, count: int | None = None) -> np.ndarray:
    """Rigid transforms (B, 4, 4), or (B, count, 4, 4), from these with or without the first axis; raises ``InputError``."""
    array = np.asarray(values, float)
    shape = (4, 4) if count is None else (count, 4, 4)
    if array.shape not in (shape, (batch, *shape)):
        raise InputError(what, value=array.shape, rule=f"must have shape {shape} or {(batch, *shape)}")
    off = np.abs(np.swapaxes(array[..., :3, :3], -1, -2) @ array[..., :3, :3] - np.eye(3)).max(initial=0.0)
    if not (np.isfinite(array).all() and off < 1e-6 and (np.linalg.det(array[..., :3, :3]) > 0.0).all()):
        raise InputError(what, value=array.tolist(), rule="must hold finite rigid transforms (4, 4)")
    return np.broadcast_to(array, (batch, *shape)).copy()
