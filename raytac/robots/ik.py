"""Cartesian control by differential inverse kinematics: joint velocities that move a site towards a pose, within all limits.

Each call solves one quadratic program with mink (K. Zakka, Apache-2.0) on DAQP:

    min over Δq of  ‖J Δq − e‖² + w² ‖q₀ − q − Δq‖² + μ ‖e‖² ‖Δq‖²
    subject to      q_min ≤ q + Δq ≤ q_max,  |Δq| ≤ q̇_max Δt,

e the twist from the site to its target, J the site's Jacobian, q₀ the posture that a redundant arm leans to. The term in μ is
Levenberg and Marquardt's damping, which keeps Δq bounded where J loses rank: S. R. Buss, "Introduction to inverse kinematics with
Jacobian transpose, pseudoinverse and damped least squares methods", 2004, section 5 and 7; proportional to ‖e‖² after T. Sugihara,
"Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", IEEE T-RO 27(5), 2011.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from raytac.errors import BackendError, InputError
from raytac.robots.arm import Arm
from raytac.robots.pose import check_pose, pose_error
from raytac.se3 import quaternion

__all__ = ["DifferentialIk", "Reached"]

_STRIDE = 0.1
"""Duration [s] that ``reach`` gives each of its steps: at 2 rad/s, a fifth of a radian."""

_PROGRESS, _PATIENCE = 0.99, 15
"""A search that keeps more than this share of its error in each of so many steps has stalled."""
_FLOOR = 1e-9
"""Least damping, so that the program has one solution on the target too."""


@dataclass(frozen=True)
class Reached:
    """What a search for joint positions came to."""

    joints: np.ndarray
    """Joint positions (n,) [rad or m], within the limits."""
    position_error: float
    """Distance of the site from its target [m]."""
    rotation_error: float
    """Angle of the site from its target [rad]."""
    steps: int
    """Quadratic programs solved."""
    reached: bool
    """Whether both errors are within the tolerances that were asked for."""


class DifferentialIk:
    """Differential inverse kinematics of one arm. Keeps no state between calls but work arrays."""

    def __init__(
        self,
        arm: Arm,
        *,
        max_velocity: np.ndarray | float = math.inf,
        posture: np.ndarray | None = None,
        posture_weight: float = 1e-3,
        damping: float = 1e-3,
    ) -> None:
        """Set the program up.

        Args:
            arm: joints and site.
            max_velocity: greatest |q̇| (n,) or one for all [rad/s or m/s].
            posture: joint positions (n,) that a redundant arm leans to; left out: the middle of the limits, 0 where there are none.
            posture_weight: w above, against 1 per metre and 1 per radian of the pose. It pulls the site off its target by about
                w² |q₀ − q|, 1e-6 m at the default.
            damping: μ above.

        Raises:
            BackendError: mink is not installed.
            InputError: a shape, sign or range is wrong.
        """
        mink = _mink()
        n = len(arm)
        self.arm = arm
        self.max_velocity = np.broadcast_to(np.asarray(max_velocity, float), (n,)).copy() if np.ndim(max_velocity) < 2 else None
        if self.max_velocity is None or not (self.max_velocity > 0.0).all():
            raise InputError("max_velocity", value=np.asarray(max_velocity).tolist(), rule="must be positive, one or one a joint")
        for name, value in (("posture_weight", posture_weight), ("damping", damping)):
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(name, value=value, rule="must be 0 or more, and finite")
        middle = np.where(np.isfinite(arm.range).all(axis=1), arm.range.mean(axis=1), 0.0)
        self.posture = _joints("posture", middle if posture is None else posture, arm)
        self._configuration = mink.Configuration(arm.model)
        site = mujoco.mj_id2name(arm.model, mujoco.mjtObj.mjOBJ_SITE, arm.site)
        self._frame = mink.FrameTask(site, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=damping)
        lean = np.zeros(arm.model.nv)
        lean[arm.dof] = posture_weight
        self._lean = mink.PostureTask(arm.model, cost=lean)
        others = np.setdiff1d(np.arange(arm.model.nv), arm.dof)
        self._still = [mink.DofFreezingTask(arm.model, dof_indices=others.tolist())] if others.size else None
        self._box = _box_limit(arm, self.max_velocity)

    def velocity(self, qpos: np.ndarray, world_from_target: np.ndarray, duration: float) -> np.ndarray:
        """Joint velocities (n,) that take the site towards ``world_from_target`` (4, 4) within ``duration`` [s], as far as limits allow.

        ``qpos`` (nq,) is the whole model's; joints that are not the arm's stay. A joint beyond its range (MuJoCo's limits are soft)
        is brought back as fast as it may move.

        Raises:
            InputError: a shape, a pose or the duration is wrong, or a position is not finite.
            BackendError: the quadratic program has no solution.
        """
        if not (math.isfinite(duration) and duration > 0.0):
            raise InputError("duration", value=duration, rule="must be positive and finite [s]")
        self._aim(qpos, world_from_target)
        return self._step([self._frame, self._lean], duration) / duration

    def reach(
        self,
        qpos: np.ndarray,
        world_from_target: np.ndarray,
        *,
        position_tolerance: float = 1e-4,
        rotation_tolerance: float = 1e-3,
        steps: int = 100,
        restarts: int = 10,
        seed: int = 0,
    ) -> Reached:
        """Search joint positions that put the site at ``world_from_target`` (4, 4): such steps over and over, from ``qpos`` (nq,).

        A search that does not arrive within ``steps``, or stalls, is started again from random positions within the limits, up to
        ``restarts`` times, since a descent within joint limits can end in a corner. The posture plays no part. Returns the first that
        arrives, else the best, with ``reached`` false: ask for it. Collisions are not looked at.

        Raises as ``velocity``.
        """
        rng = np.random.default_rng(seed)
        start = np.array(qpos, float)
        best, spent = None, 0
        low, high = np.where(np.isfinite(self.arm.range), self.arm.range, (-math.pi, math.pi)).T
        for attempt in range(restarts + 1):
            if attempt:
                start = start.copy()
                start[self.arm.qpos] = rng.uniform(low, high)
            self._aim(start, world_from_target)
            last, stalled = math.inf, 0
            for _ in range(steps + 1):
                error = pose_error(world_from_target, self.arm.world_from_site(self._configuration.data))
                distance, angle = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
                joints = self._configuration.data.qpos[self.arm.qpos].copy()
                inside = bool(((joints >= self.arm.range[:, 0]) & (joints <= self.arm.range[:, 1])).all())
                arrived = inside and distance <= position_tolerance and angle <= rotation_tolerance
                if inside and (best is None or arrived or distance + angle < best.position_error + best.rotation_error):
                    best = Reached(joints, distance, angle, spent, arrived)
                stalled = stalled + 1 if distance + angle > _PROGRESS * last else 0
                last = distance + angle
                if arrived or stalled > _PATIENCE:
                    break
                self._configuration.data.qpos[self.arm.qpos] += self._step([self._frame], _STRIDE)
                self._configuration.update()
                spent += 1
            if best is not None and best.reached:
                break
        assert best is not None  # the random starts are inside, and every step keeps them there
        return Reached(best.joints, best.position_error, best.rotation_error, spent, best.reached)

    def _aim(self, qpos: np.ndarray, world_from_target: np.ndarray) -> None:
        mink, model = _mink(), self.arm.model
        if np.shape(qpos) != (model.nq,) or not np.isfinite(qpos).all():
            raise InputError("qpos", value=np.asarray(qpos).tolist(), rule=f"must be {model.nq} finite numbers, the model's qpos")
        target = check_pose("world_from_target", world_from_target)
        self._configuration.update(np.array(qpos, float))
        self._frame.set_target(mink.SE3(np.concatenate([quaternion(target[:3, :3]), target[:3, 3]])))
        leaning = np.array(qpos, float)
        leaning[self.arm.qpos] = self.posture
        self._lean.set_target(leaning)

    def _step(self, tasks: list[Any], duration: float) -> np.ndarray:
        """Δq (n,) from the configuration's present positions."""
        import qpsolvers

        mink = _mink()
        problem = mink.build_ik(self._configuration, tasks, duration, damping=_FLOOR, limits=[self._box], constraints=self._still)
        solution = qpsolvers.solve_problem(problem, solver="daqp")
        if not solution.found or solution.x is None:
            raise BackendError("the quadratic program of the inverse kinematics has no solution here")
        return solution.x[self.arm.dof]


def _mink() -> Any:
    try:
        import mink
    except ImportError as error:
        raise BackendError(f"inverse kinematics needs mink ({error}): `pip install 'raytac[robots]'`") from error
    return mink


def _box_limit(arm: Arm, max_velocity: np.ndarray) -> Any:
    """Bounds on Δq of the arm's joints only, never contradictory: mink's own would also bind joints that only lie in the scene."""
    mink = _mink()
    rows = np.eye(arm.model.nv)[arm.dof]
    bounded = np.concatenate([rows, -rows])

    class Box(mink.Limit):
        def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
            most = max_velocity * dt
            q = configuration.data.qpos[arm.qpos]
            up, down = (np.clip(room, -most, most) for room in (arm.range[:, 1] - q, q - arm.range[:, 0]))
            bounds = np.concatenate([up, down])
            finite = np.isfinite(bounds)
            return mink.Constraint(G=bounded[finite], h=bounds[finite]) if finite.any() else mink.Constraint()

    return Box()


def _joints(name: str, value: np.ndarray, arm: Arm) -> np.ndarray:
    joints = np.asarray(value, float)
    if joints.shape != (len(arm),) or not np.isfinite(joints).all():
        raise InputError(name, value=joints.tolist(), rule=f"must be {len(arm)} finite numbers, one a joint")
    outside = (joints < arm.range[:, 0]) | (joints > arm.range[:, 1])
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        low, high = arm.range[i]
        raise InputError(f"{name}[{i}]", value=float(joints[i]), rule=f"must be within {arm.joints[i]}'s [{low:g}, {high:g}]")
    return joints
