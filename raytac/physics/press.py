"""Pads of a press: targets by environment, checks of the trajectory, loop over its stages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Required, Unpack

import numpy as np

from raytac.checks import MOST_ENVIRONMENTS, check_numbers, check_whole
from raytac.errors import InputError, MeshError, SpecError
from raytac.gel.surface import GelSurface, make_grid
from raytac.physics.base import PadReading, TargetArrays
from raytac.physics.objects import object_parts
from raytac.se3 import rotation_of, rotations
from raytac.shapes.part import Part
from raytac.shapes.underside import object_height
from raytac.specs.press import PressScene, StageSpec
from raytac.specs.sensor import GelpadSpec, SensorSpec


class PressTargets:
    """Targets of B environments in a press: those given for each, and the scene's elsewhere.

    A number that is not finite marks its environment as ``lost``: it fails from the start.

    Attributes:
        offsets: added to the object's x, y [m], (B, 2).
        rotations: ``pad_from_object`` at zero twist, (B, 3, 3); that of the scene in an environment that is lost.
        depths: of every indent to a depth in place of the scene's [m], (B,); None leaves the scene's.
        lost: (B,), bool.
    """

    def __init__(
        self,
        scene: PressScene,
        num_envs: int,
        *,
        offsets: np.ndarray | None = None,
        depths: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        shears: np.ndarray | None = None,
        twists: np.ndarray | None = None,
    ) -> None:
        """Check shapes; None leaves what the scene has.

        Args:
            scene: gives the object's own rotation, which comes first.
            num_envs: number of environments B, at least 1.
            offsets: added to the object's x, y [m], (B, 2).
            depths: of every indent to a depth [m], (B,).
            rotations: turn of the object about its origin, axes of the pad frame, wxyz, of any length, (B, 4).
            shears, twists: target of every ``shear`` stage along x, y [m], (B, 2), and of every ``twist`` stage [rad], (B,).

        Raises:
            InputError: ``num_envs`` below 1, an argument of another shape, or a quaternion of zeros.
        """
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        given = {
            "offsets": (offsets, (num_envs, 2)),
            "depths": (depths, (num_envs,)),
            "shears": (shears, (num_envs, 2)),
            "twists": (twists, (num_envs,)),
            "rotations": (rotations, (num_envs, 4)),
        }
        own = {name: check_numbers(name, values, shape) for name, (values, shape) in given.items() if values is not None}
        self.lost = np.zeros(num_envs, bool)
        for values in own.values():
            self.lost |= ~np.isfinite(values.reshape(num_envs, -1)).all(axis=1)
        self.offsets, self.depths = own.get("offsets", np.zeros((num_envs, 2))), own.get("depths")
        self._own_targets = {"depth": self.depths, "shear": own.get("shears"), "twist": own.get("twists")}
        identity = np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, 1))
        quaternions = np.where(self.lost[:, None], identity, own.get("rotations", identity))
        zero = ~quaternions.any(axis=1)
        if zero.any():
            rule = f"must not be all 0, in environment {int(zero.argmax())}"
            raise InputError("rotations", value=quaternions[zero.argmax()].tolist(), rule=rule)
        self._scene, self._quaternions = scene, quaternions
        scene_rotation = _rotation(np.asarray(scene.object.quaternion, float))
        self.rotations = scene_rotation[None].repeat(num_envs, axis=0)
        if rotations is not None:
            self.rotations = np.stack([_rotation(quaternion) for quaternion in quaternions]) @ scene_rotation

    def stage(self, stage: StageSpec, b: int) -> StageSpec:
        """A stage as environment ``b`` runs it; the scene's own in an environment that is lost."""
        name = "depth" if stage.kind == "indent" else stage.kind
        values = self._own_targets.get(name)
        if values is None or self.lost[b] or getattr(stage, name) is None:
            return stage
        value = values[b].tolist()
        return replace(stage, **{name: tuple(value) if name == "shear" else value})

    def depth(self, stage: StageSpec) -> np.ndarray:
        """Final depth of an indent [m], (B,); 0 in a lost environment."""
        return self._final("depth", stage)

    def shear(self, stage: StageSpec) -> np.ndarray:
        """Final displacement of a shear [m], (B, 2); 0 in a lost environment."""
        return self._final("shear", stage)

    def twist(self, stage: StageSpec) -> np.ndarray:
        """Final angle of a twist [rad], (B,); 0 in a lost environment."""
        return self._final("twist", stage)

    def turn(self, stage: StageSpec, turn: np.ndarray) -> np.ndarray:
        """Turn (B, 3) [rad], as of ``turn_rotations``, at the end of a ``twist`` or ``tilt``.

        The other angles are those of ``turn`` (B, 3). In a lost environment the stage's own are 0.
        """
        final = turn.copy()
        if stage.kind == "twist":
            final[:, 2] = self.twist(stage)
        else:
            final[:, :2] = np.where(self.lost[:, None], 0.0, stage.tilt)
        return final

    def _final(self, name: str, stage: StageSpec) -> np.ndarray:
        values = self._own_targets[name]
        values = np.array([getattr(stage, name)] * len(self.lost)) if values is None else values
        return np.where(self.lost if values.ndim == 1 else self.lost[:, None], 0.0, values)

    def start_error(self, b: int, error: InputError) -> InputError | SpecError:
        """``error`` of environment ``b`` at its start, with the name of the target that caused it.

        That is a target of its own, or the scene's.
        """
        own = self._responsible(b, ())
        if own is not None:
            return InputError(own[0], value=own[1], rule=f"in environment {b}, at the start: {error.rule}")
        place = [float(f"{v * 1e3:.6g}") for v in self._scene.object.position[:2]]
        return SpecError(error.rule, file=self._scene.source, key="object.position_mm", value=place)

    def stage_error(self, index: int, stage: StageSpec, b: int, error: InputError) -> InputError | SpecError:
        """``error`` of environment ``b`` in a stage, with the name of the target that caused it.

        That is a target of its own, or the scene's. After a ``tilt``, which only the scene has, it is the scene's, and own targets are
        mentioned.

        Args:
            index: the stage's number in the scene, or −1. In a stage that is none of the scene's ``error`` stays as it is, unless a target
                of the environment's own caused it.
            stage: as environment ``b`` runs it.
            error: of a place (its ``rule`` is a sentence), or of a force or depth (its ``name`` is "force" or "depth [mm]", its rule lacks
                the subject).
        """
        trajectory = self._scene.trajectory
        stages = trajectory[: index + 1] if index >= 0 else (*trajectory, stage)
        kinds = [one.kind for one in reversed(stages)]
        since = kinds[: kinds.index("tilt")] if "tilt" in kinds else kinds
        own = self._responsible(b, since, has_start="tilt" not in kinds)
        noun, unit = error.name.split()[0], {"force": "N", "depth [mm]": "mm"}.get(error.name)
        kept = f"the {noun} kept here, {error.value:.4g} {unit}, " if unit and stage.kind != "indent" else ""
        if error.name == "depth [mm]" and stage.kind == "indent" and self.depths is not None:
            own = "depths [mm]", error.value
        if own is not None:
            name, value = own
            subject = kept or (f"the {noun}, {error.value:.4g} {unit}, " if unit and name != "depths [mm]" else "")
            where = f"trajectory[{index}]" if index >= 0 else f"a further {stage.kind}"
            return InputError(name, value=value, rule=f"in environment {b}, in {where}: {subject}{error.rule}")
        if index < 0:
            return error
        others = self._responsible(b, kinds) if "tilt" in kinds else None
        if others is None and "tilt" in kinds and self.depths is not None:
            others = "depths [mm]", float(f"{1e3 * self.depths[b]:.6g}")
        if others is not None:
            kept = f"in environment {b}, which has {others[0]} = {others[1]}: {kept}"
        if stage.kind == "shear":
            name, value = "shear_mm", [float(f"{v * 1e3:.6g}") for v in stage.shear]
        elif stage.kind == "twist":
            name, value = "twist_deg", float(f"{np.degrees(stage.twist):.6g}")
        elif stage.kind == "tilt":
            name, value = "tilt_deg", [float(f"{np.degrees(v):.6g}") for v in stage.tilt]
        else:
            name, value = {"depth [mm]": "depth_mm"}.get(error.name, "force_n"), error.value
        return SpecError(kept + error.rule, file=self._scene.source, key=f"trajectory[{index}].{name}", value=value)

    def _responsible(self, b: int, kinds: Iterable[str], *, has_start: bool = True) -> tuple[str, object] | None:
        """Name and value of the own target that put environment ``b`` where it is; None if none did.

        ``kinds``: of the stages so far, the last one first; before them come its offset and its rotation, unless ``has_start`` is false.
        """
        for kind in kinds:
            values = self._own_targets.get(kind)
            if values is not None:
                return f"{kind}s", values[b].tolist()
        if not has_start:
            return None
        if self.offsets[b].any():
            return "offsets", self.offsets[b].tolist()
        return ("rotations", self._quaternions[b].tolist()) if self._quaternions[b, 1:].any() else None


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a quaternion wxyz of any length but 0."""
    return rotation_of(quaternion / np.linalg.norm(quaternion))


TURNS = ("twist", "tilt")
"""Kinds of stage that turn the object."""


def turn_rotations(turn: np.ndarray) -> np.ndarray:
    """Rotations (…, 3, 3) of a ``turn`` (…, 3) [rad]: tilt along x and y, then twist about z."""
    return rotations(turn * (0.0, 0.0, 1.0)) @ rotations(turn * (1.0, 1.0, 0.0))


def twist_of(rotation: np.ndarray) -> np.ndarray:
    """Twist (…,) [rad] of ``turn_rotations`` (…, 3, 3), whatever the tilt before it.

    The upper 2 × 2 block of a tilt is symmetric, with positive eigenvalues below 90°: the twist is the rotation in that block's polar
    decomposition.
    """
    return np.arctan2(rotation[..., 1, 0] - rotation[..., 0, 1], rotation[..., 0, 0] + rotation[..., 1, 1])


CLEARANCE = 1e-3
"""Height above first touch [m] at which an object waits before a press, after a release."""
MOST_STEPS = 1_000_000
"""Most readings of one stage."""


def _check_trajectory(scene: PressScene, gelpad: GelpadSpec, parts: Sequence[Part], depths: np.ndarray | None) -> None:
    """Refuse stages and ``depths`` [m] that no pad of this thickness can follow."""
    thickness = gelpad.thickness
    within = f"must be > 0 and less than the pad's thickness, {thickness * 1e3:.4g} mm"
    if scene.trajectory and not parts:
        rule = "a scene without object must have no trajectory"
        raise SpecError(rule, file=scene.source, key="object.kind", value=scene.object.kind)
    for index, stage in enumerate(scene.trajectory):
        key = f"trajectory[{index}]"
        if stage.depth is not None and not 0.0 < stage.depth < thickness:
            raise SpecError(within, file=scene.source, key=f"{key}.depth_mm", value=stage.depth * 1e3)
    if depths is not None:
        bad = depths[np.isfinite(depths) & ~((depths > 0.0) & (depths < thickness))]
        if len(bad):
            raise InputError("depths [mm]", value=float(bad[0]) * 1e3, rule=within)


class PressSettings(TargetArrays, total=False):
    """Keyword arguments of ``PressPad``."""

    pitch: Required[float]
    num_envs: int


class PressPad(ABC):
    """Base of the pads of a press: the object before the gel, and the loop over the stages.

    A subclass says where a press starts (``reset``), how the object moves through a stage (``begin``, ``advance``) and what is then
    to be read (``read``).

    Attributes:
        sensor, scene, num_envs: as given.
        targets: what each environment does.
        grid: nodes of the surfaces.
        parts: shape of the object; empty without one.
    """

    def __init__(
        self, sensor: SensorSpec, scene: PressScene, *, pitch: float, num_envs: int = 1, **own: Unpack[TargetArrays]
    ) -> None:
        """Check the scene, and build grid and object.

        Args:
            pitch: spacing of the grid that surfaces are given on [m].
            own: targets of each environment, as ``PressTargets`` takes them; one that is not finite fails.

        Raises:
            InputError: arguments of the wrong shape, ``depths`` deeper than the pad.
            SpecError: the scene's object or trajectory is impossible; names the scene's file and key.
        """
        self.sensor, self.scene, self.num_envs = sensor, scene, num_envs
        self.targets = PressTargets(scene, num_envs, **own)
        self.grid = make_grid(sensor.gelpad, pitch)
        try:
            self.parts = object_parts(scene.object)
        except MeshError:  # names its own file
            raise
        except SpecError as error:
            raise SpecError(error.rule, file=scene.source, key=error.key, value=error.value, choices=error.choices) from error
        _check_trajectory(scene, sensor.gelpad, self.parts, self.targets.depths)
        self._has_started = False

    @abstractmethod
    def reset(self) -> None:
        """Forget all history: the pad at rest, the object ``CLEARANCE`` above it."""

    @abstractmethod
    def begin(self, index: int, stage: StageSpec, steps: int) -> None:
        """Prepare a stage of ``steps`` readings; ``index``: its number in the scene, or −1."""

    @abstractmethod
    def advance(self, stage: StageSpec, fraction: float) -> None:
        """Move the object to ``fraction`` of the stage that was begun last."""

    @abstractmethod
    def read(self) -> PadReading:
        """The pad as it is now; stage and scene are added by the loop over the stages."""

    def run(self, steps_per_stage: int = 1, *, progress: bool = False) -> Iterator[PadReading]:
        """Readings: one lifted by ``CLEARANCE``, then ``steps_per_stage`` through each stage.

        Targets are reached in straight lines. An ``indent`` to a depth moves the object there; one to a force pushes until the contact
        balances it, and keeps that force through a shear, twist or tilt that follows. A ``release`` lifts the object ``CLEARANCE`` above
        the gel. ``progress``: a pad that takes long shows a bar on a terminal.

        Raises:
            InputError: ``steps_per_stage`` below 1. An environment whose own target takes the object off the pad, or past the gel's bonded
                face; the error names target and environment.
            SpecError: the same by the scene's own depth, force, place, shear, twist or tilt; the error names the scene's file and key.
        """
        check_whole("steps_per_stage", steps_per_stage, 1, MOST_STEPS)
        self._start()
        yield self._reading(-1, "start", 1.0)
        for index, stage in enumerate(self.scene.trajectory):
            yield from self._through(index, stage, steps_per_stage)

    def follow(self, stage: StageSpec, steps: int = 1) -> Iterator[PadReading]:
        """Readings along one more stage, from wherever the pad is now.

        It is for a loop that decides step by step where to go next. A pad that was not run yet starts with the object above the gel. The
        readings are of no stage of the scene (their ``stage`` is −1). The object moves only as readings are taken. After any of them
        another stage may be followed from there.

        Raises:
            InputError: ``steps`` below 1, or a stage that presses deeper than the pad or takes the object off it.
            SpecError: a scene without object, or a stage that no pad can follow.
        """
        check_whole("steps", steps, 1, MOST_STEPS)
        _check_trajectory(replace(self.scene, trajectory=(stage,), source=None), self.sensor.gelpad, self.parts, None)
        if not self._has_started:
            self._start()
        yield from self._through(-1, stage, steps)

    def peak(self, readings: Iterable[PadReading]) -> PadReading:
        """First of ``readings`` at the end of the scene's peak stage, else the start; none after it."""
        for reading in readings:
            if reading.stage == self.scene.peak_stage and reading.fraction == 1.0:
                return reading
        raise InputError("readings", value=self.scene.peak_stage, rule="hold none at the end of the scene's peak stage")

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the object [m], (B, Ny, Nx), inf where it is not; None without an object."""
        if surface.pad_from_object is None:
            return None
        return object_height(self.parts, surface.pad_from_object, self.grid.x, self.grid.y)

    def _start(self) -> None:
        self.reset()
        self._has_started = True

    def _through(self, index: int, stage: StageSpec, steps: int) -> Iterator[PadReading]:
        self.begin(index, stage, steps)
        for step in range(1, steps + 1):
            self.advance(stage, step / steps)
            yield self._reading(index, stage.kind, step / steps)

    def _reading(self, index: int, kind: str, fraction: float) -> PadReading:
        reading = self.read()
        reading.stage, reading.kind, reading.fraction, reading.scene = index, kind, fraction, self.scene
        return reading
