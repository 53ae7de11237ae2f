"""``CSoftPads``: soft pads of B states of C MuJoCo."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
import warp as wp

from raytac.errors import OverlapError
from raytac.physics.configs import Ipc
from raytac.physics.soft.scene_state import SceneReport
from raytac.robots.states import NumberWriter, StateReader, body_pose, site_pose
from raytac.se3 import quaternions
from raytac.world.c_coupling import CCoupling
from raytac.world.environment_models import EnvironmentModels
from raytac.world.forbidden_overlap import Inside, RobotOverlap
from raytac.world.soft_pads import SoftPads
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive, lost

_MOCAP = ("mocap_pos", 3), ("mocap_quat", 4)
"""Members of a state that mirror a body of the solver, and their numbers for each."""
_INSIDE = 1e-4
"""Most overlap of a body with a case or link that is not reported [m]: rounding."""


class CSoftPads(SoftPads):
    """All pads of a world on C MuJoCo, whose states are on the host."""

    def __init__(
        self,
        composed: WorldModel,
        models: EnvironmentModels,
        datas: Sequence[mujoco.MjData],
        *,
        physics: Ipc,
        coupling: str,
        device: str,
    ) -> None:
        """Put all pads into the solver where MuJoCo has them; ``coupling``: of ``COUPLINGS``.

        Raises as ``SoftPads``, and ``OverlapError`` where a body of the solver's lies inside a case or a link.
        """
        self._models, self._datas, model = models, tuple(datas), composed.model
        sites = np.array([model.site(m.site).id for m in composed.sensors], int)
        driven = {body.name: body_pose(body.index) for body in composed.touched if body.is_free}
        self._reader = StateReader(self._datas, {"pads": site_pose(sites)} | driven)
        super().__init__(composed, self._pad_poses(), physics=physics, coupling=coupling, device=device)
        self._mirrors = [
            (body.name, *(NumberWriter(self._datas, member, size * body.mocap + np.arange(size)) for member, size in _MOCAP))
            for body in self._own
        ]
        self._robot = RobotOverlap(composed, self._datas)
        self._warned: set[tuple[str, str]] = set()
        self._refuse_inside(range(len(datas)))
        self._coupling = None
        if self._inputs is not None:
            room = {"contacts": self._inputs.contacts, "solver_bodies": self._inputs.solver_bodies}
            self._coupling = CCoupling(models, self._datas, self.coupled_bodies, **room)
            self._chosen = wp.zeros(len(datas), dtype=wp.int32, device="cpu")

    def reset(self, envs: Sequence[int], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Put environments back to the start: gels at rest, no forces, bodies where they began.

        ``bodies``: not None if they or the robot start elsewhere: name to poses (n, 4, 4) of the environments named; the cases are where
        MuJoCo has them.

        Raises ``OverlapError``: bodies overlap there; the solver has not changed then, what MuJoCo shows of its bodies has.
        """
        chosen, starts = list(envs), self._starting(envs, bodies)
        if bodies is not None:
            self._show(chosen, starts)
            self._refuse_inside(chosen, only_rigid=True)  # soft ones are where they were, not where they will be
        self._restart(chosen, self._pad_poses(), starts, elsewhere=bodies is not None)
        if self._coupling is not None:
            self._coupling.reset(chosen)
        self._mirror(chosen)

    def advance(self, drive: Drive, failed: np.ndarray) -> None:
        """Take one control step of all environments; failures are marked in ``failed`` (B,).

        Those that fail stand still.
        An environment fails if its state is not finite, if its last step did not meet the solver's tolerance, or, with a
        ``RuntimeWarning``, if it moves too fast to be resolved near a contact.

        Raises ``InputError``: the only environment moves too fast; it has failed then, until it is reset.
        """
        scene, timestep = self._scene, self.composed.timestep
        interval, since, reports = round(scene.soft_timestep / timestep), np.zeros(len(failed), int), []
        steps = round(scene.control_timestep / timestep)
        for step in range(1, steps + 1):
            self._ahead(drive, failed)
            since += 1
            cases, driven = self._now(failed)
            due = self._due(cases, driven, since, interval, last=step == steps)
            if due.any():
                reports.append(self._follow(failed, cases, driven, since * timestep, due))
                since[due] = 0
        self._conclude(reports, failed)
        self.report["inside_robot"] = self._depth_inside(failed)

    def _ahead(self, drive: Drive, failed: np.ndarray) -> None:
        """Take one step of MuJoCo in environments that have not failed (B,); marks new failures."""
        models, datas, alive = self._models, self._datas, np.flatnonzero(~failed).tolist()
        if not alive:
            return
        for b in alive:
            mujoco.mj_step1(models[b], datas[b])
        drive(alive)
        if self._coupling is not None:
            self._coupling.apply(alive)
        for b in alive:
            mujoco.mj_step2(models[b], datas[b])
        failed[alive] = lost(*(np.array([getattr(datas[b], name) for b in alive]) for name in ("qvel", "qpos")))
        for b in np.flatnonzero(~failed).tolist():
            mujoco.mj_kinematics(models[b], datas[b])
            mujoco.mj_comPos(models[b], datas[b])

    def _now(self, failed: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """MuJoCo's poses of cases and of its bodies; failed environments keep their last ones."""
        now = self._reader.values()
        cases = np.where(failed[:, None, None, None], self._last_cases, now.pop("pads"))
        return cases, {name: np.where(failed[:, None, None], self._last_driven[name], pose) for name, pose in now.items()}

    def _follow(
        self, failed: np.ndarray, cases: np.ndarray, driven: dict[str, np.ndarray], dt: np.ndarray, due: np.ndarray
    ) -> SceneReport:
        """Step the solver (``_solve``).

        Show its bodies in MuJoCo and begin an interval of the coupling.
        """
        report = self._solve(failed, cases, driven, dt, due)
        alive = np.flatnonzero(due & ~failed).tolist()
        self._mirror(alive)
        if self._coupling is not None and self._inputs is not None:
            self._chosen.numpy()[:] = due & ~failed
            self._inputs.gather(self._coupling.law, self._chosen)
            self._coupling.update(alive)
        return report

    def _mirror(self, envs: Sequence[int]) -> None:
        """Set the mocap bodies to the poses of the solver's bodies."""
        if self._own and envs:
            self._show(envs, {body.name: self.soft.pose(body.name) for body in self._own})

    def _show(self, envs: Sequence[int], poses: Mapping[str, np.ndarray]) -> None:
        for name, place, turn in self._mirrors:
            place.values[:], turn.values[:] = poses[name][:, :3, 3], quaternions(poses[name])
            place.write(envs)
            turn.write(envs)
        if self._own:
            for b in envs:
                mujoco.mj_kinematics(self._models[b], self._datas[b])

    def _inside(self, envs: Sequence[int] | range | np.ndarray, *, only_rigid: bool = False) -> Iterator[tuple[int, Inside]]:
        """Overlaps with cases and links by environment: rigid bodies in MuJoCo, soft by vertices."""
        soft = {name: self.soft.mesh(name)[0] for name, body in self.soft.bodies.items() if body.is_soft and not only_rigid}
        by_vertices = ((int(b), one) for b in envs for name, x in soft.items() for one in self._robot.soft(b, name, x[b]))
        for b, one in (*self._robot.rigid(envs), *by_vertices):
            if one.depth > _INSIDE:
                yield b, one

    def _refuse_inside(self, envs: Sequence[int] | range, *, only_rigid: bool = False) -> None:
        for b, one in self._inside(envs, only_rigid=only_rigid):
            where = f" in environment {b}" if len(self._datas) > 1 else ""
            raise OverlapError(f"{one.body!r} starts {one.depth * 1e3:.3g} mm inside the robot's geom {one.geom!r}{where}")

    def _depth_inside(self, failed: np.ndarray) -> np.ndarray:
        """Greatest depth inside the robot [m], (B,); warns once for every pair of body and geom."""
        depth = np.zeros(len(failed))
        for b, one in self._inside(np.flatnonzero(~failed)):
            depth[b] = max(depth[b], one.depth)
            if (one.body, one.geom) not in self._warned:
                self._warned.add((one.body, one.geom))
                rule = "the solver's bodies touch gels, fixed bodies and each other, and pass through cases and links: docs/guide/worlds.md"
                where = f" in environment {b} at {self._datas[b].time:.3f} s"
                warnings.warn(
                    f"{one.body!r} is {one.depth * 1e3:.3g} mm inside the robot's geom {one.geom!r}{where}: {rule}",
                    RuntimeWarning,
                    stacklevel=4,
                )
        return depth

    def _pad_poses(self) -> np.ndarray:
        """``world_from_pad`` of every environment and pad, (B, S, 4, 4)."""
        return self._reader.values()["pads"]
