"""Two pads that close on something until they press with a given force, and then go where a path says: for grasping experiments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from raytac.robots import CartesianImpedance
from raytac.se3 import pose
from raytac.world import TactileWorld, WorldState

__all__ = ["GraspController", "smooth"]


def smooth(share: float) -> float:
    """From 0 to 1 with speed and acceleration 0 at both ends, and clipped beyond them."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


class GraspController:
    """Steers a scene with two pads: the opening by the force that they feel, the frame between them by a path in Cartesian space.

    Call ``update`` once a control step; the world calls the controller in every step of MuJoCo. An arm is steered by Cartesian
    impedance, a floating gripper by its servos; one that a hand's servo opens and closes.
    """

    def __init__(
        self,
        world: TactileWorld,
        path: Callable[[float], np.ndarray],
        *,
        force: float,
        speed: float = 0.03,
        gain: float = 0.5e-3,
        stiffness: float = 4000.0,
    ) -> None:
        """Stand still, open.

        Args:
            world: with two pads and one opening.
            path: displacement of the pads' frame from the start, world frame, at a time [s]: (3,) [m]; of a floating gripper also (6,).
            force: that each pad is to press with [N].
            speed: of the closing of the gap until both pads feel something [m/s].
            gain: speed of the closing per missing force [m/(s N)].
            stiffness: of the arm [N/m].
        """
        assert world.composed.opening is not None and world.arm is not None
        self.world, self.path, self.force, self.speed, self.gain = world, path, force, speed, gain
        self.opening, self.is_closing = world.composed.opening, False
        self.gap = float(world.composed.ctrl[self.opening])
        self._impedance = None
        if world.arm.motors is not None:
            start = world.composed.start[world.arm.qpos]
            self._impedance = CartesianImpedance(world.arm, stiffness=stiffness, rotational_stiffness=200.0, posture=start)
            self._start = world.arm.world_from_site(world.data[0])

    def update(self, state: WorldState) -> float:
        """Takes in what the pads feel; returns the smaller normal force [N]."""
        felt = [-float(state.wrench[name][0, 2]) for name in self.world.sensor_names]
        dt = self.world.control_timestep
        if self.is_closing:
            missing = self.force - min(felt)
            slow = self.gain * missing
            self.gap -= dt * (self.speed if min(felt) < 0.02 * self.force else float(np.clip(slow, -self.speed, self.speed)))
            self.gap = max(self.gap, 0.0)
        elif self.force == 0.0:
            self.gap = min(self.gap + dt * self.speed, float(self.world.composed.ctrl[self.opening]))
        return min(felt)

    def __call__(self, data: Any, time: float) -> None:
        """``data``: a ``mujoco.MjData``."""
        way = self.path(time)
        data.ctrl[self.opening] = self.gap
        if self._impedance is not None:
            target = self._start @ np.eye(4)
            target[:3, 3] += way[:3]
            assert self.world.arm is not None
            self.world.arm.drive(data, self._impedance.torque(data, pose(target[:3, :3], target[:3, 3])).torque)
        else:
            data.ctrl[: len(way)] = way
