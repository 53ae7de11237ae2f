"""Overlaps that no pad can have: bodies beyond a bonded face, where no gel remains to press, and bodies of the solver inside the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.gel.surface import make_grid
from raytac.physics.geoms import geom_part
from raytac.se3 import rotation_vector, rotations, turn_angle
from raytac.shapes.part import Part
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.shapes.primitives import UNDERSIDES, bounds
from raytac.shapes.underside import object_height, object_radius
from raytac.specs.sensor import GelpadSpec
from raytac.world.near_pads import half_spaces, near_pad
from raytac.world.world_model import WorldModel

_PITCH = 0.2e-3
"""Spacing of the vertical lines along which a bonded face is checked [m]."""
_MAX_PIECES = 100_000
"""Greatest number of pieces of one motion: 400 m, far more than a world's greatest speed allows in a step."""
_REACH = 1e-6
"""Greatest distance that MuJoCo reports [m]; only overlap matters."""


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


@dataclass(frozen=True)
class Inside:
    """Body of the solver that lies inside the robot."""

    body: str
    geom: str
    """Geom of the robot; one without a name has that of its body."""
    depth: float
    """Depth of the overlap [m]."""


class RobotOverlap:
    """Overlap of the solver's bodies with all geoms of the robot that collide in MuJoCo: cases, links, holders.

    The solver has neither cases nor links, so that nothing stops these bodies. Rigid ones are checked at the poses that MuJoCo mirrors,
    meshes by their convex hulls. Soft ones are checked by their surface's vertices, against boxes, balls, capsules, cylinders and
    half-spaces of the robot.
    """

    def __init__(self, composed: WorldModel) -> None:
        self.model = model = composed.model
        scene = {body.index for body in composed.touched}
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self.robot = np.array([g for g in np.flatnonzero(solid) if int(model.geom_bodyid[g]) not in scene], int)
        self.mirrors = {body.name: np.array(body.geoms) for body in composed.touched if body.mocap >= 0}
        known = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in SOLIDS}
        self._parts = {int(g): geom_part(model, int(g)) for g in self.robot if int(model.geom_type[g]) in known}

    def rigid(self, data: mujoco.MjData) -> list[Inside]:
        """Mirrored bodies inside the robot at the present poses (after ``mj_kinematics``)."""
        result, radius = [], self.model.geom_rbound
        for name, geoms in self.mirrors.items():
            for own in geoms:
                distance = np.linalg.norm(data.geom_xpos[self.robot] - data.geom_xpos[own], axis=1)
                near = (distance < radius[self.robot] + radius[own]) | (radius[self.robot] == 0.0)
                for geom in self.robot[near]:
                    gap = mujoco.mj_geomDistance(self.model, data, int(own), int(geom), _REACH, None)
                    if gap < 0.0:
                        result.append(Inside(name, self._name(int(geom)), -float(gap)))
        return result

    def soft(self, data: mujoco.MjData, name: str, vertices: np.ndarray) -> list[Inside]:
        """Overlaps of a soft body with the robot, by its surface's vertices (n, 3) [m], world frame."""
        result = []
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        reach = float(np.linalg.norm(vertices - middle, axis=1).max())
        for geom, part in self._parts.items():
            radius = self.model.geom_rbound[geom]
            if radius > 0.0 and np.linalg.norm(data.geom_xpos[geom] - middle) > radius + reach:
                continue
            body = int(self.model.geom_bodyid[geom])
            local = (vertices - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
            depth = float(point_depth(part, local).max())
            if depth > 0.0:
                result.append(Inside(name, self._name(geom), depth))
        return result

    def _name(self, geom: int) -> str:
        return self.model.geom(geom).name or f"of {self.model.body(int(self.model.geom_bodyid[geom])).name or 'the world'}"
