"""Contact of a world's gels in one step: kernels from motion to rows, and force to shear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid import world_kernels as world
from raytac.physics.rigid.lift_kernels import TOGETHER, Lifts
from raytac.physics.rigid.load_law import shear_modulus
from raytac.physics.rigid.motion_kernels import Frames, move_bodies, pair_of_gels
from raytac.physics.rigid.pierced import BondedFaces
from raytac.physics.rigid.response_kernels import Response, mat66d
from raytac.physics.rigid.row_kernels import read_rows, set_rows, sum_wrenches
from raytac.physics.rigid.search import PadSearch
from raytac.physics.rigid.shear_state import ShearState
from raytac.physics.rigid.step_kernels import approach, choose_active, choose_steps, clear_environments
from raytac.shapes.part import Part
from raytac.shapes.primitives import bounds
from raytac.shapes.underside import object_radius
from raytac.specs.sensor import GelpadSpec
from raytac.warp_runtime import start_warp

_AHEAD = 0.05
"""Share of the gel's thickness that a step may go deeper: twice what fast bodies may.

The load law is tabulated so far (``longest``)."""
_SHORTEST = 1e-6
"""Steps are not shorter than this, or half of it [s]."""


@dataclass(frozen=True)
class Bodies:
    """Bodies that the pads of a model may touch, and bodies that carry the pads."""

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
    """Contacts of B environments with gels, on the CPU or on CUDA.

    ``begin`` and ``end`` work on the rows that ``steps.envs`` gives an environment. Between both MuJoCo takes the step. They only launch
    kernels, always the same ones, so that they can be ``Recorded``.

    Attributes:
        ticks: parts of the scene's step, the length of the shortest one.
        search: for contacts of bodies.
        frames: frames, velocities and free accelerations of n environments, which ``begin`` reads.
        motion, steps, slots: motion, environments and contacts of the step.
        lifts: search for the lifts of slides that begin or end, after ``expect_lifts``.
        force, velocity: of the rows at the end of the step, (B, pads, bodies + pads, ROWS), which ``end`` reads.
        before: ``pad_from_body`` (B, pads, bodies) at the last step, which ``move`` renews; NaN where unknown.
        wrenches: on the pads (B, pads).
        rolling: torque of rolling over its bound, about the pad's tangents (B, pads, bodies + pads).
        acceleration: at which contacts closed faster in their last step [m/s²], (B, pads, bodies + pads).
        shear: of the gels.
        faces: beyond which no body may be.
        chosen: environments of this step, as ``choose`` named them.
        numbers: ``Differences`` of the environments, on the device.
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
        case_travel: float,
        device: str = "cpu",
    ) -> None:
        """Make the arrays.

        Args:
            pairs: two gels that may touch, and the search for that.
            numbers: those of ``Differences`` that environments may change, (B, …); on the CPU the arrays themselves are read in every step,
                on CUDA ``vary`` copies them again.
            timestep: the scene's step [s].
            case_travel: greatest travel of a body beside a case in a step [m].
        """
        start_warp()
        self.device = wp.get_device(device)
        pads, count = len(gels), len(bodies.parts)
        self.ticks = 2 ** max(int(np.ceil(np.log2(timestep / _SHORTEST))), 0)
        ahead = _AHEAD * min((gel.thickness for gel in gels), default=0.0)
        self.search = PadSearch(gels, bodies.parts, num_envs=num_envs, ahead=ahead, device=device)
        self._gels, self._touched = _gels(gels, bodies, self.device), _touched(bodies, self.device)
        self.numbers: Any = world.Differences()
        self._given = dict(numbers)
        for name, values in numbers.items():
            given = wp.array(values, dtype=wp.float64, device=self.device, copy=not self.device.is_cpu)
            setattr(self.numbers, name, given)
        self.numbers.carrier = _array(np.concatenate([bodies.index, bodies.carrier]), wp.int32, self.device)
        all_pads, bodies_of, slots = (num_envs, pads), (num_envs, pads, count), (num_envs, pads, count + pads)
        self.frames = self._struct(Frames(), (num_envs, pads + count), _FRAMES)
        self.motion = self._struct(world.Motion(), slots, _MOTION)
        self._struct(self.motion, all_pads, {"world_from_pad": wp.mat44d, "case_step": wp.float64})
        self._struct(self.motion, bodies_of, {"suspect": wp.int32, "before": wp.mat44d})
        self._struct(self.motion, (num_envs, pads, pads), {"near_gel": wp.int32})
        self.slots = self._struct(world.Slots(), slots, _SLOTS)
        self._struct(self.slots, (*slots, world.ROWS - 1), {"friction": wp.float64})
        self._struct(self.slots, (*slots, world.ROWS), {"force": wp.float64, "regularisation": wp.float64})
        self.steps = self._struct(world.Steps(), (num_envs,), _STEPS)
        together = min(pads * (count + pads), TOGETHER)
        self.lifts: Any = self._struct(Lifts(), (num_envs, together), {"slot": wp.vec2i, "best": wp.float64})
        self._struct(self.lifts, (num_envs, world.ROWS * together), {"free": wp.float64, "force": wp.float64})
        self.lifts.least = self._zeros((num_envs,), wp.float64)
        self.force, self.velocity = (self._zeros((*slots, world.ROWS), wp.float64) for _ in range(2))
        self.acceleration, self.rolling = self._zeros(slots, wp.float64), self._zeros(slots, wp.vec2d)
        self.wrenches = self._zeros(all_pads, wp.spatial_vectord)
        self.before = self._zeros(bodies_of, wp.mat44d)
        self.before.fill_(wp.mat44d(*[np.nan] * 16))
        self.shear = ShearState(*slots, device=device)
        self.chosen: list[int] = []
        # On the CPU the host writes through views, at no cost; on CUDA it copies.
        self._envs, self._done = self.steps.envs.numpy(), self.steps.done.numpy()
        self._cleared = wp.zeros(num_envs, dtype=wp.bool, device=self.device)
        self.faces = BondedFaces(*self.search.geometry, self.device)
        self._clock, self._case_travel = [float(timestep), self.ticks], float(case_travel)
        self._pairs = [(search, i, count + j) for i, j, search in pairs]
        self._searches = [*([(self.search, 0, 0)] if self.search.pairs else []), *self._pairs]
        for search, _, _ in self._searches:
            search.reserve(search.pairs)

    def expect_lifts(self, solves: int, nv: int) -> None:
        """Make room for ``lifts``.

        Args:
            solves: most solves of MuJoCo's for them.
            nv: degrees of freedom of the model.
        """
        num_envs, together = self.lifts.slot.shape
        response: Any = Response()
        response.mass = self._zeros((num_envs, nv, nv), wp.float64)
        response.rows = self._zeros((num_envs, world.ROWS * together, nv), wp.float64)
        response.other = self._zeros((num_envs, world.ROWS, nv), wp.float64)
        response.own = self._zeros((num_envs, together), mat66d)
        response.state = self._zeros((num_envs, nv), wp.float64)
        self.lifts.solves, self.lifts.response = solves, response

    def begin(self, *, whole: bool = False) -> None:
        """Find contacts from ``frames``, choose steps (unless ``whole``), and set the rows."""
        self._move_bodies()
        for search, pad, body in self._pairs:
            poses = [self.motion, self.steps, pad, body, *self._clock, search.poses, search.reach]
            self._launch(pair_of_gels, (), poses)
        shared = [self.numbers, self._gels, self._touched]
        for search, *at in self._searches:
            search.launch()
            results = [search.rows, search.near, search.ends, *search.poses.shape[1:], *at]
            self._launch(
                approach,
                search.poses.shape[1:],
                [*results, self.motion, *shared, self.acceleration, *self._clock, self.steps, self.slots],
            )
        self._launch(choose_steps, (), [self.motion, self.slots, *self._clock, int(whole), self.steps])
        for search, *at in self._searches:
            results = [search.rows, *search.poses.shape[1:], *at, self.frames, self.motion]
            self._launch(
                set_rows,
                search.poses.shape[1:],
                [*results, *shared, self.rolling, self.steps, self.shear.struct, self.slots],
            )
        self.faces.lose(self.motion, self.steps)

    def move(self) -> None:
        """Motion of bodies alone; environments in which a body has gone through a pad are lost."""
        self._move_bodies()
        self.faces.lose(self.motion, self.steps)

    def _move_bodies(self) -> None:
        inputs = [self.frames, self.steps, self._gels, self._touched, self.before, *self._clock, self._case_travel]
        self._launch(
            move_bodies,
            (len(self._gels.thickness),),
            [*inputs, self.motion, self.slots, self.search.poses, self.search.reach, self.search.closing],
        )

    def end(self) -> None:
        """Let the gels shear, and add up the wrenches, by ``force`` and ``velocity``."""
        inputs = [self.force, self.velocity, self.motion, self.steps, self._touched]
        self._launch(read_rows, self.force.shape[1:3], [*inputs, self.shear.struct, self.rolling, self.acceleration, self.slots])
        self._launch(sum_wrenches, self.wrenches.shape[1:], [self.slots, self.steps, self._touched, self.wrenches])

    def choose(self, envs: np.ndarray, done: np.ndarray | int) -> None:
        """Name the n environments of the next step; ``done`` (n,): ticks of the scene's step done."""
        count, self.chosen = len(envs), envs.tolist()
        self._envs[:count], self._envs[count:] = envs, -1
        self._done[:count] = done
        if not self.device.is_cpu:
            self.steps.envs.assign(self._envs)
            self.steps.done.assign(self._done)

    def choose_active(self, active: wp.array) -> None:
        """Make row i of the next step environment i where ``active`` (B,), bool, on the device."""
        self._launch(choose_active, (), [active, self.steps])

    def clear(self, envs: Sequence[int] | np.ndarray) -> None:
        """Forget what environments went through."""
        mask = np.zeros(len(self.steps.envs), bool)
        mask[np.asarray(envs, int)] = True
        self._cleared.assign(mask)
        self.clear_active(self._cleared)

    def clear_active(self, mask: wp.array) -> None:
        """Forget what the environments of a mask (B,), bool, on the device, went through."""
        kept = [self.shear.struct, self.before, self.acceleration, self.rolling, self.wrenches]
        self._launch(clear_environments, self.acceleration.shape[1:], [mask, *kept])

    def vary(self) -> None:
        """Take over what has changed in the arrays of ``numbers``; on the CPU that is done already."""
        if not self.device.is_cpu:
            for name, values in self._given.items():
                getattr(self.numbers, name).assign(values)

    def _launch(self, kernel: Any, rest: tuple[int, ...], inputs: Sequence[Any]) -> None:
        """``rest``: threads along the axes after that of environments."""
        wp.launch(kernel, dim=(len(self.steps.envs), *rest), inputs=list(inputs), device=self.device)

    def _zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _struct(self, struct: Any, shape: tuple[int, ...], members: Mapping[str, Any]) -> Any:
        """A structure with arrays of one shape as some of its members."""
        for name, dtype in members.items():
            setattr(struct, name, self._zeros(shape, dtype))
        return struct


class HostViews:
    """Arrays of a ``GelContact`` on the CPU as NumPy sees them."""

    def __init__(self, contact: GelContact) -> None:
        """Views of ``contact``; raises ``InputError`` if that is not on the CPU."""
        if not contact.device.is_cpu:
            raise InputError("contact.device", value=str(contact.device), rule="must be the CPU, where NumPy sees its arrays")
        bodies = contact.before.shape[2]
        self.ticks: np.ndarray = contact.steps.ticks.numpy()
        self.length: np.ndarray = contact.steps.length.numpy()
        self.lost: np.ndarray = contact.steps.lost.numpy()
        self.contacts: np.ndarray = contact.steps.contacts.numpy()
        self.slides: np.ndarray = contact.steps.slides.numpy()
        self.suspect: np.ndarray = contact.motion.suspect.numpy()
        self.poses: np.ndarray = contact.motion.pose.numpy()[:, :, :bodies]
        """``pad_from_body`` of bodies."""
        self.poses_before: np.ndarray = contact.motion.before.numpy()
        self.before: np.ndarray = contact.before.numpy()
        self.wrench: np.ndarray = contact.wrenches.numpy()
        self.acceleration: np.ndarray = contact.acceleration.numpy()
        self.rolling: np.ndarray = contact.rolling.numpy()


def _gels(gels: Sequence[GelpadSpec], bodies: Bodies, device: Any) -> Any:
    shear = np.array([shear_modulus(gel) for gel in gels])
    thickness = np.array([gel.thickness for gel in gels])
    softer = 2.0 - np.array([gel.poisson_ratio for gel in gels])
    result: Any = world.Gels()
    result.thickness = _array(thickness, wp.float64, device)
    result.half = _array([np.multiply(0.5, gel.size) for gel in gels], wp.vec2d, device)
    result.rest = _array([_rest(gel) for gel in gels], wp.vec2d, device)
    result.modulus = _array([gel.youngs_modulus for gel in gels], wp.float64, device)
    result.shear = _array(np.stack([8.0 * shear / softer, np.pi * shear / thickness], axis=1), wp.vec2d, device)
    result.twist = _array(16.0 / 3.0 * shear, wp.float64, device)
    result.hysteresis = _array([gel.hysteresis for gel in gels], wp.float64, device)
    result.relaxation = _array([gel.relaxation_time for gel in gels], wp.float64, device)
    result.case_centre, result.case_half = (
        _array(bodies.case_centre, wp.vec3d, device),
        _array(bodies.case_half, wp.vec3d, device),
    )
    result.carrier = _array(bodies.carrier, wp.int32, device)
    return result


def _rest(gel: GelpadSpec) -> tuple[float, float]:
    """Greatest slope of a gel's dome, and distance of its corners from the origin [m]."""
    half = np.multiply(0.5, gel.size)
    slopes = [u / np.sqrt(radius * radius - u * u) for u, radius in zip(half, gel.dome_radius, strict=True)]
    return float(np.hypot(*slopes)), float(np.hypot(np.hypot(*half), gel.sag(*half)))


def _touched(bodies: Bodies, device: Any) -> Any:
    boxes = [_box(part) for parts in bodies.parts for part in parts]
    result: Any = world.Touched()
    result.bodies = len(bodies.parts)
    result.mass_centre = _array(bodies.mass_centre, wp.vec3d, device)
    result.radius = _array([object_radius(parts) for parts in bodies.parts], wp.float64, device)
    result.first_box = _array(np.cumsum([0, *map(len, bodies.parts)]), wp.int32, device)
    result.box_turn = _array(np.reshape([turn for turn, _, _ in boxes], (-1, 3, 3)), wp.mat33d, device)
    result.box_centre = _array(np.reshape([centre for _, centre, _ in boxes], (-1, 3)), wp.vec3d, device)
    result.box_half = _array(np.reshape([half for _, _, half in boxes], (-1, 3)), wp.vec3d, device)
    return result


def _box(part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes, centre, half edges of a part's box, body frame; of a half-space its frame and inf."""
    turn, at = part.object_from_part[:3, :3], part.object_from_part[:3, 3]
    if part.kind == "plane":
        return turn, at, np.full(3, np.inf)
    low, high = bounds(part.kind, part.size, np.eye(4)) if part.vertices is None else (
        part.vertices.min(axis=0), part.vertices.max(axis=0)
    )  # fmt: skip
    return turn, turn @ (0.5 * (low + high)) + at, 0.5 * (high - low)


def _array(values: Any, dtype: Any, device: Any) -> wp.array:
    return wp.array(np.asarray(values), dtype=dtype, device=device)


_FRAMES: dict[str, Any] = dict.fromkeys(("place", "velocity", "spin", "push", "swing"), wp.vec3d) | {"turn": wp.mat33d}
_STEPS: dict[str, Any] = dict.fromkeys(("envs", "done", "most", "ticks", "lost", "contacts", "slides", "solves"), wp.int32) | {
    "length": wp.float64
}
_MOTION: dict[str, Any] = {"pose": wp.mat44d, "velocity": wp.vec3d, "spin": wp.vec3d, "push": wp.float64}
_SLOTS: dict[str, Any] = {
    "row": wp.int32,
    "held": wp.int32,
    "speed": wp.float64,
    "longest": wp.float64,
    "centre": wp.vec3d,
    "radius": wp.float64,
    "axes": wp.mat33d,
    "turn": wp.vec2d,
    "place": wp.vec3d,
    "frame": wp.mat33d,
    "bend": wp.vec2d,
    "lift": wp.float64,
    "wrench": wp.spatial_vectord,
    "opposite": wp.spatial_vectord,
}
