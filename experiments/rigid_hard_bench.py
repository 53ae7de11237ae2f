"""What the hard cases of rigid pads stand on: scenes in code, a record of every sub-step, and measures that need no pad's contact.

Poses are read in MuJoCo's control callback, which each sub-step calls whatever the pads make of a step. Depth, penetration and the press's
depth come from the bodies' shapes, so that a pad cannot judge itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Any

import mujoco
import numpy as np

from raytac.gel import PadGrid, make_grid
from raytac.physics import RigidPad, first_touch, object_parts
from raytac.robots import body_poses, site_poses
from raytac.se3 import quaternion
from raytac.shapes import Part, object_height
from raytac.specs import BodySpec, ObjectSpec, PressScene, RobotSpec, StageSpec, TaskScene, load_sensor
from raytac.world import TactileWorld

__all__ = [
    "GEL",
    "Bench",
    "Check",
    "G",
    "Grasps",
    "Outcome",
    "contact_radius",
    "normal_force",
    "on_pad",
    "press_depth",
    "within_grip",
]

G = 9.81
SENSOR = "gelsight_mini"
GEL = load_sensor(SENSOR).gelpad
GRID = make_grid(GEL, 0.1e-3)
COARSE = make_grid(GEL, 0.8e-3)
"""Nodes on which every sub-step is searched for the deepest ones; those are measured on ``GRID``."""
DEEPEST = 20
FAST = 25.0
"""Force with which fingers close that are far from a body [N]: some 0.25 m/s against the servo's damping."""
NEAR = 5.0
"""Force with which they close over the last millimetres, until both feel the body [N]."""
SERVO = 1e4
"""Gain of the floating gripper's opening [N/m]."""


@dataclass(frozen=True)
class Check:
    """A measured figure against its bound; it passes where it is not beyond it, and finite."""

    name: str
    value: float
    bound: float
    unit: str = ""
    at_least: bool = False

    @property
    def passed(self) -> bool:
        return bool(np.isfinite(self.value) and (self.value >= self.bound if self.at_least else self.value <= self.bound))


@dataclass
class Outcome:
    """Checks of a case, and curves for the figure."""

    checks: list[Check] = field(default_factory=list)
    curves: dict[str, Any] = field(default_factory=dict)
    penetration: float = -np.inf
    """Greatest distance of a body beyond a bonded face [m]; negative: what was left to it."""

    def add(self, name: str, value: float, bound: float, unit: str = "", *, at_least: bool = False) -> None:
        self.checks.append(Check(name, float(value), bound, unit, at_least))

    @property
    def passed(self) -> bool:
        return bool(self.checks) and all(check.passed for check in self.checks)


def on_pad(bodies: Sequence[BodySpec], dt: float, gravity: tuple[float, float, float] = (0.0, 0.0, -G)) -> TaskScene:
    """A sensor on its back, world and pad frame one, and bodies above it."""
    return TaskScene("on_pad", RobotSpec("fixed_sensor", SENSOR), tuple(bodies), None, None, dt, dt, dt, gravity=gravity)


def within_grip(bodies: Sequence[BodySpec], dt: float, opening: float) -> TaskScene:
    """Two pads on a floating gripper about the world's origin, without gravity: loads come as forces on bodies."""
    robot = RobotSpec("floating_gripper", SENSOR, opening=opening)
    return TaskScene("within_grip", robot, tuple(bodies), None, None, dt, dt, dt, gravity=(0.0, 0.0, 0.0))


class Bench:
    """One world with a record of its sub-steps and steps."""

    def __init__(self, scene: TaskScene) -> None:
        self.scene = scene
        self.world = TactileWorld(scene, outputs=("wrench",), device="cpu")
        self.data, self.model = self.world.data[0], self.world.model
        self.names = self.world.sensor_names
        self.bodies = [body.name for body in scene.bodies if body.dynamics == "free"]
        self._index = [int(self.model.body(name).id) for name in self.bodies]
        self._speed = [int(self.model.jnt_dofadr[self.model.body_jntadr[i]]) for i in self._index]
        self._parts = [object_parts(scene.body(name)) for name in self.bodies]
        self._site = [int(self.model.site(mounted.site).id) for mounted in self.world.composed.sensors]
        self._gel = {int(self.model.geom(mounted.gel).id) for mounted in self.world.composed.sensors}
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._pads: list[np.ndarray] = []
        self._speeds: list[np.ndarray] = []
        self.force: Callable[[float], float] = lambda t: 0.0
        """Force between the fingers of a gripper at a time [N]."""
        self.raised: Callable[[float], float] = lambda t: 0.0
        """Height of a gripper over its start [m]."""
        self.wrench: list[np.ndarray] = []
        """After every step, on all pads, (pads, 6), world axes for the force."""
        self.felt = np.zeros((0, 3))
        """Forces on pads in the last step [N], pad frames, (pads, 3)."""
        self.normal: list[np.ndarray] = []
        """Normal loads [N] after every step, (pads,)."""
        self.cone = 0.0
        """Greatest excess of a contact's friction over its cone, as a share of the normal load."""
        self.failed = False

    def __enter__(self) -> Bench:
        mujoco.set_mjcb_control(self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        mujoco.set_mjcb_control(None)

    def _note(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        if self._times and data.time == self._times[-1]:
            return
        self._times.append(float(data.time))
        pose = np.tile(np.eye(4), (len(self._index), 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = data.xmat[self._index].reshape(-1, 3, 3), data.xpos[self._index]
        pad = np.tile(np.eye(4), (len(self._site), 1, 1))
        pad[:, :3, :3], pad[:, :3, 3] = data.site_xmat[self._site].reshape(-1, 3, 3), data.site_xpos[self._site]
        self._poses.append(pose)
        self._pads.append(pad)
        self._speeds.append(np.array([data.qvel[k : k + 6] for k in self._speed]).reshape(-1, 6))

    def throw(self, velocity: tuple[float, float, float], body: int = 0) -> None:
        """Give a free body its velocity [m/s]."""
        self.data.qvel[self._speed[body] : self._speed[body] + 3] = velocity

    def push(self, force: Sequence[float], torque: Sequence[float] = (0.0, 0.0, 0.0), body: int = 0) -> None:
        """Force and torque on a body's centre of mass from now on, world frame."""
        self.data.xfrc_applied[self._index[body]] = [*force, *torque]

    def run(self, seconds: float, each: Callable[[Bench], bool | None] | None = None) -> None:
        """Step; ``each`` is called before every step and ends the run with True. An environment that fails ends it too."""
        for _ in range(round(seconds / self.scene.control_timestep)):
            if self.failed or (each is not None and each(self)):
                return
            state = self.world.step(self._steer)
            self.failed = bool(state.failed[0])
            felt = np.array([state.wrench[name][0] for name in self.names])
            self.felt = felt[:, :3]
            self.normal.append(-felt[:, 2])
            turn = np.array([state.world_from_pad[name][0, :3, :3] for name in self.names])
            self.wrench.append(np.concatenate([(turn @ felt[:, :3, None])[..., 0], felt[:, 3:]], axis=1))
            self.cone = max(self.cone, cone_excess(self.model, self.data, self._gel))

    def settle(self, most: float = 6.0) -> None:
        """Run until the normal loads of a tenth of a second differ by less than 1e-6 of them from those before it."""
        before, count = np.inf, max(round(0.1 / self.scene.control_timestep), 1)
        for _ in range(round(most / 0.1)):
            self.run(0.1)
            load = float(np.mean(self.normal[-count:]))
            if self.failed or abs(load - before) < 1e-6 * abs(load):
                return
            before = load

    def press_pads_together(self) -> None:
        """Let a gripper close beyond where its gels meet, which is as far as its joints and its servo go."""
        opening, fingers = self.world.composed.opening, self.world.composed.fingers
        assert opening is not None
        joints = np.isin(self.model.jnt_qposadr, fingers)
        self.model.jnt_range[joints, 0] = -GEL.thickness
        self.model.actuator_ctrlrange[opening, 0] = -4.0 * GEL.thickness

    def _steer(self, data: mujoco.MjData, time: float) -> None:
        opening = self.world.composed.opening
        if opening is not None:
            gap = float(data.qpos[self.world.composed.fingers].sum())
            lowest = float(self.model.actuator_ctrlrange[opening, 0])
            data.ctrl[opening] = max(gap - self.force(time) / SERVO, lowest)
            data.ctrl[self.model.actuator("z").id] = self.raised(time)

    @property
    def time(self) -> np.ndarray:
        """Times of the sub-steps [s], (n,)."""
        return np.array(self._times)

    def path(self, body: int = 0) -> np.ndarray:
        """Positions (n, 3) of a body at every sub-step [m], world frame."""
        return np.array(self._poses)[:, body, :3, 3]

    def speed(self, body: int = 0) -> np.ndarray:
        """Velocities (n, 6) of a body: of its origin, world frame, and its spin."""
        return np.array(self._speeds)[:, body]

    def in_pad(self, pad: int = 0, body: int = 0) -> np.ndarray:
        """``pad_from_body`` (n, 4, 4) at every sub-step."""
        return np.linalg.inv(np.array(self._pads)[:, pad]) @ np.array(self._poses)[:, body]

    def between_pads(self) -> np.ndarray:
        """Distance of the second pad's centre from the first pad's, along its normal [m], (n,)."""
        pads = np.array(self._pads)
        return np.vecdot(pads[:, 1, :3, 3] - pads[:, 0, :3, 3], pads[:, 0, :3, 2])

    def kinetic(self, mass: float, body: int = 0) -> np.ndarray:
        """Kinetic energy of a body that hardly spins [J], (n,)."""
        return 0.5 * mass * (self.speed(body)[:, :3] ** 2).sum(axis=1)

    def depth(self, pad: int = 0, body: int = 0) -> float:
        """Present overlap of the resting gel and a body [m], by its distance from where it touched."""
        pose = self.in_pad(pad, body)[-1]
        return first_touch(self._parts[body], pose, GEL, GRID).z - float(pose[2, 3])

    def penetration(self) -> float:
        """Greatest distance of a body beyond a bonded face in all sub-steps [m]; of pad on pad that of the other gel."""
        if not self.bodies:
            return -2.0 * GEL.thickness - float(self.between_pads().min()) if len(self.names) > 1 else -np.inf
        worst = -np.inf
        for pad in range(len(self.names)):
            for body, parts in enumerate(self._parts):
                poses = self.in_pad(pad, body)
                poses = poses[np.isfinite(poses).all(axis=(1, 2))]
                low = np.concatenate(
                    [_lowest(parts, some, COARSE) for some in np.array_split(poses, max(len(poses) // 500, 1)) if len(some)]
                )
                at = np.argsort(low)[:DEEPEST]
                worst = max(worst, -GEL.thickness - float(_lowest(parts, poses[at], GRID).min()))
        return worst

    def common(self, outcome: Outcome) -> Outcome:
        """Checks that every case makes: nothing fails, nothing passes the bonded face, friction is within its cone."""
        outcome.penetration = self.penetration()
        outcome.add("environments failed", float(self.failed), 0.0)
        outcome.add("beyond the bonded face", 1e3 * outcome.penetration, 0.0, "mm")
        outcome.add("friction beyond its cone", self.cone, 0.01)
        return outcome


class Grasps:
    """Many grasps at once: environments that close on their own body, and what came of all of them."""

    def __init__(self, scene: TaskScene, count: int) -> None:
        self.count, self.scene = count, scene
        self.world = TactileWorld(scene, outputs=("wrench",), device="cpu", num_envs=count)
        (body,) = scene.bodies
        self._name, self._parts, model = body.name, object_parts(body), self.world.model
        self._index = int(model.body(body.name).id)
        self._gel = {int(model.geom(mounted.gel).id) for mounted in self.world.composed.sensors}
        self.penetration, self.cone = -np.inf, 0.0
        self.failed = self.broken = self.felt = 0

    def close(self, poses: np.ndarray, width: np.ndarray, force: np.ndarray, counted: int, seconds: float = 0.6) -> None:
        """Close on bodies at poses (count, 4, 4), of ``width`` (count,) [m] between the pads, with ``force`` (count,) [N].

        The first ``counted`` environments count.
        """
        world, dt = self.world, self.scene.control_timestep
        opening, fingers = world.composed.opening, world.composed.fingers
        assert opening is not None
        world.reset(bodies={self._name: poses})
        begin = 0.6 * seconds

        # By any pad, and by all of them at once.
        felt, gripped, failed = (np.zeros(self.count, bool) for _ in range(3))

        def steer(env: int, wide: float, press: float, data: mujoco.MjData, time: float) -> None:
            gap = float(data.qpos[fingers].sum())
            closing = press if gripped[env] else NEAR if gap < wide + 2e-3 else FAST
            data.ctrl[opening] = max(gap - closing / SERVO, 0.0)
            data.xfrc_applied[self._index, 2] = -0.2 * press if time > begin else 0.0

        controls = [partial(steer, *one) for one in zip(range(self.count), width.tolist(), force.tolist(), strict=True)]
        for step in range(round(seconds / dt)):
            state = world.step(controls)
            failed = state.failed
            touched = np.array([np.nan_to_num(np.abs(state.wrench[name][:, 2])) > 1e-2 for name in world.sensor_names])
            felt |= touched.any(axis=0)
            gripped |= touched.all(axis=0)
            if step % 4 == 0:
                self._look(counted)
        self.failed += int(failed[:counted].sum())
        self.felt += int(felt[:counted].sum())

    def _look(self, counted: int) -> None:
        datas = self.world.data[:counted]
        sound = [data for data in datas if np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()]
        self.broken += counted - len(sound)
        if not sound:
            return
        for data in sound:
            self.cone = max(self.cone, cone_excess(self.world.model, data, self._gel))
        body = body_poses(sound, self._index)
        for mounted in self.world.composed.sensors:
            pads = site_poses(sound, int(self.world.model.site(mounted.site).id))
            # What lies higher than the lowest so far cannot change it.
            low = _lowest(self._parts, np.linalg.inv(pads) @ body, COARSE, -GEL.thickness - self.penetration)
            self.penetration = max(self.penetration, -GEL.thickness - float(low.min()))


def cone_excess(model: mujoco.MjModel, data: mujoco.MjData, gels: set[int]) -> float:
    """Greatest excess of friction over its cone among the gels' contacts, as a share of the normal load."""
    excess, force = 0.0, np.empty(6)
    for k in range(data.ncon):
        contact = data.contact[k]
        if {int(contact.geom1), int(contact.geom2)} & gels:
            mujoco.mj_contactForce(model, data, k, force)
            if force[0] > 1e-4:
                excess = max(excess, float(np.linalg.norm(force[1:] / contact.friction)) / force[0] - 1.0)
    return excess


def _lowest(parts: Sequence[Part], poses: np.ndarray, grid: PadGrid, below: float = np.inf) -> np.ndarray:
    """Height of bodies' lowest point over the pad [m], (n,); may be inf where that is above ``below`` [m]."""
    if not len(poses):
        return np.zeros(0)
    return object_height(parts, poses, grid.x, grid.y, below=below).min(axis=(1, 2))


def normal_force(force: np.ndarray, pose: np.ndarray, parts: Sequence[Part]) -> float:
    """Share of a force (3,) [N], pad frame, along the resting gel's normal where a body at ``pose`` (4, 4) overlaps it."""
    height = object_height(parts, pose[None], GRID.x, GRID.y, below=float(GRID.rest.max()))[0]
    overlap = np.maximum(GRID.rest - height, 0.0)
    slopes = np.gradient(GRID.rest, GRID.y, GRID.x)
    along_y, along_x = ((overlap * slope).sum() / overlap.sum() for slope in slopes)
    normal = np.array([-along_x, -along_y, 1.0])
    return float(-force @ normal / np.linalg.norm(normal))


def _object(body: BodySpec, pose: np.ndarray) -> ObjectSpec:
    w, x, y, z = (float(v) for v in quaternion(pose[:3, :3]))
    mass = 0.1 if body.mass is None else body.mass
    return ObjectSpec(body.kind, dict(body.params), (float(pose[0, 3]), float(pose[1, 3]), 0.0), (w, x, y, z), mass)


def press_depth(body: BodySpec, pose: np.ndarray, force: float, pitch: float = 0.1e-3) -> float:
    """Depth [m] of a press with ``force`` [N] of the body where it is over the pad.

    The press counts nodes, so that thin bodies need a finer ``pitch`` [m].
    """
    scene = PressScene("hard", _object(body, pose), (StageSpec("indent", force=force),))
    watching = mujoco.get_mjcb_control()
    mujoco.set_mjcb_control(None)  # the press has a model of its own
    try:
        pad = RigidPad(load_sensor(SENSOR), scene, pitch=pitch)
        return float(pad.peak(pad.run()).depth[0])
    finally:
        mujoco.set_mjcb_control(watching)


def contact_radius(body: BodySpec, pose: np.ndarray, depth: float) -> float:
    """Radius [m] of the disc of the contact's area at a depth: where the gap at first touch is below half of it."""
    gap = first_touch(object_parts(body), pose, GEL, GRID).gap
    return float(np.sqrt((gap < 0.5 * depth).sum() * GRID.pitch[0] * GRID.pitch[1] / np.pi))
