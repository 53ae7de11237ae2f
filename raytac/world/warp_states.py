"""Environments of a ``TactileWorld`` on MuJoCo Warp: one device holds them and their gels.

Results are copied when they are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError, OverlapError
from raytac.gel.surface import PadGrid
from raytac.markers.base import MarkersConfig
from raytac.se3 import inverse, pose_of
from raytac.world.c_states import put_to_start, state_numbers
from raytac.world.engine.choice import WarpEngine
from raytac.world.environment_models import Variation
from raytac.world.pad_contact import PadIndices
from raytac.world.pad_touch import PadTouch
from raytac.world.rigid_readings import RigidReadings
from raytac.world.warp_frame import WarpFrame
from raytac.world.warp_world import WarpWorld
from raytac.world.world_model import WorldModel
from raytac.world.world_state import constant_controls


class WarpStates:
    """B environments on MuJoCo Warp, with the members of ``CStates``.

    ``world`` is the part on the device.
    """

    def __init__(
        self,
        composed: WorldModel,
        num_envs: int,
        engine: WarpEngine,
        device: str,
        *,
        grids: Mapping[str, PadGrid],
        markers: MarkersConfig | None,
    ) -> None:
        """Build the environments at their start.

        ``grids``: of the sensors whose heights, and ``markers``, ``read`` gives.

        Raises:
            InputError: a keyframe with speeds, activations or mocap bodies; as ``WarpWorld`` and ``PadTouch``.
            BackendError: MuJoCo Warp is not installed, or ``device`` does not work.
        """
        model, key = composed.model, composed.key
        if key >= 0 and (model.na or model.nmocap or model.key_qvel[key].any()):
            rule = "must start at rest on engine='mujoco_warp', without activations and mocap bodies"
            raise InputError("keyframe", value=model.key(key).name, rule=rule)
        self.composed = composed
        self.world = WarpWorld(
            composed,
            num_envs=num_envs,
            device=device,
            contacts=engine.contacts,
            rows=engine.rows,
            launches=engine.launches,
        )
        self.models = self.world.models
        self.pads = RigidReadings(composed, self.world.contact, self.world.pairs, self.world.engine)
        self._reader = self.world.engine.reader(state_numbers(composed))
        self._indices, self._scratch = PadIndices.of(composed), mujoco.MjData(model)
        place, bodies = self.world.engine.device, [body.parts for body in composed.touched]
        self._names = [mounted.name for mounted in composed.sensors]
        gels = self.world.pairs.gels
        self._touches = {
            one.name: PadTouch(
                one.spec, grids[one.name], bodies, markers, gels=gels(k), pad=k, num_envs=num_envs, device=str(place)
            )
            for k, one in enumerate(composed.sensors)
            if one.name in grids
        }
        launch = self._launch_touches
        self._touch = self.world.engine.capture(launch) if self._touches else launch
        self._forget(wp.full(num_envs, value=True, dtype=wp.bool, device=place))

    @property
    def data(self) -> Any:
        """Raise ``InputError``: there is no state of MuJoCo."""
        raise InputError("data", value="mujoco_warp", rule="is of engine='mujoco': read world.state()", choices=("mujoco",))

    def hold(self, data: mujoco.MjData) -> None:
        """Raise ``InputError``, as ``data``."""
        _ = self.data

    @property
    def failed(self) -> np.ndarray:
        """Environments whose physics broke down, (B,); it waits for the device."""
        return ~self.world.engine.active.numpy()

    def first(self) -> mujoco.MjData:
        """State of MuJoCo at the scene's start."""
        self.composed.reset(self.composed.model, self._scratch)
        mujoco.mj_forward(self.composed.model, self._scratch)
        return self._scratch

    def values(self) -> dict[str, np.ndarray]:
        """Present ``state_numbers``, (B, …) each; it waits for the device."""
        self._reader.read()
        return self._reader.host()

    def fail(self, failed: np.ndarray) -> None:
        """Mark environments (B,) as failed."""
        if (failed & ~self.failed).any():
            self.world.engine.active.assign(~(failed | self.failed))

    def read(self, name: str) -> WarpFrame:
        """Readings of a sensor on the device; nothing is copied or launched."""
        wrench: Any = self.world.contact.wrenches[:, self._names.index(name)]
        active, touch = self.world.engine.active, self._touches.get(name)
        if touch is None:
            return WarpFrame(wrench, active)
        markers = None if touch.fots is None else touch.fots.displacement
        return WarpFrame(wrench, active, touch.height, touch.contact, markers)

    def _launch_touches(self) -> None:
        for touch in self._touches.values():
            touch.launch(self.world.contact, self.world.engine.active)

    def _forget(self, mask: wp.array) -> None:
        """Forget the past of the pads of a mask (B,), and show the present."""
        for touch in self._touches.values():
            touch.reset(mask)
        self._touch()

    def step(self, control: Any) -> None:
        """One control step by constant controls, or None, which holds.

        Raises:
            InputError: other controls, or contacts that were lost for want of memory.
        """
        controls = warp_controls(control, self.world)
        if controls is None:
            self.world.hold()
        else:
            self.world.step(controls)
        self._touch()
        self.world.check()
        for touch in self._touches.values():
            touch.check()

    def reset(
        self, envs: Sequence[int], joints: np.ndarray | None, bodies: Mapping[str, np.ndarray], variation: Variation | None
    ) -> None:
        """Put environments to a checked start; see ``TactileWorld.reset``."""
        for name in bodies:
            if not self.composed.bodies[name].is_free:
                free = [one.name for one in self.composed.touched if one.is_free]
                raise InputError("bodies", value=name, rule="must be a free body on engine='mujoco_warp'", choices=free)
        qpos = None
        if joints is not None or bodies or variation is not None or self.models.differ(envs):
            models = self.models.snapshot()
            if variation is not None:
                self.models.vary(envs, variation)
            try:
                qpos = self._checked_positions(envs, joints, bodies)
            except OverlapError:
                self.models.restore(models)
                raise
        mask = np.zeros(self.world.engine.num_envs, bool)
        mask[list(envs)] = True
        self.world.check()
        self.world.reset(qpos, mask)
        self._forget(wp.array(mask, dtype=wp.bool, device=self.world.engine.device))
        self.pads.surfaces.reset(np.asarray(envs, int))

    def _checked_positions(self, envs: Sequence[int], joints: np.ndarray | None, bodies: Mapping[str, np.ndarray]) -> np.ndarray:
        """Positions (B, nq), those of the start where an environment is not named.

        Raises ``OverlapError`` for a body beyond a gel's bonded face.
        """
        data, at = self._scratch, self._indices
        qpos = np.repeat(self.composed.start[None], self.world.engine.num_envs, axis=0)
        poses = np.zeros((len(envs), len(at.sites), len(at.bodies), 4, 4))
        for row, b in enumerate(envs):
            put_to_start(self.composed, self.models[b], data, row, joints, bodies)
            mujoco.mj_kinematics(self.models[b], data)
            qpos[b] = data.qpos
            pads = np.tile(np.eye(4), (len(at.sites), 1, 1))
            pads[:, :3, :3], pads[:, :3, 3] = data.site_xmat[at.sites].reshape(-1, 3, 3), data.site_xpos[at.sites]
            world = [pose_of(data.xpos[i], data.xquat[i]) for i in at.bodies]
            poses[row] = inverse(pads)[:, None] @ np.reshape(world, (1, -1, 4, 4))
        self.pads.check_beyond(envs, poses)
        return qpos


def warp_controls(control: Any, world: WarpWorld) -> wp.array | None:
    """Constant controls (B, nu), float32, on a world's device; None holds.

    Raises ``InputError`` for others.
    """
    count, nu, device = world.engine.num_envs, world.composed.model.nu, world.engine.device
    if isinstance(control, wp.array):
        if control.shape != (count, nu) or control.dtype != wp.float32 or control.device != device:
            value = (control.shape, control.dtype.__name__, str(control.device))
            raise InputError("control", value=value, rule=f"must be ({count}, {nu}) of float32 on {device}")
        return control
    if isinstance(control, np.ndarray):
        return wp.array(constant_controls(control, count, nu).astype(np.float32), dtype=wp.float32, device=device)
    if control is not None:
        rule = "must be constant in a step on engine='mujoco_warp', which asks nothing of the host"
        raise InputError("control", value=type(control).__name__, rule=rule, choices=("None", "NumPy array", "Warp array"))
    return None
