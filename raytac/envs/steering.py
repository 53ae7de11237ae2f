"""From actions to controllers: the tool's pose, or the joints, follow a target that actions move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from raytac.envs.task import Motion, turned
from raytac.errors import InputError
from raytac.robots.impedance import JointImpedance
from raytac.robots.panda import MAX_VELOCITY
from raytac.robots.pose import pose_error, site_poses
from raytac.robots.pose_servo import PoseServo
from raytac.world.state import BatchController
from raytac.world.world import TactileWorld

__all__ = ["ACTIONS", "Steering"]

ACTIONS = ("pose", "joints")
"""``pose``: an action moves the target of the tool's pose, in the axes of the task. ``joints``: it moves the targets of the arm's seven
joints, by up to 0.05 rad a step, and the opening if there is one."""
_JOINT_STEP, _JOINT_LEASH = 0.05, 0.1
_FREQUENCY = 30.0
"""Of the joints' springs [rad/s]."""


class Steering:
    """Targets of B environments.

    With ``pose`` the target moves by ``action * step`` about where it was, but never leads the tool by more than the leash, leaves the box
    or turns further than the motion allows; axes that no action moves stay as they started. Damped least squares turn it into joint
    targets once a control step, and springs in the joints follow these in every step of MuJoCo.
    """

    def __init__(self, world: TactileWorld, motion: Motion, action: str) -> None:
        """Raises ``InputError`` for a scene without an arm that has motors."""
        if world.arm is None or world.arm.motors is None:
            raise InputError("scene", value=world.scene.name, rule="needs an arm with torque motors")
        self.world, self.arm, self.motion, self.action = world, world.arm, motion, action
        start = world.composed.start
        self._posture = start[self.arm.qpos].copy()
        self._law = JointImpedance(self.arm, frequency=_FREQUENCY)
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

    def tool(self) -> np.ndarray:
        """Poses (B, 4, 4) of the tool, as the arm reckons them: where its pad should be, were it mounted as it is drawn."""
        return site_poses(self.world.data, self.arm.site)

    def joint_speed(self) -> np.ndarray:
        """[rad/s], (B, n)."""
        return np.array([data.qvel for data in self.world.data])[:, self.arm.dof]

    def opening(self) -> np.ndarray:
        """Gap between both pads by the fingers' joints [m], (B, 1); (B, 0) without a gripper."""
        if not self._has_grip:
            return np.zeros((self.world.num_envs, 0))
        fingers = self.world.composed.fingers
        return np.array([data.qpos[fingers].sum() for data in self.world.data])[:, None]

    def reset(self, envs: Sequence[int] | range) -> None:
        """Targets of environments are where they are now."""
        chosen = list(envs)
        at = self.tool()
        self._target[chosen], self._turn[chosen] = at[chosen], 0.0
        self._joints[chosen] = self._posture
        opening = self.world.composed.opening
        if opening is not None:
            self._gap[chosen] = self.world.composed.ctrl[opening]

    def controller(self, actions: np.ndarray) -> BatchController:
        """What drives all environments in the next control step; ``actions`` (B, size) in [−1, 1]."""
        dt = self.world.scene.control_timestep
        if self.action == "pose":
            before = self._target.copy()
            self._move_pose(actions)
            joints, speed = self._servo.targets(self.world.data, before, pose_error(self._target, before) / dt, dt)
        else:
            now = np.array([data.qpos for data in self.world.data])[:, self.arm.qpos]
            wanted = self._joints + _JOINT_STEP * actions[:, : len(self.arm)]
            wanted = np.clip(wanted, now - _JOINT_LEASH, now + _JOINT_LEASH)
            wanted = np.clip(wanted, self.arm.range[:, 0], self.arm.range[:, 1])
            joints, speed = self._joints, (wanted - self._joints) / dt
            self._joints = wanted
        if self._has_grip:
            step = self.motion.step[self.motion.axes.index("grip")]
            low, high = self.motion.opening
            self._gap = np.clip(self._gap + step * actions[:, -1], low, high)
        since = np.array([data.time for data in self.world.data])
        return _Springs(self._law, joints, speed, since, self.world.composed.opening, self._gap)

    def _move_pose(self, actions: np.ndarray) -> None:
        motion, at = self.motion, self.tool()[:, :3, 3]
        goal = self._target[:, :3, 3]
        turn = self._turn
        for k, (axis, step) in enumerate(zip(motion.axes, motion.step, strict=True)):
            if axis in "xyz":
                i = "xyz".index(axis)
                goal[:, i] += step * actions[:, k]
                goal[:, i] = np.clip(goal[:, i], at[:, i] - motion.leash, at[:, i] + motion.leash)
                goal[:, i] = np.clip(goal[:, i], motion.low[i], motion.high[i])
            elif axis != "grip":
                turn[:, "xyz".index(axis[1])] += step * actions[:, k]
        length = np.linalg.norm(turn, axis=1)
        turn *= np.minimum(1.0, motion.turn / np.maximum(length, 1e-9))[:, None]
        for b in np.flatnonzero(length > 0.0):
            angle = float(np.linalg.norm(turn[b]))
            rotation = turned(turn[b] / angle, angle) if angle > 0.0 else np.eye(3)
            self._target[b, :3, :3] = rotation @ self._start[:3, :3]


class _Springs(BatchController):
    """Springs towards joint targets (B, n) that move with ``speed`` since ``since`` (B,), and the opening of a gripper."""

    def __init__(
        self, law: JointImpedance, joints: np.ndarray, speed: np.ndarray, since: np.ndarray, opening: int | None, gap: np.ndarray
    ) -> None:
        self._law, self._joints, self._speed, self._since = law, joints, speed, since
        self._opening, self._gap = opening, gap

    def drive(self, datas: Sequence[Any], envs: Sequence[int] | np.ndarray) -> None:
        some, arm = [datas[b] for b in envs], self._law.arm
        late = np.array([data.time for data in some]) - self._since[envs]
        speed = self._speed[envs]
        torque = self._law.torques(some, self._joints[envs] + late[:, None] * speed, speed).torque
        for b, data, row in zip(envs, some, torque, strict=True):
            arm.drive(data, row)
            if self._opening is not None:
                data.ctrl[self._opening] = self._gap[b]
