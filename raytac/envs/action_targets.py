"""Targets of tools and joints of B environments, moved by actions; NumPy or PyTorch."""

from __future__ import annotations

import math

from raytac.envs.task_rules import Array, Motion, constant, namespace_of
from raytac.se3 import rotations


class ToolTargets:
    """Target pose and opening of every environment.

    An action moves the target by ``action * step``. The target never leads the tool by more than the leash, leaves the box or turns further
    than the motion allows; axes that no action moves stay as they started.

    Attributes:
        pose: target poses (B, 4, 4) of the tool.
        turn: rotation vectors (B, 3) of the targets from the start [rad].
        gap: commanded openings (B,) [m]; 0 without a gripper.
        has_grip: actions command the opening.
    """

    def __init__(self, motion: Motion, tool: Array, opening: float) -> None:
        """Start at tool poses (B, 4, 4); targets turn from the first one's rotation.

        ``opening``: commanded at the start of an episode [m].
        """
        xp = namespace_of(tool)
        self._motion, self._opening = motion, opening
        self.pose, self.turn = xp.asarray(tool, copy=True), xp.zeros_like(tool[:, :3, 3])
        self.gap = xp.full_like(tool[:, 0, 3], opening)
        self._first = self.pose[0, :3, :3]
        column = {axis: k for k, axis in enumerate(motion.axes)}
        self._columns = [column.get(axis, 0) for axis in "xyz"]
        # An axis that no action moves has no step, and nothing holds it back.
        moved = [axis in column for axis in "xyz"]
        self._step = constant([motion.step[k] if one else 0.0 for one, k in zip(moved, self._columns, strict=True)], tool)
        self._leash = constant([motion.leash if one else math.inf for one in moved], tool)
        self._low = constant([low if one else -math.inf for one, low in zip(moved, motion.low, strict=True)], tool)
        self._high = constant([high if one else math.inf for one, high in zip(moved, motion.high, strict=True)], tool)
        self._turns = [(k, column[axis]) for k, axis in enumerate(("rx", "ry", "rz")) if axis in column]
        self.has_grip = "grip" in motion.axes

    def begin(self, mask: Array, tool: Array) -> None:
        """Set the targets of the environments of a mask (B,) to poses (B, 4, 4)."""
        xp = namespace_of(tool)
        self.pose = xp.where(mask[:, None, None], tool, self.pose)
        self.turn = xp.where(mask[:, None], 0.0, self.turn)
        self.gap = xp.where(mask, self._opening, self.gap)

    def move(self, actions: Array, tool: Array) -> None:
        """Move the poses by actions (B, k), k the motion's axes; tools are at (B, 3) now."""
        motion, xp = self._motion, namespace_of(actions)
        pose = xp.asarray(self.pose, copy=True)
        shift = self._step * xp.stack([actions[:, k] for k in self._columns], axis=1)
        place = _leashed(pose[:, :3, 3] + shift, tool, self._leash)
        pose[:, :3, 3] = xp.minimum(xp.maximum(place, self._low), self._high)
        if self._turns:
            turn = xp.asarray(self.turn, copy=True)
            for axis, k in self._turns:
                turn[:, axis] = turn[:, axis] + motion.step[k] * actions[:, k]
            length = xp.sqrt(xp.vecdot(turn, turn))
            self.turn = turn * (motion.turn / length.clip(1e-9)).clip(max=1.0)[:, None]
            rotation = rotations(self.turn) @ self._first
            pose[:, :3, :3] = xp.where((length > 0.0)[:, None, None], rotation, pose[:, :3, :3])
        self.pose = pose

    def grip(self, actions: Array) -> None:
        """Change the openings by the last of the actions (B, k)."""
        if self.has_grip:
            step, (low, high) = self._motion.step[self._motion.axes.index("grip")], self._motion.opening
            self.gap = (self.gap + step * actions[:, -1]).clip(low, high)


def joint_targets(motion: Motion, actions: Array, target: Array, joints: Array, limits: Array) -> Array:
    """Targets (B, n) of joints after actions (B, n).

    They move by up to the motion's ``joint_step``, lead the joints by at most its ``joint_leash`` and stay within the joints' limits.

    Args:
        actions: in [−1, 1].
        target, joints: targets before and present positions (B, n) [rad].
        limits: lower and upper one of each joint (n, 2) [rad].
    """
    xp = namespace_of(target)
    target = _leashed(target + motion.joint_step * actions, joints, motion.joint_leash)
    return xp.minimum(xp.maximum(target, limits[:, 0]), limits[:, 1])


def _leashed(target: Array, now: Array, leash: Array | float) -> Array:
    """Targets that lead what is now by at most the leash."""
    xp = namespace_of(target)
    return xp.minimum(xp.maximum(target, now - leash), now + leash)
