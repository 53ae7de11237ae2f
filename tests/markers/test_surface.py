"""Surface tracking: markers go where the coat's triangles take them."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.pattern import MarkerPattern
from raytac.markers.surface import bind_to_coat
from raytac.markers.tracker import MarkerTracker
from raytac.specs import SensorSpec, load_sensor
from tests.markers.pads import coat_mesh, pad_grid, pressed, with_coat


def test_markers_at_rest_stay_and_project_to_the_pattern() -> None:
    sensor = load_sensor("gelsight_mini_7x9")
    grid, mesh = pad_grid(sensor), coat_mesh(sensor, 40, 32)
    frame = MarkerTracker(sensor, "surface", grid).update(with_coat(GelSurface.at_rest(grid), mesh, mesh.rest[None]))
    assert not frame.displacement.any() and not frame.displacement_px.any()
    np.testing.assert_array_equal(frame.pixel, MarkerPattern.of(sensor).pixel)
    np.testing.assert_array_equal(frame.position, MarkerPattern.of(sensor).rest)


def test_an_affine_motion_is_followed_exactly(sensor: SensorSpec, grid: PadGrid) -> None:
    mesh, rng = coat_mesh(sensor), np.random.default_rng(1)
    turn, shift = np.eye(3) + 0.1 * rng.standard_normal((2, 3, 3)), 1e-3 * rng.standard_normal((2, 1, 3))
    moved = np.einsum("bij,vj->bvi", turn, mesh.rest) + shift
    surface = with_coat(pressed(grid, [], []), mesh, moved)
    frame = MarkerTracker(sensor, "surface", grid, num_envs=2).update(surface)
    expected = np.einsum("bij,bmj->bmi", turn, frame.rest) + shift
    np.testing.assert_allclose(frame.position, expected, atol=1e-12)
    np.testing.assert_allclose(frame.displacement, (expected - frame.rest)[..., :2], atol=1e-12)


def test_pure_twist_is_pure_rotation(sensor: SensorSpec, grid: PadGrid) -> None:
    mesh, angle = coat_mesh(sensor), 0.3
    c, s = np.cos(angle), np.sin(angle)
    turned = mesh.rest @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    frame = MarkerTracker(sensor, "surface", grid).update(with_coat(pressed(grid, []), mesh, turned[None]))
    rest, now = frame.rest[0, :, :2], frame.position[0, :, :2]
    np.testing.assert_allclose(np.linalg.norm(now, axis=1), np.linalg.norm(rest, axis=1), atol=1e-12)
    assert np.abs(frame.displacement).max() > 1e-3
    # Seen by a camera on the axis it is the same turn about the principal point.
    centre = np.array(sensor.camera.principal_point)
    a, b = frame.rest_px[0] - centre, frame.pixel[0] - centre
    np.testing.assert_allclose(b, a @ np.array([[c, -s], [s, c]]).T, atol=1e-6)


def test_a_sinking_coat_moves_dots_in_the_image_by_perspective(sensor: SensorSpec, grid: PadGrid) -> None:
    """Straight down by d: nothing moves on the pad, and pixels spread by d over the remaining distance."""
    mesh, deep = coat_mesh(sensor), 1e-3
    sunk = mesh.rest - (0, 0, deep)
    frame = MarkerTracker(sensor, "surface", grid).update(with_coat(pressed(grid, []), mesh, sunk[None]))
    distance = -sensor.camera.position[2]
    spread = (frame.rest_px[0] - sensor.camera.principal_point) * deep / (distance - deep)
    assert np.abs(frame.displacement).max() < 1e-12
    np.testing.assert_allclose(frame.displacement_px[0], spread, atol=1e-9)
    assert np.abs(spread).max() > 5


def test_points_are_bound_to_their_triangle(sensor: SensorSpec) -> None:
    mesh, rng = coat_mesh(sensor), np.random.default_rng(2)
    half = 0.5 * np.asarray(sensor.gelpad.size)
    points = np.concatenate([rng.uniform(-1, 1, (500, 2)) * half, mesh.rest[:, :2]])
    vertices, weights = bind_to_coat(mesh, points)
    assert weights.min() > -1e-6 and weights.sum(axis=1) == pytest.approx(1)
    np.testing.assert_allclose((weights[..., None] * mesh.rest[vertices]).sum(axis=1)[:, :2], points, atol=1e-12)
    with pytest.raises(InputError, match="off the coat"):
        bind_to_coat(mesh, half[None] * 1.1)


def test_a_rigid_pad_has_no_coat_to_track(sensor: SensorSpec, grid: PadGrid) -> None:
    with pytest.raises(InputError, match=r"physics='ipc'.*fots"):
        MarkerTracker(sensor, "surface", grid).update(pressed(grid, []))
