"""Types of the arrays that kernels take: first their inputs, last what they write."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp
from numpy.typing import NDArray

IntArray, IntArray2d = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
FloatArray, FloatArray2d, FloatArray3d = wp.array(dtype=wp.float64), wp.array2d(dtype=wp.float64), wp.array3d(dtype=wp.float64)
SingleArray2d, SingleArray3d = wp.array2d(dtype=wp.float32), wp.array3d(dtype=wp.float32)
VecArray, VecArray2d = wp.array(dtype=wp.vec3d), wp.array2d(dtype=wp.vec3d)
Vec4Array2d = wp.array2d(dtype=wp.vec4d)
MatArray2d, QuatArray2d = wp.array2d(dtype=wp.mat33d), wp.array2d(dtype=wp.quatd)


def filled(struct: Any, device: wp.Device, values: Mapping[str, NDArray | list[int] | tuple[int, ...]]) -> Any:
    """An instance of a Warp struct with these values in arrays of the types of its fields."""
    instance = struct()
    for name, value in values.items():
        setattr(instance, name, wp.array(value, dtype=struct.vars[name].type.dtype, device=device))
    return instance
