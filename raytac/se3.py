"""Rotations and rigid transforms: matrices, quaternions, rotation vectors, wrenches.

Poses that users give are checked here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import ArrayLike

from raytac.checks import check_numbers
from raytac.errors import InputError

_ORTHONORMAL = 1e-6
"""Largest entry of RᵀR − 1 of a matrix R that counts as a rotation."""


def pose(rotation: Any, position: Any) -> Any:
    """``target_from_source`` (…, 4, 4); arrays of NumPy or PyTorch.

    Args:
        rotation: matrices (…, 3, 3), or (3, 3) for all positions.
        position: (…, 3) [m].
    """
    xp = array_namespace(rotation)
    matrix = xp.zeros((*position.shape[:-1], 4, 4), dtype=rotation.dtype, device=device(rotation))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, position, 1.0
    return matrix


def pose_of(position: ArrayLike, quaternion: ArrayLike) -> np.ndarray:
    """``target_from_source`` (4, 4) from a position (3,) [m] and a unit quaternion wxyz (4,)."""
    return pose(rotation_of(quaternion), np.asarray(position))


def pose_error(world_from_a: np.ndarray, world_from_b: np.ndarray) -> np.ndarray:
    """Displacement from b to a (…, 6), world axes; poses (…, 4, 4) broadcast.

    It is p_a − p_b [m] and the rotation vector log(R_a R_bᵀ) [rad], at most π long.
    """
    turn = rotation_vector(world_from_a[..., :3, :3] @ np.swapaxes(world_from_b[..., :3, :3], -1, -2))
    return np.concatenate([world_from_a[..., :3, 3] - world_from_b[..., :3, 3], turn], axis=-1)


def rotation_of(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrices (…, 3, 3) of unit quaternions wxyz (…, 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    rows = (
        (ww + xx - yy - zz, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), ww - xx + yy - zz, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), ww - xx - yy + zz),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions(poses: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz of poses (B, 4, 4), shape (B, 4)."""
    return quaternion(poses[:, :3, :3])


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """log R (…, 3) [rad] of rotation matrices (…, 3, 3), at most π long."""
    q = quaternion(rotation)
    q = q * np.where(q[..., :1] < 0.0, -1.0, 1.0)
    sine = np.sqrt(np.square(q[..., 1:]).sum(axis=-1, keepdims=True))
    # θ / sin(θ/2), which is 2 at θ = 0
    factor = np.where(sine > 0.0, 2.0 * np.arctan2(sine, q[..., :1]) / np.where(sine > 0.0, sine, 1.0), 2.0)
    return factor * q[..., 1:]


def quaternion(r: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz (…, 4) of rotation matrices (…, 3, 3).

    The root is taken of the greatest component (S. W. Shepperd, "Quaternion from rotation matrix", J. Guid. Control 1(3), 1978), so
    that the result is accurate for any angle.
    """
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
    return q / np.sqrt(np.square(q).sum(axis=-1, keepdims=True))


def inverse(poses: Any) -> Any:
    """Inverses of rigid transforms (…, 4, 4); arrays of NumPy or PyTorch."""
    xp = array_namespace(poses)
    result = xp.zeros_like(poses)
    transposed = poses[..., :3, :3].mT
    result[..., :3, :3] = transposed
    result[..., :3, 3] = -(transposed @ poses[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def turn_angle(rotations: np.ndarray) -> np.ndarray:
    """Angles [rad] in [0, π] of rotation matrices (…, 3, 3), accurate for small turns too."""
    antisymmetric = rotations - np.swapaxes(rotations, -1, -2)
    sine = 0.5 * np.sqrt(0.5 * (antisymmetric**2).sum(axis=(-1, -2)))
    return np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1.0))


def between(start: np.ndarray, end: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) at a ``share``, one or (B,): linear positions, rotations by slerp."""
    share = np.broadcast_to(np.asarray(share, float), len(start))[:, None]
    a, b = quaternions(start), quaternions(end)
    cosine = (a * b).sum(axis=1, keepdims=True)
    b = np.where(cosine < 0.0, -b, b)
    half = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    small = half < 1e-6
    sine = np.where(small, 1.0, np.sin(half))
    q = np.where(small, (1.0 - share) * a + share * b, (np.sin((1.0 - share) * half) * a + np.sin(share * half) * b) / sine)
    result = np.tile(np.eye(4), (len(start), 1, 1))
    result[:, :3, :3] = rotation_of(q / np.linalg.norm(q, axis=1, keepdims=True))
    result[:, :3, 3] = (1.0 - share) * start[:, :3, 3] + share * end[:, :3, 3]
    result = np.where((share <= 0.0)[..., None], start, result)
    return np.where((share >= 1.0)[..., None], end, result)


def nearest_rotation(matrices: np.ndarray) -> np.ndarray:
    """Rotations closest to matrices (…, 3, 3) in the Frobenius norm (polar decomposition)."""
    u, _, v = np.linalg.svd(matrices)
    mirrored = np.linalg.det(u @ v) < 0.0
    u[mirrored, :, 2] *= -1.0
    return u @ v


def rotations(vectors: Any) -> Any:
    """Rotation matrices (…, 3, 3) of vectors (…, 3) [rad] (Rodrigues), NumPy or PyTorch."""
    xp = array_namespace(vectors)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    angle = xp.sqrt(x * x + y * y + z * z)
    some = angle > 0.0
    length = xp.where(some, angle, 1.0)
    first, half = xp.where(some, xp.sin(angle) / length, 1.0), xp.where(some, xp.sin(0.5 * angle) / (0.5 * length), 1.0)
    second = 0.5 * half * half  # (1 − cos a)/a², without cancellation
    xy, yz, zx = second * x * y, second * y * z, second * z * x
    xx, yy, zz = (1.0 - second * (angle * angle - c * c) for c in (x, y, z))
    sx, sy, sz = first * x, first * y, first * z
    rows = (xx, xy - sz, zx + sy, xy + sz, yy, yz - sx, zx - sy, yz + sx, zz)
    return xp.reshape(xp.stack(rows, axis=-1), (*vectors.shape[:-1], 3, 3))


def batch_of(world_from_pad: ArrayLike, axes: int, bodies: Mapping[str, ArrayLike]) -> int:
    """Number of environments of poses with a batch axis; 1 if none has one."""
    given = [np.shape(world_from_pad)] if np.ndim(world_from_pad) == axes else []
    given += [np.shape(pose) for pose in bodies.values() if np.ndim(pose) == axes - 1]
    return given[0][0] if given else 1


def check_pose(name: str, value: ArrayLike) -> np.ndarray:
    """``value`` as a float64 (4, 4) rigid transform; ``InputError`` with ``name`` otherwise."""
    matrix = check_numbers(name, value, (4, 4), finite=True)
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ORTHONORMAL:
        raise InputError(name, value=matrix[3].tolist(), rule="must have the last row 0, 0, 0, 1")
    rotation = matrix[:3, :3]
    a, b, c, d, e, f, g, h, i = rotation.ravel().tolist()  # by hand: NumPy's determinant takes ten times as long
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if determinant < 0.0 or np.abs(rotation.T @ rotation - np.eye(3)).max() > _ORTHONORMAL:
        raise InputError(name, value=rotation.tolist(), rule="must hold a rotation: orthonormal columns, determinant +1")
    return matrix


def rigid_poses(what: str, values: ArrayLike, batch: int, count: int | None = None) -> np.ndarray:
    """Rigid transforms (B, 4, 4) or (B, count, 4, 4) of ``values`` that may lack the batch axis."""
    array = np.asarray(values, float)
    shape = (4, 4) if count is None else (count, 4, 4)
    if array.shape not in (shape, (batch, *shape)):
        raise InputError(what, value=array.shape, rule=f"must have shape {shape} or {(batch, *shape)}")
    off = np.abs(np.swapaxes(array[..., :3, :3], -1, -2) @ array[..., :3, :3] - np.eye(3)).max(initial=0.0)
    if not (np.isfinite(array).all() and off < _ORTHONORMAL and (np.linalg.det(array[..., :3, :3]) > 0.0).all()):
        raise InputError(what, value=array.tolist(), rule="must hold finite rigid transforms (4, 4)")
    return np.broadcast_to(array, (batch, *shape)).copy()


def about_z(angle: float) -> np.ndarray:
    """Rotation by ``angle`` [rad] about z, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
