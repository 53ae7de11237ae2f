"""Inverse kinematics: a quadratic program that keeps limits; damped least squares.

``DifferentialIk`` is for one arm that must not break a limit: a viewer, a demonstration, a search for joint positions. Each call solves a
quadratic program in about a millisecond with mink (K. Zakka, Apache-2.0) on DAQP:

    min over Δq of  ‖J Δq − e‖² + w² ‖q₀ − q − Δq‖² + μ ‖e‖² ‖Δq‖²
    subject to      q_min ≤ q + Δq ≤ q_max,  |Δq| ≤ q̇_max Δt,

with e the twist from the site to its target, J the site's Jacobian, and q₀ the posture that a redundant arm tends to. The term in μ is the
damping of Levenberg and Marquardt, which keeps Δq bounded where J loses rank: S. R. Buss, "Introduction to inverse kinematics with
Jacobian transpose, pseudoinverse and damped least squares methods", 2004, section 5 and 7; proportional to ‖e‖² after T. Sugihara,
"Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", IEEE T-RO 27(5), 2011.

``PoseServo`` is for a learner that steps dozens of environments: one small solve for all of them, without mink. A step that is too fast is
shortened as a whole, and each joint stops at its limit on its own:

    Δq = Jᵀ (J Jᵀ + λ² 1)⁻¹ e + g (1 − J⁺ J) (q₀ − q)

C. W. Wampler, "Manipulator inverse kinematic solutions based on vector formulations and damped least-squares methods", IEEE Trans. Syst.
Man Cybern. 16(1), 1986; the second term moves a redundant arm towards q₀ without moving the site (A. Liégeois, IEEE Trans. SMC 7(12),
1977).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import BackendError, InputError
from raytac.robots.arm import Arm
from raytac.robots.arm_kernels import Servo, servo_step
from raytac.robots.states import StateReader
from raytac.se3 import check_pose, pose_error
from raytac.warp_runtime import Recorded

_STRIDE = 0.1
"""Duration [s] of each step of ``reach``: at 2 rad/s, a fifth of a radian."""

_PROGRESS, _PATIENCE = 0.99, 15
"""A search has stalled when its error falls by less than 1 % in each of 15 steps in a row."""
_FLOOR = 1e-9
"""Least damping, by which the program has a unique solution at the target too."""


@dataclass(frozen=True)
class IkResult:
    """Result of a search for joint positions."""

    joints: np.ndarray
    """Joint positions (n,) [rad or m], within the limits."""
    position_error: float
    """Distance of the site from its target [m]."""
    rotation_error: float
    """Angle of the site from its target [rad]."""
    steps: int
    """Quadratic programs solved."""
    reached: bool
    """True if both errors are within the tolerances of the search."""


class DifferentialIk:
    """Differential inverse kinematics of one arm; work arrays, but no state between calls."""

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
            max_velocity: greatest |q̇| (n,) or one for all [rad/s or m/s].
            posture: q₀ (n,), joint positions that a redundant arm tends to; None: the middle of the limits, 0 without limits.
            posture_weight: w above, against 1 per metre and 1 per radian of the pose. It moves the site off its target by about
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
        cost = np.zeros(arm.model.nv)
        cost[arm.dof] = posture_weight
        self._posture_task = mink.PostureTask(arm.model, cost=cost)
        others = np.setdiff1d(np.arange(arm.model.nv), arm.dof)
        self._still = [mink.DofFreezingTask(arm.model, dof_indices=others.tolist())] if others.size else None
        self._box = _box_limit(arm, self.max_velocity)

    def velocity(self, qpos: np.ndarray, world_from_target: np.ndarray, duration: float) -> np.ndarray:
        """Joint velocities (n,) to ``world_from_target`` (4, 4) in ``duration`` [s], within limits.

        ``qpos`` (nq,) is the whole model's; joints of other parts stay. A joint beyond its range (MuJoCo's limits are soft)
        moves back at its greatest speed.

        Raises:
            InputError: a shape, a pose or the duration is wrong, or a position is not finite.
            BackendError: the quadratic program has no solution.
        """
        if not (math.isfinite(duration) and duration > 0.0):
            raise InputError("duration", value=duration, rule="must be positive and finite [s]")
        self._aim(qpos, world_from_target)
        return self._step([self._frame, self._posture_task], duration) / duration

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
    ) -> IkResult:
        """Search joint positions with the site at ``world_from_target`` (4, 4) from ``qpos`` (nq,).

        A search that does not arrive within ``steps``, or stalls, is started again from random positions within the limits, up to
        ``restarts`` times, since a descent within joint limits can end in a corner. The posture is not used. Returns the first result
        within the tolerances, else the best one with ``reached`` false. Collisions are ignored.

        Raises as ``velocity``.
        """
        rng = np.random.default_rng(seed)
        start = np.array(qpos, float)
        best, steps_taken = None, 0
        low, high = np.where(np.isfinite(self.arm.range), self.arm.range, (-math.pi, math.pi)).T
        for attempt in range(restarts + 1):
            if attempt:
                start = start.copy()
                start[self.arm.qpos] = rng.uniform(low, high)
            self._aim(start, world_from_target)
            previous, stalled = math.inf, 0
            for _ in range(steps + 1):
                error = pose_error(world_from_target, self.arm.world_from_site(self._configuration.data))
                distance, angle = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
                joints = self._configuration.data.qpos[self.arm.qpos].copy()
                inside = bool(((joints >= self.arm.range[:, 0]) & (joints <= self.arm.range[:, 1])).all())
                arrived = inside and distance <= position_tolerance and angle <= rotation_tolerance
                if inside and (best is None or arrived or distance + angle < best.position_error + best.rotation_error):
                    best = IkResult(joints, distance, angle, steps_taken, arrived)
                stalled = stalled + 1 if distance + angle > _PROGRESS * previous else 0
                previous = distance + angle
                if arrived or stalled > _PATIENCE:
                    break
                self._configuration.data.qpos[self.arm.qpos] += self._step([self._frame], _STRIDE)
                self._configuration.update()
                steps_taken += 1
            if best is not None and best.reached:
                break
        assert best is not None  # random starts are within the limits, and every step stays there
        return IkResult(best.joints, best.position_error, best.rotation_error, steps_taken, best.reached)

    def _aim(self, qpos: np.ndarray, world_from_target: np.ndarray) -> None:
        mink, model = _mink(), self.arm.model
        if np.shape(qpos) != (model.nq,) or not np.isfinite(qpos).all():
            raise InputError("qpos", value=np.asarray(qpos).tolist(), rule=f"must be {model.nq} finite numbers, the model's qpos")
        target = check_pose("world_from_target", world_from_target)
        self._configuration.update(np.array(qpos, float))
        aim = np.empty(7)
        mujoco.mju_mat2Quat(aim[:4], target[:3, :3].ravel())
        aim[4:] = target[:3, 3]
        self._frame.set_target(mink.SE3(aim))
        posture = np.array(qpos, float)
        posture[self.arm.qpos] = self.posture
        self._posture_task.set_target(posture)

    def _step(self, tasks: list[Any], duration: float) -> np.ndarray:
        """Solve for Δq (n,) from the configuration's present positions."""
        import qpsolvers

        mink = _mink()
        problem = mink.build_ik(self._configuration, tasks, duration, damping=_FLOOR, limits=[self._box], constraints=self._still)
        solution = qpsolvers.solve_problem(problem, solver="daqp")
        if not solution.found or solution.x is None:
            raise BackendError("the quadratic program of the inverse kinematics has no solution here")
        return solution.x[self.arm.dof]


SERVO_READS = ("joints", "anchor", "axis", "site")
"""Numbers of an arm (``Arm.numbers``) that ``PoseServo`` reads."""


class PoseServo:
    """Steps of one arm in any number of environments. It has no state."""

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
            max_velocity: greatest |q̇| (n,) or one for all [rad/s or m/s].
            posture: q₀ (n,); None: no second term.
            posture_gain: g, share of q₀ − q that a step covers.
            damping: λ, for metres and radians alike.

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
        self.arm = arm
        self._speed = np.broadcast_to(speed, (n,)).copy()
        self._posture, self._gain, self._damping = posture, posture_gain, damping
        self._latest: _ServoBatch | None = None

    def targets(
        self, datas: Sequence[mujoco.MjData], world_from_target: np.ndarray, twist: np.ndarray, duration: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and velocities, each (B, n), with which the sites follow moving targets.

        Args:
            datas: states, kinematics up to date (``mj_kinematics``, or any step).
            world_from_target: present targets (B, 4, 4).
            twist: their velocity and angular velocity (B, 6) [m/s, rad/s], world axes.
            duration: time [s] in which the present error is removed.

        Positions are targets at the present time, within the joints' ranges; add velocities times the time since.
        """
        # Where their numbers lie is looked up once for states that are asked about again and again.
        if self._latest is None or not self._latest.reader.reads(datas):
            self._latest = _ServoBatch(self, datas)
        return self._latest.targets(world_from_target, twist, duration)

    def struct(self, arrays: Mapping[str, wp.array]) -> Any:
        """Arguments of ``servo_step`` from ``arrays``, ``SERVO_READS`` of B states on a device."""
        joints, n = arrays["joints"], len(self.arm)
        servo: Any = Servo()
        servo.joints, servo.anchor, servo.axis, servo.site = (arrays[name] for name in SERVO_READS)

        def numbers(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.float64, device=joints.device)

        servo.slides = wp.array(self.arm.slides, dtype=wp.int32, device=joints.device)
        servo.range, servo.fastest = numbers(self.arm.range), numbers(self._speed)
        servo.posture = numbers(np.zeros(n) if self._posture is None else self._posture)
        servo.gain, servo.damping = 0.0 if self._posture is None else self._gain, self._damping
        work = {
            "target": (4, 4),
            "twist": (6,),
            "jacobian": (n, 6),
            "gram": (6, 6),
            "side": (2, 6),
            "step": (n,),
            "velocity": (n,),
        }
        for name, size in work.items():
            setattr(servo, name, wp.zeros((len(joints), *size), dtype=wp.float64, device=joints.device))
        servo.duration = wp.zeros(1, dtype=wp.float64, device=joints.device)
        return servo


class _ServoBatch:
    """Arrays of ``PoseServo`` for B states of C MuJoCo, and its kernel."""

    def __init__(self, servo: PoseServo, datas: Sequence[mujoco.MjData]) -> None:
        members = {name: one for name, one in servo.arm.numbers().items() if name in SERVO_READS}
        self.reader = StateReader(datas, members)
        struct = servo.struct(self.reader.arrays)
        self._target, self._twist, self._duration = struct.target.numpy(), struct.twist.numpy(), struct.duration.numpy()
        self._results = struct.step.numpy(), struct.velocity.numpy()
        self._step = Recorded(self.reader.launch, partial(wp.launch, servo_step, dim=len(datas), inputs=[struct], device="cpu"))

    def targets(self, world_from_target: np.ndarray, twist: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
        self._target[:], self._twist[:], self._duration[:] = world_from_target, twist, duration
        self._step()
        step, velocity = self._results
        return step.copy(), velocity.copy()


def _mink() -> Any:
    try:
        import mink
    except ImportError as error:
        raise BackendError(f"inverse kinematics needs mink ({error}): `pip install 'raytac[robots]'`") from error
    return mink


def _box_limit(arm: Arm, max_velocity: np.ndarray) -> Any:
    """Bounds on Δq of the arm's joints, never contradictory; mink's own limit other bodies too."""
    mink = _mink()
    rows = np.eye(arm.model.nv)[arm.dof]
    bounded = np.concatenate([rows, -rows])

    class Box(mink.Limit):
        def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
            limit = max_velocity * dt
            q = configuration.data.qpos[arm.qpos]
            up, down = (np.clip(room, -limit, limit) for room in (arm.range[:, 1] - q, q - arm.range[:, 0]))
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
