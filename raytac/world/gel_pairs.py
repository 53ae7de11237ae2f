"""Gels that touch each other: one is the body for the other, and both are springs in series.

The overlap of two gels at rest is shared by both. With the area at a common overlap δ the two layers carry the same force, so that the law
is that of the first gel against the second as if that were rigid, softened: by E₁ / E₂ + 1. Two gels of one kind carry half of it, each at
half of the overlap.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import PadGrid, make_grid
from raytac.physics.rigid.search import PadSearch
from raytac.se3 import inverse
from raytac.shapes.part import Part, mesh_part
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

_PITCH = 0.8e-3
"""Spacing of the vertices of a gel's surface [m]; a dome of 100 mm is off by 1 µm."""


class GelPairs:
    """Pairs of pads on different bodies."""

    def __init__(self, gels: Sequence[GelpadSpec], bodies: np.ndarray, num_envs: int, *, device: str = "cpu") -> None:
        """``bodies`` (pads,): indices of the bodies that carry the pads."""
        self._gels = tuple(gels)
        parts = [(_gel_part(gel),) for gel in gels] if len(gels) > 1 else []
        self._parts = parts
        self.pairs: list[tuple[int, int, PadSearch]] = [
            (i, j, PadSearch([gels[i]], [parts[j]], num_envs=num_envs, device=device))
            for i in range(len(gels))
            for j in range(i + 1, len(gels))
            if bodies[i] != bodies[j]
        ]
        """Two pads, and the search for the second one's gel as a body that the first touches."""
        self._modulus = np.array([gel.youngs_modulus for gel in gels])

    def press(self, pad: int, height: np.ndarray, grid: PadGrid, world_from_pad: np.ndarray, failed: np.ndarray) -> None:
        """Lower ``height`` (n, Ny, Nx) of ``pad`` by its share of the overlap with other gels."""
        for i, j, _ in self.pairs:
            if pad not in (i, j):
                continue
            other = j if pad == i else i
            poses = inverse(world_from_pad[:, pad]) @ world_from_pad[:, other]
            near = np.flatnonzero(~failed & (np.linalg.norm(poses[:, :3, 3], axis=1) < self._reach(pad) + self._reach(other)))
            if not len(near):
                continue
            under = object_height(self._parts[other], poses[near], grid.x, grid.y, below=float(grid.rest.max()))
            share = self._modulus[other] / (self._modulus[pad] + self._modulus[other])
            pressed = np.where(under < grid.rest, grid.rest - share * (grid.rest - under), np.inf)
            height[near] = np.minimum(height[near], pressed)

    def _reach(self, pad: int) -> float:
        return 0.5 * float(np.hypot(*self._gels[pad].size)) + self._gels[pad].thickness


def _gel_part(gelpad: GelpadSpec) -> Part:
    """The gel at rest as a closed mesh, pad frame."""
    grid = make_grid(gelpad, _PITCH)
    ny, nx = grid.shape
    x, y = (values.ravel() for values in np.meshgrid(grid.x, grid.y))
    top, back = np.stack([x, y, grid.rest.ravel()], axis=1), np.stack([x, y, np.full(x.size, -gelpad.thickness)], axis=1)
    node = np.arange(ny * nx).reshape(ny, nx)
    a, b, c, d = (node[rows, columns].ravel() for rows in (slice(-1), slice(1, None)) for columns in (slice(-1), slice(1, None)))
    up = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    rim = np.concatenate([node[0, :-1], node[:-1, -1], node[-1, :0:-1], node[:0:-1, 0]])
    following, deep = np.roll(rim, -1), ny * nx
    wall = np.concatenate(
        [np.stack([rim, rim + deep, following + deep], axis=1), np.stack([rim, following + deep, following], axis=1)]
    )
    return mesh_part(np.concatenate([top, back]), np.concatenate([up, up[:, ::-1] + deep, wall]))
