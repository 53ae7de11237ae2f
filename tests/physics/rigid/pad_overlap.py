"""Overlap of a body and a resting pad on a grid of nodes, and its load law; all environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.gel.surface import make_grid
from raytac.physics.rigid.layer_response import LayerResponse
from raytac.physics.rigid.load_law import LoadLaw
from raytac.shapes.part import Part
from raytac.shapes.primitives import bounds
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

__all__ = ["PadOverlap", "Touches", "least_width", "refined"]

_PITCHES = 0.8e-3, 0.4e-3, 0.2e-3
"""Spacings of the nodes [m]: a contact is measured on the first grid of which it covers enough nodes, else on the last …"""
_FINER = 0.1e-3, 0.05e-3
"""… which is one of these if the body is convex and narrower than 20 cells of the one before."""
_ENOUGH = 150
"""Nodes: 96 mm² of the first grid, 24 mm² of the second."""
_NEAR = 0.75
"""Between nodes that all stay this share of the spacing from the gel a body does not touch: a cone of 45° would reach 0.71 further."""


_WINDOWS = np.array([8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256])
"""Nodes along a side of the windows that are looked at, beyond which it is the whole line: few sizes, so that environments share them, and
each by what is in it, so that no environment's sums depend on the others'."""


@dataclass(frozen=True)
class Touches:
    """Overlaps of one body and one resting pad in n environments that touch, pad frame."""

    env: np.ndarray
    """Indices of the poses that touch, (n,), ascending."""
    depth: np.ndarray
    """Greatest overlap [m], (n,)."""
    centre: np.ndarray
    """Centroid of the overlap on the body's underside [m], (n, 3)."""
    normal: np.ndarray
    """Unit normal of the resting gel there, (n, 3)."""
    gap: tuple[np.ndarray, ...]
    """Of each, the distance along z from the resting gel to the body [m], (Ny, Nx); negative where they overlap, inf where there is no
    body, or none within ``clear`` of the gel."""
    cell: np.ndarray
    """Area of one node of each [m²], (n,)."""
    x: tuple[np.ndarray, ...]
    """Of each, the nodes along x [m], (Nx,)."""
    y: tuple[np.ndarray, ...]
    clear: np.ndarray
    """Up to where each ``gap`` is known [m], (n,)."""

    def known_depth(self, k: int, layer: LayerResponse) -> float:
        """Depth [m] up to which a load law of the k-th follows from its gap: where all nodes whose gap is known are in contact."""
        radius = np.sqrt(np.count_nonzero(self.gap[k] < self.clear[k]) * self.cell[k] / np.pi)
        return float((self.depth[k] + self.clear[k]) / np.interp(radius, layer.radius, layer.share))


def least_width(parts: Sequence[Part], pose: np.ndarray) -> float:
    """Least width [m] of the outline of a convex primitive's own box as seen along z, square to one of its edges; inf of other bodies."""
    result = np.inf
    if len(parts) > 1:
        return result
    for part in parts:
        if part.kind in ("plane", "torus") or part.vertices is not None:
            continue
        low, high = bounds(part.kind, part.size, np.eye(4))
        half = 0.5 * (high - low)
        edges = half[:, None] * (pose[:3, :3] @ part.object_from_part[:3, :3])[:2].T
        for edge in edges:
            length = np.hypot(*edge)
            if length > 1e-9:
                result = min(result, float(2.0 * np.abs(edge[0] * edges[:, 1] - edge[1] * edges[:, 0]).sum() / length))
    return result


class PadOverlap:
    """One pad at rest, with which bodies are overlapped."""

    def __init__(self, gelpad: GelpadSpec, width: float = np.inf) -> None:
        """``width`` [m]: of the narrowest body."""
        self._gelpad = gelpad
        pitches = list(_PITCHES)
        for finer in _FINER:
            if pitches[-1] > 0.05 * width:
                pitches.append(finer)
        # Who does not reach the gel on the last grid does not touch it.
        self._grids = [_Nodes(gelpad, pitch, _NEAR * pitch if pitch > pitches[-1] else 0.0) for pitch in pitches]
        self.highest = self._grids[-1].highest

    def touches(self, parts: Sequence[Part], pad_from_body: np.ndarray, radius: float) -> Touches:
        """Overlaps of a body at poses (B, 4, 4) with the pad; ``radius`` [m]: bounding ball about the body's origin."""
        by_grid: list[Touches] = []
        ball, last = _Ball(pad_from_body, radius), len(self._grids) - 1
        following = self._first_grid(ball)
        for k, nodes in enumerate(self._grids):
            rows = np.flatnonzero(following == k)
            if not len(rows):
                continue
            for some, size in nodes.windows(ball.of(rows)):
                rows_of = rows[some]
                gaps = nodes.gaps(parts, ball.of(rows_of), size)
                if k == last:
                    done = gaps.least < 0.0
                else:
                    count = np.count_nonzero(gaps.values < 0.0, axis=(1, 2))
                    done = count >= _ENOUGH
                    # With half the spacing there are four times as many nodes: of few, at most half of enough.
                    on = np.where(count < _ENOUGH // 8, max(k + 1, len(_PITCHES) - 1), k + 1)
                    following[rows_of] = np.where(done | (gaps.least >= nodes.near), -1, on)
                if done.any():
                    by_grid.append(nodes.measure(gaps, rows_of, done))
        return _joined(by_grid)

    def _first_grid(self, ball: _Ball) -> np.ndarray:
        """The first grid that may hold enough nodes of each ball below the highest gel, (B,), the last if none may."""
        reach = ball.reach(self.highest)
        # No disc holds more nodes than the area of one that is wider by half a cell's diagonal. A body narrower than a cell is in none.
        first = np.zeros(len(reach), int)
        for nodes in self._grids[:-1]:
            first += np.pi * (reach / nodes.pitch + 0.71) ** 2 < _ENOUGH
        return first

    def law(self, touches: Touches, k: int) -> LoadLaw:
        """Load law of the body in the k-th environment that touches, at this place and angle."""
        return LoadLaw(np.maximum(touches.gap[k] + touches.depth[k], 0.0), touches.x[k], touches.y[k], self._gelpad)


@dataclass(frozen=True)
class _Ball:
    """Balls of one radius about a body's origin, each of which holds the body."""

    pad_from_body: np.ndarray
    """Poses of the body (n, 4, 4)."""
    radius: float
    """[m], inf for a half-space."""

    def reach(self, below: float) -> np.ndarray:
        """Greatest distance along x and y from the balls' centres to points lower than ``below`` [m], (n,) [m]."""
        above = np.maximum(self.pad_from_body[:, 2, 3] - below, 0.0)
        return np.sqrt(np.maximum(self.radius**2 - above * above, 0.0))

    def of(self, rows: np.ndarray) -> _Ball:
        return self if len(rows) == len(self.pad_from_body) else _Ball(self.pad_from_body[rows], self.radius)


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
    def __init__(self, gelpad: GelpadSpec, pitch: float, near: float) -> None:
        """``near`` [m]: how far above the gel a body may stay and be looked at."""
        grid = make_grid(gelpad, pitch)
        self.x, self.y = grid.x, grid.y
        self.pitch, self.cell = pitch, grid.pitch[0] * grid.pitch[1]
        self.near = near
        self.highest = float(grid.rest.max())
        self._bond, self._thinnest = -gelpad.thickness, gelpad.thickness + float(grid.rest.min())
        # The rest surface is a sum of a function of x and one of y (``GelpadSpec.sag``), and so are its slopes.
        rest_x, rest_y = -gelpad.sag(grid.x, 0.0), -gelpad.sag(0.0, grid.y)
        self._rest, self._rest_x, self._rest_y = grid.rest, rest_x, rest_y
        # Along each axis: place, height and slope of every node.
        self._along = [
            np.stack([line, rest, np.gradient(rest, line)], axis=1) for line, rest in ((grid.x, rest_x), (grid.y, rest_y))
        ]

    def windows(self, ball: _Ball) -> list[tuple[np.ndarray, int]]:
        """Balls by the window that they need in ``gaps``: their rows, and the index of the window into ``_WINDOWS``."""
        need = 2.0 / self.pitch * ball.reach(self.highest + self.near) + 2.0
        size = _WINDOWS.searchsorted(need)
        return [(np.flatnonzero(size == one), one) for one in sorted(set(size.tolist()))]

    def gaps(self, parts: Sequence[Part], ball: _Ball, size: int) -> _Gaps:
        """Gaps of the body that each ball holds, on windows about them; what is ``near`` above the highest gel may read inf.

        Lines on which the body reaches below the bonded face read inf: it lies behind the pad there, or went through it (``BondedFace``).
        """
        below, pad_from_body = self.highest + self.near, ball.pad_from_body
        nodes = int(_WINDOWS[size]) if size < len(_WINDOWS) else max(len(self.x), len(self.y))
        columns, rows = (_window(line, pad_from_body[:, k, 3], nodes) for k, line in enumerate((self.x, self.y)))
        whole = columns.shape[1] == len(self.x) and rows.shape[1] == len(self.y)
        if whole:
            values = object_height(parts, pad_from_body, self.x, self.y, below=below)
            values -= self._rest
        else:
            x, y = self.x[columns], self.y[rows]
            if len(pad_from_body) > 1:
                x, y = (np.broadcast_to(v, (len(pad_from_body), v.shape[1])) for v in (x, y))
            values = object_height(parts, pad_from_body, x, y, below=below)
            values -= self._rest_x[columns][:, None, :]
            values -= self._rest_y[rows][:, :, None]
        least = values.min(axis=(1, 2))
        deep = np.flatnonzero(least < -self._thinnest)
        if len(deep):
            at = (columns, rows) if len(columns) == 1 else (columns[deep], rows[deep])
            rest = self._rest if whole else self._rest_x[at[0]][:, None, :] + self._rest_y[at[1]][:, :, None]
            values[deep] = np.where(values[deep] + rest < self._bond, np.inf, values[deep])
            least[deep] = values[deep].min(axis=(1, 2))
        return _Gaps(values, columns, rows, least)

    def measure(self, gaps: _Gaps, env: np.ndarray, chosen: np.ndarray) -> Touches:
        """Depth, centroid and normal of the overlaps that a mask chooses; ``env`` is what the environments are called."""
        values, columns, rows = gaps.values, gaps.columns, gaps.rows
        if not chosen.all():
            values, env = values[chosen], env[chosen]
            columns, rows = (v[chosen] if len(v) > 1 else v for v in (columns, rows))
        # Moments of the overlap by its sums along the axes: the vectors are short then, and the gel is a sum of two functions.
        overlap = np.minimum(values, 0.0)
        total = overlap.sum(axis=(1, 2))[:, None]
        (x, height_x, slope_x), (y, height_y, slope_y) = (
            ((overlap.sum(axis=axis)[:, None, :] @ along[nodes])[:, 0] / total).T
            for axis, along, nodes in ((1, self._along[0], columns), (2, self._along[1], rows))
        )
        height = height_x + height_y + np.vecdot(flat := overlap.reshape(len(values), -1), flat) / total[:, 0]
        normal = np.stack([-slope_x, -slope_y, np.ones(len(values))], axis=1)
        normal /= np.sqrt(np.vecdot(normal, normal))[:, None]
        cell, clear = np.full(len(values), self.cell), np.full(len(values), self.near)
        centre, lines = np.stack([x, y, height], axis=1), (self.x[columns], self.y[rows])
        at_x, at_y = (tuple(np.broadcast_to(line, (len(values), line.shape[1]))) for line in lines)
        return Touches(env, -refined(values, self.pitch), centre, normal, tuple(values), cell, at_x, at_y, clear)


def _window(line: np.ndarray, at: np.ndarray, nodes: int) -> np.ndarray:
    """Indices (n, k) of a line's nodes about places (n,), ``nodes`` or (1, k) of all there are."""
    if nodes >= len(line):
        return np.arange(len(line))[None]
    pitch = line[1] - line[0]
    first = np.ceil((at - line[0]) / pitch - 0.5 * nodes).astype(int)
    return np.minimum(np.maximum(first, 0), len(line) - nodes)[:, None] + np.arange(nodes)


def refined(gap: np.ndarray, pitch: float) -> np.ndarray:
    """The least gaps (n,) of (n, Ny, Nx) between the nodes: parabolas through the least node and its neighbours along both axes, exact
    for a ball on a dome; none where a neighbour is higher by half the pitch, for it lies beyond an edge."""
    n, ny, nx = gap.shape
    lowest = gap.reshape(n, -1).argmin(axis=1)
    j, i = np.divmod(lowest, nx)
    lowest += (ny * nx) * np.arange(n)
    inside = np.stack([(i > 0) & (i < nx - 1), (j > 0) & (j < ny - 1)])
    step = np.where(inside, [[1], [nx]], 0)
    middle, before, after = (gap.take(lowest + offset * step) for offset in (0, -1, 1))
    with np.errstate(invalid="ignore"):  # where no body is
        curve = before + after - 2.0 * middle
    bent = inside & (curve > 0.0) & (np.maximum(before, after) < middle + 0.5 * pitch)
    rise = np.where(bent, after, 0.0) - np.where(bent, before, 0.0)
    return middle[0] - 0.125 * (rise * rise / np.where(bent, curve, 1.0)).sum(axis=0)


def _joined(touches: Sequence[Touches]) -> Touches:
    """Touches of several grids in the order of the environments."""
    if len(touches) == 1:
        return touches[0]
    if not touches:
        nothing = np.zeros(0)
        return Touches(np.zeros(0, int), nothing, np.zeros((0, 3)), np.zeros((0, 3)), (), nothing, (), (), nothing)
    env, depth, centre, normal, cell, clear = (
        np.concatenate([getattr(some, name) for some in touches])
        for name in ("env", "depth", "centre", "normal", "cell", "clear")
    )
    order = np.argsort(env)
    gap, x, y = (
        tuple(np.array([k for some in touches for k in getattr(some, name)], object)[order]) for name in ("gap", "x", "y")
    )
    return Touches(env[order], depth[order], centre[order], normal[order], gap, cell[order], x, y, clear[order])
