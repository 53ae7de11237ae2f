"""NumPy reference of the cells for which nodes at an outline stand: marching squares, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import rest_height
from raytac.physics.rigid.regions import cells_of
from raytac.shapes.part import Part
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

EXACT, ON_EDGE, IN_CELL, GENTLE = 30, 5, 2, 2.0
BESIDE = np.array([0.0, 1e-3])
"""A mesh has heights on two lines or more [m]."""
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
EDGED = "cylinder", "box", "cone", "torus", "mesh", "relief"


class Covered:
    """Cells of the nodes of one window of a grid."""

    def __init__(
        self, body: Sequence[Part], pose: np.ndarray, gelpad: GelpadSpec, lines: Sequence[np.ndarray], pitch: float
    ) -> None:
        """``lines``: x and y of the nodes [m]; ``pitch`` [m]: nominal spacing."""
        self._body, self._pose, self._gelpad, self._lines, self._pitch = body, pose[None], gelpad, lines, pitch
        around = [np.concatenate([v[:1] - (v[1] - v[0]), v, v[-1:] + (v[1] - v[0])]) for v in lines]
        self._x, self._y = around
        on_pad = [np.abs(v) < 0.5 * size + 1e-9 for v, size in zip(around, gelpad.size, strict=True)]
        self._on_pad = on_pad[1][:, None] & on_pad[0]
        self._gap = np.where(self._on_pad, self._gaps(self._x, self._y), np.inf)

    def cells(self, below: float) -> np.ndarray:
        """Of each node, (Ny, Nx); those with a gap ``below`` one [m] count."""
        more, gap = np.zeros_like(self._gap), self._gap
        inside = gap < below
        count = inside[:-1, :-1].astype(int) + inside[1:, :-1] + inside[:-1, 1:] + inside[1:, 1:]
        pads = self._on_pad[:-1, :-1] & self._on_pad[1:, 1:]
        if any(part.kind in EDGED for part in self._body):
            for j, i in np.argwhere((count > 0) & (count < 4) & pads):
                column, row = i + CORNERS[:, 0], j + CORNERS[:, 1]
                here = inside[row, column]
                share = self._share(np.stack([self._x[column], self._y[row]], axis=1), gap[row, column], here, below)
                more[row[here], column[here]] += share / here.sum() - 0.25
        return cells_of(self._lines[0], self._lines[1], self._gelpad) + more[1:-1, 1:-1]

    def _share(self, at: np.ndarray, gap: np.ndarray, inside: np.ndarray, below: float) -> float:
        """Covered share of a cell with corners ``at`` (4, 2)."""
        following = np.roll(np.arange(4), -1)
        crossed = inside != inside[following]
        with np.errstate(invalid="ignore"):
            rise = np.where(crossed, np.abs(gap - gap[following]), 0.0)
        steep = np.clip(rise / (GENTLE * self._pitch) - 1.0, 0.0, 1.0)
        ends = np.full(4, 0.5)
        for k in np.flatnonzero(steep > 0.0):
            start, stop = (at[k], at[following[k]]) if inside[k] else (at[following[k]], at[k])
            ends[k] += steep[k] * (self._end(start, stop - start, below, ON_EDGE) - 0.5)
        if not steep.any():
            return 0.25 * inside.sum()
        if inside.sum() == 2 and crossed.sum() == 2:
            return 0.5 * ends[crossed].sum()
        area = 1.0 if inside.sum() == 3 else 0.0
        for k in range(4):
            p, q, sharp = ends[k], ends[k - 1], max(steep[k], steep[k - 1])
            if inside[k] and inside.sum() < 3:
                part = 1.0
                if sharp > 0.0:
                    diagonal = p * (at[following[k]] - at[k]) + q * (at[k - 1] - at[k])
                    part += sharp * (self._end(at[k], diagonal, below, IN_CELL) - 1.0)
                area += part * p * q
            elif not inside[k] and inside.sum() == 3:
                area -= (1.0 - 0.5 * sharp) * (1.0 - p) * (1.0 - q)
        return area

    def _end(self, start: np.ndarray, step: np.ndarray, below: float, halvings: int) -> float:
        low, high = 0.0, 1.0
        rest = [rest_height(self._gelpad, v[:1], v[1:]).item() for v in (start, start + step)]
        for _ in range(EXACT if all(part.kind == "box" for part in self._body) else halvings):
            middle = 0.5 * (low + high)
            x, y = start + middle * step
            z = float(object_height(self._body, self._pose, x + BESIDE, y + BESIDE)[0, 0, 0])
            counts = z >= -self._gelpad.thickness and z - rest[0] - middle * (rest[1] - rest[0]) < below
            low, high = (middle, high) if counts else (low, middle)
        return 0.5 * (low + high)

    def _gaps(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        z = object_height(self._body, self._pose, x, y)[0]
        return np.where(z < -self._gelpad.thickness, np.inf, z - rest_height(self._gelpad, x[None, :], y[:, None]))
