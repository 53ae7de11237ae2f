"""``WarpWorld``: a task scene with rigid pads on MuJoCo Warp, driven by joints or tool.

Thousands of environments run on one GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from raytac.checks import MOST_ENVIRONMENTS, check_number, check_numbers, check_whole
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.arm_kernels import Springs, joint_springs, servo_step
from raytac.robots.ik import PoseServo
from raytac.robots.panda import MAX_VELOCITY
from raytac.robots.states import body_pose, numbers, site_pose
from raytac.se3 import rigid_poses
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.world.compose import compose
from raytac.world.engine.mjwarp import MujocoWarp
from raytac.world.environment_models import EnvironmentModels
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_contact import PadIndices, gel_contact
from raytac.world.start_kernels import aim_at_positions, place_body, set_columns
from raytac.world.world_model import WorldModel

_SPRINGS = ("joints", "speed", "bias", "mass")


class WarpWorld:
    """B environments of a model with rigid pads on MuJoCo Warp.

    Arms with torque motors follow targets by springs, which obey the law of ``JointImpedance``.

    A control step is launched without waiting for the device, on CUDA as one graph. An environment in which physics breaks down, or a
    body goes through a pad, is no longer active until it is reset.

    Attributes:
        composed: names and indices of the scene's parts in the model.
        contact: of the gels; ``contact.wrenches`` (B, pads), pad frame, are those of the last step, and ``contact.motion.pose``
            (B, pads, bodies + pads) are the poses of everything in the pads' frames after it.
        engine: MuJoCo Warp's states; ``engine.active`` (B,) are the environments that have not broken down.
        models: of the environments; ``vary`` gives them others, which ``check`` uploads.
        state: Warp arrays (B, …), float64, after the last step or reset: ``time``, ``joints``, ``speed``, ``tool`` (4, 4), ``fingers``,
            ``pads`` (pads, 4, 4) and ``bodies`` (bodies, 4, 4), in the order of ``composed``.
    """

    def __init__(
        self,
        scene: str | Path | TaskScene | WorldModel,
        *,
        num_envs: int = 1,
        device: str = "auto",
        frequency: float = 30.0,
        launches: int | None = None,
        contacts: int | None = None,
        rows: int | None = None,
    ) -> None:
        """Compose the scene and put all environments to its start.

        Args:
            scene: name of a shipped task scene, path of a scene file, a scene, or a composed model, which may do without an arm: it
                follows no targets then.
            device: "auto", "cpu" or "cuda".
            frequency: of the springs in the joints [rad/s].
            launches: steps of MuJoCo in a control step, as many as the scene's if None. With more, a world divides a step in
                which something moves fast near a pad.
            contacts, rows: memory for contacts and constraint rows, an environment each; None is a guess.

        Raises:
            InputError: a value out of its range, a scene without an arm that has torque motors, or a model that MuJoCo Warp refuses.
            BackendError: MuJoCo Warp is not installed.
        """
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        check_number("frequency", frequency, "[0, inf)", "rad/s")
        if not isinstance(scene, WorldModel):
            given, scene = scene, compose(scene if isinstance(scene, TaskScene) else load_task(scene), "rigid")
            if scene.arm is None or scene.arm.motors is None:
                raise InputError("scene", value=str(given), rule="needs an arm with torque motors")
        self.composed, name = scene, resolve_device(device, ray_tracing=False)
        composed = scene
        self._steps = round(composed.control_timestep / composed.timestep)
        self._launches = self._steps if launches is None else check_whole("launches", launches, self._steps)
        pads, self.models = PadIndices.of(composed), EnvironmentModels(composed, num_envs)
        self.pairs = GelPairs([spec.gelpad for spec in composed.sensor_specs], pads.carriers, num_envs, device=name)
        self.contact = gel_contact(composed, self.models, self.pairs.pairs, num_envs=num_envs, device=name)
        self.engine = MujocoWarp(self.contact, pads, self.models, contacts=contacts, rows=rows)
        arm = composed.arm
        known = {} if arm is None else arm.numbers()
        if arm is not None:
            known["tool"] = known["site"]
        known |= {"time": numbers("time", np.array(0)), "fingers": numbers("qpos", composed.fingers)}
        known |= {"pads": site_pose(pads.sites), "bodies": body_pose(pads.bodies)}
        self._reader = self.engine.reader(known)
        self.state = self._reader.arrays
        with wp.ScopedDevice(self.engine.device):
            self._all = wp.full(num_envs, value=True, dtype=wp.bool)
            self._start = wp.array(np.repeat(composed.start[None], num_envs, axis=0), dtype=wp.float32)
            self._placed = wp.clone(self._start)
            self._ctrl = wp.array(np.repeat(composed.ctrl[None], num_envs, axis=0), dtype=wp.float32)
            self._opening = None
            if composed.opening is not None:
                self._gap = wp.array(composed.ctrl[[composed.opening]], dtype=wp.float64)
                self._gripper = wp.array([composed.opening], dtype=wp.int32)
                self._opening = wp.zeros((num_envs, 1), dtype=wp.float64)
        self._springs: Any = None
        if arm is not None and arm.motors is not None:
            self._make_springs(arm, arm.motors, frequency)
        self._graphs: dict[bool, Callable[[], None]] = {}
        self.reset()

    def _make_springs(self, arm: Arm, motors: np.ndarray, frequency: float) -> None:
        """Springs in an arm's joints, and the inverse kinematics that moves their targets."""
        composed, count = self.composed, self.engine.num_envs
        posture = composed.start[arm.qpos]
        self._servo: Any = PoseServo(arm, max_velocity=np.array(MAX_VELOCITY), posture=posture).struct(self.state)
        self._servo.duration.fill_(composed.control_timestep)
        springs: Any = Springs()
        for key in _SPRINGS:
            setattr(springs, key, self.state[key])
        with wp.ScopedDevice(self.engine.device):
            springs.target, springs.target_speed = self._servo.step, self._servo.velocity
            springs.torque = wp.zeros((count, len(arm)), dtype=wp.float64)
            springs.start = wp.zeros(count, dtype=wp.float64)
            springs.time = self.engine.elapsed
            self._motors, self._joints = (wp.array(index, dtype=wp.int32) for index in (motors, arm.qpos))
        springs.stiffness, springs.damping = frequency**2, 2.0 * frequency
        self._springs = springs

    @property
    def target(self) -> wp.array:
        """Targets of the arm's joints (B, n), float64, to write in place; at the start the joints."""
        return self._springs.target

    @property
    def target_speed(self) -> wp.array:
        """Speeds of the joints' targets in a step (B, n), float64, to write in place; first 0."""
        return self._springs.target_speed

    @property
    def tool_target(self) -> wp.array:
        """Poses (B, 4, 4) of the tools at the start of a step, float64, to write; for ``aim``."""
        return self._servo.target

    @property
    def tool_twist(self) -> wp.array:
        """Their velocities in the step (B, 6) [m/s, rad/s], world axes, to write; for ``aim``."""
        return self._servo.twist

    @property
    def opening(self) -> wp.array | None:
        """Commanded gap between two pads (B, 1) [m], float64, to write; None without a gripper."""
        return self._opening

    def reset(
        self,
        qpos: np.ndarray | wp.array | None = None,
        envs: np.ndarray | wp.array | None = None,
        *,
        bodies: Mapping[str, np.ndarray | wp.array] | None = None,
    ) -> None:
        """Put environments to positions, or to the scene's start, with the arm's targets there.

        With Warp arrays on the device it launches kernels only. Where a body starts beyond a gel's bonded face, the environment is not
        active.

        Args:
            qpos: positions (B, nq); None is the scene's start.
            envs: a mask (B,), bool; None for all.
            bodies: other starts of free bodies: name to ``world_from_body`` (B, 4, 4), float64.

        Raises:
            InputError: arrays of another shape, numbers of the host that are not finite, or a body that is not free.
        """
        composed, count = self.composed, self.engine.num_envs
        shape = count, composed.model.nq
        positions, chosen = self._placed, self._all
        if qpos is not None and not isinstance(qpos, wp.array):
            qpos = self._upload(check_numbers("qpos", qpos, shape, finite=True), wp.float32)
        wp.copy(positions, self._start if qpos is None else qpos)
        if isinstance(envs, wp.array):
            chosen = envs
        elif envs is not None:
            mask = np.asarray(envs)
            if mask.shape != (count,) or mask.dtype != bool:
                raise InputError("envs", value=mask.shape, rule=f"must be a mask of {count} environments")
            chosen = self._upload(mask, wp.bool)
        for name, poses in (bodies or {}).items():
            free = [key for key, body in composed.bodies.items() if body.qpos >= 0]
            if name not in free:
                raise InputError("bodies", value=name, rule="must be the name of a free body", choices=free)
            if not isinstance(poses, wp.array):
                poses = self._upload(rigid_poses(f"bodies[{name!r}]", poses, count), wp.float64)
            self._launch(place_body, count, [poses, composed.bodies[name].qpos, positions])
        self.engine.reset(chosen, positions, self._ctrl)
        self.contact.clear_active(chosen)
        if self._springs is not None:
            self._launch(aim_at_positions, self.target.shape, [chosen, self._joints, positions, self.target, self.target_speed])
        if self.opening is not None:
            self._launch(set_columns, self.opening.shape, [chosen, self._gap, self.opening])
        self.engine.finish()
        self._reader.read()

    def step(self, controls: wp.array | None = None) -> None:
        """One control step of active environments towards ``target``, at ``target_speed``.

        With ``controls`` (B, nu), float32, on the device the actuators have these instead.
        """
        holding = controls is None
        if controls is not None:
            wp.copy(self.engine.data.ctrl, controls)
        if holding in self._graphs:
            self._graphs[holding]()
        else:
            self._graphs[holding] = self.engine.capture(partial(self.launch, holding=holding))  # which runs once

    def hold(self) -> None:
        """One control step in which everything is held at the start, as ``TactileWorld.hold`` does."""
        if self.aim_home() == self.drive:
            self.step()
        else:
            self.step(self.engine.data.ctrl)

    def aim_home(self) -> Callable[[], None]:
        """Set targets and controls to the start; returns what drives the robot there in a step."""
        if self._springs is None:
            if self.composed.scene is not None:
                wp.copy(self.engine.data.ctrl, self._ctrl)
            return _leave
        wp.copy(self.engine.data.ctrl, self._ctrl)
        everywhere = [self._all, self._joints, self._start, self.target, self.target_speed]
        self._launch(aim_at_positions, self.target.shape, everywhere)
        if self.opening is not None:
            self._launch(set_columns, self.opening.shape, [self._all, self._gap, self.opening])
        return self.drive

    def take(self, controls: wp.array) -> Callable[[], None]:
        """Set the actuators' controls (B, nu), float32; returns what drives the robot in a step."""
        wp.copy(self.engine.data.ctrl, controls)
        return _leave

    def begin_part(self, elapsed: float) -> None:
        """Say that ``elapsed`` [s] of the control step have passed, where it is launched in parts."""
        if self._springs is not None:
            self._springs.start.fill_(-elapsed)

    def aim(self) -> None:
        """Launch the inverse kinematics (``PoseServo``): from the tool's targets to the joints'."""
        self._launch(servo_step, self.engine.num_envs, [self._servo])

    def launch(self, *, holding: bool = True) -> None:
        """Launch a control step, as ``step`` records it: for a graph that does more.

        ``holding``: by springs, not by constant controls.
        """
        drive = self.drive if holding else _leave
        self.engine.advance(drive, scene_steps=self._steps, launches=self._launches)
        self.engine.finish()
        self._reader.read()

    def drive(self) -> None:
        """Torques of the springs in the joints, and the gripper's command."""
        if self._springs is not None:
            self._reader.read()
            self._launch(joint_springs, self.target.shape, [self._springs])
            self.engine.write_controls(self._motors, self._springs.torque)
        if self.opening is not None:
            self.engine.write_controls(self._gripper, self.opening)

    def check(self) -> None:
        """Upload what ``models.vary`` changed; it waits for the device.

        Raises ``InputError`` if contacts were lost for want of memory.
        """
        self.contact.vary()
        self.engine.prepare()

    def _upload(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.engine.device)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.engine.device)


def _leave() -> None:
    """Drive nothing: controls stay as they are."""
