"""``DeviceVariation``: masses, friction, gels and mountings in MuJoCo Warp by a mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid.gel_contact import GelContact
from raytac.se3 import pose_of
from raytac.world import variation_kernels as kernels
from raytac.world.engine.mjwarp import MujocoWarp
from raytac.world.world_model import WorldModel

FACTORS = ("mass", "friction", "gel_stiffness", "gel_friction")


@dataclass(frozen=True)
class _Scaled:
    """Columns of an array of the environments that factors multiply, or divide."""

    factors: wp.array
    which: wp.array
    columns: wp.array
    nominal: wp.array
    divides: int
    values: wp.array


class DeviceVariation:
    """``EnvironmentModels.vary`` by kernels alone, so that it can be part of a CUDA graph.

    Inverse weights follow from the factors: those of a free body, a tree of its own, are as many times smaller as its mass is larger. That
    a pad of some grams that is mounted off its drawing changes the inverse weights of the arm is neglected.

    Attributes:
        names: of the columns of every array.
        arrays: ``mass`` (B, free bodies), ``friction`` (B, bodies), ``gel_stiffness`` and ``gel_friction`` (B, sensors), and ``mounting``
            (B, sensors, 4, 4), float64, as of ``Variation``, to be written in place before ``launch``.
    """

    def __init__(self, composed: WorldModel, engine: MujocoWarp, contact: GelContact) -> None:
        """Note the scene's nominal numbers; InputError for a free body that carries others."""
        model, self._device, envs = composed.model, engine.device, engine.num_envs
        touched, sensors = composed.touched, composed.sensors
        free = [body for body in touched if body.is_free]
        for body in free:
            if model.body_subtreemass[body.index] != model.body_mass[body.index]:
                raise InputError("scene", value=body.name, rule="must carry no other body, if its mass is to vary on the device")
        self.names = {
            "mass": tuple(body.name for body in free),
            "friction": tuple(composed.bodies),
            **dict.fromkeys(("gel_stiffness", "gel_friction", "mounting"), tuple(mounted.name for mounted in sensors)),
        }
        self.arrays: dict[str, wp.array] = {
            name: wp.full((envs, len(self.names[name])), 1.0, dtype=wp.float64, device=self._device) for name in FACTORS
        }
        mounting = np.tile(np.eye(4), (envs, len(sensors), 1, 1))
        self.arrays["mounting"] = wp.array(mounting, dtype=wp.float64, device=self._device)
        self._scaled: dict[str, list[_Scaled]] = {name: [] for name in FACTORS}
        own, numbers = engine.model, contact.numbers
        bodies = [body.index for body in free]
        first = [int(model.body_dofadr[body]) for body in bodies]
        for array, nominal, divides, columns in (
            (own.body_mass, model.body_mass, 0, bodies),
            (own.body_inertia, model.body_inertia, 0, _columns([3 * body for body in bodies], 3)),
            (own.body_subtreemass, model.body_subtreemass, 0, bodies),
            (own.body_invweight0, model.body_invweight0, 1, _columns([2 * body for body in bodies], 2)),
            (own.dof_invweight0, model.dof_invweight0, 1, _columns(first, 6)),
            (numbers.inverse_weight, model.body_invweight0[:, 0], 1, bodies),
        ):
            each = len(columns) // max(len(free), 1)
            self._add("mass", array, np.repeat(np.arange(len(free)), each), columns, nominal, divides=divides)
        scene = composed.scene
        rubbed = [
            (k, geom)
            for k, body in enumerate(touched)
            if scene is None or scene.body(body.name).friction is not None
            for geom in body.geoms
        ]
        self._add("friction", own.geom_friction, [k for k, _ in rubbed], [3 * geom for _, geom in rubbed], model.geom_friction)
        on_gel = np.array([np.nan if body.friction is None else body.friction for body in touched], float)
        self._add("friction", numbers.body_friction, range(len(touched)), range(len(touched)), on_gel)
        pads = range(len(sensors))
        self._add("gel_stiffness", numbers.gel_stiffness, pads, pads, np.ones(len(sensors)))
        own_friction = np.array([spec.gelpad.friction for spec in composed.sensor_specs], float)
        self._add("gel_friction", numbers.gel_friction, pads, pads, own_friction)
        carriers = [int(model.body(mounted.body).id) for mounted in sensors]
        poses = np.array([pose_of(model.body_pos[body], model.body_quat[body]) for body in carriers]).reshape(-1, 4, 4)
        self._carriers = wp.array(carriers, dtype=wp.int32, device=self._device)
        self._poses = wp.array(poses, dtype=wp.mat44d, device=self._device)
        self._place, self._turn = own.body_pos, own.body_quat

    def _add(
        self, name: str, array: Any, which: Sequence[int] | np.ndarray | range, columns: Sequence[int] | range,
        nominal: np.ndarray, *, divides: int = 0,
    ) -> None:  # fmt: skip
        """Let the factors ``which`` of ``name`` change columns of an array, side by side."""
        if not len(columns):
            return
        # MuJoCo Warp's vectors are float32 one after the other.
        dtype, size = (wp.float64, 8) if array.dtype is wp.float64 else (wp.float32, 4)
        width = array.strides[0] // size
        values = wp.array(ptr=array.ptr, shape=(array.shape[0], width), dtype=dtype, device=self._device)
        of, into = (wp.array(np.asarray(index, np.int32), dtype=wp.int32, device=self._device) for index in (which, columns))
        start = wp.array(np.asarray(nominal, float).reshape(-1)[list(columns)], dtype=wp.float64, device=self._device)
        self._scaled[name].append(_Scaled(self.arrays[name], of, into, start, divides, values))

    def launch(self, chosen: wp.array, names: Sequence[str]) -> None:
        """Launch the changes that ``names`` of ``arrays`` make where ``chosen`` (B,), bool."""
        for name in names:
            if name == "mounting":
                inputs = [chosen, self.arrays[name], self._carriers, self._poses, self._place, self._turn]
                wp.launch(kernels.mount_pads, dim=self.arrays[name].shape[:2], inputs=inputs, device=self._device)
            for one in self._scaled.get(name, ()):
                inputs = [chosen, one.factors, one.which, one.columns, one.nominal, one.divides, one.values]
                shape = one.values.shape[0], one.columns.shape[0]
                wp.launch(kernels.scale_columns, dim=shape, inputs=inputs, device=self._device)


def _columns(starts: Sequence[int], width: int) -> list[int]:
    """Columns of ``width`` numbers from each of the starts on."""
    return [start + k for start in starts for k in range(width)]
