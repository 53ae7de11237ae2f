"""Controllers from actions, which move a target of the tool's pose or of the joints.

Targets of many environments go through ``PoseServo``, one small solve for all of them; the viewer's sliders, one environment and people,
go through ``DifferentialIk``, which keeps every limit (``raytac.robots.ik`` says what each costs).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.envs.action_targets import ToolTargets, joint_targets
from raytac.envs.task_rules import Motion
from raytac.errors import InputError
from raytac.robots.ik import PoseServo
from raytac.robots.impedance import JointImpedance
from raytac.robots.joint_springs import JointSprings
from raytac.robots.panda import MAX_VELOCITY
from raytac.robots.pose_errors import PoseErrors
from raytac.robots.states import StateReader, numbers
from raytac.world.world import TactileWorld
from raytac.world.world_state import BatchController

ACTIONS = ("pose", "joints")
"""Actions: ``pose`` moves the target of the tool's pose, ``joints`` those of the joints.

A pose's axes are the task's. The arm's seven joints move by up to ``Motion.joint_step`` a step, with the opening if there is one."""


class ActionControl:
    """Targets of B environments.

    With ``pose`` actions move ``ToolTargets``. Damped least squares turn them into joint targets once a control step, and springs in the
    joints follow these in every step of MuJoCo.
    """

    def __init__(self, world: TactileWorld, motion: Motion, action: str) -> None:
        """Start with the targets where the tool is; InputError for no arm with motors."""
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
        fingers = np.arange(world.model.nq)[composed.fingers] if "grip" in motion.axes else np.zeros(0, int)
        arm = self.arm.numbers()
        known = {
            "time": arm["time"],
            "tool": arm["site"],
            "joints": arm["joints"],
            "speed": arm["speed"],
            "fingers": numbers("qpos", fingers),
        }
        self._reader = StateReader(data, known)
        has_grip, count = "grip" in motion.axes, world.num_envs
        self.size = len(motion.axes) if action == "pose" else len(self.arm) + has_grip
        self.opening_range = motion.opening if has_grip else ()
        self._joints = np.repeat(self._posture[None], count, axis=0)
        self._errors = PoseErrors(count)
        self._targets = ToolTargets(motion, self.state().tool, 0.0 if opening is None else float(composed.ctrl[opening]))
        self.reset(range(count))

    @property
    def target(self) -> np.ndarray:
        """Target poses (B, 4, 4) of the tool; of ``action="joints"`` where the episode began."""
        return self._targets.pose.copy()

    def state(self) -> ToolState:
        """Present state of tool, joints and fingers."""
        now = self._reader.values()
        fingers = now["fingers"]
        opening = fingers.sum(axis=1, keepdims=True) if self.opening_range else fingers
        return ToolState(now["time"], now["tool"], now["joints"], now["speed"], opening)

    def reset(self, envs: Sequence[int] | range) -> None:
        """Set the targets of environments to their present poses."""
        mask = np.zeros(self.world.num_envs, bool)
        mask[list(envs)] = True
        self._targets.begin(mask, self.state().tool)
        self._joints[mask] = self._posture

    def controller(self, actions: np.ndarray) -> BatchController:
        """Controller of all environments for the next step; ``actions`` (B, size) in [−1, 1].

        It has no targets of its own: one that was asked for before follows the same from now on.
        """
        dt, now = self.world.composed.control_timestep, self.state()
        if self.action == "pose":
            before = self._targets.pose
            self._targets.move(actions, now.tool[:, :3, 3])
            joints, speed = self._servo.targets(self.world.data, before, self._errors((self._targets.pose, before))[0] / dt, dt)
        else:
            target = joint_targets(self.motion, actions[:, : len(self.arm)], self._joints, now.joints, self.arm.range)
            joints, speed = self._joints, (target - self._joints) / dt
            self._joints = target
        self._targets.grip(actions)
        self._springs.aim(joints, speed, now.time, self._targets.gap[:, None])
        return _Follow(self._springs)


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
