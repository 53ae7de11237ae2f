"""The soft pad: gel with contact, friction, large deformation, under driven or free bodies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Unpack

import numpy as np

from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface
from raytac.io.progress import Progress
from raytac.physics.base import PadReading
from raytac.physics.press import CLEARANCE, PressPad, PressSettings
from raytac.physics.soft.bodies import object_body
from raytac.physics.soft.coat_points import CoatTraction
from raytac.physics.soft.coat_state import CoatState
from raytac.physics.soft.mesh import PadMesh, pad_mesh
from raytac.physics.soft.placement import PressPlacement
from raytac.physics.soft.press_controller import PressController
from raytac.physics.soft.press_solver import PressSolver
from raytac.physics.soft.reading import SoftReader, SoftReading
from raytac.physics.soft.settings import DEFAULT_CONTROL, DEFAULT_CORRECTION, Correction, PressControl
from raytac.specs.press import PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

_SAG = 0.1
"""Largest depth of the object's facets below its true surface, in units of d̂."""


class SoftPad(PressPad):
    """Press scene on a sensor with a soft pad (docs/concepts/soft-pad.md); used as ``RigidPad``.

    Between readings the solver takes as many steps as it needs. An ``indent`` to a depth ends when the *coat* is at that depth:
    the barrier's clearance is added to the object's height; on the way the coat is there within some micrometres, and never deeper than
    the stage's end; in a shear, twist or tilt that follows, it stays there. A free object is laid down and comes to rest.

    The ``pad_from_object`` of a reading is where the object is shown: lowered by the barrier's clearance, so that it touches.

    Attributes:
        mesh: of the gel.
        solver: pad and object in the contact solver; None without an object.
    """

    def __init__(
        self,
        sensor: SensorSpec,
        scene: PressScene,
        *,
        level: str | PadMesh = "coarse",
        correction: Correction | None = DEFAULT_CORRECTION,
        control: PressControl = DEFAULT_CONTROL,
        device: str = "cpu",
        **settings: Unpack[PressSettings],
    ) -> None:
        """Mesh the pad, make the object's surface and put both into the solver.

        Args:
            level: a name of ``PAD_LEVELS``, or a mesh of the user's.
            correction, control: as in ``Ipc``.
            device: where the solver runs, ``cpu`` or ``cuda``.
            sensor, scene, settings: as of ``PressPad``.

        Raises:
            InputError: an unknown level; else as ``PressPad``.
            RaytacError: the object overlaps the pad where it starts.
        """
        super().__init__(sensor, scene, **settings)
        self.mesh = pad_mesh(sensor.gelpad, level)
        self._reader = SoftReader(self.mesh, sensor.gelpad, self.grid, correction)
        self._last: SoftReading | None = None
        self.solver: PressSolver | None = None
        self._drive: PressController | None = None
        self._bar = Progress(desc="press", show=False)
        if self.parts:
            self._places = PressPlacement(scene, self.parts, sensor.gelpad, self.grid, self.targets)
            above = self._places.poses(
                np.full(self.num_envs, self.mesh.d_hat + CLEARANCE), np.zeros((self.num_envs, 2)), np.zeros((self.num_envs, 3))
            )
            self.solver = PressSolver(sensor, self.mesh, self._body(), above, device, control)
            self._drive = PressController(scene, self.solver, self._reader, self._places, self.targets)

    def run(self, steps_per_stage: int = 1, *, progress: bool = False) -> Iterator[PadReading]:
        """Readings as of ``PressPad``; ``progress`` shows the solver's steps and the stage."""
        with Progress(desc=f"press {self.scene.name}", unit="step", show=progress, leave=False) as bar:
            self._bar = bar
            if self._drive is not None:
                self._drive.bar = bar
            yield from super().run(steps_per_stage)

    def follow(self, stage: StageSpec, steps: int = 1) -> Iterator[PadReading]:
        """Readings along one more stage, as of ``PressPad``.

        Raises ``InputError``: also for a stage deeper, or tilted farther, than any of the scene's: there the object's surface was left out.
        """
        if stage.kind == "indent" and (stage.depth or self.sensor.gelpad.thickness) > self._deepest:
            rule = f"must not go deeper than the scene's deepest stage, {self._deepest * 1e3:.4g} mm (a force may go as deep as the pad)"
            raise InputError("stage", value=stage, rule=rule)
        if math.hypot(*stage.tilt) > self._widest + 1e-12:
            rule = f"must not tilt farther than any of the scene's stages, {math.degrees(self._widest):.4g}°"
            raise InputError("stage", value=stage, rule=rule)
        yield from super().follow(stage, steps)

    def reset(self) -> None:
        self._last = None
        if self._drive is not None:
            self._drive.reset()

    def begin(self, index: int, stage: StageSpec, steps: int) -> None:
        assert self._drive is not None
        self._bar.set_postfix_str(f"stage {index + 1} of {len(self.scene.trajectory)}: {stage.kind}")
        self._drive.begin(index, stage)

    def advance(self, stage: StageSpec, fraction: float) -> None:
        assert self._drive is not None
        self._drive.advance(stage, fraction)

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """As of ``PressPad``; a soft object is shown as it was at the last reading."""
        if surface.pad_from_object is not None and self.scene.object.dynamics == "soft" and self._last is not None:
            return self._last.underside
        return super().object_height(surface)

    def read(self) -> PadReading:
        batch, case, unconverged = self.num_envs, None, np.zeros(self.num_envs, int)
        if self._drive is None or self.solver is None:
            depth, poses = np.zeros(batch), np.tile(np.eye(4), (batch, 1, 1))
            coat = self._last = self._at_rest()
        else:
            coat = self._last = self._reader.read(self.solver.coat_state(self._drive.poses()), self._drive.failed)
            self._drive.failed = coat.failed
            self._drive.measured = coat.clearance
            poses, case, unconverged = coat.poses[0], self._drive.case(), self.solver.unconverged.copy()
            depth = np.where(coat.failed, np.nan, self._places.origin[:, 2] - poses[:, 2, 3])
        case = np.tile(np.eye(4), (batch, 1, 1)) if case is None else case
        case[coat.failed] = np.nan
        torque = np.cross(coat.vertices, coat.forces).sum(axis=1)
        return PadReading(
            coat.surface,
            np.concatenate([coat.forces.sum(axis=1), torque], axis=1),
            coat.failed.copy(),
            lambda _: self._traction(coat.forces),
            unconverged=unconverged,
            pad_from_object=poses,
            world_from_pad=case,
            depth=depth,
            solved=coat,
        )

    @cached_property
    def _traction(self) -> CoatTraction:
        return CoatTraction(self.mesh.coat, self.grid)

    def _at_rest(self) -> SoftReading:
        """The coat without an object."""
        vertices = np.repeat(self.mesh.coat.rest[None], self.num_envs, axis=0)
        return self._reader.read(CoatState.of(vertices, np.zeros_like(vertices)), np.zeros(self.num_envs, bool))

    @property
    def _deepest(self) -> float:
        """Depth that the object's surface was made for [m]; a force may go as deep as the pad."""
        deepest = max((stage.depth or self.sensor.gelpad.thickness for stage in self.scene.trajectory), default=0.0)
        depths = self.targets.depths
        return deepest if depths is None else max(deepest, float(np.nanmax(depths, initial=0.0)))

    @property
    def _widest(self) -> float:
        """Tilt that the object's surface was made for [rad]."""
        return max((math.hypot(*stage.tilt) for stage in self.scene.trajectory), default=0.0)

    def _body(self):
        settings = {
            "weight": max((stage.force or 0.0 for stage in self.scene.trajectory), default=0.0),
            "edge_length": 0.75 * float(np.diff(self.mesh.coat.lines_x).mean()),
            "lowest": self._deepest + float(np.ptp(self.grid.rest)) + CLEARANCE,
            "tilt": self._widest,
            "sag": _SAG * self.mesh.d_hat,
        }
        try:
            return object_body(self.parts, self.scene.object, self.targets.rotations, **settings)
        except InputError as error:
            raise SpecError(
                error.rule, file=self.scene.source, key=error.name, value=error.value, choices=error.choices
            ) from error
