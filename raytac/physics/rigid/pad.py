"""The rigid pad: depth and force by the load law in MuJoCo, the gel's shape by geometry."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Unpack

import numpy as np

from raytac.errors import InputError, SpecError
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface
from raytac.gel.traction import foundation_traction
from raytac.physics.base import PadReading
from raytac.physics.press import CLEARANCE, TURNS, PressPad, PressSettings, turn_rotations
from raytac.physics.rigid.load_law import LoadLaw, first_touch, too_deep
from raytac.physics.rigid.rig import PressRig
from raytac.shapes.underside import object_height
from raytac.specs.press import DYNAMICS, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec


@dataclass
class _Environment:
    """State of one environment between stages."""

    origin: np.ndarray
    """Pad-frame position of the object's origin at first touch, zero shear and turn (3,) [m]."""
    rig: PressRig
    depth: float = -CLEARANCE
    force: float = 0.0
    by_force: bool = False
    shear: np.ndarray | None = None
    turn: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """As of ``turn_rotations`` [rad]."""
    slid: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Path along x and y of the object's matter at the contact [m]; 0 for a ball that rolls."""
    stuck_slid: np.ndarray | None = None
    """``slid`` at which the contact carries no tangential force; None out of contact."""
    stuck_twist: float = 0.0
    failed: bool = False


class RigidPad(PressPad):
    """Press scene on a sensor with the rigid pad (see docs/concepts/rigid-pad.md).

    .. code-block:: python

        pad = RigidPad(sensor, scene, pitch=0.1e-3)
        for reading in pad.run():
            surface = reading.surface

    An ``indent`` to a depth moves the object there exactly; one to a force lets the drive push until the compliant contact balances it.
    """

    def __init__(self, sensor: SensorSpec, scene: PressScene, **settings: Unpack[PressSettings]) -> None:
        """Build the grid, the object and the surround; ``settings`` and errors as of ``PressPad``."""
        if scene.object.dynamics == "soft":
            rule = "is for the soft pad, physics='ipc': the rigid pad's object does not give way"
            choices = tuple(name for name in DYNAMICS if name != "soft")
            raise SpecError(rule, file=scene.source, key="object.dynamics", value="soft", choices=choices)
        super().__init__(sensor, scene, **settings)
        self._surround = ElasticSurround(self.grid, thickness=sensor.gelpad.thickness)
        self._touches: dict[bytes, tuple[float, LoadLaw, float]] = {}
        self._environments: list[_Environment] = []
        """State of every environment at the last reading; empty before, and without an object."""
        self._begun: tuple[int, int, list[_Environment]] = -1, 1, []
        """Index and readings of the last stage begun, and the environments before it."""

    def reset(self) -> None:
        self._environments = [self._start_of(b) for b in range(self.num_envs)] if self.parts else []

    def begin(self, index: int, stage: StageSpec, steps: int) -> None:
        self._begun = index, steps, [replace(e) for e in self._environments]

    def advance(self, stage: StageSpec, fraction: float) -> None:
        index, steps, before = self._begun
        for b, (e, old) in enumerate(zip(self._environments, before, strict=True)):
            if not e.failed:
                self._advance(e, old, index, stage, b, fraction, steps)

    def read(self) -> PadReading:
        """The present reading; an environment whose gel would lie below its bonded face fails."""
        reading = self._present()
        # The gel moves by no more than the greatest overlap: one that is less than the pad's thinnest place cannot take it there.
        thinnest = self.sensor.gelpad.thickness + float(self.grid.rest.min())
        if any(e.rig.depth > thinnest and not e.failed for e in self._environments):
            pierced = np.isnan(reading.surface.height).any(axis=(1, 2))
            if (pierced & ~reading.failed).any():
                for b in np.flatnonzero(pierced).tolist():
                    self._environments[b].failed = True
                reading = self._present()
        return reading

    def surface_from_pose(self, pad_from_object: np.ndarray) -> GelSurface:
        """Gel surface with the object at poses (B, 4, 4), for a loop that moves it.

        A pose that is not finite, or that would press the gel below its bonded face, gives a surface of NaN. Raises ``InputError`` for
        another shape.
        """
        highest = float(self.grid.rest.max())
        height = object_height(self.parts, pad_from_object, self.grid.x, self.grid.y, below=highest)
        return self._surround.surface(height, pad_from_object if self.parts else None)

    def _start_of(self, b: int) -> _Environment:
        x, y = np.asarray(self.scene.object.position[:2]) + self.targets.offsets[b]
        if self.targets.lost[b]:
            return _Environment(np.full(3, np.nan), self._rig(1.0), failed=True)
        try:
            touch, law, _ = self._touch(b, x, y, np.zeros(3))
        except InputError as error:
            raise self.targets.start_error(b, error) from error
        stiffest = law.stiffest(max((stage.force or 0.0 for stage in self.scene.trajectory), default=0.0))
        e = _Environment(np.array([x, y, touch]), self._rig(stiffest), shear=np.zeros(2))
        e.rig.place(e.origin, touch)
        e.rig.hold(np.array([0.0, 0.0, CLEARANCE, 0.0]), law.secant_stiffness)
        return e

    def _rig(self, stiffest: float) -> PressRig:
        return PressRig(self.scene.object.mass, stiffest, self.scene.moves)

    def _touch(self, b: int, x: float, y: float, turn: np.ndarray) -> tuple[float, LoadLaw, float]:
        """First-touch height of the object's origin, load law and lever at a place and turn; cached."""
        pose = np.eye(4)
        pose[:3, :3] = turn_rotations(turn) @ self.targets.rotations[b]
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            touch = first_touch(self.parts, pose, self.sensor.gelpad, self.grid)
            law = LoadLaw(touch.gap, self.grid.x, self.grid.y, self.sensor.gelpad, touch.deepest)
            self._touches[key] = touch.z, law, touch.lever
        return self._touches[key]

    def _advance(
        self, e: _Environment, old: _Environment, index: int, stage: StageSpec, b: int, fraction: float, steps: int
    ) -> None:
        """Bring one environment from where it was before a stage to ``fraction`` of it."""
        assert old.shear is not None
        stage = self.targets.stage(stage, b)
        previous_force = e.force
        assert e.shear is not None
        shear, turn = e.shear, e.turn
        if stage.kind == "shear":
            shear = old.shear + fraction * (np.asarray(stage.shear, float) - old.shear)
        elif stage.kind in TURNS:
            end = (*old.turn[:2], stage.twist) if stage.kind == "twist" else (*stage.tilt, old.turn[2])
            turn = old.turn + fraction * (np.array(end) - old.turn)
        try:
            touch, law, lever = self._touch(b, e.origin[0] + shear[0], e.origin[1] + shear[1], turn)
        except InputError as error:
            raise self.targets.stage_error(index, stage, b, error) from error
        # The matter that touches first stands for the contact; its rim is nearer the origin's height, by the depth at most.
        tilted = turn_rotations(np.array([0.0, 0.0, turn[2]]))[:2, :2] @ (turn - e.turn)[:2]
        e.slid = e.slid + shear - e.shear + lever * np.array([-tilted[1], tilted[0]])
        e.shear, e.turn = shear, turn
        if stage.kind == "indent":
            e.by_force = stage.force is not None
        e.rig.place(e.origin, touch)
        lift = e.origin[2] - touch
        if stage.kind == "release":
            e.by_force = False
            e.depth = old.depth + fraction * (lift - CLEARANCE - old.depth)
        elif stage.kind == "indent" and stage.depth is not None:
            e.depth = max(old.depth, 0.0) + fraction * (stage.depth - max(old.depth, 0.0))
        if not e.by_force and stage.kind != "release":
            end = stage.depth if stage.kind == "indent" and stage.depth is not None else e.depth
            if end - lift > law.deepest:
                raise self.targets.stage_error(index, stage, b, too_deep(end, law.deepest + lift))
        if e.by_force:
            target = old.force + fraction * ((stage.force or old.force) - old.force)
            try:
                law.depth_at(target)
            except InputError as error:
                raise self.targets.stage_error(index, stage, b, error) from error
            e.rig.joints = np.array([*e.shear, -max(e.depth, lift), e.turn[2]])
            settled = e.rig.load(previous_force, target, stage.duration / steps, law.secant_stiffness)
            e.failed = not settled
            e.depth = -float(e.rig.joints[2])
        if not e.failed:
            e.force = e.rig.hold(np.array([*e.shear, -e.depth, e.turn[2]]), law.secant_stiffness)
            e.failed = not np.isfinite(e.force)
        self._stick(b, e)

    def _stick(self, b: int, e: _Environment) -> None:
        """Let the contact slip where the gel's elastic shear or twist would exceed Coulomb's limit."""
        assert e.shear is not None
        if e.force <= 0.0 or e.failed:
            e.stuck_slid = None
            return
        if e.stuck_slid is None:
            e.stuck_slid, e.stuck_twist = e.slid.copy(), e.turn[2]
        _, law, _ = self._touch(b, e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.turn)
        stretch, angle = e.slid - e.stuck_slid, e.turn[2] - e.stuck_twist
        limit = self.sensor.gelpad.friction * e.force
        longest = limit / law.shear_stiffness(e.rig.depth)
        length = float(np.hypot(*stretch))
        if length > longest:
            e.stuck_slid = e.slid - stretch * (longest / length)
        widest = 3.0 * np.pi / 16.0 * limit * law.contact_radius(e.rig.depth) / law.twist_stiffness(e.rig.depth)
        if abs(angle) > widest:
            e.stuck_twist = e.turn[2] - np.sign(angle) * widest

    def _present(self) -> PadReading:
        batch, environments = self.num_envs, self._environments
        pose, case = np.tile(np.eye(4), (2, batch, 1, 1))
        depth, torque, area = np.zeros((3, batch))
        force = np.zeros((batch, 3))
        failed = np.zeros(batch, bool)
        for b, e in enumerate(environments):
            pose[b], case[b] = e.rig.pad_from_object, e.rig.world_from_pad
            tilt = turn_rotations(e.turn * (1.0, 1.0, 0.0))
            pose[b, :3, :3] = pose[b, :3, :3] @ tilt @ self.targets.rotations[b]
            if self.scene.moves == "case" and e.turn[:2].any():
                case[b, :3, :3] = tilt.T @ case[b, :3, :3]
                case[b, :3, 3] = e.origin + tilt.T @ (case[b, :3, 3] - e.origin)
            depth[b], force[b, 2] = e.depth, -e.force
            if e.stuck_slid is not None and e.shear is not None:
                _, law, _ = self._touch(b, e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.turn)
                force[b, :2] = law.shear_stiffness(e.rig.depth) * (e.slid - e.stuck_slid)
                area[b] = law.contact_area(e.rig.depth)
                torque[b] = law.twist_stiffness(e.rig.depth) * (e.turn[2] - e.stuck_twist)
            if e.failed:
                failed[b] = True
                for array in (pose, case, depth, force, torque, area):
                    array[b] = np.nan
        return PadReading(
            lambda: self.surface_from_pose(pose),
            lambda surface: _wrench(surface, force, torque),
            failed,
            lambda surface: foundation_traction(surface, force, torque),
            pad_from_object=pose,
            world_from_pad=case,
            depth=depth,
            force_law_area=area,
        )


def _wrench(surface: GelSurface, force: np.ndarray, twist_torque: np.ndarray) -> np.ndarray:
    """Wrench (B, 6) of a force (B, 3) at the contact's centre on the gel and a torque about z."""
    grid, at = surface.grid, np.zeros((len(force), 3))
    for b, (x, y) in enumerate(np.nan_to_num(surface.contact_centre)):
        node = np.abs(grid.y - y).argmin(), np.abs(grid.x - x).argmin()
        at[b] = x, y, surface.height[b][node]
    torque = np.cross(at, force)
    torque[:, 2] += twist_torque
    return np.concatenate([force, torque], axis=1)
