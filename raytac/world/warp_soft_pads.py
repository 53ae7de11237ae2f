"""``WarpSoftPads``: soft pads of worlds on MuJoCo Warp, whose states lie on a device."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from raytac.physics.configs import Ipc
from raytac.physics.soft.scene_state import SceneReport
from raytac.robots.states import body_pose, site_pose
from raytac.world.coupling import Coupling, coupling_numbers
from raytac.world.soft_pads import SoftPads
from raytac.world.warp_world import WarpWorld
from raytac.world.world_model import WorldModel

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def write_wrenches(
    bodies: wp.array(dtype=wp.int32), applied: wp.array3d(dtype=wp.float64),
    # outputs
    xfrc: wp.array2d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Copy wrenches (B, n, 6) about centres of mass to ``xfrc_applied`` of ``bodies`` (n,)."""
    env, k = wp.tid()
    w = wp.spatial_vector()
    for i in range(6):
        w[i] = wp.float32(applied[env, k, i])
    xfrc[env, bodies[k]] = w


@wp.kernel
def mirror_bodies(
    chosen: wp.array(dtype=wp.int32), solver: wp.array(dtype=wp.int32), mocap: wp.array(dtype=wp.int32),
    position: wp.array3d(dtype=wp.float64), rotation: wp.array4d(dtype=wp.float64),
    # outputs
    place: wp.array2d(dtype=wp.vec3), turn: wp.array2d(dtype=wp.quat),
):  # fmt: skip
    """Copy poses of the solver's bodies to mocap bodies, in the environments ``chosen`` (B,)."""
    env, k = wp.tid()
    if chosen[env] == 0:
        return
    body = solver[k] + 0
    matrix, at = wp.mat33d(), wp.vec3()
    for i in range(3):
        at[i] = wp.float32(position[env, body, i])
        for j in range(3):
            matrix[i, j] = rotation[env, body, i, j]
    q = wp.quat_from_matrix(matrix)
    place[env, mocap[k]] = at
    # MuJoCo's order is w, x, y, z.
    turn[env, mocap[k]] = wp.quat(wp.float32(q[3]), wp.float32(q[0]), wp.float32(q[1]), wp.float32(q[2]))


class WarpSoftPads(SoftPads):
    """All pads of a world on MuJoCo Warp.

    Forces go from the solver's arrays to MuJoCo Warp's, and poses of the solver's bodies too, without the host. What the host decides
    is which environments the solver steps, and how it divides their steps: for this it copies the poses of cases and driven bodies once
    a step of MuJoCo, and the solver's sums (``ipc.sums``) once a solve. Overlaps with cases and links are not looked for.

    Attributes:
        copies: number of copies of poses to the host so far.
    """

    def __init__(
        self, composed: WorldModel, world: WarpWorld, cases: np.ndarray, *, physics: Ipc, coupling: str, device: str
    ) -> None:
        """Put all pads into the solver at ``cases``; ``world`` moves the robot.

        Raises as ``SoftPads``.
        """
        super().__init__(composed, cases, physics=physics, coupling=coupling, device=device)
        self._world, engine, model = world, world.engine, composed.model
        sites = np.array([model.site(m.site).id for m in composed.sensors], int)
        self._reader = engine.reader({"pads": site_pose(sites)} | {body.name: body_pose(body.index) for body in self._driven})
        self.copies, self._law = 0, None
        with wp.ScopedDevice(engine.device):
            self._chosen = wp.zeros(len(cases), dtype=wp.int32)
            self._all = wp.full(len(cases), value=1, dtype=wp.int32)
            self._coupled = wp.array(self.coupled_bodies, dtype=wp.int32)
            names = self.soft.world.layout.names
            self._solver = wp.array([names.index(body.name) for body in self._own], dtype=wp.int32)
            self._mocap = wp.array([body.mocap for body in self._own], dtype=wp.int32)
        if self._inputs is not None:
            self._numbers = engine.reader(coupling_numbers(model, self.coupled_bodies))
            room = {"contacts": self._inputs.contacts, "solver_bodies": self._inputs.solver_bodies}
            self._law = Coupling(model, self.coupled_bodies, self._numbers.arrays, **room)
        self._graphs: dict[Any, Callable[[], None]] = {}

    def reset(self, envs: Sequence[int], cases: np.ndarray, bodies: Mapping[str, np.ndarray] | None, *, elsewhere: bool) -> None:
        """Put environments back to rest at ``cases`` (B, S, 4, 4) and ``bodies``.

        Before MuJoCo Warp's own reset.

        Raises ``OverlapError``: bodies overlap there; nothing has changed then.
        """
        self._restart(envs, cases, self._starting(envs, bodies), elsewhere=elsewhere)
        if self._law is not None:
            self._law.clear(self._mask(np.isin(np.arange(self.soft.num_envs), envs)))

    def show(self, envs: Sequence[int]) -> None:
        """Mirror the solver's bodies in MuJoCo Warp, after its reset."""
        self._mirror(np.isin(np.arange(self.soft.num_envs), envs))
        self._world.engine.update_poses()

    def advance(self, drive: Callable[[], None], failed: np.ndarray) -> None:
        """Take one control step of all environments; ``drive`` launches their controls.

        Failures are marked in ``failed`` (B,), as by ``CSoftPads.advance``, and ``InputError`` is raised for the same.
        """
        scene, timestep = self._scene, self.composed.timestep
        interval, since, reports = round(scene.soft_timestep / timestep), np.zeros(len(failed), int), []
        steps = round(scene.control_timestep / timestep)
        for step in range(1, steps + 1):
            self._world.begin_part((step - 1) * timestep)
            self._ahead(drive)
            since += 1
            cases, driven = self._now(failed)
            due = self._due(cases, driven, since, interval, last=step == steps)
            if due.any():
                reports.append(self._follow(failed, cases, driven, since * timestep, due))
                since[due] = 0
        self._world.begin_part(0.0)
        self._conclude(reports, failed)

    def _ahead(self, drive: Callable[[], None]) -> None:
        """Take one step of MuJoCo Warp, on CUDA as one graph."""
        if drive in self._graphs:
            self._graphs[drive]()
        else:
            self._graphs[drive] = self._world.engine.capture(partial(self._launch_step, drive))  # which runs once

    def _launch_step(self, drive: Callable[[], None]) -> None:
        engine = self._world.engine
        engine.advance(partial(self._launch_drive, drive))
        engine.finish()
        self._reader.read()

    def _launch_drive(self, drive: Callable[[], None]) -> None:
        """Controls, then the coupling's law at the accelerations that they and w₀ give."""
        drive()
        if self._law is None:
            return
        self._numbers.read()
        self._law.hold()
        self._write()
        self._world.engine.free_acceleration()
        self._numbers.read()
        self._law.apply(self._all)
        self._write()

    def _write(self) -> None:
        assert self._law is not None
        xfrc = self._world.engine.data.xfrc_applied
        inputs = [self._coupled, self._law.applied, xfrc]
        wp.launch(write_wrenches, dim=self._law.applied.shape[:2], inputs=inputs, device=xfrc.device)

    def _now(self, failed: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """MuJoCo Warp's poses of cases and of its bodies; failed environments keep their last ones."""
        now = self._reader.host()
        self.copies += 1
        finite = np.logical_and.reduce([np.isfinite(pose.reshape(len(failed), -1)).all(axis=1) for pose in now.values()])
        failed |= ~finite
        cases = np.where(failed[:, None, None, None], self._last_cases, _rigid(now.pop("pads")))
        return cases, {name: np.where(failed[:, None, None], self._last_driven[name], _rigid(pose)) for name, pose in now.items()}

    def _follow(
        self, failed: np.ndarray, cases: np.ndarray, driven: dict[str, np.ndarray], dt: np.ndarray, due: np.ndarray
    ) -> SceneReport:
        """Step the solver (``_solve``).

        Show its bodies in MuJoCo Warp and begin an interval of the coupling.
        """
        report = self._solve(failed, cases, driven, dt, due)
        self._mirror(due & ~failed)
        if self._law is not None and self._inputs is not None:
            self._inputs.gather(self._law, self._chosen)
            self._numbers.read()
            self._law.update(self._chosen)
        return report

    def _mirror(self, envs: np.ndarray) -> None:
        """Set the mocap bodies of the environments (B,) to the poses of the solver's bodies."""
        chosen, data, sums = self._mask(envs), self._world.engine.data, self.soft.world.sums
        if self._own:
            sums.launch()
            poses = [sums.arrays["position"], sums.arrays["rotation"]]
            inputs = [chosen, self._solver, self._mocap, *poses, data.mocap_pos, data.mocap_quat]
            wp.launch(mirror_bodies, dim=(len(envs), len(self._own)), inputs=inputs, device=data.qpos.device)

    def _mask(self, envs: np.ndarray) -> wp.array:
        """A mask (B,) on the device."""
        self._chosen.assign(envs.astype(np.int32))
        return self._chosen


def _rigid(poses: np.ndarray) -> np.ndarray:
    """Poses (…, 4, 4) of single precision, whose rotations are made exact."""
    from raytac.se3 import nearest_rotation

    result = poses.copy()
    result[..., :3, :3] = nearest_rotation(poses[..., :3, :3])
    return result
