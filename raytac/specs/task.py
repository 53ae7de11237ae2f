"""Task scenes: robot with sensors, bodies, steps. SI; world frame: arm's base, z up, x on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from raytac.errors import SpecError
from raytac.specs.press import PADS
from raytac.specs.sensor import SensorSpec, Vec3
from raytac.specs.shape_file import OBJECT_SCHEMA, check_params, check_quaternion
from raytac.specs.toml import ANY, Number, Schema, Text, check_fields

ROBOTS = ("panda_one_sensor", "panda_two_fingers", "floating_gripper", "fixed_sensor")
"""Robots that raytac builds itself; any other is the path of an MJCF file."""
OWNERS = ("ipc", "mujoco")
"""Simulators that can move a free body where the pads are soft."""
MOTIONS = ("fixed", "free", "soft")
"""Dynamics of a body: it never moves, it moves as a rigid body, it moves and deforms."""
COUPLINGS = ("two_way", "one_way")
"""Couplings: forces on the pads act back on the robot and on MuJoCo's bodies, or do not."""
PAIR_FRICTION = 0.5
"""Default friction of a body but on gel (a guess: dry plastics lie between 0.2 and 0.6)."""

Quaternion = tuple[float, float, float, float]

_NAME = Text(pattern=r"[a-z][a-z0-9_]*", described="lower-case letters, digits and _, a letter first")
_STEP = "[0.0001, 0.1]"
_POSE: Final[Schema] = {
    "position_mm": Number("[-5000, 5000]", length=3, default=(0.0, 0.0, 0.0)),
    "quaternion_wxyz": Number("[-1, 1]", length=4, default=(1.0, 0.0, 0.0, 0.0)),
}

TASK_SCHEMA: Final[Schema] = {
    "physics": Text(default=None),
    "pad": Text(choices=PADS, default=None),
    "coupling": Text(choices=COUPLINGS, default="two_way"),
    "timestep_s": Number(_STEP, default=0.002),
    "soft_timestep_s": Number(_STEP, default=0.01),
    "control_timestep_s": Number("[0.0001, 1]", default=0.01),
    "gravity_m_s2": Number("[-100, 100]", length=3, default=(0.0, 0.0, -9.81)),
}
"""Keys at the top of a task scene."""

ROBOT_SCHEMA: Final[Schema] = {
    "model": Text(),
    "sensor": Text(default="gelsight_mini"),
    "joints_deg": Number("[-360, 360]", length=ANY, default=None),
    "opening_mm": Number("[0, 200]", default=None),
    **_POSE,
    "arm_joints": Text(default=None),
    "keyframe": Text(default=None),
}
"""Keys of ``[robot]``; which robot takes which: ``scenes/README.md``."""

MOUNT_SCHEMA: Final[Schema] = {
    "name": _NAME,
    "at": Text(),
    "kind": Text(choices=("body", "site"), default=None),
    "position_mm": Number("[-5000, 5000]", length=3, default=None),
    "quaternion_wxyz": _POSE["quaternion_wxyz"],
}
"""Keys of ``[[robot.mount]]``."""

SHAPE_SCHEMA: Final[dict[str, Schema]] = {
    **{kind: keys for kind, keys in OBJECT_SCHEMA.items() if kind != "none"},
    "box": {key: Number("(0, 5000]") for key in ("length_mm", "width_mm", "height_mm")},
    "plane": {},
}
"""Keys in ``[[body]]`` by kind: objects of press scenes, larger boxes, half-spaces."""

BODY_SCHEMA: Final[Schema] = {
    "name": _NAME,
    **_POSE,
    "dynamics": Text(choices=MOTIONS, default="free"),
    "owner": Text(choices=OWNERS, default=None),
    "mass_kg": Number("[0.00001, 1000]", default=None),
    "density_kg_m3": Number("[1, 30000]", default=None),
    "friction": Number("[0, 10]", default=None),
    "gel_friction": Number("[0, 10]", default=None),
    "youngs_modulus_kpa": Number("[1, 100000]", default=None),
    "poisson_ratio": Number("[0, 0.49]", default=None),
    "cell_mm": Number("[0.1, 100]", default=None),
    "held_by": replace(_NAME, default=None),
    "colour": Number("[0, 1]", length=3, default=None),
}
"""Keys of ``[[body]]`` that every kind has."""


@dataclass(frozen=True)
class MountSpec:
    """One sensor on a robot from a file."""

    name: str
    """Name of the sensor."""
    at: str
    """Body or site of the robot that carries it."""
    kind: str | None = None
    """``body`` or ``site`` where ``at`` is the name of both."""
    position: Vec3 | None = None
    """Origin of the pad frame in the frame of ``at`` [m]; None: the back stands there."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the pad frame in the frame of ``at``, wxyz; matters only with ``position``."""

    def __post_init__(self) -> None:
        check_fields(vars(self), _unturned(MOUNT_SCHEMA), "robot.mount")
        check_quaternion(self.quaternion, "robot.mount.quaternion_wxyz")


@dataclass(frozen=True)
class RobotSpec:
    """Carrier of the sensors, and its start."""

    model: str
    """One of ``ROBOTS``, or the absolute path of an MJCF file."""
    sensor: str | Path | SensorSpec = "gelsight_mini"
    """Every sensor on it: name or path of a sensor file, or a specification."""
    joints: tuple[float, ...] | None = None
    """Start of an arm's joints [rad]; None: the Panda's READY, another robot's own start."""
    opening: float | None = None
    """Gap between both pads at the start [m]; None: as wide as the gripper opens."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Start of a ``floating_gripper`` (midway between pads) or ``fixed_sensor`` (pad) [m]."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation there, wxyz."""
    mounts: tuple[MountSpec, ...] = ()
    """Sensors of an MJCF robot."""
    arm_joints: tuple[str, ...] = ()
    """Joints of an MJCF robot that steer its first sensor."""
    keyframe: str | None = None
    """Keyframe of an MJCF robot that it starts from."""

    def __post_init__(self) -> None:
        given = {key: rule for key, rule in _unturned(ROBOT_SCHEMA).items() if key not in ("sensor", "arm_joints")}
        check_fields(vars(self), given, "robot")
        if not isinstance(self.sensor, (str, Path, SensorSpec)):
            raise SpecError("must be a name, a path or a SensorSpec", key="robot.sensor", value=self.sensor)
        if not isinstance(self.mounts, tuple) or not all(isinstance(mount, MountSpec) for mount in self.mounts):
            raise SpecError("must be a tuple of MountSpec", key="robot.mount", value=self.mounts)
        if not isinstance(self.arm_joints, tuple) or not all(isinstance(joint, str) for joint in self.arm_joints):
            raise SpecError("must be a tuple of names", key="robot.arm_joints", value=self.arm_joints)
        check_quaternion(self.quaternion, "robot.quaternion_wxyz")


@dataclass(frozen=True)
class BodySpec:
    """One body of the scene."""

    name: str
    kind: str
    """An object's kind but ``none``, or ``plane``: the half-space under z = 0 of its frame."""
    params: dict[str, float | int | str]
    """As in ``ObjectSpec``."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Origin of the body at the start, world frame [m]."""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """``world_from_body`` rotation at the start, wxyz, normalised."""
    dynamics: str = "free"
    """One of ``MOTIONS``."""
    owner: str = "ipc"
    """One of ``OWNERS``, of a free body with soft pads; with rigid pads all is MuJoCo's."""
    mass: float | None = None
    """[kg]; None: by ``density``."""
    density: float = 1000.0
    """[kg/m³]; plays no part where ``mass`` is given."""
    friction: float | None = None
    """Friction coefficient; None: the gelpad's own against gel, else ``PAIR_FRICTION``."""
    gel_friction: float | None = None
    """The same against gel alone, in place of ``friction``; None: ``friction``."""
    youngs_modulus: float = 1e6
    """Of a soft body [Pa]."""
    poisson_ratio: float = 0.4
    """Of a soft body."""
    cell: float | None = None
    """Edge of a soft body's tetrahedra [m]; None: the solver's choice."""
    held_by: str | None = None
    """Fixed body that holds what of a soft body is inside or touches it at the start."""
    colour: Vec3 | None = None
    """Linear red, green, blue in [0, 1] for pictures."""

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in SHAPE_SCHEMA:
            raise SpecError("must be a known kind of body", key="body.kind", value=self.kind, choices=tuple(SHAPE_SCHEMA))
        check_params(self.kind, self.params, SHAPE_SCHEMA[self.kind], "body")
        check_fields(vars(self), _unturned(BODY_SCHEMA), "body")
        check_quaternion(self.quaternion, "body.quaternion_wxyz")

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
    """Physics that the scene is meant for (checked when a world is made); None: any."""
    pad: str | None = None
    """One of ``raytac.specs.press.PADS``; None leaves it to the user."""
    timestep: float = 0.002
    """Of MuJoCo [s]; beside soft pads it is at most half of ``soft_timestep``."""
    soft_timestep: float = 0.01
    """Of the soft pads [s], a whole multiple of ``timestep``."""
    control_timestep: float = 0.01
    """Of the robot's control [s], a whole multiple of ``timestep`` and of ``soft_timestep``."""
    coupling: str = "two_way"
    """One of ``COUPLINGS``."""
    gravity: Vec3 = (0.0, 0.0, -9.81)
    """[m/s²], world frame."""
    source: Path | None = None
    """File that it was read from."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise SpecError("must be a text", file=self.source, key="name", value=self.name)
        if not isinstance(self.robot, RobotSpec):
            raise SpecError("must be a RobotSpec", file=self.source, key="robot", value=self.robot)
        if not isinstance(self.bodies, tuple) or not all(isinstance(body, BodySpec) for body in self.bodies):
            raise SpecError("must be a tuple of BodySpec", file=self.source, key="body", value=self.bodies)
        check_fields(vars(self), TASK_SCHEMA, file=self.source)
        for long, short in (("soft_timestep", "timestep"), ("control_timestep", "soft_timestep")):
            ratio = getattr(self, long) / getattr(self, short)
            if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6:
                rule = f"must be a whole multiple of {short}_s = {getattr(self, short):g}"
                raise SpecError(rule, file=self.source, key=f"{long}_s", value=getattr(self, long))

    def body(self, name: str) -> BodySpec:
        """The body of that name; raises ``KeyError`` if there is none."""
        return {body.name: body for body in self.bodies}[name]


def _unturned(schema: Schema) -> Schema:
    """The schema without the quaternion, which has a rule of its own."""
    return {key: rule for key, rule in schema.items() if key != "quaternion_wxyz"}
