"""Substeps of a soft scene near something soft, and sleep where nothing is near.

Every environment divides its own step, as it would alone. What a rigid body does by itself near another rigid one does not divide
it: where it slides, rolls or falls on a table it moves as far in one step as its speed takes it, and the solver's collision detection
keeps it outside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Protocol

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.physics.soft.bodies import SceneBody, ScenePad
from raytac.physics.soft.scene_state import Poses
from raytac.physics.soft.settings import SubstepLimits
from raytac.se3 import inverse, rotations, turn_angle

Pair = tuple[str, str]
_NOTHING = 1e-15
_MARGIN = 2.0
"""Distance that pads must keep during a step, in units of d̂: contact begins at one."""
_CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], float)


class SceneQuery(Protocol):
    """Present state of a scene, as ``Substeps`` asks for it."""

    world: ipc.World
    settings: ipc.Settings

    @property
    def failed(self) -> np.ndarray: ...

    def pose(self, name: str) -> np.ndarray: ...


class Substeps:
    """Divides steps into halves, quarters and so on, so that bodies near a soft one move little.

    Attributes:
        pairs: names of bodies of which one is soft.
        rigid_pairs: a driven and a free rigid body, of which the motion of the driven one counts. In both a half-space comes second.
    """

    def __init__(
        self, pads: Mapping[str, ScenePad], bodies: Mapping[str, SceneBody], query: SceneQuery, limits: SubstepLimits
    ) -> None:
        self.limits = limits
        self._pads, self._bodies, self._query = pads, bodies, query
        self.pairs: list[Pair] = [*combinations(pads, 2), *product(pads, bodies)]
        self.rigid_pairs: list[Pair] = []
        for a, b in combinations(bodies.values(), 2):  # two free bodies are left to the solver
            if a.is_driven != b.is_driven:
                pair = (b.name, a.name) if isinstance(a.solid, ipc.HalfSpace) else (a.name, b.name)
                (self.pairs if a.is_soft or b.is_soft else self.rigid_pairs).append(pair)

    def next_part(self, done: np.ndarray, now: Poses, goal: Poses, dt: np.ndarray) -> tuple[np.ndarray, dict[int, Pair | None]]:
        """Parts (B,) of a step of ``dt`` (B,) [s] that may be made next, and whom to refuse.

        The environments to refuse come with the pair that moves too far. Parts are counted in ``limits.most``-ths of the step, as is
        ``done`` (B,). They are powers of two that divide ``done``; 0 where the step is done, or failed. What free bodies do, and soft ones
        by themselves, is never refused (a beam that is held at its foot may snap back): the solver resolves it, in the smallest parts.
        """
        most, waits = self.limits.most, (done < self.limits.most) & ~self._query.failed
        if not waits.any():
            return np.zeros_like(done), {}
        motions = self.motions(now, goal, dt * (1.0 - done / most))
        driven = {name: replace(motion, end=self._driven_end(name, motion, goal)) for name, motion in motions.items()}
        room, pairs = self._room(done, motions, driven)
        if (waits & (room < 1.0)).any():
            room = np.where((room < 1.0) & (self._room(done, driven, driven)[0] >= 1.0), 1.0, room)
        refused = waits & (room < 1.0)
        part = 2 ** np.floor(np.log2(np.clip(room, 1.0, most))).astype(int)
        part = np.where(done > 0, np.minimum(part, done & -done), part)
        return np.where(waits & ~refused, part, 0), {b: pairs[b] for b in np.flatnonzero(refused).tolist()}

    def refusal(self, b: int, pair: Pair | None, now: Poses, goal: Poses) -> InputError:
        """The error of a motion of environment ``b`` that cannot be resolved."""
        where = f"in environment {b} " if len(self._query.failed) > 1 else ""
        length, angle = 1e3 * self.limits.most * self.limits.step, np.degrees(self.limits.most * self.limits.turn)
        rule = (
            f"{where}takes {' and '.join(pair or ())} too far against each other where they are near: at most {length:.3g} mm "
            f"or {angle:.3g} degrees in one step of {self._query.settings.dt} s; move slower or in more steps"
        )
        return InputError("world_from_pad", value=f"displacements of up to {now.longest(goal, b) * 1e3:.3g} mm", rule=rule)

    def _driven_end(self, name: str, motion: BoxMotion, goal: Poses) -> np.ndarray:
        """Poses (B, 4, 4) where a body is driven to, which for a free one is where it is."""
        body = self._bodies.get(name)
        if body is None or (body.is_driven and not isinstance(body.solid, ipc.SoftBody)):
            return motion.end
        return np.where(self._query.failed[:, None, None], motion.start, goal.bodies[name]) if body.is_driven else motion.start

    def _room(
        self, done: np.ndarray, motions: Mapping[str, BoxMotion], driven: Mapping[str, BoxMotion]
    ) -> tuple[np.ndarray, list[Pair | None]]:
        """Parts of the step that motions allow, (B,), and the pairs that limit it.

        ``driven``: motions of driven bodies alone, that count between rigid bodies.
        """
        share, limiting = np.ones(len(done)), [None] * len(done)
        for chosen, moving in ((self.pairs, motions), (self.rigid_pairs, driven)):
            pairs = [(a, b) for a, b in chosen if not (moving[a].is_still() and moving[b].is_still())]
            least, by = allowed_share(moving, pairs, self.limits.reach * self._query.world.d_hat, self.limits)
            limiting = [new if lower else old for new, old, lower in zip(by, limiting, least < share, strict=True)]
            share = np.minimum(share, least)
        return (self.limits.most - done) * share * (1.0 + 1e-9), limiting

    def motions(self, now: Poses, goal: Poses, remaining: np.ndarray) -> dict[str, BoxMotion]:
        """Motions to ``goal``; free bodies keep their velocity for ``remaining`` (B,) [s]."""
        motions, sums = {}, self._query.world.sums.host
        for k, (name, pad) in enumerate(self._pads.items()):
            rest, index = pad.mesh.tets.vertices, self._query.world.layout.names.index(name)
            low, high = np.minimum(rest.min(axis=0), sums["low"][:, index]), np.maximum(rest.max(axis=0), sums["high"][:, index])
            motions[name] = BoxMotion(now.pads[:, k], goal.pads[:, k], low, high)
        for name, body in self._bodies.items():
            motions[name] = self._body_motion(body, now.bodies, goal.bodies, remaining)
        failed = self._query.failed[:, None, None]
        if failed.any():  # nothing moves there, whatever its velocity was
            motions = {name: replace(motion, end=np.where(failed, motion.start, motion.end)) for name, motion in motions.items()}
        return motions

    def _body_motion(
        self, body: SceneBody, now: Mapping[str, np.ndarray], goal: Mapping[str, np.ndarray], remaining: np.ndarray
    ) -> BoxMotion:
        name, solid, ones = body.name, body.solid, np.ones((len(self._query.failed), 1))
        if isinstance(solid, ipc.HalfSpace):
            return BoxMotion(now[name], goal[name], 0.0 * ones, 0.0 * ones, is_plane=True)
        start = now[name] if body.is_driven else self._query.pose(name)
        if isinstance(solid, ipc.SoftBody):
            vertices = np.einsum("bji,bnj->bni", start[:, :3, :3], self._query.world.positions(name) - start[:, None, :3, 3])
            low, high = vertices.min(axis=1), vertices.max(axis=1)
        else:
            low, high = (ones * corner for corner in (solid.surface.vertices.min(axis=0), solid.surface.vertices.max(axis=0)))
        if not body.is_driven:  # it keeps its momentum
            motion = self._query.world.rigid_motion(name)
            end = _move(start, motion.centre, remaining[:, None] * motion.velocity, remaining[:, None] * motion.spin)
        else:
            end = self._contact_end(solid, start, goal[name], remaining) if isinstance(solid, ipc.SoftBody) else goal[name]
        return BoxMotion(start, end, low, high)

    def _contact_end(self, solid: ipc.SoftBody, start: np.ndarray, goal: np.ndarray, remaining: np.ndarray) -> np.ndarray:
        """Pose of a driven soft body whose contact keeps its velocity; ``goal`` without contact."""
        world = self._query.world
        load = np.linalg.norm(world.contact_forces(solid.name), axis=2)
        touched = load.sum(axis=1) > 0.0
        if not touched.any():
            return goal
        nodes = world.surface(solid.name)[0]
        x, v = world.positions(solid.name)[:, nodes], world.velocities(solid.name)[:, nodes]
        weight = load / np.where(touched, load.sum(axis=1), 1.0)[:, None]
        centre, velocity = np.einsum("bn,bni->bi", weight, x), np.einsum("bn,bni->bi", weight, v)
        arm = x - centre[:, None]
        second = np.einsum("bn,bni,bnj->bij", weight, arm, arm) + 1e-12 * np.eye(3)
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        momentum = np.einsum("bn,bni->bi", weight, np.cross(arm, v - velocity[:, None]))
        spin = np.linalg.solve(inertia, momentum[..., None])[..., 0]
        return np.where(
            touched[:, None, None], _move(start, centre, remaining[:, None] * velocity, remaining[:, None] * spin), goal
        )


class Sleep:
    """Choice of the environments that sleep through a step.

    An environment sleeps if three things hold: its gels and bodies came to rest, to the tolerance of the solver; no pad comes near anything
    in the coming step, whatever its speed; and no driven body that moves comes near a free or soft one. Nothing else is remembered, so it
    wakes in the step in which one of them does not hold.
    """

    def __init__(
        self,
        pads: Mapping[str, ScenePad],
        bodies: Mapping[str, SceneBody],
        substeps: Substeps,
        world: ipc.World,
        tolerance: float,
    ) -> None:
        """``tolerance``: largest displacement of a node from its place at rest [m]."""
        self._substeps, self._world, self._tolerance = substeps, world, tolerance
        self._margin = _MARGIN * world.d_hat
        self._pad_pairs: list[Pair] = [*combinations(pads, 2), *product(pads, bodies)]
        self._body_pairs: list[Pair] = []
        for a, b in combinations(bodies.values(), 2):
            if a.is_soft or b.is_soft or not (a.is_driven and b.is_driven):
                self._body_pairs.append((b.name, a.name) if isinstance(a.solid, ipc.HalfSpace) else (a.name, b.name))

    def choose(self, now: Poses, goal: Poses) -> np.ndarray:
        """Environments (B,) that sleep while all that is driven goes from ``now`` to ``goal``."""
        asleep = self._world.distance_from_rest() <= self._tolerance
        if not asleep.any():
            return asleep
        motions = self._substeps.motions(now, goal, np.zeros(len(asleep)))
        for a, b in self._pad_pairs:
            asleep &= clear_of_each_other(motions[a], motions[b], self._margin)
        for a, b in self._body_pairs:
            still = _is_still(motions[a]) & _is_still(motions[b])
            asleep &= still | clear_of_each_other(motions[a], motions[b], self._margin)
        return asleep


@dataclass(frozen=True)
class BoxMotion:
    """Motion of a box, or of a half-space z <= 0 of its frame, in B environments."""

    start: np.ndarray
    """``world_from_box`` (B, 4, 4)."""
    end: np.ndarray
    """The same where it is driven to, or where its velocity takes it."""
    low: np.ndarray
    high: np.ndarray
    """Corners of the box in its frame [m], (B, 3) each; not used of a half-space."""
    is_plane: bool = False

    def corners(self) -> np.ndarray:
        """(B, 8, 3) [m], in its frame."""
        return self.low[:, None] + _CORNERS * (self.high - self.low)[:, None]

    def is_still(self) -> bool:
        return np.array_equal(self.start, self.end)


def allowed_share(
    motions: Mapping[str, BoxMotion], pairs: Sequence[Pair], reach: float, limits: SubstepLimits
) -> tuple[np.ndarray, list[Pair | None]]:
    """Largest share of all motions, in (0, 1], that takes no pair too far, and that pair, (B,).

    Two bodies whose boxes are farther apart than ``reach`` [m] may use up the excess. Closer ones move by at most ``limits.step`` and
    ``limits.turn`` against each other. The distance of two boxes is bounded from below by their separation along the normals of their
    faces (conservative advancement). Boxes that one of these keeps ``limits.clear`` apart at both ends of the motion may move freely. The
    first of a pair must not be a half-space.
    """
    batch = len(next(iter(motions.values())).start)
    least = np.ones(batch)
    limiting: list[Pair | None] = [None] * batch
    for pair in pairs:
        a, b = (motions[name] for name in pair)
        gaps, slide, travel, turn = _plane_gaps(a, b) if b.is_plane else _box_gaps(a, b)
        # One normal that separates the two at the start and at the end does so all along.
        closing = np.where(gaps.min(axis=0).max(axis=1) > limits.clear, 0.0, travel)
        near = np.minimum(limits.step / np.maximum(slide, _NOTHING), limits.turn / np.maximum(turn, _NOTHING))
        far = np.maximum(gaps[0].max(axis=1) - reach, 0.0) / np.maximum(closing, _NOTHING)
        share = np.maximum(near, far)
        for env in np.flatnonzero(share < least).tolist():
            least[env], limiting[env] = share[env], pair
    return least, limiting


def clear_of_each_other(a: BoxMotion, b: BoxMotion, distance: float) -> np.ndarray:
    """Environments (B,) in which two boxes keep a ``distance`` [m] all along their motions.

    One normal of a face separates them by it at the start and at the end, and so in between. ``a`` must not be a half-space.
    """
    gaps = (_plane_gaps(a, b) if b.is_plane else _box_gaps(a, b))[0]
    return gaps.min(axis=0).max(axis=1) > distance


def _is_still(motion: BoxMotion) -> np.ndarray:
    """Environments (B,) in which a box does not move."""
    return (motion.start == motion.end).all(axis=(1, 2))


def _plane_gaps(a: BoxMotion, plane: BoxMotion) -> tuple[np.ndarray, ...]:
    """As ``_box_gaps``, of a box and a half-space: its one normal, and the box's lowest corner."""
    before, after = (inverse(p) @ t for p, t in ((plane.start, a.start), (plane.end, a.end)))
    start, end = (_transform(pose, a.corners()) for pose in (before, after))
    length, turn = _lengths(end - start), _relative_turn(before, after)
    lowest = start[:, :, 2].argmin(axis=1)
    gaps = np.stack([start[:, :, 2].min(axis=1), end[:, :, 2].min(axis=1) - _chord_error(start, end, turn)])
    return gaps[:, :, None], length[np.arange(len(start)), lowest], length.max(axis=1), turn


def _box_gaps(a: BoxMotion, b: BoxMotion) -> tuple[np.ndarray, ...]:
    """Relative motion of two boxes.

    Returns their separation along every face normal at the start and at the end [m], (2, B, 12); the displacement where they may meet
    [m], (B,); the longest of any corner [m], (B,); and the rotation [rad], (B,).
    """
    before, after = (inverse(p) @ t for p, t in ((b.start, a.start), (b.end, a.end)))
    start, end = (_transform(pose, a.corners()) for pose in (before, after))
    b_start, b_end = (_transform(inverse(pose), b.corners()) for pose in (before, after))  # of b, in the frame of a
    longest, turn = _lengths(end - start).max(axis=1), _relative_turn(before, after)
    error = np.maximum(_chord_error(start, end, turn), _chord_error(b_start, b_end, turn))[:, None]
    of_a = np.stack([_separation(start, b), _separation(end, b) - error])
    of_b = np.stack([_separation(b_start, a), _separation(b_end, a) - error])
    # They may meet at the centre of the overlap of both boxes, in the first one's frame.
    centre = 0.5 * (np.clip(b_start.min(axis=1), a.low, a.high) + np.clip(b_start.max(axis=1), a.low, a.high))[:, None]
    slide = _lengths(_transform(after, centre) - _transform(before, centre))[:, 0]
    return np.concatenate([of_a, of_b], axis=2), slide, longest, turn


def _separation(points: np.ndarray, box: BoxMotion) -> np.ndarray:
    """Separation of points (B, n, 3) from a box along each of its six normals [m], (B, 6)."""
    return np.concatenate([box.low - points.max(axis=1), points.min(axis=1) - box.high], axis=1)


def _chord_error(start: np.ndarray, end: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Greatest distance of a rotating corner from the straight line between its ends [m], (B,)."""
    radius = np.maximum(_lengths(start).max(axis=1), _lengths(end).max(axis=1))
    return radius * (1.0 - np.cos(0.5 * turn))


def _relative_turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return turn_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])


def _transform(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (B, n, 3) through poses (B, 4, 4)."""
    # In memory by points: reductions over them, and over coordinates, then go through all environments at once.
    moved = np.empty((points.shape[1], 3, len(poses)))
    np.einsum("bij,bnj->nib", poses[:, :3, :3], points, out=moved)
    moved += poses[:, :3, 3].T
    return moved.transpose(2, 0, 1)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (B, n) of vectors (B, n, 3)."""
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2)


def _move(poses: np.ndarray, centre: np.ndarray, displacement: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) after a rotation vector about a centre and a displacement, (B, 3) each."""
    rotation, result = rotations(turn), poses.copy()
    result[:, :3, :3] = rotation @ poses[:, :3, :3]
    result[:, :3, 3] = centre + displacement + np.einsum("bij,bj->bi", rotation, poses[:, :3, 3] - centre)
    return result
