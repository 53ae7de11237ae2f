"""Facets of curved parts and reliefs, for a solver that collides triangles."""

from __future__ import annotations

import numpy as np

from raytac.shapes.part import Part

SAG = 2e-6
"""Greatest depth of a facet inside a curved part [m], far below the error of pad meshes."""
_FEWEST, _MOST = 16, 256
"""Facets around a circle."""
_RELIEF_SPACING = 0.2e-3
"""Spacing of a relief's facets [m], below the finest cells; its map has half a million."""
_RELIEF_SHARE = 0.04
"""Greatest spacing over a relief's half width: a small coin's rim is 0.15 radii wide."""


def around(radius: float, sag: float) -> int:
    """Number of facets around a circle [m], a multiple of 4 for symmetry."""
    steps = np.pi / np.arccos(1.0 - min(sag / radius, 0.5))
    return 4 * int(np.clip(np.ceil(steps / 4.0), _FEWEST // 4, _MOST // 4))


def coarse_relief(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (n,) and elevation (n, n) [m] of a relief at a wider spacing, 0 around it."""
    assert part.elevation is not None
    half_width, data = part.size[0], part.elevation
    spacing = 2.0 * half_width / (len(data) - 1)
    step = max(int(min(_RELIEF_SPACING, _RELIEF_SHARE * half_width) / spacing), 1)
    coarse = data[::step, ::step]
    elevation = np.zeros((len(coarse) + 2,) * 2)
    elevation[1:-1, 1:-1] = coarse
    return step * spacing * (np.arange(len(elevation)) - 1) - half_width, elevation


def grid_facets(n: int) -> np.ndarray:
    """Triangles (2 (n − 1)², 3) of a grid of n × n nodes, rows along y, that look to −z."""
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (cut.ravel() for cut in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a, d, b], 1), np.stack([a, c, d], 1)])
