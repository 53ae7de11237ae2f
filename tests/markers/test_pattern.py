"""Dots at rest: where they are, that the camera sees them, and that its projection goes there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.markers.pattern import MarkerPattern, camera_of, marker_centres
from raytac.specs import RefractionSpec, SensorSpec, load_sensor

PATTERNS = {"gelsight_mini_7x9": (7, 9), "gelsight_mini_9x11": (9, 11), "gelsight_mini_12x16": (12, 16)}


@pytest.mark.parametrize("name", PATTERNS)
def test_shipped_patterns_lie_in_the_view(name: str) -> None:
    sensor = load_sensor(name)
    rows, columns = PATTERNS[name]
    pattern = MarkerPattern.of(sensor)
    assert pattern.count == rows * columns
    assert pattern.pixel.min() > 0 and (pattern.pixel < sensor.camera.resolution).all()
    assert pattern.rest[0, :, 2] == pytest.approx(-sensor.gelpad.sag(pattern.rest[0, :, 0], pattern.rest[0, :, 1]))


def test_fots_pattern_is_where_its_authors_have_it() -> None:
    """On the plane z = 0: x from 26 px in steps of 29, y from 15 px in steps of 26 (pixels of a 320 x 240 image)."""
    sensor = load_sensor("gelsight_mini_9x11")
    on_plane = np.concatenate([marker_centres(sensor.markers), np.zeros((99, 1))], axis=1)
    pixel = camera_of(sensor).project(on_plane)
    u, v = np.meshgrid(26 + 29 * np.arange(11), 15 + 26 * np.arange(9))
    np.testing.assert_allclose(pixel, np.stack([u, v], axis=-1).reshape(-1, 2), atol=0.01)


def test_order_is_row_by_row(sensor: SensorSpec) -> None:
    xy = marker_centres(sensor.markers).reshape(sensor.markers.rows, sensor.markers.columns, 2)
    assert np.diff(xy[..., 0], axis=1) == pytest.approx(sensor.markers.pitch[0])
    assert np.diff(xy[..., 1], axis=0) == pytest.approx(sensor.markers.pitch[1])
    assert xy.mean(axis=(0, 1)) == pytest.approx(sensor.markers.offset, abs=1e-12)


@pytest.mark.parametrize("slab", [False, True], ids=["straight", "slab"])
@pytest.mark.parametrize("resolution", [None, (160, 120)])
@pytest.mark.renderer
def test_projection_round_trip(resolution: tuple[int, int] | None, slab: bool) -> None:
    """The ray through a marker's pixel meets the marker again."""
    sensor = load_sensor("gelsight_mini_7x9")
    if slab:
        sensor = replace(sensor, refraction=RefractionSpec("slab", 1.41, 1e-3))
    pattern = MarkerPattern.of(sensor, resolution)
    (ox, oy, oz), (tx, ty) = pattern.camera.ray(pattern.pixel[0, :, 0], pattern.pixel[0, :, 1])
    z = pattern.rest[0, :, 2]
    np.testing.assert_allclose(ox + tx * (z - oz), pattern.rest[0, :, 0], atol=1e-9)
    np.testing.assert_allclose(oy + ty * (z - oz), pattern.rest[0, :, 1], atol=1e-9)


def test_half_the_resolution_halves_the_pixels(sensor: SensorSpec) -> None:
    width, height = sensor.camera.resolution
    whole, half = MarkerPattern.of(sensor), MarkerPattern.of(sensor, (width // 2, height // 2))
    np.testing.assert_allclose(half.pixel, whole.pixel / 2)


def test_a_marker_outside_the_view_is_an_error(sensor: SensorSpec) -> None:
    wide = replace(sensor, markers=replace(sensor.markers, pitch=(2.3e-3, 1.6e-3)))
    with pytest.raises(SpecError, match=r"row 0, column 0.*outside the view.*320 x 240"):
        MarkerPattern.of(wide)


def test_no_markers_is_an_error_that_names_a_way_out() -> None:
    with pytest.raises(InputError, match=r"gelsight_mini.*has no markers.*gelsight_mini_7x9"):
        MarkerPattern.of(load_sensor("gelsight_mini"))


def test_shift_and_turn(sensor: SensorSpec) -> None:
    narrow = replace(sensor, markers=replace(sensor.markers, pitch=(1e-3, 1e-3)))
    plain = MarkerPattern.of(narrow).rest[0]
    moved = MarkerPattern.of(narrow, shift=np.array([[0, 0], [1e-3, -5e-4]]), turn=np.array([np.pi / 2, 0]))
    np.testing.assert_allclose(moved.rest[0, :, :2], np.stack([-plain[:, 1], plain[:, 0]], axis=-1), atol=1e-12)
    np.testing.assert_allclose(moved.rest[1, :, :2], plain[:, :2] + (1e-3, -5e-4), atol=1e-12)
    with pytest.raises(InputError, match="outside the view"):
        MarkerPattern.of(sensor, shift=np.array([[1.5e-3, 0]]))
    with pytest.raises(InputError, match="off the pad"):
        MarkerPattern.of(sensor, shift=np.array([[9e-3, 0]]))
    with pytest.raises(InputError, match="placed for 2 environments"):
        moved.for_batch(3)
