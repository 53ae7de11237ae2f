"""Controllers from actions: the tool's pose, or the joints, follow a target that actions move.

Targets of many environments go through ``PoseServo``, one small solve for all of them; the viewer's sliders, one environment and people,
go through ``DifferentialIk``, which keeps every limit (``raytac.robots.ik`` says what each costs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.envs.task_rules import Motion
from raytac.errors import InputError
from raytac.robots.frames import site_poses
from raytac.robots.ik import PoseServo
from raytac.robots.impedance import JointImpedance
from raytac.robots.panda import MAX_VELOCITY
from raytac.se3 import pose_error, rotations
from raytac.world.world import TactileWorld
from raytac.world.world_state import BatchController

ACTIONS = ("pose", "joints")
"""``pose``: an action moves the target of the tool's pose, in the axes of the task. ``joints``: it moves the targets of the arm's seven
joints, by up to ``Motion.joint_step`` a step, and the opening if there is one."""


class ActionControl:
    """Targets of B environments.

    With ``pose`` an action moves the target by ``action * step``. The target never leads the tool by more than the leash, leaves the box
    or turns further than the motion allows; axes that no action moves stay as they started. Damped least squares turn it into joint
    targets once a control step, and springs in the joints follow these in every step of MuJoCo.
    """

    def __init__(self, world: TactileWorld, motion: Motion, action: str) -> None:
        """Start with the targets where the tool is. Raises ``InputError`` for a scene without an arm that has motors."""
        if world.arm is None or world.arm.motors is None:
            raise InputError(
                "scene", value=None if world.scene is None else world.scene.name, rule="needs an arm with torque motors"
            )
        self.world, self.arm, self.motion, self.action = world, world.arm, motion, action
        self._posture = world.composed.start[self.arm.qpos].copy()
        self._law = JointImpedance(self.arm, frequency=motion.frequency)
        self._servo = PoseServo(self.arm, max_velocity=np.array(MAX_VELOCITY), posture=self._posture)
        self._has_grip = "grip" in motion.axes
        self.size = len(motion.axes) if action == "pose" else len(self.arm) + self._has_grip
        self.opening_range = motion.opening if self._has_grip else ()
        count = world.num_envs
        self._target = np.repeat(np.eye(4)[None], count, axis=0)
        self._turn = np.zeros((count, 3))
        self._joints = np.repeat(self._posture[None], count, axis=0)
        self._gap = np.zeros(count)
        self._start = self.tool()[0].copy()
        self.reset(range(count))

    @property
    def target(self) -> np.ndarray:
        """Target poses (B, 4, 4) of the tool; with ``action="joints"`` they stay where the episode began."""
        return self._target.copy()

    def tool(self) -> np.ndarray:
        """Poses (B, 4, 4) of the tool by the arm's joints: where its pad would be if it were mounted without error."""
        return site_poses(self.world.data, self.arm.site)

    def joint_speed(self) -> np.ndarray:
        """Joint speeds (B, n) [rad/s]."""
        return np.array([data.qvel for data in self.world.data])[:, self.arm.dof]

    def opening(self) -> np.ndarray:
        """Gap between both pads by the fingers' joints [m], (B, 1); (B, 0) without a gripper."""
        if not self._has_grip:
            return np.zeros((self.world.num_envs, 0))
        fingers = self.world.composed.fingers
        return np.array([data.qpos[fingers].sum() for data in self.world.data])[:, None]

    def reset(self, envs: Sequence[int] | range) -> None:
        """Set the targets of environments to their present poses."""
        chosen = list(envs)
        self._target[chosen], self._turn[chosen] = self.tool()[chosen], 0.0
        self._joints[chosen] = self._posture
        opening = self.world.composed.opening
        if opening is not None:
            self._gap[chosen] = self.world.composed.ctrl[opening]

    def controller(self, actions: np.ndarray) -> BatchController:
        """Controller of all environments for the next control step; ``actions`` (B, size) in [−1, 1]."""
        dt = self.world.composed.control_timestep
        if self.action == "pose":
            before = self._target.copy()
            self._move_pose(actions)
            joints, speed = self._servo.targets(self.world.data, before, pose_error(self._target, before) / dt, dt)
        else:
            present = np.array([data.qpos for data in self.world.data])[:, self.arm.qpos]
            target = self._joints + self.motion.joint_step * actions[:, : len(self.arm)]
            target = np.clip(target, present - self.motion.joint_leash, present + self.motion.joint_leash)
            target = np.clip(target, self.arm.range[:, 0], self.arm.range[:, 1])
            joints, speed = self._joints, (target - self._joints) / dt
            self._joints = target
        if self._has_grip:
            step = self.motion.step[self.motion.axes.index("grip")]
            low, high = self.motion.opening
            self._gap = np.clip(self._gap + step * actions[:, -1], low, high)
        start = np.array([data.time for data in self.world.data])
        return _Springs(self._law, joints, speed, start, self.world.composed.opening, self._gap)

    def _move_pose(self, actions: np.ndarray) -> None:
        motion, tool = self.motion, self.tool()[:, :3, 3]
        position, turn = self._target[:, :3, 3], self._turn
        for k, (axis, step) in enumerate(zip(motion.axes, motion.step, strict=True)):
            if axis in "xyz":
                i = "xyz".index(axis)
                position[:, i] += step * actions[:, k]
                position[:, i] = np.clip(position[:, i], tool[:, i] - motion.leash, tool[:, i] + motion.leash)
                position[:, i] = np.clip(position[:, i], motion.low[i], motion.high[i])
            elif axis != "grip":
                turn[:, "xyz".index(axis[1])] += step * actions[:, k]
        length = np.linalg.norm(turn, axis=1)
        turn *= np.minimum(1.0, motion.turn / np.maximum(length, 1e-9))[:, None]
        turned = length > 0.0
        self._target[turned, :3, :3] = rotations(turn[turned]) @ self._start[:3, :3]


@dataclass(frozen=True)
class _Springs(BatchController):
    """Springs towards moving joint targets, and the opening of a gripper."""

    law: JointImpedance
    joints: np.ndarray
    """Targets (B, n) at ``start``."""
    speed: np.ndarray
    """Speed of the targets (B, n)."""
    start: np.ndarray
    """Time of the step's start (B,) [s]."""
    opening: int | None
    """Actuator of the opening; None without a gripper."""
    gap: np.ndarray
    """Opening (B,) [m]."""

    def drive(self, datas: Sequence[Any], envs: Sequence[int] | np.ndarray) -> None:
        some, arm = [datas[b] for b in envs], self.law.arm
        elapsed = np.array([data.time for data in some]) - self.start[envs]
        speed = self.speed[envs]
        torque = self.law.torques(some, self.joints[envs] + elapsed[:, None] * speed, speed).torque
        for b, data, row in zip(envs, some, torque, strict=True):
            arm.drive(data, row)
            if self.opening is not None:
                data.ctrl[self.opening] = self.gap[b]
