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
from raytac.robots.ik import PoseServo
from raytac.robots.impedance import JointImpedance
from raytac.robots.joint_springs import JointSprings
from raytac.robots.panda import MAX_VELOCITY
from raytac.robots.pose_errors import PoseErrors
from raytac.robots.states import StateReader, numbers
from raytac.se3 import rotations
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
        composed, data = world.composed, world.data
        self._posture = composed.start[self.arm.qpos].copy()
        opening = composed.opening
        self._springs = JointImpedance(self.arm, frequency=motion.frequency).springs(data, () if opening is None else (opening,))
        self._servo = PoseServo(self.arm, max_velocity=np.array(MAX_VELOCITY), posture=self._posture)
        self._has_grip = "grip" in motion.axes
        fingers = np.arange(world.model.nq)[composed.fingers] if self._has_grip else np.zeros(0, int)
        arm = self.arm.numbers()
        known = {
            "time": arm["time"],
            "tool": arm["site"],
            "joints": arm["joints"],
            "speed": arm["speed"],
            "fingers": numbers("qpos", fingers),
        }
        self._reader = StateReader(data, known)
        self.size = len(motion.axes) if action == "pose" else len(self.arm) + self._has_grip
        self.opening_range = motion.opening if self._has_grip else ()
        count = world.num_envs
        self._target = np.repeat(np.eye(4)[None], count, axis=0)
        self._turn = np.zeros((count, 3))
        self._joints = np.repeat(self._posture[None], count, axis=0)
        self._gap = np.zeros(count)
        self._errors = PoseErrors(count)
        moved = {"xyz".index(axis): k for k, axis in enumerate(motion.axes) if axis in "xyz"}
        self._axes, self._moves = list(moved), list(moved.values())
        self._step, self._low, self._high = (
            np.array(values)[index]
            for values, index in ((motion.step, self._moves), (motion.low, self._axes), (motion.high, self._axes))
        )
        self._turns = [
            ("xyz".index(axis[1]), k, motion.step[k]) for k, axis in enumerate(motion.axes) if axis not in ("x", "y", "z", "grip")
        ]
        self._start = self.state().tool[0].copy()
        self.reset(range(count))

    @property
    def target(self) -> np.ndarray:
        """Target poses (B, 4, 4) of the tool; with ``action="joints"`` they stay where the episode began."""
        return self._target.copy()

    def state(self) -> ToolState:
        """Present state of tool, joints and fingers."""
        now = self._reader.values()
        fingers = now["fingers"]
        opening = fingers.sum(axis=1, keepdims=True) if self._has_grip else fingers
        return ToolState(now["time"], now["tool"], now["joints"], now["speed"], opening)

    def reset(self, envs: Sequence[int] | range) -> None:
        """Set the targets of environments to their present poses."""
        chosen = list(envs)
        self._target[chosen], self._turn[chosen] = self.state().tool[chosen], 0.0
        self._joints[chosen] = self._posture
        opening = self.world.composed.opening
        if opening is not None:
            self._gap[chosen] = self.world.composed.ctrl[opening]

    def controller(self, actions: np.ndarray) -> BatchController:
        """Controller of all environments for the next control step; ``actions`` (B, size) in [−1, 1].

        It has no targets of its own: one that was asked for before follows the same from now on.
        """
        dt, now = self.world.composed.control_timestep, self.state()
        if self.action == "pose":
            before = self._target.copy()
            self._move_pose(actions, now.tool[:, :3, 3])
            joints, speed = self._servo.targets(self.world.data, before, self._errors((self._target, before))[0] / dt, dt)
        else:
            target = self._joints + self.motion.joint_step * actions[:, : len(self.arm)]
            target = np.clip(target, now.joints - self.motion.joint_leash, now.joints + self.motion.joint_leash)
            target = np.clip(target, self.arm.range[:, 0], self.arm.range[:, 1])
            joints, speed = self._joints, (target - self._joints) / dt
            self._joints = target
        if self._has_grip:
            step = self.motion.step[self.motion.axes.index("grip")]
            low, high = self.motion.opening
            self._gap = np.clip(self._gap + step * actions[:, -1], low, high)
        self._springs.aim(joints, speed, now.time, self._gap[:, None])
        return _Follow(self._springs)

    def _move_pose(self, actions: np.ndarray, tool: np.ndarray) -> None:
        motion, i = self.motion, self._axes
        tool, position = tool[:, i], self._target[:, i, 3] + self._step * actions[:, self._moves]
        for low, high in ((tool - motion.leash, tool + motion.leash), (self._low, self._high)):
            position = np.minimum(np.maximum(position, low), high)
        self._target[:, i, 3] = position
        if not self._turns:
            return
        turn = self._turn
        for axis, k, step in self._turns:
            turn[:, axis] += step * actions[:, k]
        length = np.linalg.norm(turn, axis=1)
        turn *= np.minimum(1.0, motion.turn / np.maximum(length, 1e-9))[:, None]
        turned = length > 0.0
        self._target[turned, :3, :3] = rotations(turn[turned]) @ self._start[:3, :3]


@dataclass(frozen=True)
class ToolState:
    """Arm of B environments by its joints."""

    time: np.ndarray
    """Since the reset [s], (B,)."""
    tool: np.ndarray
    """Poses (B, 4, 4) of the tool: where its pad would be if it were mounted without error."""
    joints: np.ndarray
    """Positions (B, n) [rad]."""
    speed: np.ndarray
    """Joint speeds (B, n) [rad/s]."""
    opening: np.ndarray
    """Gap between both pads by the fingers' joints [m], (B, 1); (B, 0) without a gripper."""


@dataclass(frozen=True)
class _Follow(BatchController):
    """Springs towards moving joint targets, and the opening of a gripper."""

    springs: JointSprings

    def drive(self, datas: Sequence[Any], envs: Sequence[int] | np.ndarray) -> None:
        self.springs.drive(envs)
