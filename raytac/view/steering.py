"""Steers a world's robot to where sliders ask, at a bounded speed: a pose of its site, and the gap between two pads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from raytac.errors import BackendError
from raytac.robots.ik import DifferentialIk
from raytac.robots.impedance import JointImpedance
from raytac.se3 import rotations
from raytac.view.session import Control
from raytac.world.world import TactileWorld

__all__ = ["Steering"]

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_REACH_MM, _TILT, _YAW = 100.0, 45.0, 180.0
"""How far from its start the sliders take the site: [mm], [degrees] about x and y, and about z."""
_SPEED = {**dict.fromkeys(("x", "y", "z"), 50.0), **dict.fromkeys(("roll", "pitch", "yaw"), 45.0), "opening": 40.0}
"""Fastest change of what is asked of the robot, in each control's unit per second."""
_JOINT_SPEED = 1.5
"""Fastest joint [rad/s or m/s]."""
_FREQUENCY = 60.0
"""Of the springs in the joints [rad/s]."""


class Steering:
    """A controller of one environment (see ``raytac.world.state.Controller``): ``aim`` sets ends, ``go`` moves on by one control step.

    Arms with torque motors follow by differential inverse kinematics and joint impedance, a driven frame by its servos. Other robots
    are held at their start.
    """

    def __init__(self, world: TactileWorld) -> None:
        """Read what the robot is; nothing moves."""
        self._world, self._dt = world, world.scene.control_timestep
        self._model, arm = world.model, world.arm
        self.missing = ""
        """Why the robot's pose cannot be steered, for people; empty if it can, or if there is nothing to steer."""
        self._servos: dict[str, int] = {}
        self._ik, self._law = None, None
        if arm is not None and set(arm.joints) == set(_POSE):
            self._servos = {name: int(self._model.actuator(name).id) for name in _POSE}
        elif arm is not None and arm.motors is not None:
            self._law = JointImpedance(arm, frequency=_FREQUENCY)
            try:
                self._ik = DifferentialIk(arm, max_velocity=_JOINT_SPEED, posture=world.composed.start[arm.qpos])
            except BackendError as error:
                self.missing = f"The arm cannot be steered: {error}"
        self._opening = world.composed.opening
        self.controls = self._make_controls()
        self.reset()

    def reset(self) -> None:
        """Back to what the robot does at its start; call it after the world's own ``reset``."""
        world = self._world
        self._asked = {control.name: 0.0 for control in self.controls}
        if self._opening is not None:
            self._asked["opening"] = 1e3 * float(world.composed.ctrl[self._opening])
        self._now = dict(self._asked)
        if self._law is not None:
            assert world.arm is not None
            self._start = world.arm.world_from_site(world.data[0])
            self._qpos, self._velocity = world.composed.start.copy(), np.zeros(len(world.arm))
            self._from, self._since = self._qpos[world.arm.qpos].copy(), 0.0

    @property
    def asked(self) -> dict[str, float]:
        """Where each control is to take the robot."""
        return dict(self._asked)

    def aim(self, targets: Mapping[str, float]) -> None:
        """Change some of ``asked``; the values are within their controls' ends."""
        self._asked |= targets

    def go(self) -> None:
        """Move what is asked of the robot on by one control step."""
        for name, wanted in self._asked.items():
            most = _SPEED[name] * self._dt
            self._now[name] += float(np.clip(wanted - self._now[name], -most, most))
        if self._ik is not None:
            arm = self._world.arm
            assert arm is not None
            target = np.eye(4)
            target[:3, :3] = _turn(np.radians([self._now[name] for name in ("roll", "pitch", "yaw")])) @ self._start[:3, :3]
            target[:3, 3] = self._start[:3, 3] + [1e-3 * self._now[name] for name in ("x", "y", "z")]
            self._from = self._qpos[arm.qpos].copy()
            self._velocity = self._ik.velocity(self._qpos, target, self._dt)
            self._qpos[arm.qpos] += self._velocity * self._dt
            self._since = 0.0

    def __call__(self, data: Any, time: float) -> None:
        """Write ``data.ctrl``, in every step of MuJoCo: joints go straight through the control step."""
        data.ctrl[:] = self._world.composed.ctrl
        for name, servo in self._servos.items():
            data.ctrl[servo] = 1e-3 * self._now[name] if name in ("x", "y", "z") else np.radians(self._now[name])
        if self._law is not None:
            arm = self._world.arm
            assert arm is not None
            self._since = min(self._since + self._model.opt.timestep, self._dt)
            joints = self._from + self._velocity * self._since
            arm.drive(data, self._law.torque(data, joints, self._velocity).torque)
        if self._opening is not None:
            data.ctrl[self._opening] = 1e-3 * self._now["opening"]

    def _make_controls(self) -> tuple[Control, ...]:
        controls = []
        if self._ik is not None or self._servos:
            away = "From its start, world axes"
            controls += [Control(axis, f"{axis} [mm]", -_REACH_MM, _REACH_MM, 0.1, away) for axis in ("x", "y", "z")]
            controls += [Control(name, f"{name} [°]", -_TILT, _TILT, 1.0, away) for name in ("roll", "pitch")]
            controls.append(Control("yaw", "yaw [°]", -_YAW, _YAW, 1.0, away))
        if self._opening is not None:
            widest = 1e3 * float(self._model.actuator_ctrlrange[self._opening, 1])
            controls.append(Control("opening", "opening [mm]", 0.0, widest, 0.1, "Gap that the fingers' servo aims at"))
        return tuple(controls)


def _turn(angles: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by three angles [rad] about x, then y, then z of the world."""
    about_x, about_y, about_z = rotations(np.diag(angles))
    return about_z @ about_y @ about_x
