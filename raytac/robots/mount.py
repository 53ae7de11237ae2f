"""Mount tactile sensors on bodies or sites of a robot; find those of a compiled model."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from raytac.checks import check_truth
from raytac.errors import InputError
from raytac.robots.frames import world_from_site
from raytac.se3 import check_pose, quaternion
from raytac.se3 import pose as rigid
from raytac.specs.sensor import GelpadSpec, SensorSpec
from raytac.specs.sensor_file import sensor_spec

_MARK = "raytac:"
"""Prefix of a sensor's custom text in the model, which holds the name or path of its file.

The text outlives ``MjSpec.compile``, ``to_xml`` and ``attach``, whose prefix it then carries."""
_IN_CODE = "made in code"
"""Text of a sensor that was mounted as a specification, which no file has."""
_TOUCH_RADIUS = 3e-3
"""Radius [m] and mass [kg] for which MuJoCo's contact is as stiff as the gel (a choice)."""
_TOUCH_MASS = 0.05
_FARTHEST, _HEAVIEST = 1.0, 5.0
"""Distance from the carrier [m] and mass [kg] of mistaken units; GelSights: 20 to 200 g."""


@dataclass(frozen=True)
class MountedSensor:
    """Names, in the compiled model, of the parts of a mounted sensor."""

    name: str
    body: str
    """Body whose frame is the pad frame; a wrench on the pad acts on it (``xfrc_applied``)."""
    site: str
    """Site at the pad frame: centre of the undeformed outer surface, +z out of the sensor."""
    case: str
    """Geom of the case; it collides."""
    gel: str
    """Geom of the gel block; it collides only with ``mount(collide=True)``."""
    nominal: str
    """Site at the pad as designed, on its carrier: a world may mount the pad with an error."""
    spec: SensorSpec
    """The sensor."""

    def __repr__(self) -> str:
        return f"MountedSensor({self.name!r}, sensor={self.spec.name!r}, body={self.body!r}, site={self.site!r})"

    def world_from_pad(self, data: mujoco.MjData) -> np.ndarray:
        """Pose (4, 4) of the pad frame after the last ``mj_kinematics`` or ``mj_step``."""
        return world_from_site(data, data.site(self.site).id)


@dataclass(frozen=True)
class RobotModel:
    """A robot with sensors, not compiled yet, and the names in it.

    Add table and objects to the spec and compile it; attached to another spec, its names carry the prefix given there.
    """

    spec: mujoco.MjSpec
    sensors: tuple[MountedSensor, ...]
    site: str
    """Site that the joints move: a sensor's ``nominal``; midway of two pads, z along fingers."""
    opening: str | None
    """Position actuator of the gap between two pads [m]; None without a gripper."""
    joints: tuple[str, ...]
    """Joints of the arm or of the driven frame, each with an actuator; none of a fixed sensor."""


def case_depth(sensor: SensorSpec) -> float:
    """Distance [m] from the pad centre to the outside of the case's back."""
    return sensor.case.wall - sensor.case.floor_z


def standing_on(sensor: SensorSpec) -> np.ndarray:
    """``mount_from_pad`` (4, 4): the back on the mount's origin, the pad looking along its +z."""
    return rigid(np.eye(3), np.array([0.0, 0.0, case_depth(sensor)]))


def mount(
    spec: mujoco.MjSpec,
    sensor: str | Path | SensorSpec,
    *,
    site: str | None = None,
    body: str | None = None,
    name: str = "sensor",
    pose: ArrayLike | None = None,
    mass: float | None = None,
    collide: bool = False,
) -> MountedSensor:
    """Put a sensor on a robot, rigidly: a body at the pad frame with case, gel block and site.

    .. code-block:: python

        spec = mujoco.MjSpec.from_file("my_arm.xml")
        left = raytac.mount(spec, "gelsight_mini_9x11", site="left_tip", name="left")
        right = raytac.mount(spec, "gelsight_mini", body="right_finger", pose=finger_from_pad, name="right")
        world = raytac.TactileWorld(spec, touches=["cube"])

    The case is a box from the outside of the back to the gel's bonded face, the inside of ``sensor.case`` plus its walls; it
    collides. The gel is a box from there to z = 0. Both carry their mass. ``spec`` is changed in place and compiles as
    before.

    Args:
        spec: robot, before it is compiled.
        sensor: name of a shipped sensor, path of a sensor file, or a specification.
        site, body: name of what carries the sensor, one of the two.
        name: prefix of the sensor's names in the model; several sensors on a robot need several names.
        pose: pose (4, 4) of the pad frame in the frame of that site or body; None: ``standing_on(sensor)``, the back of the case on the
            origin, the pad looking along +z.
        mass: mass of sensor and gel [kg]; None: the gel's by its density, the case's by its own.
        collide: MuJoCo collides the gel block too, for loops that only a ``TactileReader`` looks at. Its contacts have the gel's
            friction, and about its stiffness at one point under a body of 50 g: MuJoCo's scales with masses and the number of points.

    Raises:
        InputError: a site or body that is not there, neither or both, a pose that is no rigid transform, a ``name`` that is taken or
            empty, a ``mass`` that is not finite or leaves nothing for the case.
        SpecError: the sensor's file is missing or wrong.
    """
    if not isinstance(spec, mujoco.MjSpec):
        raise InputError("spec", value=type(spec).__name__, rule="must be a mujoco.MjSpec, such as mujoco.MjSpec.from_file(path)")
    loaded, carrier = sensor_spec(sensor), _carrier(spec, site, body)
    placement = standing_on(loaded) if pose is None else check_pose("pose", pose)
    if not isinstance(name, str) or not name:
        raise InputError("name", value=name, rule="must not be empty: it is the prefix of the sensor's names")
    mounted = _named(name, loaded)
    taken = [("body", spec.bodies, (mounted.body,)), ("site", spec.sites, (mounted.site, mounted.nominal))]
    for what, elements, new in [*taken, ("geom", spec.geoms, (mounted.case, mounted.gel))]:
        for one in sorted(set(new) & set(_names(elements))):
            raise InputError("name", value=name, rule=f"must be new: the robot has a {what} {one!r} already")
    masses, distance = _masses(loaded, mass), float(np.linalg.norm(placement[:3, 3]))
    if distance > _FARTHEST:
        warnings.warn(f"pose puts {name!r} {distance:g} m from what carries it: poses are in metres", stacklevel=2)
    if mass is not None and mass > _HEAVIEST:
        warnings.warn(f"mass makes {name!r} weigh {mass:g} kg: masses are in kilograms", stacklevel=2)
    child = _sensor_model(loaded, placement, *masses, collide=check_truth("collide", collide))
    if isinstance(carrier, mujoco.MjsSite):
        spec.attach(child, prefix=f"{name}_", site=carrier)
    else:
        spec.attach(child, prefix=f"{name}_", frame=carrier.add_frame())
    source = _IN_CODE if isinstance(sensor, SensorSpec) else str(sensor.resolve() if isinstance(sensor, Path) else sensor)
    spec.add_text(name=f"{_MARK}{name}", data=source)
    return mounted


def _check_apart(model: mujoco.MjModel, mounted: Sequence[MountedSensor]) -> None:
    """Raise ``InputError`` for two sensors at one place of one body."""
    bodies = [int(model.body(one.body).id) for one in mounted]
    for i, j in itertools.combinations(range(len(bodies)), 2):
        one, other = bodies[i], bodies[j]
        near = np.linalg.norm(model.body_pos[one] - model.body_pos[other]) < 1e-6
        turned = 1.0 - abs(model.body_quat[one] @ model.body_quat[other])
        if model.body_parentid[one] == model.body_parentid[other] and near and turned < 1e-9:
            rule = f"is mounted where {mounted[i].name!r} is: same carrier, same pose"
            raise InputError("sensors", value=mounted[j].name, rule=rule)


SensorChoice = Sequence[str | MountedSensor] | Mapping[str, str | Path | SensorSpec]
"""Sensors of a model: names that ``mount`` gave, its results, or what sensor each name is."""


def mounted_sensors(model: mujoco.MjModel, sensors: SensorChoice | None = None) -> tuple[MountedSensor, ...]:
    """Sensors of a compiled model.

    Args:
        model: model on which ``mount`` put sensors before it was compiled.
        sensors: names of those that are wanted, or what ``mount`` returned; a mapping says what sensor each name is, which a model
            needs whose sensors were mounted as specifications. None is every sensor that the model says it has.

    Raises:
        InputError: no sensor, a name that the model does not have or that is given twice, two sensors at one place, or a sensor
            that only its maker knows.
        SpecError: a sensor's file is missing or wrong.
    """
    marked = _marked(model)
    if sensors is None:
        chosen: list[Any] = list(marked)
    elif isinstance(sensors, str) or not isinstance(sensors, (Mapping, Sequence)):
        raise InputError("sensors", value=sensors, rule="must be names, results of mount, or a mapping of names to sensors")
    else:
        chosen = list(sensors)
    if not chosen:
        rule = "must be one sensor or more: put some on the MjSpec with raytac.mount before it is compiled"
        raise InputError("sensors", value=() if sensors is None else sensors, rule=rule, choices=marked)
    result = []
    for one in chosen:
        if isinstance(one, MountedSensor):
            mounted = one
        elif isinstance(one, str):
            given = sensors[one] if isinstance(sensors, Mapping) else None
            mounted = _named(one, _known_sensor(one, marked) if given is None else sensor_spec(given))
        else:
            raise InputError("sensors", value=one, rule="must be a name or a result of mount", choices=marked)
        for kind, part in (("BODY", mounted.body), ("SITE", mounted.site), ("GEOM", mounted.case), ("GEOM", mounted.gel)):
            if mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), part) < 0:
                rule = f"must be a sensor of the model, which has no {kind.lower()} {part!r}"
                raise InputError("sensors", value=mounted.name, rule=rule, choices=marked)
        if mounted.name in (other.name for other in result):
            raise InputError("sensors", value=mounted.name, rule="must not name a sensor twice")
        result.append(mounted)
    _check_apart(model, result)
    return tuple(result)


def _marked(model: mujoco.MjModel) -> dict[str, str]:
    """Names of the sensors that a model says it has, and of their files."""
    result, data = {}, bytes(model.text_data)
    for i in range(model.ntext):
        prefix, mark, name = (mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, i) or "").partition(_MARK)
        if mark:
            first = int(model.text_adr[i])
            result[prefix + name] = data[first : first + int(model.text_size[i]) - 1].decode()
    return result


def _known_sensor(name: str, marked: Mapping[str, str]) -> SensorSpec:
    source = marked.get(name, _IN_CODE)
    if name not in marked and marked:
        raise InputError("sensors", value=name, rule="must be a sensor of the model", choices=marked)
    if source == _IN_CODE:
        rule = f"was mounted as a specification, which the model does not hold: say sensors={{{name!r}: specification}}"
        raise InputError("sensors", value=name, rule=rule)
    return sensor_spec(source)


def _named(name: str, spec: SensorSpec) -> MountedSensor:
    return MountedSensor(name, f"{name}_body", f"{name}_pad", f"{name}_case", f"{name}_gel", f"{name}_nominal", spec)


def _carrier(spec: mujoco.MjSpec, site: str | None, body: str | None) -> mujoco.MjsBody | mujoco.MjsSite:
    if (site is None) == (body is None):
        rule = "must be the name of what carries the sensor, or `body` must: one of the two"
        raise InputError("site", value=(site, body), rule=rule, choices=_names(spec.sites))
    what, name, elements = ("site", site, spec.sites) if body is None else ("body", body, spec.bodies)
    carrier = (spec.site if body is None else spec.body)(name) if isinstance(name, str) else None
    if carrier is None:
        raise InputError(what, value=name, rule=f"must be the name of a {what} of the robot", choices=_names(elements))
    return carrier


def _names(elements: Iterable[Any]) -> list[str]:
    return [element.name for element in elements if element.name]


def _masses(sensor: SensorSpec, mass: float | None) -> tuple[float, float]:
    """Masses of case and gel [kg]."""
    (length, width), thickness = sensor.gelpad.size, sensor.gelpad.thickness
    gel = sensor.gelpad.density * length * width * thickness
    if mass is None:
        return sensor.case.density * math.prod(_case_size(sensor)), gel
    if not (math.isfinite(mass) and mass > gel):
        raise InputError("mass", value=mass, rule=f"must be finite and more than the gel's {gel:.4g} kg")
    return mass - gel, gel


def _case_size(sensor: SensorSpec) -> tuple[float, float, float]:
    """Outer size of the case along x, y, z [m], without the gel."""
    (length, width), wall = sensor.case.size, sensor.case.wall
    return length + 2.0 * wall, width + 2.0 * wall, case_depth(sensor) - sensor.gelpad.thickness


def _sensor_model(
    sensor: SensorSpec, mount_from_pad: np.ndarray, case_mass: float, gel_mass: float, *, collide: bool
) -> mujoco.MjSpec:
    """The sensor alone, its pad frame at ``mount_from_pad``."""
    spec = mujoco.MjSpec()
    placed = {"pos": mount_from_pad[:3, 3], "quat": quaternion(mount_from_pad[:3, :3])}
    body = spec.worldbody.add_body(name="body", **placed)
    (length, width), thickness = sensor.gelpad.size, sensor.gelpad.thickness
    case, back = np.array(_case_size(sensor)), -case_depth(sensor)
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(
        name="case", type=box, size=case / 2.0, pos=(0.0, 0.0, back + case[2] / 2.0), mass=case_mass, rgba=(0.1, 0.1, 0.12, 1.0)
    )
    gel = body.add_geom(
        name="gel",
        type=box,
        size=np.array([length, width, thickness]) / 2.0,
        pos=(0.0, 0.0, -thickness / 2.0),
        mass=gel_mass,
        rgba=(0.75, 0.75, 0.78, 1.0),
        contype=0,
        conaffinity=0,
        group=2,
    )
    if collide:
        _let_collide(gel, sensor.gelpad)
    body.add_site(name="pad", size=(1e-3,) * 3, group=4)
    spec.worldbody.add_site(name="nominal", size=(1e-3,) * 3, group=4, **placed)
    return spec


def _let_collide(gel: mujoco.MjsGeom, gelpad: GelpadSpec) -> None:
    """Give a gel block MuJoCo's contact: friction, and 2 E* a of a flat punch under a mass m.

    In MuJoCo's form by time constant T and impedance d a contact of the mass m is a spring of K = m / ((1 − d) d² T²) at rest.
    """
    gel.contype = gel.conaffinity = 1
    gel.priority, gel.condim = 1, 4
    gel.friction = (gelpad.friction, 3.0 * math.pi / 16.0 * gelpad.friction * _TOUCH_RADIUS, 1e-4)
    impedance = 0.95
    stiffness = 2.0 * gelpad.youngs_modulus / (1.0 - gelpad.poisson_ratio**2) * _TOUCH_RADIUS
    time = math.sqrt(_TOUCH_MASS / ((1.0 - impedance) * impedance**2 * stiffness))
    gel.solref, gel.solimp = (time, 1.0), (impedance, impedance, 1e-3, 0.5, 2.0)
