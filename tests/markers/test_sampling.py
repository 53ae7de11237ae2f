"""Surface and object at the markers, against SciPy's own interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.contacts import Contacts
from raytac.markers.sampling import height_and_slope, height_at, object_displacement


def test_height_is_bilinear_and_that_of_the_own_environment(grid: PadGrid) -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(3)
    height = rng.normal(0, 1e-4, (3, *grid.shape)).astype(np.float32)
    surface = GelSurface(grid, height, np.zeros(height.shape, bool), np.full((3, 2), np.nan))
    xy = rng.uniform(-1, 1, (3, 40, 2)) * (0.999 * grid.x[-1], 0.999 * grid.y[-1])
    result = height_at(surface, xy)
    for b in range(3):
        expected = interpolate.RegularGridInterpolator((grid.y, grid.x), height[b].astype(float))(xy[b, :, ::-1])
        np.testing.assert_allclose(result[b], expected, atol=1e-10)


def test_height_beyond_the_pad_is_that_of_its_edge_and_of_nowhere_is_any(grid: PadGrid) -> None:
    height = np.random.default_rng(4).normal(0, 1e-4, (1, *grid.shape)).astype(np.float32)
    surface = GelSurface(grid, height, np.zeros(height.shape, bool), np.full((1, 2), np.nan))
    half = np.array((grid.x[-1], grid.y[-1]))
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    result = height_at(surface, np.concatenate([1.2 * corners, [[np.nan, 0.0]]])[None])[0]
    # Points beyond the edge are moved to a thousandth of a cell before the last node.
    expected = [height[0, j, i] for j, i in ((-1, -1), (-1, 0), (0, 0), (0, -1))]
    np.testing.assert_allclose(result[:4], expected, atol=1e-3 * np.abs(height).max() * 4)
    assert np.isfinite(result).all()


def test_slope_and_touch_of_a_tilted_plane(grid: PadGrid) -> None:
    """z = a x + b y where the object touches one half: the gradient is (a, b), and points know on which side they are."""
    x, y = np.meshgrid(grid.x, grid.y)
    height = (0.2 * x - 0.3 * y)[None].astype(np.float32)
    surface = GelSurface(grid, height, (x > 0.02e-3)[None], np.full((1, 2), np.nan))
    xy = np.random.default_rng(5).uniform(-8e-3, 8e-3, (1, 50, 2))
    z, slope, touched = height_and_slope(surface, xy)
    np.testing.assert_allclose(z, 0.2 * xy[..., 0] - 0.3 * xy[..., 1], atol=1e-9)
    np.testing.assert_allclose(slope, np.broadcast_to((0.2, -0.3), xy.shape), atol=1e-4)
    far = np.abs(xy[..., 0]) > grid.pitch[0]
    assert far.sum() > 40
    np.testing.assert_array_equal(touched[far], xy[..., 0][far] > 0)


def test_a_point_goes_with_the_nearest_contact_as_a_rigid_body(grid: PadGrid) -> None:
    """Turned by 0.4 about (2, 0) mm and shifted; by nothing near the other contact; not at all without contact."""
    row = np.zeros((2, 2, 12))
    row[0, 0, :6] = 1, 2e-3, 0.0, 3e-4, -1e-4, 0.4
    row[0, 1, :3] = 1, -6e-3, 0.0
    xy = np.array([[(3e-3, 1e-3), (2e-3, 0.0), (-5e-3, 1e-3)]] * 2)
    moved = object_displacement(Contacts(row), xy)
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    expected = np.array([turn @ (1e-3, 1e-3) - (1e-3, 1e-3), (0.0, 0.0)]) + np.array((3e-4, -1e-4))
    np.testing.assert_allclose(moved[0, :2], expected, atol=1e-15)
    assert not moved[0, 2].any() and not moved[1].any()
