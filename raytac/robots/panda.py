"""The Franka Panda, ours or the menagerie's, with tactile sensors (docs/guide/robots.md)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from raytac.assets import asset_root
from raytac.errors import InputError
from raytac.robots.gripper import FACING, GripperSettings, add_opening_servo
from raytac.robots.mount import RobotModel, case_depth, mount, standing_on
from raytac.se3 import pose
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import sensor_spec

JOINTS: Final = tuple(f"joint{i}" for i in range(1, 8))
"""Names of the arm's joints."""
MAX_VELOCITY: Final = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
"""Greatest joint speeds [rad/s] (Franka Control Interface documentation, limits for Panda)."""
MAX_TORQUE: Final = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Greatest joint torques [N·m] (the same)."""
READY: Final = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""Joint positions [rad] from which libfranka's examples start: the flange looks down."""

_FLANGE: Final = (0.0, 0.0, 0.107)
"""The flange in the frame of link7 [m] (Franka Control Interface, Denavit-Hartenberg)."""
_HAND_TURN: Final = -math.pi / 4
"""The hand on the flange, about z [rad] (franka_ros, panda_arm_hand.urdf.xacro)."""
_TCP: Final = 0.1034
"""Point between the finger tips along z of the hand [m] (franka_ros, franka_hand.xacro)."""
_FINGER: Final = 0.0584
"""Finger frames in the hand's frame, along z [m] (the same)."""


def one_sensor_panda(sensor: SensorSpec | str = "gelsight_mini", *, model: str | Path | None = None) -> RobotModel:
    """A Panda whose flange carries one sensor, ``sensor``, which looks along the flange's +z.

    Args:
        sensor: the sensor to mount, or its name or path as ``load_sensor`` takes it.
        model: MJCF file of another Panda without a hand, e.g. the menagerie's ``panda_nohand.xml``; None: ours. Its position
            actuators are replaced by torque motors and its keyframes dropped; joints ``joint1`` to ``joint7`` and a body ``link7``
            with the DH frame are needed.

    Raises:
        InputError: the model cannot be read or lacks one of these; it has a hand.
        SpecError: the sensor's file is missing or wrong.
    """
    spec = _arm(model)
    if model is not None and spec.body("hand") is not None:
        raise InputError(
            "model", value=str(model), rule="must be an arm without a hand for a sensor on the flange (panda_nohand.xml)"
        )
    loaded = sensor_spec(sensor)
    flange_from_pad = standing_on(loaded)
    link7_from_flange = pose(np.eye(3), np.array(_FLANGE))
    link7_from_pad = link7_from_flange @ flange_from_pad
    mounted = mount(spec, loaded, body="link7", pose=link7_from_pad)
    return RobotModel(spec, (mounted,), mounted.nominal, None, JOINTS)


def two_finger_panda(sensor: SensorSpec | str = "gelsight_mini", *, model: str | Path | None = None) -> RobotModel:
    """A Panda with the Franka Hand; two sensors that face each other, ``left`` and ``right``.

    Holders replace the finger tips. A pad's centre lies where the touching plane of the tip was, 0.1034 m in front of the hand's
    flange; its x is the finger's x, its y points to the finger's end. The gap between both pads is the sum of the finger joints,
    0 to 0.08 m.

    Args:
        sensor: the sensor to mount twice, or its name or path.
        model: MJCF file of another Panda with the hand, e.g. the menagerie's ``panda.xml``; None: ours. As for
            ``one_sensor_panda``; bodies ``hand``, ``left_finger``, ``right_finger`` and joints ``finger_joint1``, ``finger_joint2``
            are needed.

    Raises as ``one_sensor_panda``.
    """
    spec = _arm(model)
    hand = "hand/" if model is None else ""
    if model is None:
        frame = spec.body("link7").add_frame(pos=_FLANGE, quat=(math.cos(_HAND_TURN / 2), 0.0, 0.0, math.sin(_HAND_TURN / 2)))
        spec.attach(_read(asset_root("scenes") / "robots" / "panda_hand.xml"), prefix=hand, frame=frame)
    else:
        _need(spec, model, bodies=("hand", "left_finger", "right_finger"), joints=("finger_joint1", "finger_joint2"))
        _replace_servo(spec)
    loaded = sensor_spec(sensor)
    depth = case_depth(loaded)
    finger_from_pad = pose(FACING, np.array([0.0, 0.0, _TCP - _FINGER]))
    mounted = []
    for side in ("left", "right"):
        finger = spec.body(f"{hand}{side}_finger")
        for geom in list(finger.geoms):
            spec.delete(geom)
        # From the slide to the far side of the case's upper edge; its mass is part of the finger's published inertia.
        top = _TCP - _FINGER - loaded.case.size[1] / 2
        finger.add_geom(
            name=f"{side}_holder",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.011, depth / 2 - 2e-3, top / 2),
            pos=(0.0, depth / 2 + 2e-3, top / 2),
            mass=0.0,
            rgba=(0.3, 0.3, 0.32, 1.0),
        )
        mounted.append(mount(spec, loaded, body=f"{hand}{side}_finger", pose=finger_from_pad, name=side))
    site = f"{hand}tcp"
    if spec.site(site) is None:
        spec.body("hand").add_site(name=site, pos=(0.0, 0.0, _TCP), group=4)
    return RobotModel(spec, tuple(mounted), site, f"{hand}opening", JOINTS)


def _arm(model: str | Path | None) -> mujoco.MjSpec:
    if model is None:
        return _read(asset_root("scenes") / "robots" / "panda.xml")
    spec = _read(Path(model))
    _need(spec, model, bodies=("link7",), joints=JOINTS)
    for key in list(spec.keys):
        spec.delete(key)
    for actuator in list(spec.actuators):
        if actuator.target in JOINTS:
            spec.delete(actuator)
    for i, (joint, limit) in enumerate(zip(JOINTS, MAX_TORQUE, strict=True), start=1):
        motor = spec.add_actuator(name=f"motor{i}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrllimited, motor.ctrlrange = True, (-limit, limit)
    return spec


def _replace_servo(spec: mujoco.MjSpec) -> None:
    """Replace the actuators of a model's hand by our servo on the sum of both finger joints."""
    for actuator in list(spec.actuators):
        if actuator.target not in JOINTS:
            spec.delete(actuator)
    add_opening_servo(spec, ("finger_joint1", "finger_joint2"), GripperSettings())


def _read(path: Path) -> mujoco.MjSpec:
    if not path.is_file():
        raise InputError("model", value=str(path), rule="must be an MJCF file that exists")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise InputError("model", value=str(path), rule=f"must be an MJCF file that MuJoCo reads ({error})") from error


def _need(spec: mujoco.MjSpec, model: str | Path, *, bodies: tuple[str, ...], joints: tuple[str, ...]) -> None:
    for kind, names, elements in (("body", bodies, spec.bodies), ("joint", joints, spec.joints)):
        known = [element.name for element in elements if element.name]
        for name in names:
            if name not in known:
                raise InputError("model", value=str(model), rule=f"must have a {kind} {name!r}", choices=known)
