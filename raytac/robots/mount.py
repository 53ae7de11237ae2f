"""Mount a tactile sensor on a body or a site of any MJCF robot."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.robots.frames import world_from_site
from raytac.se3 import check_pose, pose, quaternion
from raytac.specs.sensor import SensorSpec

__all__ = ["MountedSensor", "RobotModel", "case_depth", "mount_sensor", "standing_on"]

_WALL = 0.8e-3
"""Thickness of a case's walls and back [m]: a guess, with which the Mini's inside gives its outside of 32 × 28 mm."""
_CASE_DENSITY = 1000.0
"""Mean density of a case with its camera [kg/m³]: a guess, by which the GelSight Mini weighs 22 g without its gel."""


@dataclass(frozen=True)
class MountedSensor:
    """Names, in the compiled model, of the parts of a mounted sensor."""

    name: str
    body: str
    """Body whose frame is the pad frame; a wrench on the pad acts on it (``xfrc_applied``)."""
    site: str
    """Site at the pad frame: origin at the centre of the undeformed outer surface, +z out of the sensor."""
    case: str
    """Geom of the case; it collides."""
    gel: str
    """Geom of the gel block; for pictures only, since the pad's physics computes its contact."""

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
    """Site that the joints move: the one sensor's pad as designed, or the midpoint of two pads, where z is the direction of the fingers."""
    opening: str | None
    """Position actuator of the gap between two pads [m]; None without a gripper."""
    joints: tuple[str, ...]
    """Joints of the arm or of the driven frame, each with an actuator; none of a fixed sensor."""


def case_depth(sensor: SensorSpec) -> float:
    """Distance [m] from the pad centre to the outside of the case's back."""
    return _WALL - sensor.case.floor_z


def standing_on(sensor: SensorSpec) -> np.ndarray:
    """``mount_from_pad`` (4, 4) of a sensor whose back stands on the mount's origin, axes parallel: the pad looks along the mount's +z."""
    return pose(np.eye(3), np.array([0.0, 0.0, case_depth(sensor)]))


def mount_sensor(
    spec: mujoco.MjSpec,
    sensor: SensorSpec,
    at: str,
    mount_from_pad: np.ndarray | None = None,
    *,
    name: str = "sensor",
    kind: Literal["body", "site"] | None = None,
    mass: float | None = None,
) -> MountedSensor:
    """Put ``sensor`` on a robot, rigidly: a body at the pad frame with the case, the gel block and a site.

    The case is a box from the outside of the back to the gel's bonded face, the inside of ``sensor.case`` plus walls of 0.8 mm
    (a guess); the gel is a box from there to z = 0. Both carry their mass. ``spec`` is changed in place and compiles as before.

    Args:
        spec: robot, before it is compiled.
        sensor: the sensor to mount.
        at: name of a body or a site of ``spec``.
        mount_from_pad: pose (4, 4) of the pad frame in the frame of that body or site; None: ``standing_on(sensor)``.
        name: prefix of the four names, unique in ``spec``: several sensors on a robot need several names.
        kind: ``body`` or ``site``, where both have the same name.
        mass: mass of sensor and gel [kg]; None: the gel's by its density, the case's by a mean density of 1000 kg/m³ (a guess).

    Raises:
        InputError: ``at`` names nothing or two things, a pose is no rigid transform, ``name`` is taken or empty, ``mass`` is not
            finite or leaves nothing for the case.
    """
    if not isinstance(spec, mujoco.MjSpec):
        raise InputError("spec", value=type(spec).__name__, rule="must be a mujoco.MjSpec, from which a model is compiled later")
    anchor = _find(spec, at, kind)
    placement = standing_on(sensor) if mount_from_pad is None else check_pose("mount_from_pad", mount_from_pad)
    if not name:
        raise InputError("name", value=name, rule="must not be empty: it is the prefix of the sensor's names")
    names = MountedSensor(name, body=f"{name}_body", site=f"{name}_pad", case=f"{name}_case", gel=f"{name}_gel")
    existing = [("body", spec.bodies, names.body), ("site", spec.sites, names.site), ("geom", spec.geoms, names.case)]
    for what, elements, new in [*existing, ("geom", spec.geoms, names.gel)]:
        if new in _names(elements):
            raise InputError("name", value=name, rule=f"must be new: the robot has a {what} {new!r} already")
    child = _sensor_spec(sensor, placement, *_masses(sensor, mass))
    if isinstance(anchor, mujoco.MjsSite):
        spec.attach(child, prefix=f"{name}_", site=anchor)
    else:
        spec.attach(child, prefix=f"{name}_", frame=anchor.add_frame())
    return names


def _find(spec: mujoco.MjSpec, at: str, kind: str | None) -> mujoco.MjsBody | mujoco.MjsSite:
    if kind not in (None, "body", "site"):
        raise InputError("kind", value=kind, rule="must say what `at` is the name of", choices=("body", "site"))
    body = spec.body(at) if kind != "site" else None
    site = spec.site(at) if kind != "body" else None
    if body is not None and site is not None:
        raise InputError(
            "at", value=at, rule="is the name of a body and of a site: say which by `kind`", choices=("body", "site")
        )
    if body is None and site is None:
        bodies = [] if kind == "site" else _names(spec.bodies)
        sites = [] if kind == "body" else _names(spec.sites)
        rule = f"must be the name of a {kind or 'body or site'} of the robot"
        raise InputError("at", value=at, rule=rule, choices=[*bodies, *sites])
    return body if site is None else site


def _names(elements: Iterable[Any]) -> list[str]:
    return [element.name for element in elements if element.name]


def _masses(sensor: SensorSpec, mass: float | None) -> tuple[float, float]:
    """Masses of case and gel [kg]."""
    (length, width), thickness = sensor.gelpad.size, sensor.gelpad.thickness
    gel = sensor.gelpad.density * length * width * thickness
    if mass is None:
        return _CASE_DENSITY * math.prod(_case_size(sensor)), gel
    if not (math.isfinite(mass) and mass > gel):
        raise InputError("mass", value=mass, rule=f"must be finite and more than the gel's {gel:.4g} kg")
    return mass - gel, gel


def _case_size(sensor: SensorSpec) -> tuple[float, float, float]:
    """Outer size of the case along x, y, z [m], without the gel."""
    (length, width), thickness = sensor.case.size, sensor.gelpad.thickness
    return length + 2.0 * _WALL, width + 2.0 * _WALL, case_depth(sensor) - thickness


def _sensor_spec(sensor: SensorSpec, mount_from_pad: np.ndarray, case_mass: float, gel_mass: float) -> mujoco.MjSpec:
    """The sensor alone, its pad frame at ``mount_from_pad``."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="body", pos=mount_from_pad[:3, 3], quat=quaternion(mount_from_pad[:3, :3]))
    (length, width), thickness = sensor.gelpad.size, sensor.gelpad.thickness
    case, back = np.array(_case_size(sensor)), -case_depth(sensor)
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(
        name="case", type=box, size=case / 2.0, pos=(0.0, 0.0, back + case[2] / 2.0), mass=case_mass, rgba=(0.1, 0.1, 0.12, 1.0)
    )
    gel = np.array([length, width, thickness])
    body.add_geom(
        name="gel",
        type=box,
        size=gel / 2.0,
        pos=(0.0, 0.0, -thickness / 2.0),
        mass=gel_mass,
        rgba=(0.75, 0.75, 0.78, 1.0),
        contype=0,
        conaffinity=0,
        group=2,
    )
    body.add_site(name="pad", size=(1e-3,) * 3, group=4)
    return spec
