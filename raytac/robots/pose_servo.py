"""Joint targets that take the sites of many environments towards poses: damped least squares, one small solve a batch.

``DifferentialIk`` keeps every limit by a quadratic program, about a millisecond a call; a learner steps dozens of environments and can
live with less: a step that is too fast is shortened as a whole, and a joint stops at its limit whatever the others do.

    Δq = Jᵀ (J Jᵀ + λ² 1)⁻¹ e + g (1 − J⁺ J) (q₀ − q)

C. W. Wampler, "Manipulator inverse kinematic solutions based on vector formulations and damped least-squares methods", IEEE Trans. Syst.
Man Cybern. 16(1), 1986; the second term leans a redundant arm to q₀ without moving the site (A. Liégeois, IEEE Trans. SMC 7(12), 1977).
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.pose import pose_error, site_poses

__all__ = ["PoseServo"]


class PoseServo:
    """Steps of one arm in any number of environments. Keeps no state."""

    def __init__(
        self,
        arm: Arm,
        *,
        max_velocity: np.ndarray | float,
        posture: np.ndarray | None = None,
        posture_gain: float = 0.1,
        damping: float = 0.02,
    ) -> None:
        """Set the law.

        Args:
            arm: joints and site.
            max_velocity: greatest |q̇| (n,) or one for all [rad/s or m/s].
            posture: q₀ (n,); None does not lean.
            posture_gain: g, share of the way to q₀ that a step makes.
            damping: λ, of metres and radians alike.

        Raises:
            InputError: a shape, sign or range is wrong.
        """
        n = len(arm)
        speed = np.asarray(max_velocity, float)
        if speed.shape not in ((), (n,)) or not (speed > 0.0).all():
            raise InputError("max_velocity", value=speed.tolist(), rule=f"must be positive, one or {n}")
        if posture is not None and (np.shape(posture) != (n,) or not np.isfinite(posture).all()):
            raise InputError("posture", value=np.asarray(posture).tolist(), rule=f"must be {n} finite numbers")
        for name, value in (("posture_gain", posture_gain), ("damping", damping)):
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(name, value=value, rule="must be 0 or more, and finite")
        self.arm, self._speed = arm, np.broadcast_to(speed, (n,)).copy()
        self._posture, self._gain, self._damping = posture, posture_gain, damping

    def targets(
        self, datas: Sequence[mujoco.MjData], world_from_target: np.ndarray, twist: np.ndarray, duration: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and velocities, each (B, n), by which the sites follow targets that move.

        Args:
            datas: states, kinematics up to date (``mj_kinematics`` and ``mj_comPos``, or any step).
            world_from_target: where the targets are now (B, 4, 4).
            twist: how they move, velocity above angular velocity (B, 6) [m/s, rad/s], world axes.
            duration: how long the motion is followed [s]: what is still missing is made up for in that time.

        Positions are those of now, ranges are kept; add velocities times the time since.
        """
        arm = self.arm
        q = np.stack([data.qpos[arm.qpos] for data in datas])
        jacobian = np.stack([arm.jacobian(data) for data in datas])
        error = pose_error(world_from_target, site_poses(datas, arm.site))
        transposed = np.swapaxes(jacobian, -1, -2)
        gram = jacobian @ transposed + self._damping**2 * np.eye(6)
        lean = np.zeros_like(q) if self._posture is None else self._gain * (self._posture - q)
        # Leaning is a step of its own whose motion of the site is taken back.
        error = error - (jacobian @ lean[..., None])[..., 0]
        solved = transposed @ np.linalg.solve(gram, np.stack([error, twist], axis=-1))
        step, velocity = solved[..., 0] + lean, solved[..., 1]
        excess = np.maximum((np.abs(step) / (self._speed * duration)).max(axis=-1, keepdims=True), 1.0)
        faster = np.maximum((np.abs(velocity) / self._speed).max(axis=-1, keepdims=True), 1.0)
        return np.clip(q + step / excess, arm.range[:, 0], arm.range[:, 1]), velocity / faster
