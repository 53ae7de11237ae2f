"""Overlap of a body and a resting pad, found on a grid of nodes, and the load law that goes with it; all environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.object_height import object_height
from raytac.gel.pad import make_grid
from raytac.gel.part import Part
from raytac.physics.load_law import LoadLaw
from raytac.specs.sensor import GelpadSpec

__all__ = ["PadOverlap", "Touches"]

_PITCHES = 0.8e-3, 0.4e-3, 0.2e-3
"""Spacings of the nodes [m]: a contact is measured on the first grid of which it covers enough nodes, else on the last."""
_ENOUGH = 150
"""Nodes: 96 mm² of the first grid, 24 mm² of the second."""
_NEAR = 0.75
"""Between nodes that all stay this share of the spacing from the gel a body does not touch: a cone of 45° would reach 0.71 further."""


@dataclass(frozen=True)
class Touches:
    """Overlaps of one body and one resting pad in n environments that touch, pad frame."""

    env: np.ndarray
    """Which of the poses given, (n,), ascending."""
    depth: np.ndarray
    """Greatest overlap [m], (n,)."""
    centre: np.ndarray
    """Centroid of the overlap on the body's underside [m], (n, 3)."""
    normal: np.ndarray
    """Unit normal of the resting gel there, (n, 3)."""
    gap: tuple[np.ndarray, ...]
    """Of each, the distance along z from the resting gel to the body [m], (Ny, Nx); negative where they overlap, inf where there is no
    body."""
    cell: np.ndarray
    """Area of one node of each [m²], (n,)."""


class PadOverlap:
    """One pad at rest; bodies are held against it."""

    def __init__(self, gelpad: GelpadSpec) -> None:
        self._gelpad = gelpad
        self._grids = [_Nodes(gelpad, pitch) for pitch in _PITCHES]
        self.highest = self._grids[-1].highest

    @property
    def none(self) -> Touches:
        """No overlap."""
        return _joined([])

    def touches(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float) -> Touches:
        """How a body at poses (B, 4, 4) overlaps the pad. ``radius`` [m] of a ball about the body's origin that holds it."""
        found: list[Touches] = []
        left = [np.arange(len(pad_from_body)), *(np.zeros(0, int) for _ in self._grids[1:])]
        for k, nodes in enumerate(self._grids):
            rows, last = left[k], k == len(self._grids) - 1
            if not len(rows):
                continue
            if not last and radius < nodes.pitch:
                left[k + 1] = np.union1d(left[k + 1], rows)  # such a body may lie between the nodes
                continue
            gaps = nodes.gaps(parts, pad_from_body[rows], radius, below=0.0 if last else _NEAR * nodes.pitch)
            least, count = gaps.least, np.count_nonzero(gaps.values < 0.0, axis=(1, 2))
            done = least < 0.0 if last else count >= _ENOUGH
            if done.any():
                found.append(nodes.measure(gaps, rows, done))
            if not last:
                on = (least < _NEAR * nodes.pitch) & ~done
                few = count < _ENOUGH // 8  # with half the spacing there are four times as many, at most half of enough
                left[k + 1] = np.union1d(left[k + 1], rows[on & ~few])
                left[-1] = np.union1d(left[-1], rows[on & few])
        return _joined(found)

    def law(self, touches: Touches, k: int) -> LoadLaw:
        """Load law of the body in the k-th environment that touches, at this place and angle."""
        return LoadLaw(np.maximum(touches.gap[k] + touches.depth[k], 0.0), float(touches.cell[k]), self._gelpad)


@dataclass(frozen=True)
class _Gaps:
    """Gaps between body and gel on a window of nodes of every environment, all of one shape."""

    values: np.ndarray
    """[m], (n, Ny, Nx)."""
    columns: np.ndarray
    """Nodes of the window along x, (n, Nx), or (1, Nx) if it is the same in all."""
    rows: np.ndarray
    least: np.ndarray
    """(n,)."""


class _Nodes:
    def __init__(self, gelpad: GelpadSpec, pitch: float) -> None:
        grid = make_grid(gelpad, pitch)
        self.x, self.y = grid.x, grid.y
        self.pitch, self.cell = pitch, grid.pitch[0] * grid.pitch[1]
        self.highest = float(grid.rest.max())
        # The rest surface is a sum of a function of x and one of y (``GelpadSpec.sag``), and so are its slopes.
        self.rest_x, self.rest_y = -gelpad.sag(grid.x, 0.0), -gelpad.sag(0.0, grid.y)
        self._rest = grid.rest
        self.slope_x, self.slope_y = np.gradient(self.rest_x, grid.x), np.gradient(self.rest_y, grid.y)

    def gaps(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float, below: float) -> _Gaps:
        """Gaps at poses (n, 4, 4); a body that stays ``below`` [m] above the highest gel may read inf."""
        columns, rows = (_window(line, pad_from_body[:, k, 3], radius) for k, line in enumerate((self.x, self.y)))
        if columns.shape[1] == len(self.x) and rows.shape[1] == len(self.y):
            x, y = self.x, self.y
        else:
            x, y = (np.broadcast_to(v, (len(pad_from_body), v.shape[1])) for v in (self.x[columns], self.y[rows]))
        values = object_height(parts, pad_from_body, x, y, below=self.highest + below)
        values -= self._rest if x.ndim == 1 else self.rest_x[columns][:, None, :] + self.rest_y[rows][:, :, None]
        return _Gaps(values, columns, rows, values.min(axis=(1, 2)))

    def measure(self, gaps: _Gaps, env: np.ndarray, chosen: np.ndarray) -> Touches:
        """Depth, centroid and normal of the overlaps that a mask chooses; ``env`` is what the environments are called."""
        values = gaps.values[chosen]
        columns, rows = (v[chosen] if len(v) > 1 else v for v in (gaps.columns, gaps.rows))
        # Moments of the overlap by its sums along the axes: the vectors are short then, and the gel is a sum of two functions.
        overlap = np.minimum(values, 0.0)
        along_x, along_y = overlap.sum(axis=1), overlap.sum(axis=2)
        total = along_x.sum(axis=1)
        along_x, along_y = along_x / total[:, None], along_y / total[:, None]

        def mean(on_x: np.ndarray, on_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return (along_x * on_x[columns]).sum(axis=1), (along_y * on_y[rows]).sum(axis=1)

        height = np.add(*mean(self.rest_x, self.rest_y)) + np.square(overlap).sum(axis=(1, 2)) / total
        centre = np.stack([*mean(self.x, self.y), height], axis=1)
        slope = mean(self.slope_x, self.slope_y)
        normal = np.stack([-slope[0], -slope[1], np.ones(len(total))], axis=1)
        normal /= np.sqrt(np.square(normal).sum(axis=1))[:, None]
        return Touches(env[chosen], -_refined(values), centre, normal, tuple(values), np.full(len(total), self.cell))


def _window(line: np.ndarray, at: np.ndarray, radius: float) -> np.ndarray:
    """Indices (n, k) of a line's nodes within ``radius`` of places (n,), as many for all; (1, k) if these are all nodes."""
    count = len(line) if np.isinf(radius) else min(int(2.0 * radius / (line[1] - line[0])) + 2, len(line))
    if count == len(line):
        return np.arange(count)[None]
    first = np.clip(np.searchsorted(line, at - radius), 0, len(line) - count)
    return first[:, None] + np.arange(count)


def _refined(gap: np.ndarray) -> np.ndarray:
    """The least gaps (n,) of (n, Ny, Nx) between the nodes: parabolas through the least node and its neighbours along both axes, exact
    for a ball on a dome."""
    n, ny, nx = gap.shape
    env = np.arange(n)
    j, i = np.divmod(gap.reshape(n, -1).argmin(axis=1), nx)
    middle = gap[env, j, i]
    least = middle.copy()
    for inside, before, after in (
        ((i > 0) & (i < nx - 1), gap[env, j, np.maximum(i - 1, 0)], gap[env, j, np.minimum(i + 1, nx - 1)]),
        ((j > 0) & (j < ny - 1), gap[env, np.maximum(j - 1, 0), i], gap[env, np.minimum(j + 1, ny - 1), i]),
    ):
        curve = before + after - 2.0 * middle
        bent = inside & np.isfinite(curve) & (curve > 0.0)
        before, after = (np.where(bent, v, 0.0) for v in (before, after))
        least -= 0.125 * (after - before) ** 2 / np.where(bent, curve, 1.0)
    return least


def _joined(found: Sequence[Touches]) -> Touches:
    """Touches of several grids in the order of the environments."""
    if len(found) == 1:
        return found[0]
    if not found:
        nothing = np.zeros(0)
        return Touches(np.zeros(0, int), nothing, np.zeros((0, 3)), np.zeros((0, 3)), (), nothing)
    env, depth, centre, normal, cell = (
        np.concatenate([getattr(some, name) for some in found]) for name in ("env", "depth", "centre", "normal", "cell")
    )
    gap = [one for some in found for one in some.gap]
    order = np.argsort(env)
    return Touches(env[order], depth[order], centre[order], normal[order], tuple(gap[k] for k in order), cell[order])
