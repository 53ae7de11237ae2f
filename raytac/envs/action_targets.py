"""Targets of tools that actions move, of B environments; arrays of NumPy, or of PyTorch on any device."""

from __future__ import annotations

from array_api_compat import array_namespace

from raytac.envs.task_rules import Array, Motion
from raytac.se3 import rotations


class ToolTargets:
    """Target pose and opening of every environment.

    An action moves the target by ``action * step``. The target never leads the tool by more than the leash, leaves the box or turns further
    than the motion allows; axes that no action moves stay as they started.

    Attributes:
        pose: target poses (B, 4, 4) of the tool.
        turn: rotation vectors (B, 3) of the targets from the start [rad].
        gap: commanded openings (B,) [m]; 0 without a gripper.
    """

    def __init__(self, motion: Motion, tool: Array, opening: float) -> None:
        """Start at poses (B, 4, 4) of the tool; the first one's rotation is that from which targets turn.

        ``opening``: commanded at the start of an episode [m].
        """
        xp = array_namespace(tool)
        self._motion, self._opening = motion, opening
        self._first = xp.asarray(tool[0, :3, :3], copy=True)
        self.pose, self.turn, self.gap = xp.asarray(tool, copy=True), xp.zeros_like(tool[:, :3, 3]), 0.0 * tool[:, 0, 3] + opening
        axes = list(enumerate(motion.axes))
        self._shifts = [("xyz".index(axis), k) for k, axis in axes if axis in ("x", "y", "z")]
        self._turns = [("xyz".index(axis[1]), k) for k, axis in axes if axis in ("rx", "ry", "rz")]
        self.has_grip = "grip" in motion.axes

    def begin(self, mask: Array, tool: Array) -> None:
        """Set the targets of the environments of a mask (B,) to poses (B, 4, 4)."""
        xp = array_namespace(tool)
        self.pose = xp.where(mask[:, None, None], tool, self.pose)
        self.turn = xp.where(mask[:, None], 0.0, self.turn)
        self.gap = xp.where(mask, self._opening, self.gap)

    def move(self, actions: Array, tool: Array) -> None:
        """Move the targets by actions (B, k), k the number of the motion's axes, from the tools' present positions (B, 3)."""
        motion, xp = self._motion, array_namespace(actions)
        pose = xp.asarray(self.pose, copy=True)
        for axis, k in self._shifts:
            place = pose[:, axis, 3] + motion.step[k] * actions[:, k]
            place = xp.minimum(xp.maximum(place, tool[:, axis] - motion.leash), tool[:, axis] + motion.leash)
            pose[:, axis, 3] = xp.clip(place, motion.low[axis], motion.high[axis])
        if self._turns:
            turn = xp.asarray(self.turn, copy=True)
            for axis, k in self._turns:
                turn[:, axis] = turn[:, axis] + motion.step[k] * actions[:, k]
            length = xp.sqrt(xp.vecdot(turn, turn))
            self.turn = turn * xp.where(length > motion.turn, motion.turn / xp.clip(length, 1e-9, None), 1.0)[:, None]
            pose[:, :3, :3] = rotations(self.turn) @ self._first
        self.pose = pose

    def grip(self, actions: Array) -> None:
        """Change the openings by the last of the actions (B, k)."""
        if self.has_grip:
            step, (low, high) = self._motion.step[self._motion.axes.index("grip")], self._motion.opening
            self.gap = array_namespace(actions).clip(self.gap + step * actions[:, -1], low, high)
