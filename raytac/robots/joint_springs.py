"""Springs in the joints of one arm in B states: aimed by control step, driven every step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.arm_kernels import Springs, joint_springs
from raytac.robots.states import NumberWriter, StateReader
from raytac.warp_runtime import Recorded

_READ = ("time", "joints", "speed", "bias", "mass")


class JointSprings:
    """The law of ``JointImpedance`` for the states that it is made for."""

    def __init__(
        self, arm: Arm, datas: Sequence[mujoco.MjData], *, frequency: float, damping_ratio: float, others: Sequence[int] = ()
    ) -> None:
        """Springs of ``frequency`` [rad/s], without target; ``others``: actuators beside the motors."""
        self.arm, self._datas = arm, tuple(datas)
        count, n = len(self._datas), len(arm)
        self._reader = StateReader(self._datas, {name: one for name, one in arm.numbers().items() if name in _READ})
        self._writer = None if arm.motors is None else NumberWriter(self._datas, "ctrl", [*arm.motors.tolist(), *others])
        springs = Springs()
        springs.time, springs.joints, springs.speed, springs.bias, springs.mass = (self._reader.arrays[name] for name in _READ)
        springs.target, springs.target_speed = (wp.zeros((count, n), dtype=wp.float64, device="cpu") for _ in range(2))
        springs.start = wp.zeros(count, dtype=wp.float64, device="cpu")
        springs.stiffness, springs.damping = frequency**2, 2.0 * damping_ratio * frequency
        if self._writer is None:
            springs.torque = wp.zeros((count, n), dtype=wp.float64, device="cpu")
        else:
            springs.torque = self._writer.array
        self._target, self._speed = springs.target.numpy(), springs.target_speed.numpy()
        self._start, controls = springs.start.numpy(), springs.torque.numpy()
        self._torque, self._others = controls[:, :n], controls[:, n:]
        law = partial(wp.launch, joint_springs, dim=(count, n), inputs=[springs], device="cpu")
        self._law = Recorded(self._reader.launch, law)

    def is_for(self, datas: Sequence[mujoco.MjData]) -> bool:
        """True if it was made for these states."""
        return self._reader.reads(datas)

    def aim(self, joints: np.ndarray, speed: np.ndarray, start: np.ndarray, others: np.ndarray | float = 0.0) -> None:
        """Aim at ``joints`` (B, n) from ``start`` [s] at ``speed``; ``others`` (B, k): controls."""
        self._target[:], self._speed[:], self._start[:], self._others[:] = joints, speed, start, others

    def torque(self) -> np.ndarray:
        """Torques (B, n) [N·m] for the present states; the array is overwritten by the next call."""
        self._law()
        return self._torque

    def drive(self, envs: Sequence[int] | np.ndarray) -> None:
        """Command motors and others of environments, or raise ``InputError`` and write nothing."""
        if self._writer is None:
            self.arm.check_motors()
            return
        self.torque()
        wrong = self._writer.write(envs)
        if wrong is not None:
            raise InputError("torque", value=wrong.tolist(), rule=f"must be {wrong.size} finite numbers")
