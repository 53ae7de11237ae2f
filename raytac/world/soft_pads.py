"""Soft pads of a world: one contact solver for all gels and bodies, and its readings.

MuJoCo moves the robot and the rest. Every ``soft_timestep`` it steps first, with the forces of the pads on the robot. Then the solver
follows: cases and MuJoCo's bodies are driven to MuJoCo's poses, bodies of the solver move freely and are mirrored in MuJoCo as mocap
bodies. ``CSoftPads`` does this with C MuJoCo, ``WarpSoftPads`` with MuJoCo Warp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from itertools import combinations

import numpy as np
import warp as wp

import ipc
from raytac.device import resolve_device
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.physics.base import PadReading
from raytac.physics.configs import Ipc
from raytac.physics.objects import object_parts
from raytac.physics.soft.bodies import SceneBody, ScenePad, scene_body
from raytac.physics.soft.coat_points import CoatMarkers, CoatTraction
from raytac.physics.soft.mesh import pad_mesh
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.scene_state import SceneReport
from raytac.se3 import pose_of
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.shapes.triangulate import enclosed_volume, object_surface
from raytac.specs.press import PADS
from raytac.specs.task import PAIR_FRICTION, TaskScene
from raytac.world.coupling_inputs import CouplingInputs
from raytac.world.warp_frame import WarpFrame
from raytac.world.world_model import WorldModel

_TOUCH = 1e-5
"""Distance from a soft body's holder within which its vertices are bonded to it [m]."""
_CELLS = 8
"""Cells of a soft body along its longest edge where the scene does not say."""

_REPORT = {
    **{"min_gap": np.inf, "min_det": 1.0, "blocked": 0.0, "converged": True},
    **{"unconverged": 0, "newton": 0, "linear": 0, "substeps": 0},
}
"""Fields of ``SceneReport`` that a world reports, and their values before any step."""


class SoftPads:
    """All pads of a world, B environments, as one ``SoftScene``; the engine's class steps it."""

    def __init__(self, composed: WorldModel, cases: np.ndarray, *, physics: Ipc, coupling: str, device: str) -> None:
        """Put all pads into the solver at ``cases``, ``world_from_pad`` (B, S, 4, 4).

        Raises:
            BackendError: the solver is not installed, or the device does not work here.
            SpecError: a body that the solver cannot hold, or with two-way coupling a held soft one with too many cells.
            OverlapError: bodies overlap at the start.
        """
        self.composed, count = composed, len(cases)
        assert composed.scene is not None, "a world of a given MuJoCo model has rigid pads"
        self._scene, level = composed.scene, physics.level or PADS[0]
        scene = self._scene
        pads = [
            ScenePad(mounted.name, spec, pad_mesh(spec.gelpad, level), correction=physics.correction)
            for mounted, spec in zip(composed.sensors, composed.sensor_specs, strict=True)
        ]
        self._own = [b for b in composed.touched if b.mocap >= 0]
        """Bodies that belong to the solver."""
        self._driven = [b for b in composed.touched if b.is_free]
        """Bodies that belong to MuJoCo."""
        bodies = [_solver_body(scene, i) for i in range(len(scene.bodies))]
        self._starts = {b.name: pose_of(b.position, b.quaternion) for b in scene.bodies}
        self.soft = SoftScene(
            pads,
            bodies,
            cases,
            self._starts,
            dt=scene.soft_timestep,
            gravity=scene.gravity,
            friction=_pair_friction(scene),
            ignored=[(b.name, b.held_by) for b in scene.bodies if b.held_by is not None],
            num_envs=count,
            device=resolve_device(device, ray_tracing=False),
            accuracy=physics.accuracy,
        )
        self._inputs = None
        if coupling == "two_way":
            self._inputs = CouplingInputs(self.soft, [*(m.name for m in composed.sensors), *(b.name for b in self._driven)])
            self._prepare_bonded()
        self._last_cases = cases.copy()
        self._last_driven = {b.name: np.stack([self._starts[b.name]] * count) for b in self._driven}
        self._traction: dict[str, CoatTraction] = {}
        self._markers: dict[str, CoatMarkers] = {}
        self._wrench = {m.name: np.zeros((count, 6)) for m in composed.sensors}
        self._unconverged = np.zeros(count, int)
        """Steps of the solver since the reset that did not meet its tolerance."""
        self.report: dict[str, np.ndarray] = {}

    @property
    def coupled_bodies(self) -> list[int]:
        """Bodies of MuJoCo that the solver acts on, in the order of the coupling's inputs."""
        links = [int(self.composed.model.body(mounted.body).id) for mounted in self.composed.sensors]
        return [*links, *(body.index for body in self._driven)]

    def _starting(self, envs: Sequence[int], bodies: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray]:
        """Poses (B, 4, 4) of all bodies at the start; ``bodies``: other ones of the n environments."""
        starts = {name: np.repeat(at[None], self.soft.num_envs, axis=0) for name, at in self._starts.items()}
        for name, at in (bodies or {}).items():
            starts[name][list(envs)] = at
        return starts

    def _restart(self, envs: Sequence[int], cases: np.ndarray, starts: Mapping[str, np.ndarray], *, elsewhere: bool) -> None:
        """Reset the solver and all readings of environments, which begin ``elsewhere`` or not.

        Raises ``OverlapError``: bodies overlap there; nothing has changed then.
        """
        chosen = list(envs)
        if elsewhere:
            kept = np.isin(np.arange(self.soft.num_envs), chosen, invert=True)
            self.soft.reset(chosen, np.where(kept[:, None, None, None], self._last_cases, cases), starts)
        else:
            self.soft.reset(chosen)
        self._last_cases[chosen], self._unconverged[chosen] = cases[chosen], 0
        for body in self._driven:
            self._last_driven[body.name][chosen] = starts[body.name][chosen]
        for wrench in self._wrench.values():
            wrench[chosen] = 0.0
        for key, values in self.report.items():
            values[chosen] = _REPORT.get(key, 0.0)

    def _solve(
        self, failed: np.ndarray, cases: np.ndarray, driven: dict[str, np.ndarray], dt: np.ndarray, due: np.ndarray
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
        sums = self.soft.world.sums.host
        failed |= due & ~(np.isfinite(sums["force"]).all(axis=(1, 2)) & np.isfinite(sums["torque"]).all(axis=(1, 2)))
        for k, mounted in enumerate(self.composed.sensors):
            world_from_pad, wrench = cases[:, k, :3, :3], self.soft.wrench(mounted.name)
            force, torque = (np.einsum("bji,bj->bi", world_from_pad, axes) for axes in (wrench[:, :3], wrench[:, 3:]))
            self._wrench[mounted.name][due] = np.concatenate([force, torque], axis=1)[due]
        return report

    def _conclude(self, reports: Sequence[SceneReport], failed: np.ndarray) -> None:
        """Report all steps of the solver in a control step, and freeze what failed (B,)."""
        total = reduce(SceneReport.then, reports)
        failed |= ~total.last_converged
        if (failed & ~self.soft.failed).any():
            self.soft.fail(failed)
        self.report = {key: np.broadcast_to(getattr(total, key), len(failed)).copy() for key in _REPORT}
        self._unconverged += total.unconverged

    def _due(
        self, cases: np.ndarray, driven: dict[str, np.ndarray], since: np.ndarray, interval: int, *, last: bool
    ) -> np.ndarray:
        """Environments (B,) in which the solver steps now: every ``interval`` steps of MuJoCo.

        Where a contact is about to begin it steps earlier, so that MuJoCo has the contact's force before the bodies overlap far.

        Args:
            cases, driven: present poses of the cases (B, S, 4, 4) and of driven bodies (B, 4, 4) by name, world frame.
            since: steps of MuJoCo since the solver stepped, (B,).
            interval: steps of MuJoCo in one of the solver.
            last: True in the last step of MuJoCo in a control step, with which all of them step.
        """
        due = (since == interval) | last
        if self._inputs is not None and not due.all():
            due |= ~self.soft.is_small(cases, driven, since * self.composed.timestep)
        return due

    @property
    def meshes(self) -> tuple[str, ...]:
        """Names of the pads and bodies whose surface the solver has."""
        return (*self.soft.pads, *(name for name, body in self.soft.bodies.items() if not isinstance(body.solid, ipc.HalfSpace)))

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) of all contacts on a pad, about its origin, pad frame."""
        return self._wrench[name].copy()

    def reading(self, name: str, grid: PadGrid, failed: np.ndarray, envs: Sequence[int] | None = None) -> PadReading:
        """Surface and forces of one sensor, for the environments named, one row each; None is all."""
        unread = failed if envs is None else failed | ~np.isin(np.arange(len(failed)), envs)
        reading = self.soft.reading(name, grid, unread)
        failed = failed | (reading.failed & ~unread)
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
        failed = failed | self.soft.failed
        wrench = np.where(failed[:, None], np.nan, self._wrench[name])
        return WarpFrame(
            wp.array(wrench, dtype=wp.float64, device=device),
            wp.array(~failed, dtype=wp.bool, device=device),
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
