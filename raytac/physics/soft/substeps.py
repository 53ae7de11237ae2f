"""Where pads and bodies of a soft scene go in a step: their poses, and into how many parts the step must be cut."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.physics.soft.bodies import SceneBody
from raytac.se3 import between, rotations

if TYPE_CHECKING:
    from raytac.physics.soft.scene import SoftScene
from collections.abc import Sequence

from raytac.se3 import inverse, turn_angle

__all__ = ["MOST_SUBSTEPS", "STEP", "TURN", "Mover", "Pair", "Poses", "SceneReport", "Travel", "allowed_share"]


MOST_SUBSTEPS = 64
"""Parts that one step may be cut into: 6.4 mm or 128° near something."""
_REACH = 4.0
"""Bodies closer than so many d̂ are near."""


@dataclass(frozen=True)
class Poses:
    """Of all that is driven, ``world_from_…``."""

    pads: np.ndarray
    """(B, S, 4, 4)."""
    bodies: dict[str, np.ndarray]
    """(B, 4, 4) by name."""

    def copy(self) -> Poses:
        return Poses(self.pads.copy(), {name: pose.copy() for name, pose in self.bodies.items()})

    def towards(self, goal: Poses, share: float) -> Poses:
        """A share of the way to ``goal``."""
        pads = [between(self.pads[:, k], goal.pads[:, k], share) for k in range(self.pads.shape[1])]
        return Poses(np.stack(pads, axis=1), {name: between(self.bodies[name], p, share) for name, p in goal.bodies.items()})

    def longest(self, goal: Poses, b: int) -> float:
        """Longest way of any origin of environment ``b`` to ``goal`` [m]."""
        ways = [np.linalg.norm((goal.pads - self.pads)[b, :, :3, 3], axis=-1).max()]
        ways += [np.linalg.norm((goal.bodies[n] - p)[b, :3, 3]) for n, p in self.bodies.items()]
        return float(max(ways))


class Travel:
    """Cuts the steps of a scene: half, a quarter and so on of it, never more than bodies that are near may move against each other."""

    def __init__(self, scene: SoftScene) -> None:
        self.scene = scene
        pads, bodies = list(scene.pads), list(scene.bodies.values())
        self.pairs: list[Pair] = [(a, b) for k, a in enumerate(pads) for b in pads[k + 1 :]]
        self.pairs += [(a, b.name) for a in pads for b in bodies]
        for k, a in enumerate(bodies):  # the solver alone sees to those that are both free; a half-space comes second
            others = [b for b in bodies[k + 1 :] if a.is_driven != b.is_driven]
            flip = isinstance(a.solid, ipc.HalfSpace)
            self.pairs += [(b.name, a.name) if flip else (a.name, b.name) for b in others]

    def part(self, done: int, now: Poses, goal: Poses, dt: float) -> tuple[int, dict[int, Pair | None]]:
        """How much of a step of ``dt`` [s] may be made next, and environments where even the least part is too much, with the pair.

        In ``MOST_SUBSTEPS``-ths, a power of two that ``done`` is a multiple of; what is too much counts for nothing in it. What no one
        drives may be too fast (a beam that snaps back): that is the solver's to resolve, in the smallest parts.
        """
        room, pairs = self._room(done, self._movers(now, goal, dt * (1.0 - done / MOST_SUBSTEPS)))
        if (room < 1.0).any():
            driven = self._room(done, self._movers(now, goal, 0.0))[0]
            room = np.where((room < 1.0) & (driven >= 1.0), 1.0, room)
        least = room[room >= 1.0].min(initial=MOST_SUBSTEPS)
        part = MOST_SUBSTEPS
        while part > least or done % part:
            part //= 2
        return part, {b: pairs[b] for b in np.flatnonzero(room < 1.0).tolist()}

    def _room(self, done: int, movers: Mapping[str, Mover]) -> tuple[np.ndarray, list[Pair | None]]:
        """Sixty-fourths of the step that these motions leave in every environment (B,), and the pairs that set it."""
        pairs = [(a, b) for a, b in self.pairs if not (_is_still(movers[a]) and _is_still(movers[b]))]
        share, limiting = allowed_share(movers, pairs, _REACH * self.scene.world.d_hat)
        return (MOST_SUBSTEPS - done) * share * (1.0 + 1e-9), limiting

    def refusal(self, b: int, pair: Pair | None, now: Poses, goal: Poses) -> InputError:
        """The error of a motion of environment ``b`` that cannot be resolved."""
        where = f"in environment {b} " if self.scene.num_envs > 1 else ""
        rule = (
            f"{where}takes {' and '.join(pair or ())} too far against each other where they are near: "
            f"at most {MOST_SUBSTEPS * STEP * 1e3:.3g} mm "
            f"or {np.degrees(MOST_SUBSTEPS * TURN):.3g} degrees in one step of {self.scene.settings.dt} s; move slower or in more steps"
        )
        return InputError("world_from_pad", value=f"ways of up to {now.longest(goal, b) * 1e3:.3g} mm", rule=rule)

    def _movers(self, now: Poses, goal: Poses, left: float) -> dict[str, Mover]:
        found = {}
        for k, (name, pad) in enumerate(self.scene.pads.items()):
            rest, at = pad.mesh.tets.vertices, self.scene.world.positions(name, frame="body")
            low, high = np.minimum(rest.min(axis=0), at.min(axis=1)), np.maximum(rest.max(axis=0), at.max(axis=1))
            found[name] = Mover(now.pads[:, k], goal.pads[:, k], low, high)
        for name, body in self.scene.bodies.items():
            found[name] = self._mover(body, now.bodies, goal.bodies, left)
        failed = self.scene.failed[:, None, None]
        if failed.any():  # nothing moves there, whatever speed it had
            found = {name: replace(mover, end=np.where(failed, mover.start, mover.end)) for name, mover in found.items()}
        return found

    def _mover(self, body: SceneBody, now: Mapping[str, np.ndarray], goal: Mapping[str, np.ndarray], left: float) -> Mover:
        name, solid, one = body.name, body.solid, np.ones((self.scene.num_envs, 1))
        if isinstance(solid, ipc.HalfSpace):
            return Mover(now[name], goal[name], 0.0 * one, 0.0 * one, is_plane=True)
        start = now[name] if body.is_driven else self.scene.pose(name)
        if isinstance(solid, ipc.SoftBody):
            at = np.einsum("bji,bnj->bni", start[:, :3, :3], self.scene.world.positions(name) - start[:, None, :3, 3])
            end = self._pulled(solid, start, goal[name], left) if body.is_driven else self._carried(name, start, left)
            return Mover(start, end, at.min(axis=1), at.max(axis=1))
        vertices = solid.surface.vertices
        end = goal[name] if body.is_driven else self._carried(name, start, left)
        return Mover(start, end, one * vertices.min(axis=0), one * vertices.max(axis=0))

    def _carried(self, name: str, start: np.ndarray, left: float) -> np.ndarray:
        """Where a free body's momentum takes its pose in the time ``left`` [s]."""
        motion = self.scene.world.rigid_motion(name)
        return _moved(start, motion.centre, left * motion.velocity, left * motion.spin)

    def _pulled(self, solid: ipc.SoftBody, start: np.ndarray, goal: np.ndarray, left: float) -> np.ndarray:
        """The same of a soft body that is held somewhere: its places in contact, as they move now; without any, it is where it is held."""
        world = self.scene.world
        load = np.linalg.norm(world.contact_forces(solid.name), axis=2)
        touched = load.sum(axis=1) > 0.0
        if not touched.any():
            return goal
        nodes = world.surface(solid.name)[0]
        x, v = world.positions(solid.name)[:, nodes], world.velocities(solid.name)[:, nodes]
        share = load / np.where(touched, load.sum(axis=1), 1.0)[:, None]
        centre, velocity = np.einsum("bn,bni->bi", share, x), np.einsum("bn,bni->bi", share, v)
        arm = x - centre[:, None]
        second = np.einsum("bn,bni,bnj->bij", share, arm, arm) + 1e-12 * np.eye(3)
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        momentum = np.einsum("bn,bni->bi", share, np.cross(arm, v - velocity[:, None]))
        spin = np.linalg.solve(inertia, momentum[..., None])[..., 0]
        return np.where(touched[:, None, None], _moved(start, centre, left * velocity, left * spin), goal)


def _moved(poses: np.ndarray, centre: np.ndarray, way: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) after a turn about a centre [m] and a way, (B, 3) each."""
    rotation, found = rotations(turn), poses.copy()
    found[:, :3, :3] = rotation @ poses[:, :3, :3]
    found[:, :3, 3] = centre + way + np.einsum("bij,bj->bi", rotation, poses[:, :3, 3] - centre)
    return found


def _is_still(mover: Mover) -> bool:
    return np.array_equal(mover.start, mover.end)


@dataclass(frozen=True)
class SceneReport:
    """One step of B environments, all of its parts together; every array has shape (B,).

    failed: a number was not finite; the environment stays as it was until it is reset. converged: every part met its tolerance.
    unconverged: how many parts of an environment that has not failed did not. last_converged: whether the last part did.
    min_gap: least distance between surfaces [m], inf if none was near. min_det: least det F of any tetrahedron [-]. blocked: largest share
    of a part's motion that was refused because it would crush what is in the way. newton: iterations. elastic, barrier: energies at the
    end [J]. substeps: parts of the step.
    """

    failed: np.ndarray
    converged: np.ndarray
    unconverged: np.ndarray
    last_converged: np.ndarray
    min_gap: np.ndarray
    min_det: np.ndarray
    blocked: np.ndarray
    newton: np.ndarray
    elastic: np.ndarray
    barrier: np.ndarray
    substeps: int

    def then(self, later: SceneReport) -> SceneReport:
        """Both parts of a step as one."""
        return SceneReport(
            self.failed | later.failed,
            self.converged & later.converged,
            self.unconverged + later.unconverged,
            later.last_converged,
            np.minimum(self.min_gap, later.min_gap),
            np.minimum(self.min_det, later.min_det),
            np.maximum(self.blocked, later.blocked),
            self.newton + later.newton,
            later.elastic,
            later.barrier,
            self.substeps + later.substeps,
        )


STEP = 1e-4
"""Longest relative way of two bodies that may touch, in one step of the solver [m]."""
TURN = 0.035
"""Largest relative turn in one step [rad]: 0.1 mm at 3 mm from the axis."""
_NOTHING = 1e-15
_CLEAR = 1e-3
"""Two boxes that one face's normal keeps so far apart, before and after, do not meet on the way [m]."""
_CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], float)


@dataclass(frozen=True)
class Mover:
    """A box that goes from one pose to another, in B environments; or a half-space, z <= 0 of its frame."""

    start: np.ndarray
    """``world_from_box`` (B, 4, 4)."""
    end: np.ndarray
    """Where it is told to be, or where its velocity takes it."""
    low: np.ndarray
    high: np.ndarray
    """Corners of the box in its frame [m], (B, 3) each; of a half-space not used."""
    is_plane: bool = False

    def corners(self) -> np.ndarray:
        """(B, 8, 3) [m], in its frame."""
        return self.low[:, None] + _CORNERS * (self.high - self.low)[:, None]


Pair = tuple[str, str]


def allowed_share(movers: Mapping[str, Mover], pairs: Sequence[Pair], reach: float) -> tuple[np.ndarray, list[Pair | None]]:
    """Largest share of all ways, in (0, 1], that brings no pair of bodies too far in one step, and the pair that sets it, by environment.

    Two bodies whose boxes are ``reach`` [m] apart or more may come that much nearer in one step; closer ones move by at most ``STEP``
    and ``TURN`` against each other. The distance of two boxes is bounded from below by their separation along the normals of their
    faces; boxes that one of these keeps a millimetre apart at both ends of the way are free to go. The first of a pair must not be a
    half-space.
    """
    batch = len(next(iter(movers.values())).start)
    least = np.ones(batch)
    limiting: list[Pair | None] = [None] * batch
    for pair in pairs:
        a, b = (movers[name] for name in pair)
        if b.is_plane:
            gap, way, turn, free_way = _against_plane(a, b)
        else:
            gap, way, turn, free_way = _against_box(a, b)
        near = np.minimum(STEP / np.maximum(way, _NOTHING), TURN / np.maximum(turn, _NOTHING))
        far = np.maximum(gap - reach, 0.0) / np.maximum(free_way, _NOTHING)
        share = np.maximum(near, far)
        for b in np.flatnonzero(share < least).tolist():
            least[b], limiting[b] = share[b], pair
    return least, limiting


def _place(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (B, n, 3) through poses (B, 4, 4)."""
    return np.einsum("bij,bnj->bni", poses[:, :3, :3], points) + poses[:, None, :3, 3]


def _against_plane(a: Mover, plane: Mover) -> tuple[np.ndarray, ...]:
    before, after = (inverse(p) @ t for p, t in ((plane.start, a.start), (plane.end, a.end)))
    there, then = (_place(pose, a.corners()) for pose in (before, after))
    moved = np.linalg.norm(then - there, axis=2)
    lowest = there[:, :, 2].argmin(axis=1)
    one = np.arange(len(there))
    turn = _turn(before, after)
    gaps = np.stack([there[:, :, 2].min(axis=1), then[:, :, 2].min(axis=1) - _bulge(there, then, turn)])
    return gaps[0], moved[one, lowest], turn, _free_way(moved.max(axis=1), gaps[:, :, None])


def _against_box(a: Mover, b: Mover) -> tuple[np.ndarray, ...]:
    before, after = (inverse(p) @ t for p, t in ((b.start, a.start), (b.end, a.end)))
    there, then = (_place(pose, a.corners()) for pose in (before, after))
    moved = np.linalg.norm(then - there, axis=2).max(axis=1)
    back, later = (_place(inverse(pose), b.corners()) for pose in (before, after))
    turn = _turn(before, after)
    bulge = np.maximum(_bulge(there, then, turn), _bulge(back, later, turn))
    gaps = np.stack([_apart(there, b), _apart(then, b) - bulge[:, None]])
    gaps = np.concatenate([gaps, np.stack([_apart(back, a), _apart(later, a) - bulge[:, None]])], axis=2)
    # Where they may meet: the middle of what the second box and the first's own have in common, as seen from the first.
    middle = 0.5 * (np.clip(back.min(axis=1), a.low, a.high) + np.clip(back.max(axis=1), a.low, a.high))[:, None]
    way = np.linalg.norm((_place(after, middle) - _place(before, middle))[:, 0], axis=1)
    return gaps[0].max(axis=1), way, turn, _free_way(moved, gaps)


def _apart(points: np.ndarray, box: Mover) -> np.ndarray:
    """Separation of points (B, n, 3) from a box along each of its six normals [m], (B, 6)."""
    return np.concatenate([box.low - points.max(axis=1), points.min(axis=1) - box.high], axis=1)


def _free_way(moved: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """The way ``moved`` (B,) that may use up a gap; 0 where one normal separates the two at the start and at the end, so all along.

    ``gaps``: start and end, (2, B, normals) [m].
    """
    return np.where(gaps.min(axis=0).max(axis=1) > _CLEAR, 0.0, moved)


def _bulge(there: np.ndarray, then: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """How far the way of a turning box can leave its chord [m], (B,)."""
    reach = np.maximum(np.linalg.norm(there, axis=2).max(axis=1), np.linalg.norm(then, axis=2).max(axis=1))
    return reach * (1.0 - np.cos(0.5 * turn))


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return turn_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
