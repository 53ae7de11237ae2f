"""Overlap of a body and a resting pad, found on a grid of nodes, and the load law that goes with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.object_height import object_height
from raytac.gel.pad import make_grid
from raytac.gel.part import Part
from raytac.physics.load_law import LoadLaw
from raytac.specs.sensor import GelpadSpec

__all__ = ["PadOverlap", "Touch"]

_PITCHES = 0.8e-3, 0.4e-3, 0.2e-3
"""Spacings of the nodes [m]: a contact is measured on the first grid of which it covers enough nodes, else on the last."""
_ENOUGH = 150
"""Nodes: 96 mm² of the first grid, 24 mm² of the second."""
_NEAR = 0.75
"""Between nodes that all stay this share of the spacing from the gel a body does not touch: a cone of 45° would reach 0.71 further."""


@dataclass(frozen=True)
class Touch:
    """Overlap of one body and one resting pad, pad frame."""

    depth: float
    """Greatest overlap [m]."""
    centre: np.ndarray
    """Centroid of the overlap on the body's underside [m], (3,)."""
    normal: np.ndarray
    """Unit normal of the resting gel there, (3,)."""
    gap: np.ndarray
    """Distance along z from the resting gel to the body [m], (Ny, Nx); negative where they overlap, inf where there is no body."""
    cell: float
    """Area of one of its nodes [m²]."""


class PadOverlap:
    """One pad at rest; bodies are held against it."""

    def __init__(self, gelpad: GelpadSpec) -> None:
        self._gelpad = gelpad
        self._grids = [_Nodes(gelpad, pitch) for pitch in _PITCHES]
        self.highest = self._grids[-1].highest

    def touch(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float) -> Touch | None:
        """How a body at a pose (4, 4) overlaps the pad; None where it does not. ``radius`` [m] of a ball that holds the body."""
        finest = self._grids[-1]
        for nodes in self._grids[:-1]:
            found, near = nodes.measure(parts, pad_from_body, radius, reach=_NEAR * nodes.pitch)
            if not near:
                return None
            count = 0 if found is None else np.count_nonzero(found.gap < 0.0)
            if count >= _ENOUGH:
                return found
            if count < _ENOUGH // 8:
                break  # with half the spacing there are four times as many, at most half of enough
        return finest.measure(parts, pad_from_body, radius)[0]

    def law(self, touch: Touch) -> LoadLaw:
        """Load law of the body that touches, at this place and angle."""
        return LoadLaw(np.maximum(touch.gap + touch.depth, 0.0), touch.cell, self._gelpad)


class _Nodes:
    def __init__(self, gelpad: GelpadSpec, pitch: float) -> None:
        grid = make_grid(gelpad, pitch)
        self.x, self.y, self.rest = grid.x, grid.y, grid.rest
        self.pitch, self.cell = pitch, grid.pitch[0] * grid.pitch[1]
        self.highest = float(grid.rest.max())
        # The rest surface is a sum of a function of x and one of y (``GelpadSpec.sag``), and so are its slopes.
        self.rest_x, self.rest_y = -gelpad.sag(grid.x, 0.0), -gelpad.sag(0.0, grid.y)
        self.slope_x, self.slope_y = np.gradient(self.rest_x, grid.x), np.gradient(self.rest_y, grid.y)

    def measure(
        self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float, reach: float = 0.0
    ) -> tuple[Touch | None, bool]:
        """The overlap, if there is one, and whether the body comes nearer to the gel than ``reach`` [m]."""
        columns, rows = (
            slice(*np.searchsorted(line, (at - radius, at + radius)))
            for line, at in zip((self.x, self.y), pad_from_body[:2, 3], strict=True)
        )
        x, y = self.x[columns], self.y[rows]
        if len(x) < 2 or len(y) < 2:
            return None, True  # too small for this grid to tell
        under = object_height(parts, pad_from_body[None], x, y, below=self.highest + reach)[0]
        gap = under - self.rest[rows, columns]
        least = float(gap.min())
        if not least < 0.0:
            return None, least < reach
        # Moments of the overlap by its sums along the axes: the vectors are short then, and the gel is a sum of two functions.
        overlap = np.minimum(gap, 0.0)
        along_x, along_y = overlap.sum(axis=0), overlap.sum(axis=1)
        total = float(along_x.sum())
        along_x, along_y = along_x / total, along_y / total
        gel = along_x @ self.rest_x[columns] + along_y @ self.rest_y[rows]
        height = gel + float(np.square(overlap).sum()) / total
        normal = np.array([-(along_x @ self.slope_x[columns]), -(along_y @ self.slope_y[rows]), 1.0])
        centre = np.array([along_x @ x, along_y @ y, height])
        return Touch(-_refined(gap, least), centre, normal / math.sqrt(normal @ normal), gap, self.cell), True


def _refined(gap: np.ndarray, least: float) -> float:
    """The least gap between the nodes: parabolas through the least node and its neighbours along both axes, exact for a ball on a dome."""
    j, i = np.unravel_index(int(gap.argmin()), gap.shape)
    for line, at in ((gap[j], i), (gap[:, i], j)):
        if not 0 < at < len(line) - 1:
            continue
        before, after = float(line[at - 1]), float(line[at + 1])
        curve = before + after - 2.0 * float(gap[j, i])
        if np.isfinite(curve) and curve > 0.0:
            least -= 0.125 * (after - before) ** 2 / curve
    return least
