"""Sensors without an arm: two pads that face each other on a driven frame, and one sensor that stands still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from raytac.robots.mount import MountedSensor, case_depth, mount_sensor
from raytac.robots.pose import pose
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import load_sensor

__all__ = ["FRAME_JOINTS", "FloatingGripper", "floating_gripper"]

FRAME_JOINTS: Final = ("x", "y", "z", "yaw", "pitch", "roll")
"""Joints of the driven frame, in order: slides along the world's axes, then hinges about z, y and x, each in the frame that those before
leave. The position actuators of the same names take the displacement from the start [m, rad]."""

_MASS = 0.5
"""Of the driven frame [kg]: a guess, near a parallel gripper's."""
_INERTIA = 1e-3
"""Of the driven frame about each axis [kg m²]: that of a box of 0.5 kg, 15 cm wide."""
_FREQUENCY = 100.0
"""Natural frequency of the frame's servos without pads and fingers [rad/s]; critically damped."""
_TRAVEL = 0.08
_FINGER = 0.02
"""Mass of a finger without its sensor [kg]: a guess, the Panda's weigh 15 g."""
_SERVO: Final = (1e4, 100.0, 70.0)
"""Servo of the opening: gain [N/m], damping [N s/m], greatest force [N], as of the Panda's hand."""


@dataclass(frozen=True)
class FloatingGripper:
    """A driven frame with two pads: an editable spec, and the names in it."""

    spec: mujoco.MjSpec
    sensors: tuple[MountedSensor, ...]
    site: str
    """Site midway between both pads: z as the fingers point, y from the right pad to the left one."""
    opening: str
    """Position actuator of the gap between both pads [m], 0 to 0.08."""
    joints: tuple[str, ...] = FRAME_JOINTS


def floating_gripper(
    sensor: SensorSpec | str = "gelsight_mini",
    *,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> FloatingGripper:
    """Two sensors, ``left`` and ``right``, on fingers of a frame that six position servos drive; gravity does not pull at it.

    The pads face each other as on the Panda's hand (``two_finger_panda``): a pad's z points to the other finger, its y along z of the
    frame.

    Args:
        sensor: what is mounted twice, or its name or path.
        position, quaternion: pose of the frame where all six joints are 0, world frame [m], wxyz.
    """
    loaded = load_sensor(sensor) if isinstance(sensor, str) else sensor
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    base = spec.worldbody.add_body(name="gripper", pos=position)
    base.mass, base.inertia, base.explicitinertial, base.gravcomp = _MASS, np.full(3, _INERTIA), True, 1.0
    # Left out, MuJoCo takes the position of the body for it: a gripper at x = 0.45 m had its mass 0.45 m off its joints.
    base.ipos = (0.0, 0.0, 0.0)
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    for name, kind, axis in zip(FRAME_JOINTS, [slide] * 3 + [hinge] * 3, [*axes, *reversed(axes)], strict=True):
        base.add_joint(name=name, type=kind, axis=axis)
        stiffness = (_MASS if kind == slide else _INERTIA) * _FREQUENCY**2
        _servo(spec, name, mujoco.mjtTrn.mjTRN_JOINT, stiffness, 2.0 * stiffness / _FREQUENCY)
    # The start's rotation lies below the joints, so that the slides stay along the world's axes.
    hand = base.add_body(name="hand", quat=quaternion)
    hand.gravcomp = 1.0
    hand.add_site(name="tcp", size=(1e-3,) * 3, group=4)
    depth = case_depth(loaded)
    back = loaded.case.size[1] / 2
    half = (0.011, 0.5 * _TRAVEL + depth + 2e-3, 0.005)
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
        finger.add_joint(name=f"{side}_slide", type=slide, axis=(0, 1, 0), range=(0.0, 0.5 * _TRAVEL), limited=True, damping=0.3)
        finger.add_geom(
            name=f"{side}_holder",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            # 4 mm behind the pad, as on the Panda's hand: what the pads hold must meet gel before it meets a holder.
            size=(0.011, depth / 2 - 2e-3, 0.002),
            pos=(0.0, depth / 2 + 2e-3, -back - 2e-3),
            mass=_FINGER,
            rgba=(0.3, 0.3, 0.32, 1.0),
        )
        inward = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # columns: the pad's axes in the finger's frame
        mounted.append(mount_sensor(spec, loaded, f"{side}_finger", pose(inward, np.zeros(3)), name=side, kind="body"))
        spec.body(f"{side}_body").gravcomp = 1.0
    tendon = spec.add_tendon(name="opening")
    for side in ("left", "right"):
        tendon.wrap_joint(f"{side}_slide", 1.0)
    spindle = spec.add_equality(
        name="spindle", type=mujoco.mjtEq.mjEQ_JOINT, name1="left_slide", name2="right_slide", objtype=mujoco.mjtObj.mjOBJ_JOINT
    )
    spindle.data[:5] = 0.0, 1.0, 0.0, 0.0, 0.0
    spindle.solref, spindle.solimp = (0.005, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)
    gain, damping, most = _SERVO
    servo = _servo(spec, "opening", mujoco.mjtTrn.mjTRN_TENDON, gain, damping)
    servo.ctrllimited, servo.ctrlrange = True, (0.0, _TRAVEL)
    servo.forcelimited, servo.forcerange = True, (-most, most)
    return FloatingGripper(spec, tuple(mounted), "tcp", "opening")


def _servo(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, stiffness: float, damping: float) -> mujoco.MjsActuator:
    servo = spec.add_actuator(name=name, target=name, trntype=kind)
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.gainprm[0] = stiffness
    servo.biasprm[:3] = 0.0, -stiffness, -damping
    return servo
