"""Contacts that the kernels shear, one launch a call: ``ShearState`` with the two moments of a step."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from raytac.physics.rigid.shear_kernels import begin_shear, move_shear
from raytac.physics.rigid.shear_state import ShearState
from raytac.physics.rigid.world_kernels import Shear

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_all(
    shear: Shear,
    slot: wp.array(dtype=wp.vec3i),
    stiffness: wp.array(dtype=wp.vec2d),
    centre: wp.array(dtype=wp.vec3d),
    pull: wp.array(dtype=wp.vec3d),
):
    k = wp.tid()
    at = slot[k]
    pull[k] = begin_shear(shear, at[0], at[1], at[2], stiffness[k], centre[k])


@wp.kernel
def move_all(
    shear: Shear,
    slot: wp.array(dtype=wp.vec3i),
    displacement: wp.array(dtype=wp.vec3d),
    limit: wp.array(dtype=wp.vec2d),
    centre: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
):
    k = wp.tid()
    at = slot[k]
    move_shear(shear, at[0], at[1], at[2], displacement[k], limit[k], centre[k], radius[k])


class Sheared(ShearState):
    """As the oracle (``oracle_shear``)."""

    def begin(self, rows: Sequence[np.ndarray], stiffness: np.ndarray, centre: np.ndarray) -> np.ndarray:
        pull = wp.zeros(len(stiffness), dtype=wp.vec3d, device="cpu")
        inputs = [self.struct, _slots(rows), _array(stiffness, wp.vec2d), _array(centre, wp.vec3d), pull]
        wp.launch(begin_all, len(stiffness), inputs=inputs, device="cpu")
        return pull.numpy()

    def move(
        self, rows: Sequence[np.ndarray], displacement: np.ndarray, limit: np.ndarray, centre: np.ndarray, radius: np.ndarray
    ) -> None:
        given = zip((displacement, limit, centre, radius), (wp.vec3d, wp.vec2d, wp.vec3d, wp.float64), strict=True)
        inputs = [self.struct, _slots(rows), *(_array(values, dtype) for values, dtype in given)]
        wp.launch(move_all, len(displacement), inputs=inputs, device="cpu")


def _slots(rows: Sequence[np.ndarray]) -> wp.array:
    return wp.array(np.stack(rows, axis=1).astype(np.int32), dtype=wp.vec3i, device="cpu")


def _array(values: np.ndarray, dtype: type) -> wp.array:
    return wp.array(np.ascontiguousarray(values, float), dtype=dtype, device="cpu")
