"""Rolls a ball between a pad and a table to goals, in strokes: press, roll, lift, go over the ball again. Sees by touch only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.robots import MAX_VELOCITY, DifferentialIk, JointImpedance
from raytac.world import TactileWorld

__all__ = ["PHASES", "RollingController", "Strokes"]

PHASES = ("press", "roll", "stop", "lift", "travel", "done")


@dataclass(frozen=True)
class Strokes:
    """How the ball is rolled; lengths in m, speeds in m/s."""

    ball_radius: float = 0.005
    force: float = 0.5
    """Normal force that the pad presses with [N]."""
    reach: float = 0.005
    """Greatest distance of the ball from the middle of the pad along a stroke: it starts this far ahead and ends this far behind."""
    roll_speed: float = 0.04
    """Of the pad; the ball has half of it."""
    press_speed: float = 0.01
    lift_speed: float = 0.04
    travel_speed: float = 0.1
    clearance: float = 0.003
    """Between ball and pad while the pad travels."""
    tolerance: float = 0.001
    """From ball to goal."""
    rest: float = 0.05
    """Time that the pad stands still after a roll, so that the ball does not run away when it is let go [s]."""
    force_gain: float = 0.004
    """Speed of the pad along its normal per newton that is missing [m/(s N)]."""


class RollingController:
    """One arm and one ball. ``update`` once a control step with what the pad feels, then the world calls it in every step of MuJoCo.

    The ball rolls on the table and under the pad, so it moves half as far as the pad and falls behind it by as much. The ball's place is
    where the pad is touched; without touch, where it was last.
    """

    def __init__(self, world: TactileWorld, env: int, goals: np.ndarray, strokes: Strokes | None = None) -> None:
        """``goals`` (G, 2): x, y of the ball [m], world frame, in order."""
        assert world.arm is not None
        self.strokes = Strokes() if strokes is None else strokes
        self.goals, self.arm = np.asarray(goals, float), world.arm
        self.goal, self.phase, self.strokes_done = 0, "press", 0
        self.dt = world.control_timestep
        start = world.composed.start[self.arm.qpos]
        self._ik = DifferentialIk(self.arm, max_velocity=np.array(MAX_VELOCITY), posture=start)
        self._law = JointImpedance(self.arm, frequency=60.0)
        self._qpos, self._velocity = world.composed.start.copy(), np.zeros(len(self.arm))
        state = world.state()
        (name,) = world.sensor_names
        self.target = state.world_from_pad[name][env].copy()
        self.ball = state.world_from_body["ball"][env, :2, 3].copy()
        self._waited, self._since = 0.0, 0.0
        self._target_start = float(world.data[env].time)

    @property
    def done(self) -> bool:
        return self.phase == "done"

    def update(self, world_from_pad: np.ndarray, contact_centre: np.ndarray, force: float) -> None:
        """Move the target on by one control step.

        ``world_from_pad`` (4, 4) of the pad now; ``contact_centre`` (2,) [m], pad frame, NaN without contact; ``force`` of the pad on the
        ball along the pad's normal [N], >= 0.
        """
        touching = bool(np.isfinite(contact_centre).all()) and force > 0.0
        if touching:
            self.ball = (world_from_pad[:3, :2] @ contact_centre + world_from_pad[:3, 3])[:2]
        velocity = self._next(world_from_pad, touching, force)
        self.target[:3, 3] += velocity * self.dt
        joints = self._ik.velocity(self._qpos, self.target, self.dt)
        self._from = self._qpos[self.arm.qpos].copy()
        self._velocity = joints
        self._qpos[self.arm.qpos] += joints * self.dt
        self._since = 0.0

    def __call__(self, data: Any, time: float) -> None:
        """Torques that follow the joints' straight line through this control step."""
        self._since = min(self._since + self.arm.model.opt.timestep, self.dt)
        joints = self._from + self._velocity * self._since
        self.arm.drive(data, self._law.torque(data, joints, self._velocity).torque)

    def _next(self, world_from_pad: np.ndarray, touching: bool, force: float) -> np.ndarray:
        """Velocity (3,) of the target [m/s], world axes; changes the phase."""
        s, pad = self.strokes, self.target[:2, 3]
        velocity = np.zeros(3)
        to_goal = self.goals[min(self.goal, len(self.goals) - 1)] - self.ball
        distance = float(np.linalg.norm(to_goal))
        along = to_goal / max(distance, 1e-9)
        if self.phase == "press":
            velocity[2] = -s.press_speed
            if force >= s.force:
                self.phase, self._along = "roll", along
        elif self.phase == "roll":
            velocity[2] = s.force_gain * (force - s.force)
            behind = float((pad - self.ball) @ self._along)
            left = float(to_goal @ self._along)
            # Slow down so that the pad can stop in one control step within a tenth of the tolerance.
            speed = min(s.roll_speed, max(8.0 * left, 0.0))
            velocity[:2] = speed * self._along
            if left <= 0.5 * s.tolerance or behind >= s.reach or not touching:
                self.phase, self._waited = "stop", 0.0
        elif self.phase == "stop":
            velocity[2] = s.force_gain * (force - s.force)
            self._waited += self.dt
            if self._waited >= s.rest:
                self.strokes_done += 1
                if distance <= s.tolerance:
                    self.goal += 1
                self.phase = "lift"
        elif self.phase == "lift":
            velocity[2] = s.lift_speed
            if self.target[2, 3] >= 2.0 * s.ball_radius + s.clearance:
                self.phase = "done" if self.goal == len(self.goals) else "travel"
        elif self.phase == "travel":
            # The stroke's middle is where the pad is over the ball.
            away = self.ball + min(s.reach, 0.5 * distance) * -along - pad
            most = s.travel_speed * self.dt
            length = float(np.linalg.norm(away))
            velocity[:2] = away / self.dt * min(1.0, most / max(length, 1e-12))
            if length <= most:
                self.phase = "press"
        return velocity
