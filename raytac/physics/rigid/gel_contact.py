"""Contact of all gels of a world in one step, on the CPU: the kernels from the bodies' motion to the rows, and from forces to the shear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.physics.rigid import world_kernels as world
from raytac.physics.rigid.load_law import shear_modulus
from raytac.physics.rigid.motion_kernels import Frames, move_bodies, pair_of_gels
from raytac.physics.rigid.row_kernels import number_rows, read_rows, set_rows, sum_wrenches
from raytac.physics.rigid.search import PadSearch
from raytac.physics.rigid.shear_state import ShearState
from raytac.physics.rigid.step_kernels import approach, choose_steps
from raytac.physics.rigid.warp_cache import start_warp
from raytac.shapes.part import Part
from raytac.shapes.primitives import bounds
from raytac.shapes.underside import object_radius
from raytac.specs.sensor import GelpadSpec

_SHORTEST = 1e-6
"""Steps are not shorter than this, or half of it [s]."""


@dataclass(frozen=True)
class Bodies:
    """What the pads of a model may touch, and what carries them."""

    parts: Sequence[Sequence[Part]]
    """Of every body, body frame."""
    index: np.ndarray
    """Of each body in the model, (bodies,)."""
    carrier: np.ndarray
    """Body of the model that carries each pad, (pads,)."""
    mass_centre: np.ndarray
    """In the frame of what is touched, (bodies + pads, 3)."""
    case_centre: np.ndarray
    """Of the case behind each gel, pad frame, (pads, 3)."""
    case_half: np.ndarray


class GelContact:
    """Contacts of B environments with gels.

    ``begin`` and ``end`` work on the first n rows of the arrays, the environments that ``rows`` names. Between both MuJoCo takes the step.

    Attributes:
        ticks: parts of the scene's step, the length of the shortest one.
        frames: frames and velocities of n environments, which ``begin`` reads.
        steps, slots: the environments and the contacts of the step.
        force, velocity: of the rows at the end of the step, (B, pads, bodies + pads, ROWS), which ``end`` reads.
        before: ``pad_from_body`` (B, pads, bodies, 4, 4) at the last step; NaN where unknown.
        wrench: on the pads (B, pads, 6).
        acceleration: at which contacts closed faster in their last step [m/s²], (B, pads, bodies + pads).
        shear: of the gels.
    """

    def __init__(
        self,
        gels: Sequence[GelpadSpec],
        bodies: Bodies,
        pairs: Sequence[tuple[int, int, PadSearch]],
        numbers: Mapping[str, np.ndarray],
        *,
        num_envs: int,
        timestep: float,
        fall: float,
        case_travel: float,
    ) -> None:
        """Make the arrays.

        Args:
            gels, bodies: of the world.
            pairs: two gels that may touch, and the search for that.
            numbers: those of ``Differences`` that environments may change, (B, …); the arrays themselves are read in every step.
            num_envs: B.
            timestep: the scene's step [s].
            fall: acceleration [m/s²] that may close a gap on top of its speed.
            case_travel: greatest travel of a body beside a case in a step [m].
        """
        start_warp()
        count = len(bodies.parts)
        self.ticks = 2 ** max(int(np.ceil(np.log2(timestep / _SHORTEST))), 0)
        self._count, self._pads = count, len(gels)
        self.search = PadSearch(gels, bodies.parts, num_envs=num_envs)
        self._pairs = tuple(pairs)
        self._gels, self._touched = _gels(gels, bodies), _touched(bodies)
        self._numbers: Any = world.Differences()
        for name, values in numbers.items():
            setattr(self._numbers, name, wp.array(values, dtype=wp.float64, device="cpu", copy=False))
        self._numbers.carrier = _array(np.concatenate([bodies.index, bodies.carrier]), wp.int32)
        envs, slots = (num_envs,), (num_envs, self._pads, count + self._pads)
        self.frames: Any = Frames()
        for name, dtype in _FRAMES.items():
            setattr(self.frames, name, _zeros((num_envs, self._pads + count), dtype))
        self._motion: Any = world.Motion()
        self._motion.world_from_pad, self._motion.case_step = (_zeros(slots[:2], dtype) for dtype in (wp.mat44d, wp.float64))
        for name, dtype in (("pose", wp.mat44d), ("velocity", wp.vec3d), ("spin", wp.vec3d)):
            setattr(self._motion, name, _zeros(slots, dtype))
        self._motion.suspect = _zeros((num_envs, self._pads, count), wp.int32)
        self._motion.near_gel = _zeros((num_envs, self._pads, self._pads), wp.int32)
        self.slots: Any = world.Slots()
        for name, (inner, dtype) in _SLOTS.items():
            setattr(self.slots, name, _zeros((*slots, *inner), dtype))
        self.steps: Any = world.Steps()
        for name, dtype in _STEPS.items():
            setattr(self.steps, name, _zeros(envs, dtype))
        self._force, self._velocity, self._acceleration, self._wrench = (
            _zeros((*slots, world.ROWS), wp.float64), _zeros((*slots, world.ROWS), wp.float64), _zeros(slots, wp.float64),
            _zeros(slots[:2], wp.spatial_vectord),
        )  # fmt: skip
        self._before = _zeros((num_envs, self._pads, count), wp.mat44d)
        self.force, self.velocity = self._force, self._velocity
        self.shear = ShearState(*slots)
        self.before: np.ndarray = self._before.numpy().reshape(num_envs, self._pads, count, 4, 4)
        self.before[:] = np.nan
        self.wrench: np.ndarray = self._wrench.numpy()
        self.acceleration: np.ndarray = self._acceleration.numpy()
        self._view = {name: getattr(self.steps, name).numpy() for name in _STEPS}
        self._suspect: np.ndarray = self._motion.suspect.numpy()
        self._near_gel: np.ndarray = self._motion.near_gel.numpy()
        self._pose: np.ndarray = self._motion.pose.numpy()
        clock = [float(timestep), self.ticks]
        inputs = [self.frames, self.steps, self._gels, self._touched, self._before, *clock, float(fall), float(case_travel)]
        inputs += [self._motion, self.slots, self.search.poses, self.search.reach]
        self._move = Launch(move_bodies, (self._pads,), inputs)
        self._choose = Launch(choose_steps, (), [self._motion, self.slots, *clock, 0, self.steps])
        self._number = Launch(number_rows, (), [self.slots, self.steps])
        outputs = [self.shear.struct, self._acceleration, self.slots]
        self._read = Launch(
            read_rows, slots[1:], [self._force, self._velocity, self._motion, self.steps, self._touched, *outputs]
        )
        self._sum = Launch(sum_wrenches, (self._pads,), [self.slots, self.steps, self._touched, self._wrench])
        self._whole, self._clock, self._fall = False, clock, float(fall)
        self._results = [_Results(self, self.search, 0, 0)]
        self._results += [_Results(self, search, i, count + j) for i, j, search in self._pairs]
        self._pose_pair = [
            Launch(pair_of_gels, (), [self._motion, self.steps, i, count + j, *clock, search.poses, search.reach])
            for i, j, search in self._pairs
        ]

    def rows(self, envs: np.ndarray, done: np.ndarray) -> None:
        """Name the environments of the step, and the ticks that each has done of the scene's step."""
        self._view["envs"][: len(envs)], self._view["done"][: len(envs)] = envs, done

    def begin(self, count: int, *, whole: bool = False) -> None:
        """Find contacts from ``frames``, and the length of each environment's step, and set the rows of its contacts."""
        self.move(count)
        found = [self._results[0]] if self.search.run(count) else []
        if self._pairs and self._near_gel[:count].any():
            for (i, j, search), pose, results in zip(self._pairs, self._pose_pair, self._results[1:], strict=True):
                if self._near_gel[:count, i, j].any():
                    pose(count)
                    if search.run(count):
                        found.append(results)
        for results in found:
            results.approach(count)
        if whole is not self._whole:
            self._whole = whole
            self._choose.set("whole", int(whole))
        self._choose(count)
        for results in found:
            results.set_rows(count)
        if found:
            self._number(count)

    def move(self, count: int) -> None:
        """Motion of bodies alone, with what may have gone through a pad (``suspects``)."""
        self._move(count)

    def end(self, count: int) -> None:
        """Let the gels shear, and add up the wrenches, by ``force`` and ``velocity``."""
        self._read(count)
        self._sum(count)

    def lose(self, rows: np.ndarray) -> None:
        """Mark rows as broken down."""
        self._view["lost"][rows] = 1

    def suspects(self, count: int) -> np.ndarray | None:
        """True (n, pads, bodies) where a body may have gone through a pad; None if none has."""
        some = self._suspect[:count]
        return some != 0 if some.any() else None

    def poses(self, count: int) -> np.ndarray:
        """``pad_from_body`` (n, pads, bodies, 4, 4) of the step."""
        return self._pose[:count, :, : self._count]

    def view(self, name: str, count: int) -> np.ndarray:
        """An array of ``steps``, (n,)."""
        return self._view[name][:count]

    def clear(self, envs: np.ndarray) -> None:
        """Forget what environments went through."""
        self.shear.clear(envs)
        self.wrench[envs] = self.acceleration[envs] = 0.0
        self.before[envs] = np.nan

    def inputs(self, search: PadSearch, pad: int, body: int) -> tuple[list[Any], list[Any], tuple[int, int]]:
        """Inputs of the kernels on the results of a search, and how many pads and bodies it has."""
        pads, bodies = search.poses.shape[1:]
        places = [pads, bodies, pad, body]
        shared = [self._numbers, self._gels, self._touched]
        to_approach = [search.rows, search.near, search.ends, *places, self._motion, *shared, self._acceleration, *self._clock]
        to_set = [search.rows, *places, self._motion, self.steps, *shared, self._fall, self.shear.struct, self.slots]
        return [*to_approach, self.steps, self.slots], to_set, (pads, bodies)


class Launch:
    """Launch of a kernel on the CPU for a number of environments, recorded: repeating it costs a tenth."""

    def __init__(self, kernel: Any, rest: tuple[int, ...], inputs: Sequence[Any]) -> None:
        """``rest``: threads along the axes after that of environments."""
        self._rest, self._count = rest, 1
        self._launch: Any = wp.launch(kernel, dim=(1, *rest), inputs=list(inputs), device="cpu", record_cmd=True)

    def __call__(self, count: int) -> None:
        if count != self._count:
            self._launch.set_dim((count, *self._rest))
            self._count = count
        self._launch.launch()

    def set(self, name: str, value: Any) -> None:
        """Give another value to a parameter."""
        self._launch.set_param_by_name(name, value)


class _Results:
    """Launches on the results of one search, recorded again when the search has made more memory."""

    def __init__(self, contact: GelContact, search: PadSearch, pad: int, body: int) -> None:
        self._contact, self._search, self._at = contact, search, (pad, body)
        self._rows: Any = None

    def approach(self, count: int) -> None:
        if self._rows is not self._search.rows:
            self._rows = self._search.rows
            to_approach, to_set, dim = self._contact.inputs(self._search, *self._at)
            self._approach, self._set = Launch(approach, dim, to_approach), Launch(set_rows, dim, to_set)
        self._approach(count)

    def set_rows(self, count: int) -> None:
        self._set(count)


def _gels(gels: Sequence[GelpadSpec], bodies: Bodies) -> Any:
    shear = np.array([shear_modulus(gel) for gel in gels])
    thickness = np.array([gel.thickness for gel in gels])
    softer = 2.0 - np.array([gel.poisson_ratio for gel in gels])
    result: Any = world.Gels()
    result.thickness = _array(thickness, wp.float64)
    result.half = _array([np.multiply(0.5, gel.size) for gel in gels], wp.vec2d)
    result.modulus = _array([gel.youngs_modulus for gel in gels], wp.float64)
    result.shear = _array(np.stack([8.0 * shear / softer, np.pi * shear / thickness], axis=1), wp.vec2d)
    result.twist = _array(np.stack([16.0 / 3.0 * shear, 0.5 * np.pi * shear / thickness], axis=1), wp.vec2d)
    result.hysteresis = _array([gel.hysteresis for gel in gels], wp.float64)
    result.relaxation = _array([gel.relaxation_time for gel in gels], wp.float64)
    result.case_centre, result.case_half = _array(bodies.case_centre, wp.vec3d), _array(bodies.case_half, wp.vec3d)
    result.carrier = _array(bodies.carrier, wp.int32)
    return result


def _touched(bodies: Bodies) -> Any:
    boxes = [_box(part) for parts in bodies.parts for part in parts]
    result: Any = world.Touched()
    result.bodies = len(bodies.parts)
    result.mass_centre = _array(bodies.mass_centre, wp.vec3d)
    result.radius = _array([object_radius(parts) for parts in bodies.parts], wp.float64)
    result.first_box = _array(np.cumsum([0, *map(len, bodies.parts)]), wp.int32)
    result.box_turn = _array(np.reshape([turn for turn, _, _ in boxes], (-1, 3, 3)), wp.mat33d)
    result.box_centre = _array(np.reshape([centre for _, centre, _ in boxes], (-1, 3)), wp.vec3d)
    result.box_half = _array(np.reshape([half for _, _, half in boxes], (-1, 3)), wp.vec3d)
    return result


def _box(part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes, centre and half edges of a box that holds a part, body frame; of a half-space its frame, and inf."""
    turn, at = part.object_from_part[:3, :3], part.object_from_part[:3, 3]
    if part.kind == "plane":
        return turn, at, np.full(3, np.inf)
    low, high = bounds(part.kind, part.size, np.eye(4)) if part.vertices is None else (
        part.vertices.min(axis=0), part.vertices.max(axis=0)
    )  # fmt: skip
    return turn, turn @ (0.5 * (low + high)) + at, 0.5 * (high - low)


def _array(values: Any, dtype: Any) -> wp.array:
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def _zeros(shape: tuple[int, ...], dtype: Any) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device="cpu")


_FRAMES: dict[str, Any] = {"place": wp.vec3d, "turn": wp.mat33d, "velocity": wp.vec3d, "spin": wp.vec3d}
_STEPS: dict[str, Any] = dict.fromkeys(("envs", "done", "ticks", "lost", "contacts"), wp.int32) | {"length": wp.float64}
_SLOTS: dict[str, tuple[tuple[int, ...], Any]] = {
    "row": ((), wp.int32),
    "held": ((), wp.int32),
    "speed": ((), wp.float64),
    "longest": ((), wp.float64),
    "centre": ((), wp.vec3d),
    "radius": ((), wp.float64),
    "axes": ((), wp.mat33d),
    "turn": ((), wp.vec2d),
    "place": ((), wp.vec3d),
    "frame": ((), wp.mat33d),
    "friction": ((world.ROWS - 1,), wp.float64),
    "force": ((world.ROWS,), wp.float64),
    "regularisation": ((world.ROWS,), wp.float64),
    "wrench": ((), wp.spatial_vectord),
    "opposite": ((), wp.spatial_vectord),
}
