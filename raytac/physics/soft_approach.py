"""How far driven bodies may go in one step of the contact solver: far where nothing is near, a tenth of a millimetre in contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from raytac.physics.rotation import inverse, turn_angle

__all__ = ["STEP", "TURN", "Mover", "Pair", "allowed_share"]

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
