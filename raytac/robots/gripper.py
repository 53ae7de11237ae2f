"""Grippers: the servo that opens two fingers, and a driven frame that carries two sensors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from raytac.robots.mount import RobotModel, case_depth, mount
from raytac.se3 import pose
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import sensor_spec

FRAME_JOINTS: Final = ("x", "y", "z", "yaw", "pitch", "roll")
"""Joints of the driven frame, in order: slides along the world's axes, hinges about z, y, x.

Each hinge is in the frame that those before it have turned. Position actuators of these names take the displacement [m, rad]."""
FACING: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation of a pad that faces the other finger: its x, y, z in the finger's frame."""


@dataclass(frozen=True)
class GripperSettings:
    """Mechanics of the floating gripper and of the servo that opens it."""

    mass: float = 0.5
    """Mass of the driven frame [kg]: a guess, near a parallel gripper's."""
    inertia: float = 1e-3
    """Inertia of the driven frame about each axis [kg m²]: that of a box of 0.5 kg, 15 cm wide."""
    frequency: float = 100.0
    """Natural frequency of the servos without pads and fingers [rad/s]; critically damped."""
    opening: float = 0.08
    """Greatest opening [m]."""
    finger_mass: float = 0.02
    """Mass of a finger without its sensor [kg]: a guess, the Panda's weigh 15 g."""
    servo: tuple[float, float, float] = (1e4, 100.0, 70.0)
    """Servo of the opening: gain [N/m], damping [N s/m], greatest force [N]; the Panda's."""


def floating_gripper(
    sensor: SensorSpec | str = "gelsight_mini",
    *,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    settings: GripperSettings | None = None,
) -> RobotModel:
    """Two sensors, ``left`` and ``right``, on fingers of a frame that six position servos drive.

    There is no gravity. The pads face each other as on the Panda's hand (``two_finger_panda``): a pad's z points to the other
    finger, its y along z of the frame. The site ``tcp`` lies midway between both pads, its z in the direction of the fingers, its
    y from the right pad to the left one.

    Args:
        sensor: the sensor to mount twice, or its name or path.
        position, quaternion: pose of the frame where all six joints are 0, world frame [m], wxyz.
        settings: mechanics of the gripper; None is ``GripperSettings()``.
    """
    loaded = sensor_spec(sensor)
    settings = GripperSettings() if settings is None else settings
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    base = spec.worldbody.add_body(name="gripper", pos=position)
    base.mass, base.inertia, base.explicitinertial, base.gravcomp = settings.mass, np.full(3, settings.inertia), True, 1.0
    # MuJoCo's default is the position of the body, which would put the mass that far from the joints.
    base.ipos = (0.0, 0.0, 0.0)
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    for name, kind, axis in zip(FRAME_JOINTS, [slide] * 3 + [hinge] * 3, [*axes, *reversed(axes)], strict=True):
        base.add_joint(name=name, type=kind, axis=axis)
        stiffness = (settings.mass if kind == slide else settings.inertia) * settings.frequency**2
        _servo(spec, name, mujoco.mjtTrn.mjTRN_JOINT, stiffness, 2.0 * stiffness / settings.frequency)
    # The start's rotation lies below the joints, so that the slides stay along the world's axes.
    hand = base.add_body(name="hand", quat=quaternion)
    hand.gravcomp = 1.0
    hand.add_site(name="tcp", size=(1e-3,) * 3, group=4)
    depth = case_depth(loaded)
    back = loaded.case.size[1] / 2
    half = (0.011, 0.5 * settings.opening + depth + 2e-3, 0.005)
    hand.add_geom(
        name="bar",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=half,
        pos=(0.0, 0.0, -back - half[2] - 4e-3),
        mass=0.0,
        contype=0,
        conaffinity=0,
        rgba=(0.93, 0.93, 0.91, 1.0),
    )
    mounted = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        finger = hand.add_body(name=f"{side}_finger", quat=(1.0, 0.0, 0.0, 0.0) if sign > 0 else (0.0, 0.0, 0.0, 1.0))
        finger.gravcomp = 1.0
        finger.add_joint(
            name=f"{side}_slide",
            type=slide,
            axis=(0, 1, 0),
            range=(0.0, 0.5 * settings.opening),
            limited=True,
            damping=0.3,
        )
        finger.add_geom(
            name=f"{side}_holder",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            # 4 mm behind the pad, as on the Panda's hand, so that a grasped body touches the gel and no holder.
            size=(0.011, depth / 2 - 2e-3, 0.002),
            pos=(0.0, depth / 2 + 2e-3, -back - 2e-3),
            mass=settings.finger_mass,
            rgba=(0.3, 0.3, 0.32, 1.0),
        )
        mounted.append(mount(spec, loaded, body=f"{side}_finger", pose=pose(FACING, np.zeros(3)), name=side))
        spec.body(f"{side}_body").gravcomp = 1.0
    add_opening_servo(spec, ("left_slide", "right_slide"), settings)
    spindle = spec.add_equality(
        name="spindle", type=mujoco.mjtEq.mjEQ_JOINT, name1="left_slide", name2="right_slide", objtype=mujoco.mjtObj.mjOBJ_JOINT
    )
    spindle.data[:5] = 0.0, 1.0, 0.0, 0.0, 0.0
    spindle.solref, spindle.solimp = (0.005, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)
    return RobotModel(spec, tuple(mounted), "tcp", "opening", FRAME_JOINTS)


def add_opening_servo(spec: mujoco.MjSpec, joints: Iterable[str], settings: GripperSettings) -> None:
    """Add the position actuator ``opening`` [m] of the sum of the fingers' joints.

    Its damping goes into the joints. That of a servo on a tendon over two fingers MuJoCo integrates explicitly in part, and not at all at
    the bound of its force.
    """
    gain, damping, greatest_force = settings.servo
    tendon = spec.add_tendon(name="opening")
    for joint in joints:
        tendon.wrap_joint(joint, 1.0)
        spec.joint(joint).damping[0] += 2.0 * damping
    servo = _servo(spec, "opening", mujoco.mjtTrn.mjTRN_TENDON, gain, 0.0)
    servo.ctrllimited, servo.ctrlrange = True, (0.0, settings.opening)
    servo.forcelimited, servo.forcerange = True, (-greatest_force, greatest_force)


def _servo(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, stiffness: float, damping: float) -> mujoco.MjsActuator:
    servo = spec.add_actuator(name=name, target=name, trntype=kind)
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.gainprm[0] = stiffness
    servo.biasprm[:3] = 0.0, -stiffness, -damping
    return servo
