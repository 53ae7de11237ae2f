"""Environments of one world that differ: masses, friction, gels, and pads that do not sit where the drawing has them.

MuJoCo keeps such numbers in its model, of which a world has one for all environments. An environment that differs gets a model of its own,
the scene's with these numbers changed; what MuJoCo derives from them (inverse weights) is computed anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.se3 import quaternion, rigid_poses, rotation_of
from raytac.world.compose import ComposedScene

__all__ = ["EnvironmentModels", "Variation"]


@dataclass(frozen=True)
class Variation:
    """What n environments have otherwise than the scene; all that is not named is as in the scene."""

    mass: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Free body to factors (n,) of its mass and inertia."""
    friction: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Body to factors (n,) of the coefficients that the scene gives it, against gel and against all else; none that it leaves out."""
    gel_stiffness: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to factors (n,) of its gel's Young's modulus."""
    gel_friction: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to factors (n,) of its gel's own coefficient of friction, which holds for bodies that the scene gives none."""
    mounting: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Sensor to ``nominal_from_pad`` (n, 4, 4): where its pad is in the frame in which the scene has the pad."""


class EnvironmentModels:
    """MuJoCo's models of B environments: the scene's own, but for those that differ.

    Attributes:
        inverse_weight: ``body_invweight0`` of translations [1/kg], (B, bodies of the model).
        friction_on_gel: coefficients against gel (B, bodies of the scene); NaN is the gel's own.
        gel_stiffness: factors of the gels' moduli (B, sensors).
        gel_friction: the gels' own coefficients (B, sensors).
    """

    inverse_weight: np.ndarray
    friction_on_gel: np.ndarray
    gel_stiffness: np.ndarray
    gel_friction: np.ndarray

    def __init__(self, composed: ComposedScene, num_envs: int) -> None:
        self._composed = composed
        self._models = [composed.model] * num_envs
        self._bodies = tuple(composed.bodies.values())
        given = [np.nan if (own := body.spec.friction_on_gel) is None else own for body in self._bodies]
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
        """Whether any of these environments has a model of its own."""
        return any(self._models[b] is not self._composed.model for b in envs)

    def snapshot(self) -> tuple[list[mujoco.MjModel], list[np.ndarray]]:
        """What ``restore`` takes."""
        return list(self._models), [values.copy() for values in self._numbers()]

    def restore(self, before: tuple[list[mujoco.MjModel], list[np.ndarray]]) -> None:
        """As at a ``snapshot``."""
        self._models[:] = before[0]
        for values, old in zip(self._numbers(), before[1], strict=True):
            values[:] = old

    def _numbers(self) -> tuple[np.ndarray, ...]:
        return self.inverse_weight, self.friction_on_gel, self.gel_stiffness, self.gel_friction

    def check(self, variation: Variation, count: int, *, rigid: bool) -> None:
        """Refuse what cannot be.

        Args:
            variation: of ``count`` environments.
            rigid: whether pads are rigid: the solver of simulated ones has the same bodies and gels in all environments.

        Raises:
            InputError: a name that is not there, factors that are not positive and finite, poses that are not rigid, arrays of another
                length, or bodies or gels that differ with simulated pads.
        """
        free = [body.spec.name for body in self._bodies if body.spec.dynamics == "free"]
        sensors = [mounted.name for mounted in self._composed.sensors]
        names = {"mass": free, "friction": list(self._composed.bodies)}
        names |= dict.fromkeys(("gel_stiffness", "gel_friction", "mounting"), sensors)
        for what, known in names.items():
            given: Mapping[str, np.ndarray] = getattr(variation, what)
            if given and what != "mounting" and not rigid:
                rule = "needs the rigid pad: the solver of simulated pads has the same bodies and gels in all environments"
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
        """Give environments models with what is checked and theirs; what they had of their own before is gone."""
        for row, b in enumerate(envs):
            own = self._models[b] = copy(self._composed.model)
            self.friction_on_gel[b] = self._scene_friction
            self.gel_stiffness[b], self.gel_friction[b] = 1.0, self._scene_gel_friction
            for i, body in enumerate(self._bodies):
                name, index = body.spec.name, body.index
                if name in variation.mass:
                    factor = float(variation.mass[name][row])
                    own.body_mass[index] *= factor
                    own.body_inertia[index] *= factor
                if name in variation.friction:
                    factor = float(variation.friction[name][row])
                    self.friction_on_gel[b, i] *= factor
                    if body.spec.friction is not None:
                        first = int(own.body_geomadr[index])
                        own.geom_friction[first : first + int(own.body_geomnum[index]), 0] *= factor
            for i, mounted in enumerate(self._composed.sensors):
                if mounted.name in variation.gel_stiffness:
                    self.gel_stiffness[b, i] = variation.gel_stiffness[mounted.name][row]
                if mounted.name in variation.gel_friction:
                    self.gel_friction[b, i] *= variation.gel_friction[mounted.name][row]
                if mounted.name in variation.mounting:
                    at = np.broadcast_to(variation.mounting[mounted.name], (len(envs), 4, 4))[row]
                    index = int(own.body(mounted.body).id)
                    turn = rotation_of(own.body_quat[index])
                    own.body_pos[index] += turn @ at[:3, 3]
                    own.body_quat[index] = quaternion(turn @ at[:3, :3])
            if self._scratch is None:
                self._scratch = mujoco.MjData(self._composed.model)
            mujoco.mj_setConst(own, self._scratch)
            self.inverse_weight[b] = own.body_invweight0[:, 0]
