"""The rigid pad: MuJoCo moves object or case, the contact's compliance ties depth to force, the gel's shape follows from geometry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from raytac.checks import check_whole
from raytac.errors import InputError, SpecError
from raytac.gel.pierced import without_pierced
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, make_grid
from raytac.gel.traction import foundation_traction
from raytac.physics.base import ContactState
from raytac.physics.press import (
    CLEARANCE,
    MOST_STEPS,
    PressTargets,
    about_z,
    check_trajectory,
    peak_state,
    scene_parts,
)
from raytac.physics.rigid.load_law import LoadLaw, first_touch
from raytac.physics.rigid.rig import PressRig
from raytac.shapes.underside import object_height
from raytac.specs.press import DYNAMICS, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

__all__ = ["CLEARANCE", "ContactState", "RigidPad"]


@dataclass
class _Environment:
    """What one environment remembers between stages."""

    origin: np.ndarray
    """Pad-frame position of the object's origin at first touch, zero shear and twist (3,) [m]."""
    rig: PressRig
    depth: float = -CLEARANCE
    force: float = 0.0
    by_force: bool = False
    shear: np.ndarray | None = None
    twist: float = 0.0
    stuck_shear: np.ndarray | None = None
    """Shear at which the contact carries no tangential force; None out of contact."""
    stuck_twist: float = 0.0
    failed: bool = False


class RigidPad:
    """Press scene on a sensor with the rigid pad (see docs/rigid-pad.md).

    .. code-block:: python

        pad = RigidPad(sensor, scene, pitch=0.1e-3)
        for state in pad.run():
            surface = pad.surface(state)
    """

    def __init__(
        self,
        sensor: SensorSpec,
        scene: PressScene,
        *,
        pitch: float,
        num_envs: int = 1,
        seed: int = 0,
        offsets: np.ndarray | None = None,
        depths: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        shears: np.ndarray | None = None,
        twists: np.ndarray | None = None,
    ) -> None:
        """Build the grid, the object and, with an object, one rig for every environment.

        Args:
            sensor: gives the gelpad.
            scene: object and trajectory.
            pitch: spacing of the pad's grid [m].
            num_envs: number of environments B.
            seed: accepted for symmetry with sampled physics; nothing here is random.
            offsets, depths, rotations, shears, twists: what environments do each in their own way, see ``PressTargets``; not finite:
                that environment fails.

        Raises:
            InputError: arguments of the wrong shape, ``depths`` deeper than the pad.
            SpecError: the scene's object or trajectory is impossible; names the scene's file and key.
        """
        self.sensor, self.scene, self.seed, self.num_envs = sensor, scene, seed, num_envs
        self._targets = PressTargets(
            scene, num_envs, offsets=offsets, depths=depths, rotations=rotations, shears=shears, twists=twists
        )
        if scene.object.dynamics == "soft":
            rule = "is for the simulated pad, physics='ipc': the rigid pad's object does not give way"
            choices = tuple(name for name in DYNAMICS if name != "soft")
            raise SpecError(rule, file=scene.source, key="object.dynamics", value="soft", choices=choices)
        self.grid = make_grid(sensor.gelpad, pitch)
        self.parts = scene_parts(scene)
        self._surround = ElasticSurround(self.grid)
        self._touches: dict[bytes, tuple[float, LoadLaw]] = {}
        self._environments: list[_Environment] = []
        """Where the last state left the object; empty before the first, and without an object."""
        self._last: tuple[ContactState, GelSurface] | None = None
        check_trajectory(scene, sensor.gelpad, self.parts, self._targets.depths)

    def run(self, steps_per_stage: int = 1) -> Iterator[ContactState]:
        """States along the trajectory: one before it (lifted by ``CLEARANCE``), then ``steps_per_stage`` through each stage.

        Targets are reached in straight lines. An ``indent`` to a depth moves the object there exactly; one to a force lets the
        drive push until the compliant contact balances it, and keeps that force through a shear or twist that follows. A
        ``release`` lifts the object ``CLEARANCE`` above the gel.

        Raises:
            InputError: ``steps_per_stage`` below 1.
            SpecError: a depth or force that would take the object's lowest point past the gel's bonded face, or an object that does not
                start over the pad or is sheared or twisted off it; names the scene's file and key.
            InputError: the same of an environment that is there by its own offset, rotation, shear or twist; names both.
        """
        check_whole("steps_per_stage", steps_per_stage, 1, MOST_STEPS)
        self._environments = [self._start(b) for b in range(self.num_envs)] if self.parts else []
        yield self._state(-1, "start", 1.0)
        for index, stage in enumerate(self.scene.trajectory):
            yield from self._through(index, stage, steps_per_stage)

    def follow(self, stage: StageSpec, steps: int = 1) -> Iterator[ContactState]:
        """States along one more stage, from wherever the pad is now: for a loop in which somebody else decides where to go next.

        A pad that was not run yet starts above the gel. The states are of no stage of the scene (their ``stage`` is −1). Nothing moves
        before the first state is asked for; who stops asking leaves the pad on the way, and may follow another stage from there.

        Raises:
            InputError: ``steps`` below 1, or a stage that presses deeper than the pad or takes the object off it.
            SpecError: a scene without object, or a stage that no pad can follow.
        """
        check_whole("steps", steps, 1, MOST_STEPS)
        check_trajectory(replace(self.scene, trajectory=(stage,), source=None), self.sensor.gelpad, self.parts, None)
        if not self._environments:
            self._environments = [self._start(b) for b in range(self.num_envs)]
        yield from self._through(-1, stage, steps)

    def peak(self, states: Iterable[ContactState]) -> ContactState:
        """First of ``states`` at the end of the scene's peak stage (the start, if it has none); later ones are not computed."""
        return peak_state(self.scene, states)

    def surface(self, state: ContactState) -> GelSurface:
        """Gel surface at a state; that of the last state asked for is kept, since wrench and traction need it again."""
        if self._last is None or self._last[0] is not state:
            self._last = state, self.surface_from_pose(state.pad_from_object)
        return self._last[1]

    def wrench(self, state: ContactState) -> np.ndarray:
        """Force of the object on the pad [N] and its torque about the pad frame's origin [N m], pad frame, shape (B, 6).

        The force acts at the contact's centre, at the height of the gel there; the twist torque is added.
        """
        surface = self.surface(state)
        force = np.concatenate([state.shear_force, -state.normal_force[:, None]], axis=1)
        at = np.zeros((len(force), 3))
        for b, (x, y) in enumerate(np.nan_to_num(surface.contact_centre)):
            node = np.abs(self.grid.y - y).argmin(), np.abs(self.grid.x - x).argmin()
            at[b] = x, y, surface.height[b][node]
        torque = np.cross(at, force)
        torque[:, 2] += state.twist_torque
        return np.concatenate([force, torque], axis=1)

    def traction(self, state: ContactState) -> np.ndarray:
        """Traction of the object on the pad [Pa], pad frame, shape (B, Ny, Nx, 3): a share of the contact's force (see the function)."""
        force = np.concatenate([state.shear_force, -state.normal_force[:, None]], axis=1)
        return foundation_traction(self.surface(state), force, state.twist_torque)

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the object at the surface's poses [m], shape (B, Ny, Nx), inf where it is not; None without an object."""
        if surface.pad_from_object is None:
            return None
        return object_height(self.parts, surface.pad_from_object, self.grid.x, self.grid.y)

    def surface_from_pose(self, pad_from_object: np.ndarray) -> GelSurface:
        """Gel surface with the object at given poses (B, 4, 4), for a loop in which another simulation moves it.

        A pose that is not finite, or that would press the gel below its bonded face, gives a surface of NaN. Raises ``InputError`` for
        another shape.
        """
        highest = float(self.grid.rest.max())
        height = object_height(self.parts, pad_from_object, self.grid.x, self.grid.y, below=highest)
        return without_pierced(self._surround.surface(height, pad_from_object if self.parts else None), self.sensor.gelpad)

    def _through(self, index: int, stage: StageSpec, steps: int) -> Iterator[ContactState]:
        """``steps`` states through a stage; ``index``: its number in the scene, −1 if it is none of the scene's."""
        before = [replace(e) for e in self._environments]
        for step in range(1, steps + 1):
            for b, (e, old) in enumerate(zip(self._environments, before, strict=True)):
                if not e.failed:
                    self._advance(e, old, index, stage, b, step / steps, steps)
            yield self._state(index, stage.kind, step / steps)

    def _start(self, b: int) -> _Environment:
        x, y = np.asarray(self.scene.object.position[:2]) + self._targets.offsets[b]
        if self._targets.lost[b]:
            return _Environment(np.full(3, np.nan), self._rig(1.0), failed=True)
        try:
            touch, law = self._touch(b, x, y, 0.0)
        except InputError as error:
            raise self._targets.start_error(b, error) from error
        stiffest = float((np.diff(law.table) / np.diff(law.depth)).max())
        e = _Environment(np.array([x, y, touch]), self._rig(stiffest), shear=np.zeros(2))
        e.rig.place(e.origin, touch)
        e.rig.hold(np.array([0.0, 0.0, CLEARANCE, 0.0]), law.secant_stiffness)
        return e

    def _rig(self, stiffest: float) -> PressRig:
        return PressRig(self.scene.object.mass, stiffest, self.scene.moves)

    def _touch(self, b: int, x: float, y: float, twist: float) -> tuple[float, LoadLaw]:
        """First-touch height of the object's origin and load law at a place and angle; kept, since environments share them."""
        pose = np.eye(4)
        pose[:3, :3] = about_z(twist) @ self._targets.rotations[b]
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            touch, pitch = first_touch(self.parts, pose, self.sensor.gelpad, self.grid), self.grid.pitch
            self._touches[key] = touch.z, LoadLaw(touch.gap, pitch[0] * pitch[1], self.sensor.gelpad, touch.deepest)
        return self._touches[key]

    def _advance(
        self, e: _Environment, old: _Environment, index: int, stage: StageSpec, b: int, fraction: float, steps: int
    ) -> None:
        """Bring one environment from where it was before a stage to ``fraction`` of it."""
        assert old.shear is not None
        stage = self._targets.stage(stage, b)
        previous_force = e.force
        assert e.shear is not None
        shear, twist = e.shear, e.twist
        if stage.kind == "shear":
            shear = old.shear + fraction * (np.asarray(stage.shear, float) - old.shear)
        elif stage.kind == "twist":
            twist = old.twist + fraction * (stage.twist - old.twist)
        try:
            touch, law = self._touch(b, e.origin[0] + shear[0], e.origin[1] + shear[1], twist)
        except InputError as error:
            raise self._targets.stage_error(index, stage, b, error) from error
        e.shear, e.twist = shear, twist
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
                raise self._targets.stage_error(index, stage, b, _too_deep(end, law.deepest + lift))
        if e.by_force:
            target = old.force + fraction * ((stage.force or old.force) - old.force)
            try:
                law.depth_at(target)
            except InputError as error:
                raise self._targets.stage_error(index, stage, b, error) from error
            e.rig.joints = np.array([*e.shear, -max(e.depth, lift), e.twist])
            settled = e.rig.load(previous_force, target, stage.duration / steps, law.secant_stiffness)
            e.failed = not settled
            e.depth = -float(e.rig.joints[2])
        if not e.failed:
            e.force = e.rig.hold(np.array([*e.shear, -e.depth, e.twist]), law.secant_stiffness)
            e.failed = not np.isfinite(e.force)
        self._stick(b, e)

    def _stick(self, b: int, e: _Environment) -> None:
        """Let the contact slip where the gel's elastic shear or twist would exceed Coulomb's limit."""
        assert e.shear is not None
        if e.force <= 0.0 or e.failed:
            e.stuck_shear = None
            return
        if e.stuck_shear is None:
            e.stuck_shear, e.stuck_twist = e.shear.copy(), e.twist
        _, law = self._touch(b, e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.twist)
        stretch, angle = e.shear - e.stuck_shear, e.twist - e.stuck_twist
        limit = self.sensor.gelpad.friction * e.force
        longest = limit / law.shear_stiffness(e.rig.depth)
        length = float(np.hypot(*stretch))
        if length > longest:
            e.stuck_shear = e.shear - stretch * (longest / length)
        widest = 3.0 * np.pi / 16.0 * limit * law.contact_radius(e.rig.depth) / law.twist_stiffness(e.rig.depth)
        if abs(angle) > widest:
            e.stuck_twist = e.twist - np.sign(angle) * widest

    def _state(self, stage: int, kind: str, fraction: float) -> ContactState:
        """The present state; an environment whose gel would lie below its bonded face fails."""
        state = self._present(stage, kind, fraction)
        # The gel moves by no more than the greatest overlap: one that is less than the pad's thinnest place cannot take it there.
        thinnest = self.sensor.gelpad.thickness + float(self.grid.rest.min())
        if any(e.rig.depth > thinnest and not e.failed for e in self._environments):
            pierced = np.isnan(self.surface(state).height).any(axis=(1, 2))
            if (pierced & ~state.failed).any():
                for b in np.flatnonzero(pierced).tolist():
                    self._environments[b].failed = True
                state = self._present(stage, kind, fraction)
        return state

    def _present(self, stage: int, kind: str, fraction: float) -> ContactState:
        batch, environments = self.num_envs, self._environments
        pose, case = np.tile(np.eye(4), (2, batch, 1, 1))
        depth, force, torque, area = np.zeros((4, batch))
        shear = np.zeros((batch, 2))
        failed = np.zeros(batch, bool)
        turns = np.tile(np.eye(4), (batch, 1, 1))
        turns[:, :3, :3] = self._targets.rotations
        for b, e in enumerate(environments):
            pose[b], case[b] = e.rig.pad_from_object @ turns[b], e.rig.world_from_pad
            depth[b], force[b] = e.depth, e.force
            if e.stuck_shear is not None and e.shear is not None:
                _, law = self._touch(b, e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.twist)
                shear[b] = law.shear_stiffness(e.rig.depth) * (e.shear - e.stuck_shear)
                area[b] = np.pi * law.contact_radius(e.rig.depth) ** 2
                torque[b] = law.twist_stiffness(e.rig.depth) * (e.twist - e.stuck_twist)
            if e.failed:
                failed[b] = True
                for array in (pose, case, depth, force, shear, torque, area):
                    array[b] = np.nan
        return ContactState(stage, kind, fraction, pose, case, depth, force, shear, torque, area, failed, self.scene)


def _too_deep(depth: float, deepest: float) -> InputError:
    rule = f"would press deeper than the pad is there: at most {deepest * 1e3:.5g} mm"
    return InputError("depth [mm]", value=float(f"{depth * 1e3:.6g}"), rule=rule)
