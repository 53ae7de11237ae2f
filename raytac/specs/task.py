"""What a task scene is: a robot that carries sensors, bodies around it, and the steps in which they move. SI units, world frame.

World frame: base of the arm, z up, x ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from raytac.specs.sensor import SensorSpec, Vec3

__all__ = [
    "COUPLINGS",
    "MOTIONS",
    "OWNERS",
    "PAIR_FRICTION",
    "ROBOTS",
    "BodySpec",
    "MountSpec",
    "Quaternion",
    "RobotSpec",
    "TaskScene",
]

ROBOTS = ("panda_one_sensor", "panda_two_fingers", "floating_gripper", "fixed_sensor")
"""Robots that raytac builds itself; any other is the path of an MJCF file."""
OWNERS = ("ipc", "mujoco")
"""Which simulator moves a free body where the pads are simulated."""
MOTIONS = ("fixed", "free", "soft")
"""What a body can be: it never moves, it moves as a rigid body, it moves and deforms."""
COUPLINGS = ("two_way", "one_way")
"""Whether what the pads feel acts back on the robot and on MuJoCo's bodies."""
PAIR_FRICTION = 0.5
"""Friction coefficient of a body that names none, against all but gel (a guess: dry plastics lie between 0.2 and 0.6)."""

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class MountSpec:
    """One sensor on a robot of one's own."""

    name: str
    """Name of the sensor."""
    at: str
    """Body or site of the robot that carries it."""
    kind: str | None = None
    """``body`` or ``site`` where ``at`` is the name of both."""
    position: Vec3 | None = None
    """Origin of the pad frame in the frame of ``at`` [m]; None: the sensor stands there with its back."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the pad frame in the frame of ``at``, wxyz; matters only with ``position``."""


@dataclass(frozen=True)
class RobotSpec:
    """What carries the sensors, and where it starts."""

    model: str
    """One of ``ROBOTS``, or the absolute path of an MJCF file."""
    sensor: str | SensorSpec = "gelsight_mini"
    """Every sensor on it: name or path of a sensor file, or a specification."""
    joints: tuple[float, ...] | None = None
    """Where an arm's joints start [rad]; None: the Panda's READY, another robot's own start."""
    opening: float | None = None
    """Gap between both pads at the start [m]; None: as wide as the gripper opens."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Where a ``floating_gripper`` (point midway between the pads) or a ``fixed_sensor`` (pad frame) starts [m]."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """How it is turned there, wxyz."""
    mounts: tuple[MountSpec, ...] = ()
    """Sensors of an MJCF robot."""
    arm_joints: tuple[str, ...] = ()
    """Joints of an MJCF robot that steer its first sensor."""
    keyframe: str | None = None
    """Keyframe of an MJCF robot that it starts from."""


@dataclass(frozen=True)
class BodySpec:
    """One body of the scene."""

    name: str
    kind: str
    """Shape: a kind of a press scene's object but ``none``, or ``plane``, the half-space under z = 0 of its frame."""
    params: dict[str, float | int | str]
    """As in ``ObjectSpec``."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Origin of the body at the start, world frame [m]."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """``world_from_body`` rotation at the start, wxyz, normalised."""
    dynamics: str = "free"
    """One of ``MOTIONS``."""
    owner: str = "ipc"
    """One of ``OWNERS``, of a free body where the pads are simulated; with the rigid pad all is MuJoCo's."""
    mass: float | None = None
    """[kg]; None: by ``density``."""
    density: float = 1000.0
    """[kg/m³]; plays no part where ``mass`` is given."""
    friction: float | None = None
    """Coulomb friction coefficient; None: the gelpad's own against a gel, ``PAIR_FRICTION`` against anything else."""
    gel_friction: float | None = None
    """The same against gel alone, in place of ``friction``; None: ``friction``."""
    youngs_modulus: float = 1e6
    """Of a soft body [Pa]."""
    poisson_ratio: float = 0.4
    """Of a soft body."""
    cell: float | None = None
    """Edge of a soft body's tetrahedra [m]; None: the solver's choice."""
    held_by: str | None = None
    """Fixed body that holds the part of a soft body which lies inside of it or touches it at the start."""
    colour: Vec3 | None = None
    """Linear red, green, blue in [0, 1] for pictures."""

    @property
    def friction_on_gel(self) -> float | None:
        """Coefficient against gel; None: the gelpad's own."""
        return self.friction if self.gel_friction is None else self.gel_friction


@dataclass(frozen=True)
class TaskScene:
    name: str
    robot: RobotSpec
    bodies: tuple[BodySpec, ...]
    physics: str | None = None
    """One of ``raytac.specs.press.PHYSICS`` that the scene is meant for; None leaves it to the user."""
    pad: str | None = None
    """One of ``raytac.specs.press.PADS``; None leaves it to the user."""
    timestep: float = 0.002
    """Of MuJoCo [s]."""
    soft_timestep: float = 0.01
    """Of the simulated pads [s], a whole multiple of ``timestep``."""
    control_timestep: float = 0.01
    """Of the robot's control [s], a whole multiple of ``timestep`` and of ``soft_timestep``."""
    coupling: str = "two_way"
    """One of ``COUPLINGS``."""
    gravity: Vec3 = (0.0, 0.0, -9.81)
    """[m/s²], world frame."""
    source: Path | None = None
    """File that it was read from."""

    def body(self, name: str) -> BodySpec:
        """The body of that name; raises ``KeyError`` if there is none."""
        return {body.name: body for body in self.bodies}[name]
