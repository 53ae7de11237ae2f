"""``WarpWorld``: a task scene with rigid pads on MuJoCo Warp, thousands of environments on one GPU, driven by joint targets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from raytac.checks import MOST_ENVIRONMENTS, check_number, check_numbers, check_whole
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.robots.arm_kernels import Springs, joint_springs
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.world.compose import compose
from raytac.world.engine.mjwarp import MujocoWarp
from raytac.world.environment_models import EnvironmentModels
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_contact import PadIndices, gel_contact

_READ = ("time", "joints", "speed", "bias", "mass")


class WarpWorld:
    """B environments of a task scene, whose arms follow joint targets by springs of the law of ``JointImpedance``.

    A control step is launched without waiting for the device, on CUDA as one graph. Sensors, and controllers of another kind, need
    ``TactileWorld``. An environment in which a body goes through a pad is no longer active.

    Attributes:
        composed: names and indices of the scene's parts in the model.
        contact: of the gels; ``contact.wrenches`` (B, pads), pad frame, are those of the last step.
        engine: MuJoCo Warp's states; ``engine.active`` (B,) are the environments that have not broken down.
        models: of the environments; ``vary`` gives them others, which ``check`` uploads.
        target, target_speed: of the arm's joints (B, n), float64, on the device; at the start where the joints are, at rest.
    """

    def __init__(
        self,
        scene: str | Path | TaskScene,
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
            scene: name of a shipped task scene, path of a scene file, or a scene.
            num_envs: number of environments B.
            device: "auto", "cpu" or "cuda".
            frequency: of the springs in the joints [rad/s].
            launches: steps of MuJoCo in a control step, as many as the scene's if None. Of more a world divides one in which something
                moves fast near a pad.
            contacts, rows: memory for contacts and constraint rows, an environment each; None is a guess.

        Raises:
            InputError: a value out of its range, a scene without an arm that has torque motors, or one that MuJoCo Warp refuses.
            BackendError: MuJoCo Warp is not installed.
        """
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        check_number("frequency", frequency, "[0, inf)", "rad/s")
        self.composed = composed = compose(scene if isinstance(scene, TaskScene) else load_task(scene), "rigid")
        arm, name = composed.arm, resolve_device(device, ray_tracing=False)
        if arm is None or arm.motors is None:
            raise InputError("scene", value=str(scene), rule="needs an arm with torque motors")
        self._steps = round(composed.control_timestep / composed.timestep)
        self._launches = self._steps if launches is None else check_whole("launches", launches, self._steps)
        pads, self.models = PadIndices.of(composed), EnvironmentModels(composed, num_envs)
        pairs = GelPairs([spec.gelpad for spec in composed.sensor_specs], pads.carriers, num_envs, device=name).pairs
        self.contact = gel_contact(composed, self.models, pairs, num_envs=num_envs, device=name)
        self.engine = MujocoWarp(self.contact, pads, self.models, contacts=contacts, rows=rows)
        self._reader = self.engine.reader({key: one for key, one in arm.numbers().items() if key in _READ})
        springs: Any = Springs()
        for key in _READ:
            setattr(springs, key, self._reader.arrays[key])
        with wp.ScopedDevice(self.engine.device):
            shape = num_envs, len(arm)
            springs.target, springs.target_speed, springs.torque = (wp.zeros(shape, dtype=wp.float64) for _ in range(3))
            springs.start = wp.zeros(num_envs, dtype=wp.float64)
            self._motors = wp.array(arm.motors, dtype=wp.int32)
        springs.stiffness, springs.damping = frequency**2, 2.0 * frequency
        self._springs, self.target, self.target_speed = springs, springs.target, springs.target_speed
        self._graph: Callable[[], None] | None = None
        self.reset()

    def reset(self, qpos: np.ndarray | None = None, envs: np.ndarray | None = None) -> None:
        """Put environments (a mask (B,), or None for all) to positions ``qpos`` (B, nq), or to the scene's start, with targets there.

        Raises ``InputError`` for arrays of another shape.
        """
        composed, arm, count = self.composed, self.composed.arm, self.engine.num_envs
        assert arm is not None
        if qpos is None:
            qpos = np.repeat(composed.start[None], count, axis=0)
        qpos = check_numbers("qpos", qpos, (count, composed.model.nq))
        chosen = np.ones(count, bool) if envs is None else np.asarray(envs)
        if chosen.shape != (count,) or chosen.dtype != bool:
            raise InputError("envs", value=chosen.shape, rule=f"must be a mask of {count} environments")
        with wp.ScopedDevice(self.engine.device):
            mask, ctrl = wp.array(chosen, dtype=wp.bool), np.repeat(composed.ctrl[None], count, axis=0)
            self.engine.reset(mask, wp.array(qpos, dtype=wp.float32), wp.array(ctrl, dtype=wp.float32))
        self.contact.clear_active(mask)
        rows = np.where(chosen[:, None], qpos[:, arm.qpos], self.target.numpy())
        self.target.assign(rows)
        self.target_speed.assign(np.where(chosen[:, None], 0.0, self.target_speed.numpy()))

    def step(self) -> None:
        """One control step of all environments that are active, towards ``target``, which moves with ``target_speed`` in it."""
        if self._graph is None:
            self._graph = self.engine.capture(self.launch)  # which runs once
        else:
            self._graph()

    def launch(self) -> None:
        """Launch a control step, as ``step`` records it: for a graph that does more."""
        self._reader.read()
        wp.copy(self._springs.start, self._reader.arrays["time"])
        self.engine.advance(self.drive, scene_steps=self._steps, launches=self._launches)

    def drive(self) -> None:
        """Torques of the springs in the joints."""
        self._reader.read()
        wp.launch(joint_springs, dim=self.target.shape, inputs=[self._springs], device=self.engine.device)
        self.engine.write_controls(self._motors, self._springs.torque)

    def check(self) -> None:
        """Upload what ``models.vary`` changed; it waits for the device.

        Raises ``InputError`` if contacts were lost for want of memory.
        """
        self.engine.prepare()
        self.contact.vary()
