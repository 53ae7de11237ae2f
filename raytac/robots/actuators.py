"""Actuators of a MuJoCo model: their kind, unit and range, read from the compiled model."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

_UNITS = {
    ("position", True): ("°", math.degrees(1.0), math.pi),
    ("position", False): ("mm", 1e3, 0.1),
    ("velocity", True): ("°/s", math.degrees(1.0), 1.0),
    ("velocity", False): ("mm/s", 1e3, 0.1),
    ("force", True): ("N m", 1.0, 1.0),
    ("force", False): ("N", 1.0, 10.0),
    ("control", True): ("", 1.0, 1.0),
    ("control", False): ("", 1.0, 1.0),
}
"""Unit for people, its number in one SI unit, and half of a range that a model lacks [SI].

By kind and by whether it turns."""


@dataclass(frozen=True)
class Actuator:
    """One entry of ``data.ctrl``."""

    index: int
    name: str
    """The model's; else that of the joint or tendon, with a number if it has several."""
    kind: str
    """``position`` or ``velocity`` of a servo, ``force``, or ``control`` of anything else."""
    unit: str
    """For people; empty where the control has none."""
    factor: float
    """Numbers in ``unit`` of one unit of the control."""
    low: float
    high: float
    """Range of the control."""
    is_ranged: bool
    """False if the model gives no range and ``low`` and ``high`` are only a choice."""


def actuators(model: mujoco.MjModel) -> tuple[Actuator, ...]:
    """All actuators in the order of ``data.ctrl``.

    A range is that of the control; else, of a position servo, the joint's (times the gear), of a force its own limit.
    """
    return tuple(_actuator(model, index) for index in range(model.nu))


def _actuator(model: mujoco.MjModel, index: int) -> Actuator:
    kind, turns = _kind(model, index), _turns(model, index)
    unit, factor, half = _UNITS[kind, turns]
    limits = _limits(model, index, kind)
    low, high = limits if limits is not None else (-half, half)
    return Actuator(index, _name(model, index), kind, unit, factor, low, high, limits is not None)


def _name(model: mujoco.MjModel, index: int) -> str:
    name = model.actuator(index).name
    if name:
        return name
    kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    of_joint, of_tendon = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_TENDON)
    moved = {of_joint: model.joint, of_tendon: model.tendon}.get(kind)
    name = "" if moved is None else moved(target).name
    same = (model.actuator_trntype == kind) & (model.actuator_trnid[:, 0] == target)
    return f"{name} {index}" if name and same.sum() > 1 else name or f"actuator {index}"


def _kind(model: mujoco.MjModel, index: int) -> str:
    fixed = model.actuator_gaintype[index] == int(mujoco.mjtGain.mjGAIN_FIXED)
    bias = int(model.actuator_biastype[index])
    dynamics = int(model.actuator_dyntype[index])
    if not fixed or dynamics == int(mujoco.mjtDyn.mjDYN_MUSCLE):
        return "control"
    if bias == int(mujoco.mjtBias.mjBIAS_AFFINE):
        _, stiffness, damping = model.actuator_biasprm[index, :3]
        if stiffness < 0.0:
            return "velocity" if dynamics == int(mujoco.mjtDyn.mjDYN_INTEGRATOR) else "position"
        return "velocity" if damping < 0.0 else "control"
    plain = bias == int(mujoco.mjtBias.mjBIAS_NONE) and model.actuator_gainprm[index, 0] == 1.0
    return "force" if plain and dynamics == int(mujoco.mjtDyn.mjDYN_NONE) and _gear(model, index) == 1.0 else "control"


def _turns(model: mujoco.MjModel, index: int) -> bool:
    """True if the actuator's length is an angle: of a hinge, or of a tendon over hinges alone."""
    kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return int(model.jnt_type[target]) in (hinge, int(mujoco.mjtJoint.mjJNT_BALL))
    if kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
        wraps = range(first, first + count)
        if any(model.wrap_type[k] != int(mujoco.mjtWrap.mjWRAP_JOINT) for k in wraps):
            return False
        return all(int(model.jnt_type[int(model.wrap_objid[k])]) == hinge for k in wraps)
    return False


def _gear(model: mujoco.MjModel, index: int) -> float:
    return float(model.actuator_gear[index, 0])


def _limits(model: mujoco.MjModel, index: int, kind: str) -> tuple[float, float] | None:
    """Range of the control; None where the model does not give one."""
    if model.actuator_ctrllimited[index]:
        low, high = model.actuator_ctrlrange[index]
        return float(low), float(high)
    joint = int(model.actuator_trnid[index, 0])
    if kind == "position" and model.actuator_trntype[index] == int(mujoco.mjtTrn.mjTRN_JOINT) and model.jnt_limited[joint]:
        low, high = sorted(_gear(model, index) * model.jnt_range[joint])
        return float(low), float(high)
    if kind == "force" and model.actuator_forcelimited[index]:
        low, high = model.actuator_forcerange[index]
        return float(low), float(high)
    return None


def torque_motors(model: mujoco.MjModel, joints: Iterable[int]) -> np.ndarray | None:
    """Torque motor of each joint (unit gain and gear, no bias or activation), or None."""
    motors = []
    for joint in joints:
        plain = (
            (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
            & (model.actuator_trnid[:, 0] == joint)
            & (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
            & (model.actuator_gainprm[:, 0] == 1.0)
            & (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))
            & (model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE))
            & (model.actuator_gear[:, 0] == 1.0)
        )
        if plain.sum() != 1:
            return None
        motors.append(int(np.flatnonzero(plain)[0]))
    return np.array(motors)


def force_limits(model: mujoco.MjModel, motors: np.ndarray) -> np.ndarray:
    """Least and greatest force (n, 2) of motors by their two ranges; ±inf without."""
    ctrl = np.where(model.actuator_ctrllimited[motors, None] == 1, model.actuator_ctrlrange[motors], (-np.inf, np.inf))
    force = np.where(model.actuator_forcelimited[motors, None] == 1, model.actuator_forcerange[motors], (-np.inf, np.inf))
    return np.stack([np.maximum(ctrl[:, 0], force[:, 0]), np.minimum(ctrl[:, 1], force[:, 1])], axis=1)
