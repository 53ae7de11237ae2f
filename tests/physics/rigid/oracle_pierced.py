"""Bodies beyond the bonded faces of pads, in NumPy: the oracle of ``pierce_kernels``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import make_grid
from raytac.se3 import rotation_vector, rotations, turn_angle
from raytac.shapes.part import Part
from raytac.shapes.primitives import UNDERSIDES, bounds
from raytac.shapes.underside import object_height, object_radius
from raytac.specs.sensor import GelpadSpec
from tests.physics.rigid.oracle_near import half_spaces, near_pad

_PITCH = 0.2e-3
"""Spacing of the vertical lines along which a bonded face is checked [m]."""
_MAX_PIECES = 100_000
"""Greatest number of pieces of one motion."""


class BondedFace:
    """Bonded face of a pad's gel, and the case behind it, one thickness of the gel deep.

    A body with a point in that layer, under the gel, has gone through the gel or the case. A body that lies wholly behind the layer, on the
    other side of the sensor, has not. A motion through the layer is detected if it is checked at every thickness.
    """

    def __init__(self, gelpad: GelpadSpec) -> None:
        self._bond, self._depth = -gelpad.thickness, gelpad.thickness
        grid = make_grid(gelpad, _PITCH)
        # Without the outermost lines: MuJoCo lets bodies some hundredths of a millimetre into walls, and a case may be as wide as its gel.
        self._x, self._y = grid.x[1:-1], grid.y[1:-1]
        self._reach = 0.5 * float(np.hypot(*gelpad.size))

    def pierced(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float) -> np.ndarray:
        """True (n,) where a body at poses (n, 4, 4) lies beyond the face; ``radius`` [m]: bounding ball about its origin."""
        result = np.zeros(len(pad_from_body), bool)
        low = np.flatnonzero(_lowest(parts, pad_from_body, radius) < self._bond)
        if not len(low):
            return result
        under = object_height(parts, pad_from_body[low], self._x, self._y, below=self._bond)
        some = np.flatnonzero((under < self._bond).any(axis=(1, 2)))
        if not len(some):
            return result
        # The top of the body is the underside of the body rotated by half a turn about x.
        flipped = np.diag([1.0, -1.0, -1.0, 1.0]) @ pad_from_body[low[some]]
        top = -object_height(parts, flipped, self._x, -self._y[::-1])[:, ::-1]
        top[np.isneginf(top)] = np.inf  # a half-space that faces down is unbounded above
        result[low[some]] = ((under[some] < self._bond) & (top > self._bond - self._depth)).any(axis=(1, 2))
        return result

    def pieces(self, before: np.ndarray, after: np.ndarray, radius: float) -> np.ndarray:
        """Numbers (n,) of pieces of motions between poses (n, 4, 4), so short that no point moves by more than a thickness.

        1 where a pose is NaN.
        """
        angle = turn_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
        if np.isfinite(radius):
            length = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) + angle * radius
        else:  # a half-space moves along its normal
            offset = [np.vecdot(poses[:, :3, 2], poses[:, :3, 3]) for poses in (before, after)]
            length = np.abs(offset[1] - offset[0]) + angle * self._reach
        return np.nan_to_num(np.clip(np.ceil(length / self._depth), 1, _MAX_PIECES), nan=1.0).astype(int)

    @staticmethod
    def poses_between(before: np.ndarray, after: np.ndarray, pieces: int) -> np.ndarray:
        """Intermediate poses (pieces − 1, 4, 4) on the straight path between two poses (4, 4)."""
        share = (np.arange(1, pieces) / pieces)[:, None]
        result = np.tile(np.eye(4), (len(share), 1, 1))
        result[:, :3, :3] = before[:3, :3] @ rotations(share * rotation_vector(before[:3, :3].T @ after[:3, :3]))
        result[:, :3, 3] = before[:3, 3] + share * (after[:3, 3] - before[:3, 3])
        return result


class BondedFaces:
    """Bonded faces of all pads of a world."""

    def __init__(self, gelpads: Sequence[GelpadSpec], bodies: Sequence[Sequence[Part]]) -> None:
        """``bodies``: parts of each in its frame."""
        self._gelpads, self._bodies = tuple(gelpads), tuple(bodies)
        self._faces = [BondedFace(gelpad) for gelpad in gelpads]
        self._radius = np.array([object_radius(parts) for parts in bodies])
        self._planes = half_spaces(bodies)
        self._frame = np.tile(np.eye(4), (len(bodies), 1, 1))
        """Pose of a half-space in its body's frame; the identity of all else."""
        self._frame[self._planes[0]] = self._planes[1]

    def pierced(self, pad_from_body: np.ndarray) -> np.ndarray:
        """True (n, pads, bodies) where bodies at poses (n, pads, bodies, 4, 4) lie beyond a pad's bonded face."""
        near = [self._near(k, pad_from_body[:, k]) for k in range(len(self._faces))]
        result = np.stack(near, axis=1) if near else np.zeros(pad_from_body.shape[:3], bool)
        for k, i in np.argwhere(result.any(axis=0)).tolist():
            rows = np.flatnonzero(result[:, k, i])
            result[rows, k, i] = self._faces[k].pierced(self._bodies[i], pad_from_body[rows, k, i], float(self._radius[i]))
        return result

    def pierced_on_path(self, pad_from_body: np.ndarray, before: np.ndarray, suspects: np.ndarray) -> np.ndarray:
        """True (n, pads, bodies) where bodies at poses (n, pads, bodies, 4, 4) are beyond a face, or were on the path from ``before``.

        ``before``: poses that they come from, NaN where unknown. ``suspects`` (n, pads, bodies): nothing else is looked at.
        """
        result = np.zeros(suspects.shape, bool)
        for k, i in np.argwhere(suspects.any(axis=0)).tolist():
            face, parts, radius = self._faces[k], self._bodies[i], float(self._radius[i])
            rows = np.flatnonzero(suspects[:, k, i])
            start, end = before[rows, k, i], pad_from_body[rows, k, i]
            result[rows, k, i] = face.pierced(parts, end, radius)
            pieces = face.pieces(start @ self._frame[i], end @ self._frame[i], radius)
            for row in np.flatnonzero(pieces > 1).tolist():
                path = face.poses_between(start[row], end[row], int(pieces[row]))
                path = path[self._near(k, np.repeat(path[:, None], len(self._bodies), axis=1))[:, i]]
                result[rows[row], k, i] |= face.pierced(parts, path, radius).any()
        return result

    def _near(self, pad: int, poses: np.ndarray) -> np.ndarray:
        return near_pad(self._gelpads[pad], self._radius, self._planes, poses)


def _lowest(parts: Sequence[Part], poses: np.ndarray, radius: float) -> np.ndarray:
    """Lower bounds (n,) [m] of the heights of a body at poses (n, 4, 4)."""
    lowest = np.full(len(poses), np.inf)
    for part in parts:
        if part.kind in UNDERSIDES:
            lowest = np.minimum(lowest, bounds(part.kind, part.size, poses @ part.object_from_part)[0][:, 2])
        else:
            lowest = np.minimum(lowest, poses[:, 2, 3] - radius)
    return lowest
