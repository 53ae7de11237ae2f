"""NumPy reference of the contact search, for its tests and its benchmark: ``PadSearch`` by ``PadOverlap`` and ``LoadLaw``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import PadGrid, make_grid
from raytac.physics.rigid.contacts import LAW_POINTS, PadContacts
from raytac.physics.rigid.load_law import LoadLaw
from raytac.shapes.part import Part
from raytac.shapes.underside import object_height, object_radius
from raytac.specs.sensor import GelpadSpec
from tests.physics.rigid.oracle_near import half_spaces, near_pad
from tests.physics.rigid.pad_overlap import PadOverlap, Touches, refined

__all__ = ["PadOverlap", "ReferenceSearch"]

_GAP_PITCH = 0.4e-3
"""Spacing of the nodes between which the least gap of a body that does not touch is looked for [m]."""
_SHALLOW = 0.1e-3
"""Overlap [m] that a body across a gap is given to find the place of the least gap."""


class ReferenceSearch:
    """Contacts of all bodies with all pads of a world."""

    def __init__(
        self, gelpads: Sequence[GelpadSpec], bodies: Sequence[Sequence[Part]], *, num_envs: int, device: str = "cpu"
    ) -> None:
        """``gelpads`` of the pads, parts of the bodies in their frames; ``num_envs`` and ``device`` do not matter here."""
        self._gelpads, self._bodies = tuple(gelpads), tuple(bodies)
        self._overlaps = [PadOverlap(gelpad) for gelpad in gelpads]
        self._radius = np.array([object_radius(parts) for parts in bodies])
        self._planes = half_spaces(bodies)
        self._grids: dict[tuple[int, float], PadGrid] = {}

    def contacts(self, pad_from_body: np.ndarray, envs: np.ndarray, reach: np.ndarray | float) -> PadContacts:
        """Bodies that touch pads or are nearer than ``reach`` [m], (n, pads) or a number.

        ``pad_from_body``: poses (n, pads, bodies, 4, 4) of the environments named.
        """
        reach = np.broadcast_to(reach, pad_from_body.shape[:2])
        rows: list[dict[str, np.ndarray]] = []
        for p, gelpad in enumerate(self._gelpads):
            near = near_pad(gelpad, self._radius, self._planes, pad_from_body[:, p], reach[:, p])
            for i in np.flatnonzero(near.any(axis=0)).tolist():
                some = np.flatnonzero(near[:, i])
                for row in self._pair(p, i, pad_from_body[some, p, i], reach[some, p]):
                    k = int(some[row.pop("row")])
                    rows.append({"env": envs[k], "pad": p, "body": i} | row)
        rows.sort(key=lambda row: (row["env"], row["pad"], row["body"]))
        shapes = {"centre": (3,), "normal": (3,), "spread": (3,), "force": (LAW_POINTS,), "radius": (LAW_POINTS,)}
        whole = ("env", "pad", "body")
        return PadContacts(
            **{
                name: np.array([row[name] for row in rows], int if name in whole else float).reshape(-1, *shapes.get(name, ()))
                for name in PadContacts.__dataclass_fields__
            }
        )

    def _pair(self, p: int, i: int, poses: np.ndarray, reach: np.ndarray) -> list[dict]:
        """Contacts of one pad and one body at poses (n, 4, 4)."""
        parts, radius, overlap = self._bodies[i], float(self._radius[i]), self._overlaps[p]
        touches = overlap.touches(parts, poses, radius)
        result = [self._row(p, i, int(row), poses, touches, k, 0.0) for k, row in enumerate(touches.env)]
        apart = np.setdiff1d(np.arange(len(poses)), touches.env)
        apart = apart[reach[apart] > 0.0]
        if len(apart):
            grid = self._grid(p, _GAP_PITCH)
            gap = refined(
                object_height(parts, poses[apart], grid.x, grid.y, below=float(reach[apart].max())) - grid.rest, _GAP_PITCH
            )
            some = (gap < reach[apart]) & np.isfinite(gap)
            apart, shift = apart[some], np.maximum(gap[some], 0.0) + _SHALLOW
            if len(apart):
                beside = overlap.touches(parts, _lowered(poses[apart], shift), radius)
                result += [
                    self._row(p, i, int(apart[row]), poses, beside, k, float(shift[row])) for k, row in enumerate(beside.env)
                ]
        return result

    def _grid(self, p: int, pitch: float) -> PadGrid:
        key = p, round(pitch, 7)
        if key not in self._grids:
            self._grids[key] = make_grid(self._gelpads[p], pitch)
        return self._grids[key]

    def _row(self, p: int, i: int, row: int, poses: np.ndarray, touches: Touches, k: int, shift: float) -> dict:
        gelpad, pitch = self._gelpads[p], float(np.sqrt(touches.cell[k]))
        grid = self._grid(p, pitch)
        under = object_height(self._bodies[i], poses[row][None], grid.x, grid.y)[0]
        depth = float(touches.depth[k]) - shift
        clearance = float(refined(under[None], pitch)[0]) + gelpad.thickness
        gap = under - grid.rest
        law = LoadLaw(np.maximum(gap + depth, 0.0), grid.x, grid.y, gelpad)
        deepest = min(max(depth + clearance, 1e-5), gelpad.thickness)
        at = deepest * (np.arange(LAW_POINTS) / (LAW_POINTS - 1)) ** 2
        spread = np.zeros(3)
        centre = touches.centre[k] + [0.0, 0.0, shift]
        if depth > 0.0:
            overlap = np.maximum(-gap, 0.0)
            x, y = grid.x[None, :] - centre[0], grid.y[:, None] - centre[1]
            inside = overlap > 0.0
            if inside.any():
                spread = np.array([(inside * xy).sum() for xy in (x * x, x * y, y * y)]) / overlap.sum()
        return {
            "row": row,
            "depth": depth,
            "centre": centre,
            "normal": touches.normal[k],
            "clearance": clearance,
            "spread": spread,
            "deepest": deepest,
            "force": np.interp(at, law.depth, law.table),
            "radius": np.interp(at, law.depth, law.radius),
        }


def _lowered(poses: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) nearer to the pad by ``shift`` (n,) [m]."""
    result = poses.copy()
    result[:, 2, 3] -= shift
    return result
