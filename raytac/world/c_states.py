"""Environments of a world in C MuJoCo: starts, steps with the pads, and controllers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

import mujoco
import numpy as np

from raytac.errors import InputError, OverlapError
from raytac.robots.impedance import JointImpedance
from raytac.robots.states import Numbers, StateReader, body_pose, numbers, site_pose
from raytac.se3 import quaternion
from raytac.world.environment_models import EnvironmentModels, Variation
from raytac.world.pads import WorldPads
from raytac.world.world_model import WorldModel
from raytac.world.world_state import BatchController, Control, Drive, check_controls, constant_controls


class CStates:
    """B states of MuJoCo, one for each environment.

    Attributes:
        data: MuJoCo's states.
        models: of the environments.
        pads: of the world.
        failed: environments whose physics broke down, (B,).
    """

    def __init__(self, composed: WorldModel, num_envs: int, pads: Callable[..., WorldPads]) -> None:
        """States at the start; ``pads`` makes the pads of ``(composed, models, data)``."""
        self.composed, self._arm = composed, composed.arm
        self.data = tuple(mujoco.MjData(composed.model) for _ in range(num_envs))
        self.models = EnvironmentModels(composed, num_envs)
        self._reader = StateReader(self.data, state_numbers(composed))
        self._law, self._holding = None, None
        arm = composed.arm
        if composed.scene is not None and arm is not None and arm.motors is not None:
            self._law = JointImpedance(arm)
            others = np.setdiff1d(np.arange(composed.model.nu), arm.motors)
            self._holding = self._law.springs(self.data, others.tolist())
            self._holding.aim(composed.start[arm.qpos], np.zeros(1), np.zeros(1), composed.ctrl[others])
        self._spares: list[mujoco.MjData] = []
        """States in which a reset keeps those that it may have to put back."""
        self.failed = np.zeros(num_envs, bool)
        self._place(range(num_envs))
        self.pads = pads(composed, self.models, self.data)

    def first(self) -> mujoco.MjData:
        """State of the first environment."""
        return self.data[0]

    def values(self) -> dict[str, np.ndarray]:
        """Present ``state_numbers``, (B, …) each."""
        return self._reader.values()

    def read(self, name: str) -> NoReturn:
        """Raise ``InputError``: readings on a device need MuJoCo Warp."""
        raise InputError(
            "engine", value="mujoco", rule=f"has no readings on a device: observe({name!r})", choices=("mujoco_warp",)
        )

    def fail(self, failed: np.ndarray) -> None:
        """Mark environments (B,) as failed."""
        self.failed |= failed

    def step(self, control: Control | None) -> None:
        """One control step; None is ``hold``. Raises as ``TactileWorld.step``."""
        self.pads.advance(self._drive(control), self.failed)

    def reset(
        self, envs: Sequence[int], joints: np.ndarray | None, bodies: Mapping[str, np.ndarray], variation: Variation | None
    ) -> None:
        """Put environments to a checked start; see ``TactileWorld.reset``."""
        if joints is None and not bodies and variation is None and not self.models.differ(envs):
            self._place(envs)
            self.pads.reset(envs)
        else:
            self._start_elsewhere(envs, joints, bodies, variation)

    def _start_elsewhere(
        self, envs: Sequence[int], joints: np.ndarray | None, bodies: Mapping[str, np.ndarray], variation: Variation | None
    ) -> None:
        """Reset to given starts or models; nothing changes if bodies overlap there."""
        failed, models = self.failed.copy(), self.models.snapshot()
        # A state takes longer to make than to copy.
        self._spares += [mujoco.MjData(self.composed.model) for _ in range(len(envs) - len(self._spares))]
        before = self._spares[: len(envs)]
        for b, spare in zip(envs, before, strict=True):
            mujoco.mj_copyData(spare, self.composed.model, self.data[b])
        if variation is not None:
            self.models.vary(envs, variation)
        self._place(envs, joints, bodies)
        try:
            self.pads.reset(envs, bodies)
        except OverlapError:
            self.models.restore(models)
            for b, data in zip(envs, before, strict=True):
                mujoco.mj_copyData(self.data[b], self.composed.model, data)
            self.failed[:] = failed
            raise

    def _place(
        self, envs: Sequence[int] | range, joints: np.ndarray | None = None, bodies: Mapping[str, np.ndarray] | None = None
    ) -> None:
        """MuJoCo's part of a reset."""
        for row, b in enumerate(envs):
            put_to_start(self.composed, self.models[b], self.data[b], row, joints, bodies or {})
            mujoco.mj_forward(self.models[b], self.data[b])
            self.failed[b] = False

    def hold(self, data: mujoco.MjData) -> None:
        """Keep the robot of a scene at its start; a given model keeps its present controls."""
        if self.composed.scene is None:
            return
        data.ctrl[:] = self.composed.ctrl
        if self._law is not None and self._arm is not None:
            self._arm.drive(data, self._law.torque(data, self.composed.start[self._arm.qpos]).torque)

    def _drive(self, control: Control | None) -> Drive:
        """Function that writes the controls of environments, from any form of ``Control``."""
        if isinstance(control, BatchController):
            return lambda envs: control.drive(self.data, envs)
        if isinstance(control, np.ndarray):
            rows = constant_controls(control, len(self.data), self.composed.model.nu)

            def write(envs: Sequence[int] | np.ndarray) -> None:
                for b in envs:
                    self.data[b].ctrl[:] = rows[b]

            return write
        if control is None:
            return self._holding.drive if self._holding is not None else self._hold_all
        each = [control] * len(self.data) if callable(control) else list(control)
        if len(each) != len(self.data):
            raise InputError("control", value=len(each), rule=f"must be one controller, or one for each of {len(self.data)}")
        for controller in each:
            if not callable(controller):
                raise InputError("control", value=controller, rule="must be a controller; constant controls are a NumPy array")

        def call(envs: Sequence[int] | np.ndarray) -> None:
            for b in envs:
                each[b](self.data[b], float(self.data[b].time))
                check_controls(b, self.data[b])

        return call

    def _hold_all(self, envs: Sequence[int] | np.ndarray) -> None:
        for b in envs:
            self.hold(self.data[b])
            check_controls(b, self.data[b])


def state_numbers(composed: WorldModel) -> dict[str, Numbers]:
    """Numbers that ``TactileWorld.state`` reads of every environment."""
    model = composed.model
    read = {"time": numbers("time", np.array(0))}
    read |= {f"pad {m.name}": site_pose(int(model.site(m.site).id)) for m in composed.sensors}
    read |= {f"body {name}": body_pose(body.index) for name, body in composed.bodies.items()}
    return read if composed.arm is None else read | {"joints": composed.arm.numbers()["joints"]}


def put_to_start(
    composed: WorldModel,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    row: int,
    joints: np.ndarray | None,
    bodies: Mapping[str, np.ndarray],
) -> None:
    """Put one state to the start.

    The arm's joints and bodies are at ``row`` of ``joints`` (n, joints) and of poses (n, 4, 4).
    """
    composed.reset(model, data)
    if joints is not None and composed.arm is not None:
        data.qpos[composed.arm.qpos] = joints[row]
    for name, poses in bodies.items():
        body = composed.bodies[name]
        if body.is_free:
            data.qpos[body.qpos : body.qpos + 3] = poses[row, :3, 3]
            data.qpos[body.qpos + 3 : body.qpos + 7] = quaternion(poses[row, :3, :3])
        else:  # the solver's own bodies are mirrored here again once it has reset them
            data.mocap_pos[body.mocap], data.mocap_quat[body.mocap] = poses[row, :3, 3], quaternion(poses[row, :3, :3])
