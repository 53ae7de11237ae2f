"""Environments of one world that differ: masses, friction, gels, mounting errors.

MuJoCo keeps such numbers in its model, of which a world has one for all environments. An environment that differs gets its own copy of
the scene's model with these numbers changed; quantities that MuJoCo derives from them (inverse weights) are computed again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.se3 import quaternion, rigid_poses, rotation_of
from raytac.world.world_model import WorldModel


@dataclass(frozen=True)
class Variation:
    """Differences of n environments from the scene; what is not named is as in the scene."""

    mass: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Free body to factors (n,) of its mass and inertia."""
    friction: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Body to factors (n,) of its friction in the scene, against gel and all else."""
    gel_stiffness: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to factors (n,) of its gel's Young's modulus."""
    gel_friction: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to factors (n,) of its gel's friction, for bodies without one in the scene."""
    mounting: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to ``nominal_from_pad`` (n, 4, 4): pose of its pad relative to the pad as designed."""


class EnvironmentModels:
    """MuJoCo's models of B environments: the scene's, or a copy for each that differs.

    Attributes:
        inverse_weight: ``body_invweight0`` of translations [1/kg], (B, bodies of the model).
        friction_on_gel: coefficients against gel (B, touched bodies); NaN is the gel's own.
        gel_stiffness: factors of the gels' moduli (B, sensors).
        gel_friction: the gels' own coefficients (B, sensors).
    """

    inverse_weight: np.ndarray
    friction_on_gel: np.ndarray
    gel_stiffness: np.ndarray
    gel_friction: np.ndarray

    def __init__(self, composed: WorldModel, num_envs: int) -> None:
        self._composed = composed
        self._models = [composed.model] * num_envs
        self._bodies = composed.touched
        given = [np.nan if body.friction is None else body.friction for body in self._bodies]
        self._scene_friction = np.array(given, float)
        self.inverse_weight = np.repeat(composed.model.body_invweight0[None, :, 0], num_envs, axis=0)
        self.friction_on_gel = np.repeat(self._scene_friction[None], num_envs, axis=0)
        self._scene_gel_friction = np.array([spec.gelpad.friction for spec in composed.sensor_specs])
        self.gel_friction = np.repeat(self._scene_gel_friction[None], num_envs, axis=0)
        self.gel_stiffness = np.ones_like(self.gel_friction)
        self._scratch: mujoco.MjData | None = None

    def __getitem__(self, env: int) -> mujoco.MjModel:
        return self._models[env]

    def differ(self, envs: Sequence[int] | range) -> bool:
        """True if any of these environments has its own model."""
        return any(self._models[b] is not self._composed.model for b in envs)

    def snapshot(self) -> tuple[list[mujoco.MjModel], list[np.ndarray]]:
        """Present models and numbers, for ``restore``."""
        return list(self._models), [values.copy() for values in self._numbers()]

    def restore(self, before: tuple[list[mujoco.MjModel], list[np.ndarray]]) -> None:
        """Return to a ``snapshot``."""
        self._models[:] = before[0]
        for values, old in zip(self._numbers(), before[1], strict=True):
            values[:] = old

    def _numbers(self) -> tuple[np.ndarray, ...]:
        return self.inverse_weight, self.friction_on_gel, self.gel_stiffness, self.gel_friction

    def check(self, variation: Variation, count: int, *, rigid: bool) -> None:
        """Raise for a variation that is not possible.

        Args:
            variation: of ``count`` environments.
            rigid: pads are rigid; the solver of soft pads has the same bodies and gels in all environments.

        Raises:
            InputError: a name that is not there, factors that are not positive and finite, poses that are not rigid, arrays of another
                length, or bodies or gels that differ with soft pads.
        """
        free = [body.name for body in self._bodies if body.is_placed]
        sensors = [mounted.name for mounted in self._composed.sensors]
        names = {"mass": free, "friction": list(self._composed.bodies)}
        names |= dict.fromkeys(("gel_stiffness", "gel_friction", "mounting"), sensors)
        for what, known in names.items():
            given: Mapping[str, np.ndarray] = getattr(variation, what)
            if given and what != "mounting" and not rigid:
                rule = "needs the rigid pad: the solver of soft pads has the same bodies and gels in all environments"
                raise InputError(f"variation.{what}", value=sorted(given), rule=rule)
            for name, values in given.items():
                label = f"variation.{what}[{name!r}]"
                if name not in known:
                    raise InputError(label, value=name, rule="must be a name of the scene", choices=known)
                if what == "mounting":
                    rigid_poses(label, values, count)
                    continue
                factors = np.asarray(values, float)
                if factors.shape != (count,):
                    raise InputError(label, value=factors.shape, rule=f"must have the shape ({count},), one an environment named")
                wrong = ~(np.isfinite(factors) & (factors > 0.0))
                if wrong.any():
                    row = int(np.flatnonzero(wrong)[0])
                    raise InputError(label, value=float(factors[row]), rule=f"must be positive and finite; row {row} is not")

    def vary(self, envs: Sequence[int], variation: Variation) -> None:
        """Give environments models with a checked variation, in place of the one they had."""
        scene = self._composed.scene
        for row, b in enumerate(envs):
            model = self._models[b] = copy(self._composed.model)
            self.friction_on_gel[b] = self._scene_friction
            self.gel_stiffness[b], self.gel_friction[b] = 1.0, self._scene_gel_friction
            for i, body in enumerate(self._bodies):
                name, members = body.name, list(body.members)
                if name in variation.mass:
                    factor = float(variation.mass[name][row])
                    model.body_mass[members] *= factor
                    model.body_inertia[members] *= factor
                if name in variation.friction:
                    factor = float(variation.friction[name][row])
                    self.friction_on_gel[b, i] *= factor
                    if scene is None or scene.body(name).friction is not None:
                        model.geom_friction[list(body.geoms), 0] *= factor
            for i, mounted in enumerate(self._composed.sensors):
                if mounted.name in variation.gel_stiffness:
                    self.gel_stiffness[b, i] = variation.gel_stiffness[mounted.name][row]
                if mounted.name in variation.gel_friction:
                    self.gel_friction[b, i] *= variation.gel_friction[mounted.name][row]
                if mounted.name in variation.mounting:
                    shift = np.broadcast_to(variation.mounting[mounted.name], (len(envs), 4, 4))[row]
                    index = int(model.body(mounted.body).id)
                    turn = rotation_of(model.body_quat[index])
                    model.body_pos[index] += turn @ shift[:3, 3]
                    model.body_quat[index] = quaternion(turn @ shift[:3, :3])
            if self._scratch is None:
                self._scratch = mujoco.MjData(self._composed.model)
            mujoco.mj_setConst(model, self._scratch)
            self.inverse_weight[b] = model.body_invweight0[:, 0]
