"""Soft pads in a MuJoCo world: one contact solver for all gels and the bodies they touch.

MuJoCo moves the robot and the rest. Every ``soft_timestep`` it steps first, with the forces of the pads on the robot. Then the solver
follows: cases and MuJoCo's bodies are driven to MuJoCo's poses, bodies of the solver move freely and are mirrored in MuJoCo as mocap
bodies.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from itertools import combinations

import mujoco
import numpy as np
import warp as wp

import ipc
from raytac.device import resolve_device
from raytac.errors import InputError, OverlapError, SpecError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.physics.base import PadReading
from raytac.physics.configs import Ipc
from raytac.physics.objects import object_parts
from raytac.physics.soft.bodies import SceneBody, ScenePad, scene_body
from raytac.physics.soft.coat_points import CoatMarkers, CoatTraction
from raytac.physics.soft.mesh import pad_mesh
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.scene_state import SceneReport
from raytac.robots.states import NumberWriter, StateReader, body_pose, site_pose
from raytac.se3 import pose_of, quaternions
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.shapes.triangulate import enclosed_volume, object_surface
from raytac.specs.press import PADS
from raytac.specs.task import PAIR_FRICTION, TaskScene
from raytac.world.c_coupling import CCoupling
from raytac.world.coupling_inputs import CouplingInputs
from raytac.world.environment_models import EnvironmentModels
from raytac.world.forbidden_overlap import Inside, RobotOverlap
from raytac.world.warp_frame import WarpFrame
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive, lost

_TOUCH = 1e-5
"""Distance from a soft body's holder within which its vertices are bonded to it [m]."""
_CELLS = 8
"""Cells of a soft body along its longest edge where the scene does not say."""

_MOCAP = ("mocap_pos", 3), ("mocap_quat", 4)
"""Members of a state that mirror a body of the solver, and their numbers for each."""
_INSIDE = 1e-4
"""Most overlap of a body with a case or link that is not reported [m]: rounding."""

_REPORT = {
    **{"min_gap": np.inf, "min_det": 1.0, "blocked": 0.0, "converged": True},
    **{"unconverged": 0, "newton": 0, "linear": 0, "substeps": 0},
}
"""Fields of ``SceneReport`` that a world reports, and their values before any step."""


class SoftPads:
    """All pads of a world, B environments, as one ``SoftScene``."""

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

        Raises:
            BackendError: the solver is not installed, or the device does not work here.
            SpecError: a body that the solver cannot hold, or with two-way coupling a held soft one with too many cells.
            OverlapError: bodies overlap at the start, or one of the solver's lies inside a case or a link.
        """
        self.composed, self.model, self._models, self._datas = composed, composed.model, models, tuple(datas)
        assert composed.scene is not None, "a world of a given MuJoCo model has rigid pads"
        self._scene, level = composed.scene, physics.level or PADS[0]
        scene = self._scene
        pads = [
            ScenePad(mounted.name, spec, pad_mesh(spec.gelpad, level), correction=physics.correction)
            for mounted, spec in zip(composed.sensors, composed.sensor_specs, strict=True)
        ]
        links = [int(self.model.body(m.body).id) for m in composed.sensors]
        sites = np.array([self.model.site(m.site).id for m in composed.sensors], int)
        self._own = [b for b in composed.touched if b.mocap >= 0]
        """Bodies that belong to the solver."""
        self._driven = [b for b in composed.touched if b.is_free]
        """Bodies that belong to MuJoCo."""
        members = {"pads": site_pose(sites)} | {body.name: body_pose(body.index) for body in self._driven}
        self._reader = StateReader(self._datas, members)
        self._mirrors = [
            (body.name, *(NumberWriter(self._datas, member, size * body.mocap + np.arange(size)) for member, size in _MOCAP))
            for body in self._own
        ]
        bodies = [_solver_body(scene, i) for i in range(len(scene.bodies))]
        starts = {b.name: pose_of(b.position, b.quaternion) for b in scene.bodies}
        self.soft = SoftScene(
            pads,
            bodies,
            self._pad_poses(),
            starts,
            dt=scene.soft_timestep,
            gravity=scene.gravity,
            friction=_pair_friction(scene),
            ignored=[(b.name, b.held_by) for b in scene.bodies if b.held_by is not None],
            num_envs=len(datas),
            device=resolve_device(device, ray_tracing=False),
        )
        self._robot = RobotOverlap(composed)
        self._warned: set[tuple[str, str]] = set()
        self._refuse_inside(datas, range(len(datas)))
        self._coupling = None
        if coupling == "two_way":
            self._inputs = CouplingInputs(self.soft, [*(m.name for m in composed.sensors), *(b.name for b in self._driven)])
            felt, room = [*links, *(b.index for b in self._driven)], (self._inputs.contacts, self._inputs.solver_bodies)
            self._coupling = CCoupling(models, self._datas, felt, contacts=room[0], solver_bodies=room[1])
            self._chosen = wp.zeros(len(datas), dtype=wp.int32, device="cpu")
            self._prepare_bonded()
        self._last_cases = self._pad_poses()
        self._last_driven = {b.name: np.stack([starts[b.name]] * len(datas)) for b in self._driven}
        self._traction: dict[str, CoatTraction] = {}
        self._markers: dict[str, CoatMarkers] = {}
        self._wrench = {m.name: np.zeros((len(datas), 6)) for m in composed.sensors}
        self._unconverged = np.zeros(len(datas), int)
        """Steps of the solver since the reset that did not meet its tolerance."""
        self.report: dict[str, np.ndarray] = {}

    def reset(self, envs: Sequence[int], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Put environments back to the start: gels at rest, no forces, bodies where they began.

        ``bodies``: not None if they or the robot start elsewhere: name to poses (n, 4, 4) of the environments named; the cases are where
        MuJoCo has them.

        Raises ``OverlapError``: bodies overlap there; the solver has not changed then, what MuJoCo shows of its bodies has.
        """
        datas = self._datas
        cases, chosen = self._pad_poses(), list(envs)
        begin = {b.name: pose_of(b.position, b.quaternion) for b in self._scene.bodies}
        starts = {name: np.repeat(at[None], len(datas), axis=0) for name, at in begin.items()}
        for name, at in (bodies or {}).items():
            starts[name][chosen] = at
        kept = np.isin(np.arange(len(datas)), chosen, invert=True)
        if bodies is None:
            self.soft.reset(chosen)
        else:
            self._show(chosen, starts)
            self._refuse_inside(datas, chosen, only_rigid=True)  # soft ones are where they were, not where they will be
            self.soft.reset(chosen, np.where(kept[:, None, None, None], self._last_cases, cases), starts)
        for b in envs:
            self._last_cases[b] = cases[b]
            for body in self._driven:
                self._last_driven[body.name][b] = starts[body.name][b]
            self._unconverged[b] = 0
            for wrench in self._wrench.values():
                wrench[b] = 0.0
            for key, values in self.report.items():
                values[b] = _REPORT.get(key, 0.0)
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
        scene, timestep, datas = self._scene, self.composed.timestep, self._datas
        interval, since, reports = round(scene.soft_timestep / timestep), np.zeros(len(datas), int), []
        steps = round(scene.control_timestep / timestep)
        for step in range(1, steps + 1):
            self._ahead(drive, failed)
            since += 1
            cases, driven = self._now(failed)
            # Before a contact begins, the solver steps early, so that MuJoCo has the contact's force before the bodies overlap far.
            due = (since == interval) | (step == steps)
            if self._coupling is not None and not due.all():
                due |= ~self.soft.is_small(cases, driven, since * timestep)
            if due.any():
                reports.append(self._follow(failed, cases, driven, since * timestep, due))
                since[due] = 0
        whole = reduce(SceneReport.then, reports)
        failed |= ~whole.last_converged
        if (failed & ~self.soft.failed).any():
            self.soft.fail(failed)
        self.report = {key: np.broadcast_to(getattr(whole, key), len(datas)).copy() for key in _REPORT}
        self.report["inside_robot"] = self._depth_inside(datas, failed)
        self._unconverged += whole.unconverged

    @property
    def meshes(self) -> tuple[str, ...]:
        """Names of the pads and bodies whose surface the solver has."""
        return (*self.soft.pads, *(name for name, body in self.soft.bodies.items() if not isinstance(body.solid, ipc.HalfSpace)))

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) of all contacts on a pad, about its origin, pad frame."""
        return self._wrench[name].copy()

    def reading(self, name: str, grid: PadGrid, failed: np.ndarray, envs: Sequence[int] | None = None) -> PadReading:
        """Surface and forces of one sensor, for the environments named, one row each; None is all."""
        left_out = failed if envs is None else failed | ~np.isin(np.arange(len(failed)), envs)
        reading = self.soft.reading(name, grid, left_out)
        failed = failed | (reading.failed & ~left_out)
        wrench = np.where(failed[:, None], np.nan, self._wrench[name])

        def traction(_: GelSurface) -> np.ndarray:
            return self._traction_on(name, grid)(reading.forces)

        result = PadReading(reading.surface, wrench, failed, traction, unconverged=self._unconverged.copy())
        return result if envs is None else result.of(envs)

    def arrays(self, name: str, grid: PadGrid, failed: np.ndarray, markers: np.ndarray | None = None) -> WarpFrame:
        """Readings of one sensor as arrays of the solver's device; the next reading overwrites them.

        ``markers``: places of markers at rest (M, 2) [m], which move with the coat; None without.
        """
        mesh, device = self.soft.pads[name].mesh.coat, self.soft.world.device
        shown = self.soft.arrays(name, grid, failed)
        displacement = None
        if markers is not None:
            if name not in self._markers:
                self._markers[name] = CoatMarkers(mesh, markers, len(failed), device)
            displacement = self._markers[name].launch(shown.coat)
        lost = failed | self.soft.failed
        wrench = np.where(lost[:, None], np.nan, self._wrench[name])
        return WarpFrame(
            wp.array(wrench, dtype=wp.float64, device=device),
            wp.array(~lost, dtype=wp.bool, device=device),
            shown.height,
            shown.contact,
            displacement,
            self._traction_on(name, grid).launch(shown.forces),
        )

    def _traction_on(self, name: str, grid: PadGrid) -> CoatTraction:
        if name not in self._traction:
            self._traction[name] = CoatTraction(self.soft.pads[name].mesh.coat, grid, self.soft.world.device)
        return self._traction[name]

    def overlap(self, env: int) -> list[tuple[str, str, float]]:
        """Overlaps at the start: an empty list, since the solver raises an error for them."""
        return []

    def _prepare_bonded(self) -> None:
        """Invert the stiffness of bonded soft bodies now, for ``CouplingInputs`` at first touch."""
        scene = self._scene
        for i, body in enumerate(scene.bodies):
            if body.held_by is None:
                continue
            try:
                self.soft.world.held_patch(body.name, 0)
            except ipc.IpcError as error:
                cell = None if body.cell is None else float(f"{body.cell * 1e3:.6g}")
                raise SpecError(str(error), file=scene.source, key=f"body[{i}].cell_mm", value=cell) from error

    def _ahead(self, drive: Drive, failed: np.ndarray) -> None:
        """Take one step of MuJoCo in environments that have not failed (B,); marks new failures."""
        models, datas, alive = self._models, self._datas, np.flatnonzero(~failed).tolist()
        for b in alive:
            mujoco.mj_step1(models[b], datas[b])
        if alive:
            drive(alive)
        if self._coupling is not None:
            self._coupling.apply(alive)
        for b in alive:
            mujoco.mj_step2(models[b], datas[b])
        if alive:
            failed[alive] = lost([datas[b] for b in alive])
        for b in np.flatnonzero(~failed).tolist():
            mujoco.mj_kinematics(models[b], datas[b])
            mujoco.mj_comPos(models[b], datas[b])

    def _now(self, failed: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """MuJoCo's poses of cases and of its bodies; failed environments keep their last ones."""
        now = self._reader.values()
        cases = np.where(failed[:, None, None, None], self._last_cases, now.pop("pads"))
        return cases, {name: np.where(failed[:, None, None], self._last_driven[name], pose) for name, pose in now.items()}

    def _follow(
        self,
        failed: np.ndarray,
        cases: np.ndarray,
        driven: dict[str, np.ndarray],
        dt: np.ndarray,
        due: np.ndarray,
    ) -> SceneReport:
        """Step the solver by ``dt`` (B,) [s] to MuJoCo's poses, in environments ``due`` (B,)."""
        try:
            report = self.soft.step(cases, driven, dt, due)
        except InputError:
            failed[:] = True  # MuJoCo is ahead of the solver
            raise
        self._last_cases[due] = cases[due]
        for name, pose in driven.items():
            self._last_driven[name][due] = pose[due]
        failed |= report.failed
        self._mirror(np.flatnonzero(due & ~failed).tolist())
        if self._coupling is not None:
            wrenches = self.soft.world.sums.host
            sound = np.isfinite(wrenches["force"]).all(axis=(1, 2)) & np.isfinite(wrenches["torque"]).all(axis=(1, 2))
            failed |= due & ~sound
            self._chosen.numpy()[:] = due & ~failed
            self._inputs.gather(self._coupling.law, self._chosen)
            self._coupling.update(np.flatnonzero(due & ~failed).tolist())
        for k, mounted in enumerate(self.composed.sensors):
            turn, world = cases[:, k, :3, :3], self.soft.wrench(mounted.name)
            split = [np.einsum("bji,bj->bi", turn, world[:, at : at + 3]) for at in (0, 3)]
            self._wrench[mounted.name][due] = np.concatenate(split, axis=1)[due]
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

    def _inside(
        self, datas: Sequence[mujoco.MjData], envs: Sequence[int] | range | np.ndarray, *, only_rigid: bool = False
    ) -> Iterator[tuple[int, Inside]]:
        """Overlaps with cases and links by environment: rigid bodies in MuJoCo, soft by vertices."""
        soft = {name: self.soft.mesh(name)[0] for name, body in self.soft.bodies.items() if body.is_soft and not only_rigid}
        for b in envs:
            overlaps = self._robot.rigid(datas[b])
            for name, vertices in soft.items():
                overlaps += self._robot.soft(datas[b], name, vertices[b])
            yield from ((int(b), one) for one in overlaps if one.depth > _INSIDE)

    def _refuse_inside(self, datas: Sequence[mujoco.MjData], envs: Sequence[int] | range, *, only_rigid: bool = False) -> None:
        for b, one in self._inside(datas, envs, only_rigid=only_rigid):
            where = f" in environment {b}" if len(datas) > 1 else ""
            raise OverlapError(f"{one.body!r} starts {one.depth * 1e3:.3g} mm inside the robot's geom {one.geom!r}{where}")

    def _depth_inside(self, datas: Sequence[mujoco.MjData], failed: np.ndarray) -> np.ndarray:
        """Greatest depth inside the robot [m], (B,); warns once for every pair of body and geom."""
        depth = np.zeros(len(datas))
        for b, one in self._inside(datas, np.flatnonzero(~failed)):
            depth[b] = max(depth[b], one.depth)
            if (one.body, one.geom) not in self._warned:
                self._warned.add((one.body, one.geom))
                rule = "bodies of the solver touch gels, fixed bodies and each other, and pass through cases and links (docs/worlds.md)"
                where = f" in environment {b} at {datas[b].time:.3f} s"
                warnings.warn(
                    f"{one.body!r} is {one.depth * 1e3:.3g} mm inside the robot's geom {one.geom!r}{where}: {rule}",
                    RuntimeWarning,
                    stacklevel=4,
                )
        return depth

    def _pad_poses(self) -> np.ndarray:
        """``world_from_pad`` of every environment and pad, (B, S, 4, 4)."""
        return self._reader.values()["pads"]


def _solver_body(scene: TaskScene, index: int) -> SceneBody:
    body = scene.bodies[index]
    parts, friction = object_parts(body), body.friction_on_gel
    if body.kind == "plane":
        return scene_body(body.name, (), "half_space", friction=friction)
    if body.dynamics == "fixed" or (body.dynamics == "free" and body.owner == "mujoco"):
        return scene_body(body.name, parts, "kinematic", friction=friction)
    if body.dynamics == "free":
        density = body.density if body.mass is None else body.mass / enclosed_volume(object_surface(parts))
        return scene_body(body.name, parts, "affine", density=density, friction=friction)
    return scene_body(
        body.name,
        parts,
        "soft",
        density=body.density,
        youngs_modulus=body.youngs_modulus,
        poisson_ratio=body.poisson_ratio,
        cell=float(np.ptp(object_surface(parts).vertices, axis=0).max()) / _CELLS if body.cell is None else body.cell,
        bonded=None if body.held_by is None else _bonded_vertices(scene, index),
        friction=friction,
    )


def _pair_friction(scene: TaskScene) -> dict[tuple[str, str], float]:
    """Coefficients between bodies, the larger of both, as in MuJoCo; pads follow the solver."""
    known = {b.name: PAIR_FRICTION if b.friction is None else b.friction for b in scene.bodies}
    return {(a, b): max(known[a], known[b]) for a, b in combinations(known, 2)}


def _bonded_vertices(scene: TaskScene, index: int) -> Callable[[np.ndarray], np.ndarray]:
    """Function that selects a soft body's vertices (n, 3), in its frame, bonded to its holder."""
    body = scene.bodies[index]
    fixed = scene.body(str(body.held_by))
    fixed_from_body = np.linalg.inv(pose_of(fixed.position, fixed.quaternion)) @ pose_of(body.position, body.quaternion)
    parts = object_parts(fixed)
    for part in parts:
        if part.kind not in SOLIDS:
            rule = "cannot hold a soft body: its shape must be made of these"
            raise SpecError(rule, file=scene.source, key=f"body[{index}].held_by", value=fixed.name, choices=SOLIDS)

    def is_bonded(vertices: np.ndarray) -> np.ndarray:
        inside = np.zeros(len(vertices), bool)
        for part in parts:
            inside |= point_depth(part, vertices @ fixed_from_body[:3, :3].T + fixed_from_body[:3, 3]) >= -_TOUCH
        return inside

    return is_bonded
