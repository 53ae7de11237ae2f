"""Impedance control: torques that make an arm a mass on springs, Cartesian or in joints.

Both add C(q, q̇) q̇ + g(q), which compensates gravity. Read the state after ``mj_forward`` or ``mj_step1``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.joint_springs import JointSprings
from raytac.se3 import check_pose, pose_error

_SINGULAR = 1e-3
"""Added to J M⁻¹ Jᵀ [1/kg]: a finite mass of 1000 kg in a singular direction."""


@dataclass(frozen=True)
class JointTorque:
    """Torques that a controller commands; of a batch, one row an environment."""

    torque: np.ndarray
    """Torques (…, n) [N·m] by the law."""
    saturated: np.ndarray
    """True (…, n) where MuJoCo cuts a torque at the motor's limit; False without motors."""


class CartesianImpedance:
    """Springs between a site and a target pose: τ = Jᵀ (K e − D J q̇ + w) + Nᵀ τ₀ + C q̇ + g.

    N. Hogan, "Impedance control: an approach to manipulation", ASME J. Dyn. Syst. Meas. Control 107, 1985, without inertia shaping:
    the arm keeps its own inertia Λ = (J M⁻¹ Jᵀ)⁻¹ at the site, so no force sensor is needed. e (6,) is the distance [m] and the
    rotation vector [rad] to the target, in world axes. D damps every mode of (Λ, K) by the ratio ζ: with Λ = Q Qᵀ and
    K = Q K₀ Qᵀ, D = 2 ζ Q √K₀ Qᵀ (A. Albu-Schäffer, C. Ott, U. Frese, G. Hirzinger, "Cartesian impedance control of redundant robots:
    recent results with the DLR-light-weight-arms", ICRA 2003). The posture's torque τ₀ = M (ω² (q₀ − q) − 2 ζ ω q̇) acts through the
    dynamically consistent null space Nᵀ = 1 − Jᵀ Λ J M⁻¹, so that it does not move the site (O. Khatib, "A unified approach for motion
    and force control of robot manipulators: the operational space formulation", IEEE J. Robot. Autom. 3(1), 1987).
    """

    def __init__(
        self,
        arm: Arm,
        *,
        stiffness: float = 1000.0,
        rotational_stiffness: float = 50.0,
        damping_ratio: float = 1.0,
        posture: np.ndarray | None = None,
        posture_frequency: float = 3.0,
    ) -> None:
        """Set the springs.

        Args:
            stiffness: K of the translations [N/m].
            rotational_stiffness: K of the rotations [N·m/rad].
            damping_ratio: ζ.
            posture: q₀ (n,); None: the null space is damped only.
            posture_frequency: ω of the posture [rad/s].

        Raises ``InputError`` if a value is negative or not finite, or ``posture`` has the wrong shape.
        """
        values = {
            "stiffness": stiffness,
            "rotational_stiffness": rotational_stiffness,
            "damping_ratio": damping_ratio,
            "posture_frequency": posture_frequency,
        }
        for name, value in values.items():
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(name, value=value, rule="must be 0 or more, and finite")
        if posture is not None and (np.shape(posture) != (len(arm),) or not np.isfinite(posture).all()):
            raise InputError("posture", value=np.asarray(posture).tolist(), rule=f"must be {len(arm)} finite numbers")
        self.arm = arm
        self._stiffness = np.diag([stiffness] * 3 + [rotational_stiffness] * 3)
        self._ratio, self._frequency = damping_ratio, posture_frequency
        self._posture = None if posture is None else np.array(posture, float)

    def torque(self, data: mujoco.MjData, world_from_target: np.ndarray, wrench: np.ndarray | None = None) -> JointTorque:
        """Torques for the present state.

        Args:
            data: state of the arm's model.
            world_from_target: target pose (4, 4) of the site; the rotation to it must stay below half a turn.
            wrench: w (6,), additional force [N] and torque [N·m] that the site exerts, world axes.

        Raises ``InputError`` for a pose or a wrench that is not valid.
        """
        target = check_pose("world_from_target", world_from_target)
        feedforward = np.zeros(6) if wrench is None else np.asarray(wrench, float)
        if feedforward.shape != (6,) or not np.isfinite(feedforward).all():
            raise InputError(
                "wrench", value=feedforward.tolist(), rule="must be 6 finite numbers: force, then torque, world axes"
            )
        arm = self.arm
        jacobian, mass = arm.jacobian(data), arm.mass_matrix(data)
        speed = data.qvel[arm.dof]
        solved = np.linalg.solve(mass, jacobian.T)
        inertia = np.linalg.inv(jacobian @ solved + _SINGULAR * np.eye(6))
        error = pose_error(target, arm.world_from_site(data))
        force = self._stiffness @ error - self._damping(inertia) @ (jacobian @ speed) + feedforward
        spring = np.zeros(len(arm)) if self._posture is None else self._frequency**2 * (self._posture - data.qpos[arm.qpos])
        posture_torque = mass @ (spring - 2.0 * self._ratio * self._frequency * speed)
        posture_torque -= jacobian.T @ (inertia @ (solved.T @ posture_torque))
        return _joint_torque(arm, jacobian.T @ force + posture_torque + arm.bias(data))

    def _damping(self, inertia: np.ndarray) -> np.ndarray:
        root = np.linalg.cholesky(inertia)
        inverse = np.linalg.inv(root)
        square, modes = np.linalg.eigh(inverse @ self._stiffness @ inverse.T)
        mixed = root @ modes
        return 2.0 * self._ratio * (mixed * np.sqrt(np.maximum(square, 0.0))) @ mixed.T


class JointImpedance:
    """Springs in the joints: τ = M (ω² (q_d − q) + 2 ζ ω (q̇_d − q̇)) + C q̇ + g.

    The computed torque law (J. J. Craig, "Introduction to Robotics", chapter 10): each joint's error obeys ë + 2 ζ ω ė + ω² e = 0.
    It follows the velocities of differential inverse kinematics.
    """

    def __init__(self, arm: Arm, *, frequency: float = 30.0, damping_ratio: float = 1.0) -> None:
        """``frequency`` ω [rad/s], ``damping_ratio`` ζ; keep ω Δt of a time step below about 0.1.

        Raises ``InputError`` if one is negative or not finite.
        """
        for name, value in (("frequency", frequency), ("damping_ratio", damping_ratio)):
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(name, value=value, rule="must be 0 or more, and finite")
        self.arm, self._frequency, self._ratio = arm, frequency, damping_ratio
        self._latest: JointSprings | None = None

    def springs(self, datas: Sequence[mujoco.MjData], others: Sequence[int] = ()) -> JointSprings:
        """The same springs, driven in every step; ``others``: actuators beside the motors."""
        return JointSprings(self.arm, datas, frequency=self._frequency, damping_ratio=self._ratio, others=others)

    def torque(self, data: mujoco.MjData, joints: np.ndarray, velocity: np.ndarray | None = None) -> JointTorque:
        """Torques towards ``joints`` (n,) [rad] that move with ``velocity`` [rad/s]; None: 0."""
        rows = [None if value is None else np.asarray(value)[None] for value in (joints, velocity)]
        result = self.torques([data], rows[0], rows[1])  # type: ignore[arg-type]
        return JointTorque(result.torque[0], result.saturated[0])

    def torques(self, datas: Sequence[mujoco.MjData], joints: np.ndarray, velocity: np.ndarray | None = None) -> JointTorque:
        """Torques for B states, each array (B, n)."""
        shape = len(datas), len(self.arm)
        velocity = np.zeros(shape) if velocity is None else velocity
        for name, value in (("joints", joints), ("velocity", velocity)):
            if np.shape(value) != shape or not np.isfinite(value).all():
                rule = f"must be {len(self.arm)} finite numbers, of every state"
                raise InputError(name, value=np.asarray(value).tolist(), rule=rule)
        # Where their numbers lie is looked up once for states that are asked about again and again.
        if self._latest is None or not self._latest.is_for(datas):
            self._latest = self.springs(datas)
        self._latest.aim(joints, velocity, np.array([data.time for data in datas]))
        return _joint_torque(self.arm, self._latest.torque().copy())


def _joint_torque(arm: Arm, torque: np.ndarray) -> JointTorque:
    limit = arm.torque_limit
    beyond = np.zeros(torque.shape, bool) if limit is None else (torque < limit[:, 0]) | (torque > limit[:, 1])
    return JointTorque(torque, beyond)
