"""The soft pad: the gel simulated with contact, friction and large deformation; object or case driven, or the object lying free."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from raytac.checks import check_whole
from raytac.errors import InputError, SpecError
from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.surface import GelSurface, make_grid
from raytac.gel.traction import CoatTraction
from raytac.io.progress import Progress
from raytac.physics.base import ContactState
from raytac.physics.press import (
    CLEARANCE,
    MOST_STEPS,
    PressTargets,
    check_trajectory,
    peak_state,
    scene_parts,
)
from raytac.physics.soft.bodies import object_body
from raytac.physics.soft.mesh import PadMesh, pad_mesh
from raytac.physics.soft.placement import PressPlacement
from raytac.physics.soft.press_controller import PressController
from raytac.physics.soft.press_solver import PressSolver
from raytac.physics.soft.reading import SoftReader, SoftReading
from raytac.physics.soft.settings import DEFAULT_CONTROL, DEFAULT_CORRECTION, Correction, PressControl
from raytac.shapes.underside import object_height
from raytac.specs.press import PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

__all__ = ["SoftPad", "SoftState"]

_SAG = 0.1
"""How far the object's facets may lie inside it, in units of d̂."""


@dataclass(frozen=True)
class SoftState(ContactState):
    """B environments at one instant (see ``ContactState``), and the coat that the solver knows.

    ``pad_from_object`` is where the object is shown: lowered by the clearance that the barrier kept, so that it touches.
    ``force_law_area`` is nothing of a law here: the area that bears pressure, as ``GelSurface.contact`` counts it.
    """

    reading: SoftReading | None = None
    """The smooth coat with its mesh, the force on each of its vertices, and the clearance."""


class SoftPad:
    """Press scene on a sensor with a simulated pad (see docs/soft-pad.md); used as ``RigidPad`` is.

    .. code-block:: python

        pad = SoftPad(sensor, scene, pitch=0.1e-3, pad="medium")
        for state in pad.run(steps_per_stage=8):
            surface = pad.surface(state)
    """

    def __init__(
        self,
        sensor: SensorSpec,
        scene: PressScene,
        *,
        pitch: float,
        pad: str | PadMesh = "coarse",
        num_envs: int = 1,
        seed: int = 0,
        offsets: np.ndarray | None = None,
        depths: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        shears: np.ndarray | None = None,
        twists: np.ndarray | None = None,
        device: str = "cpu",
        correction: Correction | None = DEFAULT_CORRECTION,
        control: PressControl = DEFAULT_CONTROL,
    ) -> None:
        """Cut the pad, make the object's surface and put both into the solver.

        Args:
            sensor: gives the gelpad.
            scene: object and trajectory.
            pitch: spacing of the grid that surfaces are given on [m].
            pad: a level of ``PAD_LEVELS``, or a mesh of one's own.
            num_envs: number of environments B.
            seed: accepted for symmetry with sampled physics; nothing here is random.
            offsets, depths, rotations, shears, twists: what environments do each in their own way, see ``PressTargets``; not finite:
                that environment fails.
            device: where the solver runs, ``cpu`` or ``cuda``.
            correction: of what the mesh gets wrong below the size of its cells; None shows the plain finite-element surface.
            control: tolerances and search of the solver and its controller.

        Raises:
            InputError: an unknown level, arguments of the wrong shape, ``depths`` deeper than the pad.
            SpecError: the scene's object or trajectory is impossible; names the scene's file and key.
            RaytacError: the object overlaps the pad where it starts.
        """
        targets = self._targets = PressTargets(
            scene, num_envs, offsets=offsets, depths=depths, rotations=rotations, shears=shears, twists=twists
        )
        self.sensor, self.scene, self.seed, self.num_envs = sensor, scene, seed, num_envs
        self.mesh = pad if isinstance(pad, PadMesh) else pad_mesh(sensor.gelpad, pad)
        self.grid = make_grid(sensor.gelpad, pitch)
        self.parts = scene_parts(scene)
        check_trajectory(scene, sensor.gelpad, self.parts, targets.depths)
        self._reader = SoftReader(self.mesh, sensor.gelpad, self.grid, correction)
        self._traction: CoatTraction | None = None
        self._last: SoftReading | None = None
        self.solver: PressSolver | None = None
        """Pad and object in the contact solver; None without an object."""
        self._drive: PressController | None = None
        if self.parts:
            self._places = PressPlacement(scene, self.parts, sensor.gelpad, self.grid, targets)
            above = self._places.poses(
                np.full(num_envs, self.mesh.d_hat + CLEARANCE), np.zeros((num_envs, 2)), np.zeros(num_envs)
            )
            self.solver = PressSolver(sensor, self.mesh, self._body(), above, device, control)
            self._drive = PressController(scene, self.solver, self._reader, self._places, targets)

    # --- trajectory ------------------------------------------------------------------------------------------------------------

    def run(self, steps_per_stage: int = 1, *, progress: bool = False) -> Iterator[SoftState]:
        """States along the trajectory from the start: one before it (lifted by ``CLEARANCE``), ``steps_per_stage`` through each stage.

        Between states the solver takes as many steps as it needs. An ``indent`` to a depth ends when the *coat* is at that
        depth: what the barrier keeps between it and the object is added to the object's height; on the way the coat is there within some
        micrometres, and never deeper than the stage's end; in a shear or twist that follows, it stays there. One to a force moves the
        object until the contact bears it, and keeps it through a shear or twist that follows; a free object is laid down and comes to
        rest. A ``release`` lifts the object ``CLEARANCE`` above the gel.

        ``progress``: on a terminal, a bar of the solver's steps with the stage beside it; how many a search takes is not known before.

        Raises:
            InputError: ``steps_per_stage`` below 1.
        """
        check_whole("steps_per_stage", steps_per_stage, 1, MOST_STEPS)
        self.reset()
        with Progress(desc=f"press {self.scene.name}", unit="step", show=progress, leave=False) as bar:
            if self._drive is not None:
                self._drive.bar = bar
            yield self._state(-1, "start", 1.0)
            for index, stage in enumerate(self.scene.trajectory):
                bar.set_postfix_str(f"stage {index + 1} of {len(self.scene.trajectory)}: {stage.kind}")
                yield from self._through(index, stage, steps_per_stage)

    def follow(self, stage: StageSpec, steps: int = 1) -> Iterator[SoftState]:
        """States along one more stage, from wherever the pad is now; as ``RigidPad.follow``.

        Raises:
            InputError: ``steps`` below 1, or a stage deeper than any of the scene's: there the object's surface was left out.
            SpecError: a scene without object, or a stage that no pad can follow.
        """
        check_whole("steps", steps, 1, MOST_STEPS)
        if stage.kind == "indent" and (stage.depth or self.sensor.gelpad.thickness) > self._deepest:
            rule = f"must not go deeper than the scene's deepest stage, {self._deepest * 1e3:.4g} mm (a force may go as deep as the pad)"
            raise InputError("stage", value=stage, rule=rule)
        check_trajectory(replace(self.scene, trajectory=(stage,), source=None), self.sensor.gelpad, self.parts, None)
        yield from self._through(-1, stage, steps)

    def peak(self, states: Iterable[SoftState]) -> SoftState:
        """First of ``states`` at the end of the scene's peak stage (the start, if it has none); later ones are not computed."""
        return peak_state(self.scene, states)

    def surface(self, state: ContactState) -> GelSurface:
        """Gel surface at a state of this pad."""
        return self._reading(state).surface

    def wrench(self, state: ContactState) -> np.ndarray:
        """Force of the object on the pad [N] and its torque about the pad frame's origin [N m], pad frame, shape (B, 6)."""
        forces = self._reading(state).forces
        torque = np.cross(self._reading(state).vertices, forces).sum(axis=1)
        return np.concatenate([forces.sum(axis=1), torque], axis=1)

    def traction(self, state: ContactState) -> np.ndarray:
        """Traction of the object on the pad [Pa], pad frame, shape (B, Ny, Nx, 3), at the place of the coat at rest."""
        if self._traction is None:
            self._traction = CoatTraction(self.mesh.coat, self.grid)
        return self._traction(self._reading(state).forces)

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the object at the surface's poses [m], shape (B, Ny, Nx), inf where it is not; None without an object.

        A soft object is shown as it was when the last state was read.
        """
        if surface.pad_from_object is None:
            return None
        if self.scene.object.dynamics == "soft" and self._last is not None:
            return self._last.underside
        return object_height(self.parts, surface.pad_from_object, self.grid.x, self.grid.y)

    def reset(self) -> None:
        """Forget all history: the pad at rest, the object above it."""
        self._last = None
        if self._drive is not None:
            self._drive.reset()

    # --- states ----------------------------------------------------------------------------------------------------------------

    def _through(self, index: int, stage: StageSpec, steps: int) -> Iterator[SoftState]:
        """``steps`` states through a stage; ``index``: its number in the scene, −1 if it is none of the scene's."""
        assert self._drive is not None
        begun = self._drive.start()
        for step in range(1, steps + 1):
            self._drive.advance(stage, step / steps, begun)
            yield self._state(index, stage.kind, step / steps)

    def _reading(self, state: ContactState) -> SoftReading:
        if not isinstance(state, SoftState) or state.reading is None:
            raise InputError("state", value=type(state).__name__, rule="must be a state that this pad's run() gave")
        return state.reading

    def _state(self, stage: int, kind: str, fraction: float) -> SoftState:
        batch = self.num_envs
        if self._drive is None or self.solver is None:
            poses, zero = np.tile(np.eye(4), (batch, 1, 1)), np.zeros(batch)
            rest = np.repeat(self.grid.rest[None].astype(np.float32), batch, axis=0)
            coat = DeformedCoat(self.mesh.coat, np.repeat(self.mesh.coat.rest[None], batch, axis=0))
            surface = GelSurface(self.grid, rest, np.zeros(rest.shape, bool), np.full((batch, 2), np.nan), None, coat)
            none = np.full(batch, np.nan)
            still = coat.positions, np.zeros_like(coat.positions)
            failed = np.zeros(batch, bool)
            reading = SoftReading(surface, *still, none, (), np.full(rest.shape, np.inf), none, failed)
            none_yet = np.zeros(batch, int)
            return SoftState(
                *(stage, kind, fraction, poses, poses, zero, zero, np.zeros((batch, 2)), zero, zero, failed),
                *(self.scene, none_yet, reading),
            )
        reading = self._reader.read(self.solver.coat_state(self._drive.poses()), self._drive.failed)
        failed = self._drive.failed = reading.failed
        self._last = reading
        self._drive.set_clearance(reading.clearance)
        surface, forces = reading.surface, reading.forces
        total = forces.sum(axis=1)
        arm = reading.vertices[:, :, :2] - np.nan_to_num(surface.contact_centre)[:, None]
        torque = (arm[:, :, 0] * forces[:, :, 1] - arm[:, :, 1] * forces[:, :, 0]).sum(axis=1)
        cell = self.grid.pitch[0] * self.grid.pitch[1]
        area = np.where(failed, np.nan, surface.contact.sum(axis=(1, 2)) * cell)
        depth = np.where(failed, np.nan, self._places.origin[:, 2] - reading.poses[0][:, 2, 3])
        case = self._drive.case()
        case = np.tile(np.eye(4), (batch, 1, 1)) if case is None else case
        case[failed] = np.nan
        return SoftState(
            stage,
            kind,
            fraction,
            reading.poses[0],
            case,
            depth,
            -total[:, 2],
            total[:, :2],
            torque,
            area,
            failed.copy(),
            self.scene,
            self._drive.unconverged,
            reading,
        )

    @property
    def _deepest(self) -> float:
        """Depth that the object's surface was made for [m]; a force may go as deep as the pad."""
        deepest = max((stage.depth or self.sensor.gelpad.thickness for stage in self.scene.trajectory), default=0.0)
        depths = self._targets.depths
        return deepest if depths is None else max(deepest, float(np.nanmax(depths, initial=0.0)))

    def _body(self):
        settings = {
            "weight": max((stage.force or 0.0 for stage in self.scene.trajectory), default=0.0),
            "edge_length": 0.75 * float(np.diff(self.mesh.coat.lines_x).mean()),
            "lowest": self._deepest + float(np.ptp(self.grid.rest)) + CLEARANCE,
            "sag": _SAG * self.mesh.d_hat,
        }
        try:
            return object_body(self.parts, self.scene.object, self._targets.rotations, **settings)
        except InputError as error:
            raise SpecError(
                error.rule, file=self.scene.source, key=error.name, value=error.value, choices=error.choices
            ) from error
