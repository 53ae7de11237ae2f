"""Steering of a world's robot by sliders: the site's pose, joints, the opening, actuators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from raytac.errors import BackendError
from raytac.robots.actuators import Actuator, actuators
from raytac.robots.ik import DifferentialIk
from raytac.robots.impedance import JointImpedance
from raytac.view.session import Control, Handle, HandlePlace, round_up, turn_angles, turned_by
from raytac.world.world import TactileWorld
from raytac.world.world_state import WorldState

_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_REACH_MM, _TILT, _YAW = 100.0, 45.0, 180.0
"""Range of the sliders about the site's start: [mm], [degrees] about x and y, and about z."""
_JOINT_STEP = 0.1
"""Step of a joint's slider [mm or degrees]; its ends are multiples, within the range."""
_SPEED = {"mm": 50.0, "°": 45.0}
"""Fastest change of what is asked of the robot, in these units per second."""
_OPENING_SPEED = 40.0
"""The same of the opening [mm/s]."""
_JOINT_SPEED = 1.5
"""Fastest joint [rad/s or m/s]."""
_FREQUENCY = 60.0
"""Of the springs in the joints [rad/s]."""
_FINE = 500.0
"""Least number of steps of an actuator's slider."""


class Driver(Protocol):
    """Moves a world of one environment; the session calls it and never the world itself."""

    controls: tuple[Control, ...]
    handle: Handle | None
    missing: str
    """Why something cannot be steered, for people; empty if nothing hinders it."""
    facts: Mapping[str, str]
    """Lines of the read-out, by label."""

    def reset(self) -> WorldState:
        """Back to the start."""
        ...

    def resume(self) -> None:
        """Go on; from a start if it has ended."""
        ...

    def aim(self, targets: Mapping[str, float]) -> None:
        """Change what is asked; the values are within their controls' ends."""
        ...

    def step(self) -> WorldState | None:
        """State after one control step; None at an end."""
        ...

    @property
    def asked(self) -> dict[str, float]:
        """Target of each control."""
        ...

    @property
    def place(self) -> HandlePlace | None:
        """Place of the handle."""
        ...


class Steering:
    """A robot's driver for sliders, and the controller of the world.

    Arms with torque motors follow by joint impedance, the site's pose by differential inverse kinematics, a driven frame by its servos.
    Every other actuator has a slider of its own.
    """

    def __init__(self, world: TactileWorld) -> None:
        """Read what the robot is; nothing moves."""
        self._world, self._dt = world, world.composed.control_timestep
        self._model, arm = world.model, world.arm
        self.missing = ""
        self.facts: Mapping[str, str] = {}
        self._servos: dict[str, int] = {}
        self._ik, self._law = None, None
        if arm is not None and set(arm.joints) == set(_POSE):
            self._servos = {name: int(self._model.actuator(name).id) for name in _POSE}
        elif arm is not None and arm.motors is not None:
            self._law = JointImpedance(arm, frequency=_FREQUENCY)
            try:
                self._ik = DifferentialIk(arm, max_velocity=_JOINT_SPEED, posture=world.composed.start[arm.qpos])
            except BackendError as error:
                self.missing = f"The arm's pose cannot be steered, its joints can: {error}"
        self._opening = world.composed.opening
        self._joints = {} if arm is None or self._law is None else {f"joint {name}": k for k, name in enumerate(arm.joints)}
        """Place in the arm of each joint that has a slider, by control."""
        taken = {*self._servos.values(), *(arm.motors if self._law is not None and arm is not None else ()), self._opening}  # type: ignore[misc]
        self._others = {f"actuator {one.name}": one for one in actuators(self._model) if one.index not in taken}
        """Actuators that nothing else moves, by control."""
        self._speeds: dict[str, float] = {}
        self.controls = self._make_controls()
        self.handle = Handle(("x", "y", "z"), ("roll", "pitch", "yaw")) if self._has_pose else None
        self._begin()

    @property
    def _has_pose(self) -> bool:
        return self._ik is not None or bool(self._servos)

    def reset(self) -> WorldState:
        """Back to what the robot does at its start."""
        state = self._world.reset()
        self._begin()
        return state

    def resume(self) -> None:
        """Time has no end: nothing to do."""

    def _begin(self) -> None:
        world, arm = self._world, self._world.arm
        self._asked = {control.name: 0.0 for control in self.controls}
        if self._opening is not None:
            self._asked["opening"] = 1e3 * float(world.composed.ctrl[self._opening])
        for name, one in self._others.items():
            self._asked[name] = one.factor * float(world.composed.ctrl[one.index])
        self._by_joints = not self._has_pose
        """True if joints are asked for, and the pose is what comes of it."""
        if arm is not None:
            self._start = arm.world_from_site(world.data[0])
        if self._law is not None:
            assert arm is not None
            self._qpos, self._velocity = world.composed.start.copy(), np.zeros(len(arm))
            self._from, self._since = self._qpos[arm.qpos].copy(), 0.0
            self._asked |= self._joint_values()
        self._now = dict(self._asked)

    @property
    def asked(self) -> dict[str, float]:
        """Target of each control; of pose and joints those that are not steered show what is."""
        if self._law is None:
            return dict(self._asked)
        followed = self._pose_values() if self._by_joints and self._has_pose else {}
        return {**self._asked, **followed, **({} if self._by_joints else self._joint_values())}

    @property
    def place(self) -> HandlePlace | None:
        """Pose that is asked of the site."""
        if not self._has_pose:
            return None
        values = {name: self.asked[name] for name in _POSE}
        return HandlePlace(self._target(values), values)

    def aim(self, targets: Mapping[str, float]) -> None:
        """Change some of ``asked``; a joint takes over from the pose, the pose from the joints."""
        by_joints, by_pose = any(name in self._joints for name in targets), any(name in _POSE for name in targets)
        if by_joints and not self._by_joints:
            self._by_joints = True
            self._asked |= self._joint_values()
            self._now |= self._joint_values()
        elif by_pose and self._by_joints and self._has_pose:
            self._by_joints = False
            self._asked |= self._pose_values()
            self._now |= self._pose_values()
        self._asked |= targets

    def step(self) -> WorldState:
        """Move what is asked of the robot on by one control step, and the world with it."""
        for name, wanted in self._asked.items():
            most = self._speeds.get(name, np.inf) * self._dt
            self._now[name] += float(np.clip(wanted - self._now[name], -most, most))
        if self._law is not None:
            arm = self._world.arm
            assert arm is not None
            self._from, self._since = self._qpos[arm.qpos].copy(), 0.0
            if self._by_joints:
                ends = np.array([self._now[name] / self._joint_factor(k) for name, k in self._joints.items()])
                self._velocity = (ends - self._from) / self._dt
            else:
                assert self._ik is not None
                self._velocity = self._ik.velocity(self._qpos, self._target(self._now), self._dt)
            self._qpos[arm.qpos] += self._velocity * self._dt
        return self._world.step(self)

    def __call__(self, data: Any, time: float) -> None:
        """Write ``data.ctrl``, in every step of MuJoCo: joints go straight through the control step."""
        data.ctrl[:] = self._world.composed.ctrl
        for name, servo in self._servos.items():
            data.ctrl[servo] = 1e-3 * self._now[name] if name in ("x", "y", "z") else np.radians(self._now[name])
        for name, one in self._others.items():
            data.ctrl[one.index] = self._now[name] / one.factor
        if self._law is not None:
            arm = self._world.arm
            assert arm is not None
            self._since = min(self._since + self._model.opt.timestep, self._dt)
            joints = self._from + self._velocity * self._since
            arm.drive(data, self._law.torque(data, joints, self._velocity).torque)
        if self._opening is not None:
            data.ctrl[self._opening] = 1e-3 * self._now["opening"]

    def _target(self, values: Mapping[str, float]) -> np.ndarray:
        """Pose (4, 4) of the site so far from its start."""
        target = np.eye(4)
        target[:3, :3] = turned_by(np.radians([values[name] for name in ("roll", "pitch", "yaw")])) @ self._start[:3, :3]
        target[:3, 3] = self._start[:3, 3] + [1e-3 * values[name] for name in ("x", "y", "z")]
        return target

    def _pose_values(self) -> dict[str, float]:
        """The site's pose from its start now, in the controls' units."""
        arm = self._world.arm
        assert arm is not None
        now = arm.world_from_site(self._world.data[0])
        angles = np.degrees(turn_angles(now[:3, :3] @ self._start[:3, :3].T))
        return dict(zip(_POSE, [*(1e3 * (now[:3, 3] - self._start[:3, 3])).tolist(), *angles.tolist()], strict=True))

    def _joint_values(self) -> dict[str, float]:
        """Joint positions that the arm is held at, in the controls' units."""
        arm = self._world.arm
        assert arm is not None
        return {name: self._joint_factor(k) * float(self._qpos[arm.qpos[k]]) for name, k in self._joints.items()}

    def _joint_factor(self, k: int) -> float:
        arm = self._world.arm
        assert arm is not None
        return 1e3 if arm.slides[k] else float(np.degrees(1.0))

    def _make_controls(self) -> tuple[Control, ...]:
        controls = []
        if self._has_pose:
            away = "From its start, world axes"
            controls += [Control(axis, f"{axis} [mm]", -_REACH_MM, _REACH_MM, 0.1, away) for axis in ("x", "y", "z")]
            controls += [Control(name, f"{name} [°]", -_TILT, _TILT, 1.0, away) for name in ("roll", "pitch")]
            controls.append(Control("yaw", "yaw [°]", -_YAW, _YAW, 1.0, away))
            self._speeds |= {name: _SPEED["mm" if name in ("x", "y", "z") else "°"] for name in _POSE}
        if self._opening is not None:
            widest = 1e3 * float(self._model.actuator_ctrlrange[self._opening, 1])
            controls.append(Control("opening", "opening [mm]", 0.0, widest, 0.1, "Gap that the fingers' servo aims at"))
            self._speeds["opening"] = _OPENING_SPEED
        controls += [self._joint_control(name, k) for name, k in self._joints.items()]
        controls += [self._actuator_control(name, one) for name, one in self._others.items()]
        return tuple(controls)

    def _joint_control(self, name: str, k: int) -> Control:
        arm = self._world.arm
        assert arm is not None
        unit, factor = ("mm", 1e3) if arm.slides[k] else ("°", float(np.degrees(1.0)))
        low, high = (float(factor * end) for end in arm.range[k])
        if not np.isfinite([low, high]).all():
            low, high = (-_REACH_MM, _REACH_MM) if arm.slides[k] else (-180.0, 180.0)
        low, high = math.ceil(low / _JOINT_STEP) * _JOINT_STEP, math.floor(high / _JOINT_STEP) * _JOINT_STEP
        self._speeds[name] = _SPEED[unit]
        hint = "Position that the joint's spring and damper hold it at"
        return Control(name, f"{arm.joints[k]} [{unit}]", round(low, 6), round(high, 6), _JOINT_STEP, hint)

    def _actuator_control(self, name: str, one: Actuator) -> Control:
        low, high = one.factor * one.low, one.factor * one.high
        step = round_up((high - low) / (2.0 * _FINE))
        if one.unit in _SPEED:
            self._speeds[name] = _SPEED[one.unit]
        hint = {"position": "Position that the servo aims at", "velocity": "Velocity that the servo aims at"}.get(one.kind, "")
        hint = hint or {"force": "Force or torque of the motor"}.get(one.kind, "Control of the actuator, as the model has it")
        hint += "" if one.is_ranged else "; the model gives no range, so this one is only a choice"
        label = f"{one.name} [{one.unit}]" if one.unit else one.name
        return Control(name, label, low, high, step, hint)
