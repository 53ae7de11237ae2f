"""The rigid pad: MuJoCo moves object or case, the contact's compliance ties depth to force, the gel's shape follows from geometry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from raytac.errors import InputError, MeshError, SpecError
from raytac.gel.elastic import ElasticSurround
from raytac.gel.object_height import object_height
from raytac.gel.pad import make_grid
from raytac.gel.part import Part
from raytac.gel.surface import GelSurface
from raytac.physics.first_touch import first_touch_z, gap_at_touch
from raytac.physics.load_law import LoadLaw
from raytac.physics.objects import object_parts
from raytac.physics.rig import PressRig
from raytac.specs.press import MOVES, PressScene
from raytac.specs.press_file import STAGE_SCHEMA
from raytac.specs.sensor import SensorSpec

__all__ = ["CLEARANCE", "ContactState", "RigidPad"]

CLEARANCE = 1e-3
"""Height above first touch [m] at which an object waits before the press and after a release."""


@dataclass(frozen=True)
class ContactState:
    """B environments at one instant. Forces are those of the object on the gel, pad frame.

    pad_from_object, shape (B, 4, 4): pose of the object. world_from_pad, shape (B, 4, 4): pose of the case; the identity unless the
    scene moves it (world and pad frame are one at first touch). depth [m], (B,): travel below first touch at zero shear and twist;
    negative when lifted. normal_force [N], (B,): towards −z, >= 0. shear_force [N], (B, 2): along x and y. twist_torque [N m],
    (B,): about +z. force_law_area [m²], (B,): area of contact by the load law, which the forces follow. failed, (B,) bool: the
    state of this environment is not finite or did not settle (its pose is then NaN).
    """

    stage: int
    """Index in the trajectory; −1 before the first stage."""
    kind: str
    """Kind of that stage, or ``start``."""
    fraction: float
    """How much of the stage is done, in (0, 1]."""
    pad_from_object: np.ndarray
    world_from_pad: np.ndarray
    depth: np.ndarray
    normal_force: np.ndarray
    shear_force: np.ndarray
    twist_torque: np.ndarray
    force_law_area: np.ndarray
    failed: np.ndarray
    scene: PressScene | None = None
    """Scene that the object belongs to; None if it is not known."""


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
    ) -> None:
        """Build the grid, the object and, with an object, one rig for every environment.

        Args:
            sensor: gives the gelpad.
            scene: object and trajectory.
            pitch: spacing of the pad's grid [m].
            num_envs: number of environments B.
            seed: accepted for symmetry with sampled physics; nothing here is random.
            offsets: added to the object's x, y per environment [m], shape (B, 2). Not finite: that environment fails.
            depths: depth of every depth-driven indent per environment [m], shape (B,), in place of the scene's.

        Raises:
            InputError: arguments of the wrong shape, ``depths`` deeper than the pad.
            SpecError: the scene's object or trajectory is impossible; names the scene's file and key.
        """
        self.sensor, self.scene, self.seed, self.num_envs = sensor, scene, seed, num_envs
        if num_envs < 1:
            raise InputError("num_envs", value=num_envs, rule="must be a whole number >= 1")
        self.grid = make_grid(sensor.gelpad, pitch)
        self.parts = self._object_parts()
        self._surround = ElasticSurround(self.grid)
        self._offsets = _per_environment("offsets", offsets, (num_envs, 2))
        self._depths = None if depths is None else _per_environment("depths", depths, (num_envs,))
        self._rotation = _rotation(scene.object.quaternion)
        self._touches: dict[bytes, tuple[float, LoadLaw]] = {}
        self._check_trajectory()

    def run(self, steps_per_stage: int = 1) -> Iterator[ContactState]:
        """States along the trajectory: one before it (lifted by ``CLEARANCE``), then ``steps_per_stage`` through each stage.

        Targets are reached in straight lines. An ``indent`` to a depth moves the object there exactly; one to a force lets the
        drive push until the compliant contact balances it, and keeps that force through a shear or twist that follows. A
        ``release`` lifts the object ``CLEARANCE`` above the gel.

        Raises:
            InputError: ``steps_per_stage`` below 1.
            SpecError: a force that would press deeper than the pad, or an object that does not start over the pad or is sheared or
                twisted off it; names the scene's file and key.
        """
        if steps_per_stage < 1:
            raise InputError("steps_per_stage", value=steps_per_stage, rule="must be a whole number >= 1")
        environments = [self._start(b) for b in range(self.num_envs)] if self.parts else []
        yield self._state(-1, "start", 1.0, environments)
        for index, stage in enumerate(self.scene.trajectory):
            before = [replace(e) for e in environments]
            for step in range(1, steps_per_stage + 1):
                for b, (e, old) in enumerate(zip(environments, before, strict=True)):
                    if not e.failed:
                        self._advance(e, old, index, b, step / steps_per_stage, steps_per_stage)
                yield self._state(index, stage.kind, step / steps_per_stage, environments)

    def peak(self, states: Iterable[ContactState]) -> ContactState:
        """First of ``states`` at the end of the scene's peak stage (the start, if it has none); later ones are not computed."""
        for state in states:
            if state.stage == self.scene.peak_stage and state.fraction == 1.0:
                return state
        raise InputError("states", value=self.scene.peak_stage, rule="hold no state at the end of the scene's peak stage")

    def surface(self, state: ContactState) -> GelSurface:
        """Gel surface at a state."""
        return self.surface_from_pose(state.pad_from_object)

    def surface_from_pose(self, pad_from_object: np.ndarray) -> GelSurface:
        """Gel surface with the object at given poses (B, 4, 4), for a loop in which another simulation moves it.

        A pose that is not finite gives a surface of NaN. Raises ``InputError`` for another shape.
        """
        highest = float(self.grid.rest.max())
        height = object_height(self.parts, pad_from_object, self.grid.x, self.grid.y, below=highest)
        return self._surround.surface(height, pad_from_object if self.parts else None)

    def _object_parts(self) -> tuple[Part, ...]:
        try:
            return object_parts(self.scene.object)
        except MeshError:  # names its own file
            raise
        except SpecError as error:
            raise SpecError(
                error.rule, file=self.scene.source, key=error.key, value=error.value, choices=error.choices
            ) from error

    def _check_trajectory(self) -> None:
        if self.scene.moves not in MOVES:
            raise SpecError("must be a known side", file=self.scene.source, key="moves", value=self.scene.moves, choices=MOVES)
        thickness = self.sensor.gelpad.thickness
        within = f"must be > 0 and less than the pad's thickness, {thickness * 1e3:.4g} mm"
        if self.scene.trajectory and not self.parts:
            rule = "a scene without object must have no trajectory"
            raise SpecError(rule, file=self.scene.source, key="object.kind", value=self.scene.object.kind)
        for index, stage in enumerate(self.scene.trajectory):
            key = f"trajectory[{index}]"
            if stage.kind not in STAGE_SCHEMA:
                choices = tuple(STAGE_SCHEMA)
                raise SpecError("unknown stage", file=self.scene.source, key=f"{key}.kind", value=stage.kind, choices=choices)
            if stage.kind != "indent":
                continue
            if (stage.depth is None) == (stage.force is None):
                raise SpecError(
                    "needs exactly one of depth and force", file=self.scene.source, key=key, value=(stage.depth, stage.force)
                )
            if stage.depth is not None and not 0.0 < stage.depth < thickness:
                raise SpecError(within, file=self.scene.source, key=f"{key}.depth_mm", value=stage.depth * 1e3)
            if stage.force is not None and not 0.0 < stage.force < np.inf:
                raise SpecError("must be finite and > 0 [N]", file=self.scene.source, key=f"{key}.force_n", value=stage.force)
        if self._depths is not None:
            bad = self._depths[np.isfinite(self._depths) & ~((self._depths > 0.0) & (self._depths < thickness))]
            if len(bad):
                raise InputError("depths [mm]", value=float(bad[0]) * 1e3, rule=within)

    def _start(self, b: int) -> _Environment:
        x, y = np.asarray(self.scene.object.position[:2]) + self._offsets[b]
        if not np.isfinite([x, y]).all() or (self._depths is not None and not np.isfinite(self._depths[b])):
            return _Environment(np.full(3, np.nan), self._rig(1.0), failed=True)
        try:
            touch, law = self._touch(x, y, 0.0)
        except InputError as error:
            place = [float(f"{v * 1e3:.6g}") for v in (x, y)]
            raise SpecError(error.rule, file=self.scene.source, key="object.position_mm", value=place) from error
        stiffest = float((np.diff(law.table) / np.diff(law.depth)).max())
        e = _Environment(np.array([x, y, touch]), self._rig(stiffest), shear=np.zeros(2))
        e.rig.place(e.origin, touch)
        e.rig.hold(np.array([0.0, 0.0, CLEARANCE, 0.0]), law.secant_stiffness)
        return e

    def _rig(self, stiffest: float) -> PressRig:
        return PressRig(self.scene.object.mass, stiffest, self.scene.moves)

    def _stage_error(self, index: int, error: InputError) -> SpecError:
        """``error`` of a stage, under the file and key that asked for it, in the unit of the file."""
        stage = self.scene.trajectory[index]
        if stage.kind == "shear":
            name, value = "shear_mm", [float(f"{v * 1e3:.6g}") for v in stage.shear]
        elif stage.kind == "twist":
            name, value = "twist_deg", float(f"{np.degrees(stage.twist):.6g}")
        else:
            name, value = "force_n", error.value
        kept = f"the force kept here, {error.value:.4g} N, " if error.name == "force" and stage.kind != "indent" else ""
        return SpecError(kept + error.rule, file=self.scene.source, key=f"trajectory[{index}].{name}", value=value)

    def _touch(self, x: float, y: float, twist: float) -> tuple[float, LoadLaw]:
        """First-touch height of the object's origin and load law at a place and angle; kept, since environments share them."""
        pose = np.eye(4)
        pose[:3, :3] = _about_z(twist) @ self._rotation
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            pose[2, 3] = first_touch_z(self.parts, pose, self.sensor.gelpad, self.grid)
            gap = gap_at_touch(self.parts, pose, self.grid)
            pitch = self.grid.pitch
            self._touches[key] = float(pose[2, 3]), LoadLaw(gap, pitch[0] * pitch[1], self.sensor.gelpad)
        return self._touches[key]

    def _advance(self, e: _Environment, old: _Environment, index: int, b: int, fraction: float, steps: int) -> None:
        """Bring one environment from where it was before stage ``index`` to ``fraction`` of it."""
        assert old.shear is not None
        stage = self.scene.trajectory[index]
        previous_force = e.force
        if stage.kind == "shear":
            e.shear = old.shear + fraction * (np.asarray(stage.shear, float) - old.shear)
        elif stage.kind == "twist":
            e.twist = old.twist + fraction * (stage.twist - old.twist)
        elif stage.kind == "indent":
            e.by_force = stage.force is not None
        assert e.shear is not None
        try:
            touch, law = self._touch(e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.twist)
        except InputError as error:
            raise self._stage_error(index, error) from error
        e.rig.place(e.origin, touch)
        lift = e.origin[2] - touch
        if stage.kind == "release":
            e.by_force = False
            e.depth = old.depth + fraction * (lift - CLEARANCE - old.depth)
        elif stage.kind == "indent" and stage.depth is not None:
            target = stage.depth if self._depths is None else float(self._depths[b])
            e.depth = max(old.depth, 0.0) + fraction * (target - max(old.depth, 0.0))
        if e.by_force:
            target = old.force + fraction * ((stage.force or old.force) - old.force)
            try:
                law.depth_at(target)
            except InputError as error:
                raise self._stage_error(index, error) from error
            e.rig.joints = np.array([*e.shear, -max(e.depth, lift), e.twist])
            settled = e.rig.load(previous_force, target, stage.duration / steps, law.secant_stiffness)
            e.failed = not settled
            e.depth = -float(e.rig.joints[2])
        if not e.failed:
            e.force = e.rig.hold(np.array([*e.shear, -e.depth, e.twist]), law.secant_stiffness)
            e.failed = not np.isfinite(e.force)
        self._stick(e)

    def _stick(self, e: _Environment) -> None:
        """Let the contact slip where the gel's elastic shear or twist would exceed Coulomb's limit."""
        assert e.shear is not None
        if e.force <= 0.0 or e.failed:
            e.stuck_shear = None
            return
        if e.stuck_shear is None:
            e.stuck_shear, e.stuck_twist = e.shear.copy(), e.twist
        _, law = self._touch(e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.twist)
        stretch, angle = e.shear - e.stuck_shear, e.twist - e.stuck_twist
        limit = self.sensor.gelpad.friction * e.force
        longest = limit / law.shear_stiffness(e.rig.depth)
        length = float(np.hypot(*stretch))
        if length > longest:
            e.stuck_shear = e.shear - stretch * (longest / length)
        widest = 3.0 * np.pi / 16.0 * limit * law.contact_radius(e.rig.depth) / law.twist_stiffness(e.rig.depth)
        if abs(angle) > widest:
            e.stuck_twist = e.twist - np.sign(angle) * widest

    def _state(self, stage: int, kind: str, fraction: float, environments: list[_Environment]) -> ContactState:
        batch = self.num_envs
        pose, case = np.tile(np.eye(4), (2, batch, 1, 1))
        depth, force, torque, area = np.zeros((4, batch))
        shear = np.zeros((batch, 2))
        failed = np.zeros(batch, bool)
        turn = np.eye(4)
        turn[:3, :3] = self._rotation
        for b, e in enumerate(environments):
            pose[b], case[b] = e.rig.pad_from_object @ turn, e.rig.world_from_pad
            depth[b], force[b] = e.depth, e.force
            if e.stuck_shear is not None and e.shear is not None:
                _, law = self._touch(e.origin[0] + e.shear[0], e.origin[1] + e.shear[1], e.twist)
                shear[b] = law.shear_stiffness(e.rig.depth) * (e.shear - e.stuck_shear)
                area[b] = np.pi * law.contact_radius(e.rig.depth) ** 2
                torque[b] = law.twist_stiffness(e.rig.depth) * (e.twist - e.stuck_twist)
            if e.failed:
                failed[b] = True
                for array in (pose, case, depth, force, shear, torque, area):
                    array[b] = np.nan
        return ContactState(stage, kind, fraction, pose, case, depth, force, shear, torque, area, failed, self.scene)


def _per_environment(name: str, values: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    array = np.zeros(shape) if values is None else np.asarray(values, float)
    if array.shape != shape:
        raise InputError(name, value=array.shape, rule=f"must have shape {shape}")
    return array


def _rotation(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    """Rotation matrix (3, 3) of a quaternion wxyz of any length > 0."""
    q = np.asarray(quaternion, float)
    if not np.isfinite(q).all() or np.linalg.norm(q) == 0.0:
        raise SpecError("must be four finite numbers, not all 0", key="object.quaternion_wxyz", value=quaternion)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
