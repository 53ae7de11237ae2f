"""What a marker finds at its place, against SciPy's own interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.sampling import height_at


def test_height_is_bilinear_and_that_of_the_own_environment(grid: PadGrid) -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(3)
    height = rng.normal(0, 1e-4, (3, *grid.shape)).astype(np.float32)
    surface = GelSurface(grid, height, np.zeros(height.shape, bool), np.full((3, 2), np.nan))
    xy = rng.uniform(-1, 1, (3, 40, 2)) * (0.999 * grid.x[-1], 0.999 * grid.y[-1])
    found = height_at(surface, xy)
    for b in range(3):
        expected = interpolate.RegularGridInterpolator((grid.y, grid.x), height[b].astype(float))(xy[b, :, ::-1])
        np.testing.assert_allclose(found[b], expected, atol=1e-10)
