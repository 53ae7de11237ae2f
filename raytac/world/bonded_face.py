"""Bodies beyond a pad's bonded face, where no gel is left to press: a state that no pad can have, also between two steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import make_grid
from raytac.se3 import rotation_vector, rotations, turn_angle
from raytac.shapes.part import Part
from raytac.shapes.primitives import UNDERSIDES, bounds
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

__all__ = ["BondedFace"]

_PITCH = 0.2e-3
"""Spacing of the vertical lines that are looked at [m]."""
_MOST = 100_000
"""Pieces of one motion at most: 400 m, far more than a world's greatest speed allows in a step."""


class BondedFace:
    """The face that a pad's gel is bonded to, and the case right behind it, one thickness deep.

    A body that has a point in there, under the gel, has gone through the gel or the case. One that lies wholly behind it, on the other
    side of the sensor, has not. A motion from one side to the other is seen if it is looked at every thickness.
    """

    def __init__(self, gelpad: GelpadSpec) -> None:
        self._bond, self._depth = -gelpad.thickness, gelpad.thickness
        grid = make_grid(gelpad, _PITCH)
        # Not the outermost lines: MuJoCo lets bodies some hundredths of a millimetre into walls, and a case may be no wider than its gel.
        self._x, self._y = grid.x[1:-1], grid.y[1:-1]
        self._reach = 0.5 * float(np.hypot(*gelpad.size))

    def pierced(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float) -> np.ndarray:
        """Whether a body at poses (n, 4, 4) lies beyond the face, (n,); ``radius`` [m] of a ball about its origin that holds it."""
        found = np.zeros(len(pad_from_body), bool)
        low = np.flatnonzero(_lowest(parts, pad_from_body, radius) < self._bond)
        if not len(low):
            return found
        under = object_height(parts, pad_from_body[low], self._x, self._y, below=self._bond)
        some = np.flatnonzero((under < self._bond).any(axis=(1, 2)))
        if not len(some):
            return found
        # Its topside is the underside of the body turned by half a turn about x.
        turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ pad_from_body[low[some]]
        top = -object_height(parts, turned, self._x, -self._y[::-1])[:, ::-1]
        top[np.isneginf(top)] = np.inf  # a half-space that looks down has no end above
        found[low[some]] = ((under[some] < self._bond) & (top > self._bond - self._depth)).any(axis=(1, 2))
        return found

    def pieces(self, before: np.ndarray, after: np.ndarray, radius: float) -> np.ndarray:
        """Pieces (n,) of motions between poses (n, 4, 4), in none of which a point goes further than a thickness; 1 where a pose is NaN."""
        angle = turn_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
        if np.isfinite(radius):
            length = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) + angle * radius
        else:  # a half-space moves along its normal
            offset = [np.vecdot(poses[:, :3, 2], poses[:, :3, 3]) for poses in (before, after)]
            length = np.abs(offset[1] - offset[0]) + angle * self._reach
        return np.nan_to_num(np.clip(np.ceil(length / self._depth), 1, _MOST), nan=1.0).astype(int)

    @staticmethod
    def poses_between(before: np.ndarray, after: np.ndarray, pieces: int) -> np.ndarray:
        """The ``pieces`` − 1 poses on the straight path between two poses (4, 4)."""
        share = (np.arange(1, pieces) / pieces)[:, None]
        found = np.tile(np.eye(4), (len(share), 1, 1))
        found[:, :3, :3] = before[:3, :3] @ rotations(share * rotation_vector(before[:3, :3].T @ after[:3, :3]))
        found[:, :3, 3] = before[:3, 3] + share * (after[:3, 3] - before[:3, 3])
        return found


def _lowest(parts: Sequence[Part], poses: np.ndarray, radius: float) -> np.ndarray:
    """Heights (n,) [m] that a body at poses (n, 4, 4) does not reach below."""
    lowest = np.full(len(poses), np.inf)
    for part in parts:
        if part.kind in UNDERSIDES:
            lowest = np.minimum(lowest, bounds(part.kind, part.size, poses @ part.object_from_part)[0][:, 2])
        else:
            lowest = np.minimum(lowest, poses[:, 2, 3] - radius)
    return lowest
