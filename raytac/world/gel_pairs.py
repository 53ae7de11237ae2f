"""Gels that touch each other: one is the body for the other, and both are springs in series.

The overlap of two gels at rest is shared by both. With the area at a common overlap δ the two layers carry the same force, so that the law
is that of the first gel against the second as if that were rigid, softened: by E₁ / E₂ + 1. Two gels of one kind carry half of it, each at
half of the overlap.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.gel.surface import make_grid
from raytac.physics.rigid.search import PadSearch
from raytac.shapes.part import Part, mesh_part
from raytac.specs.sensor import GelpadSpec

_WIDER = 1e-5
"""Share by which a gel that is shown is wider.

So rounding does not leave out nodes on the edge of one of the same size.
"""
_PITCH = 0.8e-3
"""Spacing of the vertices of a gel's surface [m]; a dome of 100 mm is off by 1 µm."""


class GelPairs:
    """Pairs of pads on different bodies."""

    def __init__(self, gels: Sequence[GelpadSpec], bodies: np.ndarray, num_envs: int, *, device: str = "cpu") -> None:
        """``bodies`` (pads,): indices of the bodies that carry the pads."""
        parts = [(_gel_part(gel),) for gel in gels] if len(gels) > 1 else []
        self._shown = [(_gel_part(gel, 1.0 + _WIDER),) for gel in gels] if len(gels) > 1 else []
        self.pairs: list[tuple[int, int, PadSearch]] = [
            (i, j, PadSearch([gels[i]], [parts[j]], num_envs=num_envs, device=device))
            for i in range(len(gels))
            for j in range(i + 1, len(gels))
            if bodies[i] != bodies[j]
        ]
        """Two pads, and the search for the second one's gel as a body that the first touches."""
        self._modulus = np.array([gel.youngs_modulus for gel in gels])

    def gels(self, pad: int) -> list[tuple[tuple[Part, ...], float]]:
        """Gels of all pads as ``PressedGel`` takes them.

        0 for those that ``pad`` does not touch; empty if it touches none.
        """
        others = {i + j - pad for i, j, _ in self.pairs if pad in (i, j)}
        shares = [k in others and self._modulus[k] / (self._modulus[pad] + self._modulus[k]) for k in range(len(self._modulus))]
        return [(parts, float(share)) for parts, share in zip(self._shown, shares, strict=True)] if others else []


def _gel_part(gelpad: GelpadSpec, scale: float = 1.0) -> Part:
    """The gel at rest as a closed mesh, pad frame; ``scale``: of its width."""
    grid = make_grid(gelpad, _PITCH)
    ny, nx = grid.shape
    x, y = (scale * values.ravel() for values in np.meshgrid(grid.x, grid.y))
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
