"""Quadrature over the rectangle of an LED: which edge has how many points, and Gauss's rule."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from raytac.specs.sensor import LedSpec

SMALL = np.deg2rad(25.0)
"""Angle up to which an LED's edge is one point of the quadrature."""
STEP = np.deg2rad(70.0)
"""Angle of an LED's edge that a further point covers."""


@dataclass(frozen=True)
class EdgePoints:
    """Points of the quadrature over both edges of an LED."""

    along: int
    """Points over the edge that is longer as the camera sees it, by its extent in x and y."""
    across: int
    upright: bool
    """True if ``along`` counts those of ``LedSpec.edges[1]``, which is then the longer one."""

    @property
    def by_edge(self) -> tuple[int, int]:
        """Points over ``LedSpec.edges[0]`` and ``[1]``."""
        return (self.across, self.along) if self.upright else (self.along, self.across)


def quadrature(led: LedSpec, refinement: int = 1) -> EdgePoints:
    """Points over both edges of ``led``, by their angles.

    The angles are those seen from the place of the gel plane over the LED. ``refinement`` multiplies both numbers.
    """
    distance = max(abs(led.position[2]), 1e-6)
    angles = [2 * float(np.arctan(edge / 2 / distance)) for edge in led.size]
    counts = [refinement * (1 if angle <= SMALL else 1 + int(np.ceil(angle / STEP))) for angle in angles]
    first, second = (length * float(np.hypot(*edge[:2])) for length, edge in zip(led.size, led.edges, strict=True))
    upright = second > first
    return EdgePoints(counts[upright], counts[not upright], upright)


@cache  # a fit asks for the same few rules thousands of times
def gauss(count: int) -> tuple[tuple[float, float], ...]:
    """Places and weights of the Gauss-Legendre rule of ``count`` points on [0, 1]."""
    places, weights = np.polynomial.legendre.leggauss(count)
    return tuple((0.5 + 0.5 * float(x), 0.5 * float(w)) for x, w in zip(places, weights, strict=True))
