"""A task scene as a session: time runs while it plays, and sliders steer the robot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from raytac.errors import BackendError, RaytacError
from raytac.frame import TactileFrame
from raytac.physics.geoms import geom_part
from raytac.robots.ik import DifferentialIk
from raytac.robots.impedance import JointImpedance
from raytac.se3 import rotations
from raytac.shapes.triangulate import part_surface
from raytac.view.sensor_view import coat_edges, coat_lines, coat_pad, gel_solid, narrow_warning, pad_view, square, strided
from raytac.view.session import CameraPlace, Colour, Control, Snapshot, Solid, check_targets
from raytac.world.world import TactileWorld
from raytac.world.world_state import WorldState

_SHOWN_GROUPS = 3
"""Geoms of MuJoCo's first groups are shown, as its own viewer does."""
_PLANE = 1.5
"""A half-space is drawn as a square of this size [m]."""
_ROUND = 1.5e-3
"""Depth of facets inside a curved geom, over its size."""
_SOFT_COLOUR = (200, 190, 120)
_NEAREST, _FARTHEST = 0.12, 0.6
"""Least and greatest distance of the eye from the sensors [m], over 2.5."""


class WorldSession:
    """One environment of a world, shown every ``steps`` control steps: images cost most."""

    units_per_metre = 10.0
    is_driven_at_rest = False

    def __init__(self, world: TactileWorld, *, steps: int = 1) -> None:
        """Take the world as it is at its start.

        Args:
            world: with ``num_envs = 1``.
            steps: control steps from one shown state to the next. Markers that follow a contact's history (``fots``) see only
                the states that are shown.
        """
        self._world, self._steps = world, steps
        self._steering = Steering(world)
        self._state: WorldState = world.reset()
        self._sensors = world.sensors
        self._grids = {name: strided(sensor.grid) for name, sensor in self._sensors.items()}
        label = next(iter(self._sensors.values())).label
        scene = world.scene
        self.title = f"{scene.name} · {scene.robot.model.rsplit('/', 1)[-1]} · {label}" if scene is not None else label
        self.controls: tuple[Control, ...] = self._steering.controls
        self.pads = tuple(coat_pad(name, sensor, self._grids[name]) for name, sensor in self._sensors.items())
        self._body_of: dict[str, int] = {}
        """Body of the model that carries a solid, by the solid's name."""
        self._soft = [] if scene is None else [body for body in scene.bodies if body.dynamics == "soft"]
        gels = (gel_solid(sensor.spec, f"{name}_gel") for name, sensor in self._sensors.items())
        self.solids = (*self._geoms(), *gels, *self._soft_bodies())
        self.camera = self._camera()
        self.lines = tuple(coat_lines(f"{name}_coat_mesh") for name in (self._sensors if world.physics.is_simulated else ()))
        self._physics_ms = 0.0
        self._shot: Snapshot | None = None

    def reset(self) -> None:
        self._state = self._world.reset()
        self._steering.reset()
        self._shot = None

    def resume(self) -> None:
        """Time has no end: nothing to do."""

    def drive(self, targets: Mapping[str, float]) -> None:
        check_targets(self.controls, targets)
        self._steering.aim(targets)

    def advance(self) -> bool:
        began = time.perf_counter()
        for _ in range(self._steps):
            self._steering.go()
            self._state = self._world.step(self._steering)
            if self._state.failed[0]:
                raise RaytacError(f"the physics broke down {self._state.time[0]:.3f} s after the start; reset, and go slower")
        self._physics_ms = 1e3 * (time.perf_counter() - began)
        self._shot = None
        return True

    def snapshot(self) -> Snapshot:
        if self._shot is None:
            self._shot = self._drawn(self._world.observe())
        return self._shot

    def _geoms(self) -> Iterator[Solid]:
        model = self._world.model
        gels = {int(model.geom(mounted.gel).id) for mounted in self._world.composed.sensors}
        objects = {member for body in self._world.composed.bodies.values() for member in body.members}
        for geom in range(model.ngeom):
            red, green, blue, alpha = (float(v) for v in model.geom_rgba[geom])
            if geom in gels or int(model.geom_group[geom]) >= _SHOWN_GROUPS or alpha == 0.0:
                continue
            body = int(model.geom_bodyid[geom])
            part = geom_part(model, geom)
            if part.kind == "plane":
                vertices, faces = square(_PLANE)
                faces = faces[:2]  # seen from above
            else:
                surface = part_surface(part, _ROUND * max(part.size, default=0.05))
                vertices, faces = surface.vertices, surface.faces
            pose = part.object_from_part
            name = f"{model.body(body).name or 'world'}/{geom}"
            self._body_of[name] = body
            colour: Colour = (round(255 * red), round(255 * green), round(255 * blue))
            hides = body in objects and part.kind != "plane"
            yield Solid(name, vertices @ pose[:3, :3].T + pose[:3, 3], faces, colour, alpha, hides)

    def _soft_bodies(self) -> Iterator[Solid]:
        for body in self._soft:
            vertices, faces = self._world.mesh(body.name)
            shown = _SOFT_COLOUR if body.colour is None else tuple(round(255 * v) for v in body.colour)
            yield Solid(f"soft/{body.name}", vertices[0], faces, shown, hides_pads=True)  # type: ignore[arg-type]

    def _camera(self) -> CameraPlace:
        pads = np.array([self._state.world_from_pad[name][0, :3, 3] for name in self._sensors])
        middle = pads.mean(axis=0)
        size = float(np.clip(np.linalg.norm(self._world.data[0].xpos - middle, axis=1).max(), _NEAREST, _FARTHEST))
        x, y, z = middle.tolist()
        return CameraPlace((x + 1.5 * size, y - 2.1 * size, z + 1.1 * size), (x - 0.25 * size, y, z + 0.35 * size))

    def _drawn(self, frames: Mapping[str, TactileFrame]) -> Snapshot:
        data, state = self._world.data[0], self._state
        bodies = {}
        for body in set(self._body_of.values()):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            bodies[body] = pose
        poses = {name: bodies[body] for name, body in self._body_of.items()}
        reshaped = {f"soft/{body.name}": self._world.mesh(body.name)[0][0] for body in self._soft}
        pads = {name: pad_view(f, self._grids[name], state.world_from_pad[name][0]) for name, f in frames.items()}
        time_ms = {"physics": self._physics_ms}  # of frames whose images were waited for
        for name, frame in frames.items():
            poses[f"{name}_gel"] = poses[f"{name}_coat_mesh"] = state.world_from_pad[name][0]
            if frame.surface.coat is not None:
                reshaped[f"{name}_coat_mesh"] = coat_edges(frame.surface, self._grids[name])
            for part, value in frame.time_ms.items():
                time_ms[part] = time_ms.get(part, 0.0) + value
        return Snapshot(
            pads=pads,
            poses=poses,
            reshaped=reshaped,
            controls=self._steering.asked,
            facts=self._facts(),
            warning=self._steering.missing or next(filter(None, map(narrow_warning, frames.values())), ""),
            time_ms=time_ms,
        )

    def _facts(self) -> dict[str, str]:
        state = self._state
        facts = {"time": f"{float(state.time[0]):.3f} s"}
        for name in self._sensors:
            force = state.wrench[name][0, :3]
            facts[f"{name}, force"] = f"{float(np.linalg.norm(force)):.3f} N"
        for name, label, factor, unit in (("min_gap", "least gap", 1e6, "µm"), ("min_det", "least det F", 1.0, "")):
            if name in state.report and np.isfinite(state.report[name][0]):
                facts[label] = f"{factor * float(state.report[name][0]):.3g} {unit}".strip()
        return facts


_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_REACH_MM, _TILT, _YAW = 100.0, 45.0, 180.0
"""Range of the sliders about the site's start: [mm], [degrees] about x and y, and about z."""
_SPEED = {**dict.fromkeys(("x", "y", "z"), 50.0), **dict.fromkeys(("roll", "pitch", "yaw"), 45.0), "opening": 40.0}
"""Fastest change of what is asked of the robot, in each control's unit per second."""
_JOINT_SPEED = 1.5
"""Fastest joint [rad/s or m/s]."""
_FREQUENCY = 60.0
"""Of the springs in the joints [rad/s]."""


class Steering:
    """Controller of one environment: ``aim`` sets targets, ``go`` advances by one control step.

    Arms with torque motors follow by differential inverse kinematics and joint impedance, a driven frame by its servos. Other robots
    are held at their start.
    """

    def __init__(self, world: TactileWorld) -> None:
        """Read what the robot is; nothing moves."""
        self._world, self._dt = world, world.composed.control_timestep
        self._model, arm = world.model, world.arm
        self.missing = ""
        """Why the robot's pose cannot be steered, for people; empty if nothing hinders it."""
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
        """Target of each control."""
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
