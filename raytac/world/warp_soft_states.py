"""Environments of a ``TactileWorld`` with soft pads on MuJoCo Warp.

Robot and gels on one device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError, OverlapError
from raytac.physics.configs import Ipc
from raytac.robots.frames import site_poses
from raytac.world.c_states import put_to_start, state_numbers
from raytac.world.engine.choice import WarpEngine
from raytac.world.environment_models import Variation
from raytac.world.warp_frame import WarpFrame
from raytac.world.warp_soft_pads import WarpSoftPads
from raytac.world.warp_states import warp_controls
from raytac.world.warp_world import WarpWorld
from raytac.world.world_model import WorldModel


class WarpSoftStates:
    """B environments on MuJoCo Warp with soft pads, with the members of ``CStates``.

    ``world`` is the robot's part on the device: no rigid pad touches anything in it.
    """

    def __init__(
        self, composed: WorldModel, num_envs: int, engine: WarpEngine, device: str, *, physics: Ipc, coupling: str
    ) -> None:
        """Build the environments at their start.

        Raises:
            InputError: as ``WarpWorld``; ``launches``, since soft pads divide steps by themselves.
            SpecError, OverlapError, BackendError: as ``SoftPads`` and ``WarpWorld``.
        """
        if engine.launches is not None:
            raise InputError("launches", value=engine.launches, rule="must be None with soft pads, which divide steps themselves")
        self.composed, self._scratch = composed, mujoco.MjData(composed.model)
        robot = replace(composed, touched=())
        self.world = WarpWorld(robot, num_envs=num_envs, device=device, contacts=engine.contacts, rows=engine.rows)
        self.models = self.world.models
        self._sites = np.array([composed.model.site(m.site).id for m in composed.sensors], int)
        cases = np.repeat(site_poses([self.first()], self._sites), num_envs, axis=0)
        self.pads = WarpSoftPads(
            composed,
            self.world,
            cases,
            physics=physics,
            coupling=coupling,
            device="cuda" if self.world.engine.device.is_cuda else "cpu",
        )
        self._reader = self.world.engine.reader(state_numbers(composed))
        self.failed = np.zeros(num_envs, bool)
        self.pads.show(range(num_envs))

    @property
    def data(self) -> Any:
        """Raise ``InputError``: there is no state of MuJoCo."""
        raise InputError("data", value="mujoco_warp", rule="is of engine='mujoco': read world.state()", choices=("mujoco",))

    def hold(self, data: mujoco.MjData) -> None:
        """Raise ``InputError``, as ``data``."""
        _ = self.data

    def first(self) -> mujoco.MjData:
        """State of MuJoCo at the scene's start."""
        self.composed.reset(self.composed.model, self._scratch)
        mujoco.mj_forward(self.composed.model, self._scratch)
        return self._scratch

    def values(self) -> dict[str, np.ndarray]:
        """Present ``state_numbers``, (B, …) each; it waits for the device."""
        self.world.engine.update_poses()
        self._reader.read()
        return self._reader.host()

    def fail(self, failed: np.ndarray) -> None:
        """Mark environments (B,) as failed."""
        self.failed |= failed

    def read(self, name: str) -> WarpFrame:
        """Raise ``InputError``: soft pads are read by ``SoftPads.arrays``."""
        raise InputError("sensor", value=name, rule="is read by SoftPads.arrays")

    def step(self, control: Any) -> None:
        """One control step by constant controls, or None, which holds.

        Raises:
            InputError: other controls, contacts that were lost for want of memory, or as ``CSoftPads.advance``.
        """
        controls = warp_controls(control, self.world)
        drive = self.world.aim_home() if controls is None else self.world.take(controls)
        engine = self.world.engine
        try:
            self.pads.advance(drive, self.failed)
        finally:
            self.failed |= ~engine.active.numpy()
            engine.active.assign(~self.failed)
        self.world.check()

    def reset(
        self, envs: Sequence[int], joints: np.ndarray | None, bodies: Mapping[str, np.ndarray], variation: Variation | None
    ) -> None:
        """Put environments to a checked start; see ``TactileWorld.reset``."""
        elsewhere = joints is not None or bool(bodies) or variation is not None or self.models.differ(envs)
        models, count = self.models.snapshot(), self.world.engine.num_envs
        if variation is not None:
            self.models.vary(envs, variation)
        qpos, cases = np.repeat(self.composed.start[None], count, axis=0), np.zeros((count, len(self._sites), 4, 4))
        cases[:] = np.eye(4)
        for row, b in enumerate(envs):
            put_to_start(self.composed, self.models[b], self._scratch, row, joints, bodies)
            mujoco.mj_kinematics(self.models[b], self._scratch)
            qpos[b], cases[b] = self._scratch.qpos, site_poses([self._scratch], self._sites)[0]
        try:
            self.pads.reset(envs, cases, bodies, elsewhere=elsewhere)
        except OverlapError:
            self.models.restore(models)
            raise
        mask = np.isin(np.arange(count), envs)
        self.world.check()
        self.world.reset(qpos, mask)
        self.failed[mask] = False
        self.world.engine.data.xfrc_applied.assign(
            np.where(mask[:, None, None], np.float32(0.0), self.world.engine.data.xfrc_applied.numpy())
        )
        self.pads.show(envs)
        wp.synchronize_device(self.world.engine.device)
