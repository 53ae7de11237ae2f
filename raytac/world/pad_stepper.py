"""``PadStepper``: the contact of rigid pads in a loop that somebody else writes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import mujoco
import numpy as np

from raytac.checks import MOST_ENVIRONMENTS, check_whole
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import chosen_envs
from raytac.physics.registry import rigid_physics
from raytac.world.environment_models import EnvironmentModels
from raytac.world.rigid_pads import pads_on_c_mujoco
from raytac.world.sensor_frames import SensorFrames
from raytac.world.world_model import checked_states, own_world_model
from raytac.world.world_state import check_controls

if TYPE_CHECKING:
    from raytac.physics.base import PhysicsConfig
    from raytac.robots.mount import SensorChoice
    from raytac.sensor import SensorSettings
    from raytac.world.touched import TouchChoice


class PadStepper:
    """Rigid pads that act on the states of a model that somebody else steps.

    .. code-block:: python

        pads = PadStepper(model, touches=["cube"], outputs=("rgb", "wrench"))
        for _ in range(100):
            data.ctrl[:] = policy(data)
            pads.step(model, data)  # in place of mujoco.mj_step
        frame = pads.observe(data)["left"]

        mujoco.mj_step1(model, data)  # or around your own step
        pads.add(model, data)
        mujoco.mj_step2(model, data)
        pads.finish(model, data)

    ``step`` divides a step where something moves fast near a pad, as ``TactileWorld`` does, and leaves the poses of its end. With ``add`` a
    step is as long as the model's, so that what is fast may go through a gel; that is marked in ``failed`` in both. A failed state is not
    stepped until ``reset``. A state whose time has gone back counts as reset. With ``add`` a body that was moved by hand has gone there on
    a straight line, as ``failed`` sees it, until ``reset``.

    Attributes:
        model: the model, which is not changed.
        failed: states whose physics broke down, (B,), bool.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        sensors: SensorChoice | None = None,
        touches: TouchChoice | None = None,
        num_envs: int = 1,
        allow_overlap: Sequence[str] = (),
        keyframe: str | None = None,
        physics: str | PhysicsConfig | None = None,
        seed: int = 0,
        **settings: Unpack[SensorSettings],
    ) -> None:
        """Find sensors and bodies in the model.

        Args:
            model: model with sensors that ``raytac.mount`` put on it.
            sensors, touches, allow_overlap, keyframe: as of ``TactileWorld``.
            num_envs: number of states B that are stepped together.
            physics: name or configuration of rigid pads; None is ``rigid``.
            seed: of every random number.
            settings: ``outputs``, ``markers``, ``optics``, ``resolution``, ``device``, ``pitch`` and ``noise`` of every sensor.

        Raises:
            InputError: what ``TactileWorld`` refuses of a given model, or soft pads.
        """
        config = rigid_physics(physics)
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        self.model = model
        self.composed = own_world_model(
            model, sensors=sensors, touches=touches, keyframe=keyframe, allow_overlap=allow_overlap, own_contact=True
        )
        self.failed = np.zeros(num_envs, bool)
        self._frames = SensorFrames(self.composed.sensors, num_envs=num_envs, seed=seed, physics=config, **settings)
        self._models = EnvironmentModels(self.composed, num_envs)
        self._pads, self._engine = pads_on_c_mujoco(self.composed, self._models, [mujoco.MjData(model)] * num_envs)
        self._time = np.full(num_envs, -np.inf)
        self._put: np.ndarray | None = None
        self._counts: list[tuple[int, int]] = []

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Forget what the pads of states (a mask (B,), a list, or None for all) went through.

        Raises ``InputError`` for a state that does not exist.
        """
        chosen = chosen_envs(envs, len(self.failed))
        self.failed[chosen], self._time[chosen], self._put = False, -np.inf, None
        self._pads.clear(chosen)
        self._frames.reset(chosen)

    def step(self, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData]) -> None:
        """One step of MuJoCo with the pads' contact, of one state or B; ``data.ctrl`` is set.

        Raises ``InputError``: another model, timestep or number of states, or a control that is not finite.
        """
        datas = self._states(model, data)
        self._pads.advance(lambda _: None, self.failed)
        self._time[:] = [one.time for one in datas]

    def add(self, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData]) -> None:
        """Put the pads' contacts into states, between ``mj_step1`` and ``mj_step2``.

        Controls and applied forces must have their values of this step: they may close a gap in it.

        Raises ``InputError``: as ``step``, or no ``finish`` since the last ``add``.
        """
        self._states(model, data)
        if self._put is not None:
            raise InputError("add", value="again", rule="must be followed by mj_step2 and finish before it is called again")
        self._put = self._pads.add(self.failed)
        self._counts = self._engine.counts(self._put)

    def finish(self, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData]) -> None:
        """Read the pads' forces and let the gels shear, after ``mj_step2``.

        Raises ``InputError``: another model, timestep or number of states, no ``add`` before, or another ``mj_step1`` since.
        """
        datas = checked_states(self.model, model, data, len(self.failed))
        if self._put is None:
            raise InputError("finish", value="without add", rule="must follow add and mj_step2")
        put, self._put = self._put, None
        self._engine.bind(datas)
        if self._engine.counts(put) != self._counts:
            rule = "must follow the mj_step2 after add: MuJoCo has other contacts now, and those of add are lost; call reset"
            raise InputError("finish", value="after another mj_step1", rule=rule)
        self._pads.finish(put, self.failed)
        self._time[:] = [one.time for one in datas]

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin in the last step, pad frame; NaN if failed.

        Raises ``InputError`` for an unknown sensor.
        """
        if name not in self._frames.names:
            raise InputError("name", value=name, rule="must be a sensor of the model", choices=self._frames.names)
        return np.where(self.failed[:, None], np.nan, self._pads.wrench(name))

    def observe(
        self,
        data: mujoco.MjData | Sequence[mujoco.MjData],
        sensors: Sequence[str] | str | None = None,
        envs: np.ndarray | list[int] | None = None,
    ) -> dict[str, TactileFrame]:
        """Frames of the sensor or sensors named (all if None) at the present poses.

        ``envs`` (a mask (B,) or a list): as of ``TactileWorld.observe``; all states are given.

        Raises ``InputError``: another number of states, an unknown sensor or state; as ``TactileSensor.update``.
        """
        self._engine.bind(checked_states(self.model, self.model, data, len(self.failed)))
        return self._frames.observe(
            lambda name, grid, rows: self._pads.reading(name, grid, self.failed, rows), self.failed, sensors, envs
        )

    def _states(self, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData]) -> list[mujoco.MjData]:
        """The states, whose controls must be finite; those whose time has gone back are reset."""
        datas = checked_states(self.model, model, data, len(self.failed))
        for b, one in enumerate(datas):
            check_controls(b, one)
        self._models.inverse_weight[:] = model.body_invweight0[:, 0]  # masses may have been changed
        back = [b for b, one in enumerate(datas) if one.time < self._time[b]]
        if back:
            self.reset(back)
        self._engine.bind(datas)
        return datas
