"""Gel surfaces that belong to labelled circles."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate.photographs import Photographs, press_balls, read_photographs
from raytac.errors import InputError
from raytac.gel.pad import make_grid
from raytac.io.png import write_png
from raytac.specs import SensorSpec, load_sensor

RADIUS = 3.155e-3


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    return load_sensor("gelsight_mini")


def shots(circles: list[tuple[float, float, float]]) -> Photographs:
    return Photographs(np.zeros((240, 320, 3)), np.zeros((len(circles), 240, 320, 3)), np.array(circles, float), RADIUS)


def test_a_ball_in_the_middle_of_a_flat_pad_has_the_depth_of_its_circle(sensor: SensorSpec) -> None:
    flat = dataclasses.replace(sensor, gelpad=dataclasses.replace(sensor.gelpad, dome_radius=(math.inf, math.inf)))
    grid = make_grid(flat.gelpad, 0.1e-3)
    surface = press_balls(flat, grid, shots([(160, 120, 30)]), depth_factor=1.5)
    a = 30 * 0.0634e-3
    depth = 1.5 * (RADIUS - math.sqrt(RADIUS**2 - a**2))
    assert surface.batch == 2 and not surface.contact[0].any()
    np.testing.assert_array_equal(surface.height[0], grid.rest.astype(np.float32))
    np.testing.assert_allclose(surface.indentation[1].max(), depth, rtol=2e-3)
    assert surface.pad_from_object is not None
    np.testing.assert_allclose(surface.pad_from_object[1, :3, 3], [0, 0, RADIUS - depth], atol=1e-12)


def test_on_the_dome_the_overlap_is_the_labelled_circle_seen_by_the_camera(sensor: SensorSpec) -> None:
    x, y, r = 230.0, 80.0, 31.0
    grid = make_grid(sensor.gelpad, 0.05e-3)
    surface = press_balls(sensor, grid, shots([(x, y, r)]))
    assert surface.pad_from_object is not None
    px, py, pz = surface.pad_from_object[1, :3, 3]
    gap = pz - np.sqrt(np.maximum(RADIUS**2 - (grid.x[None] - px) ** 2 - (grid.y[:, None] - py) ** 2, 0)) - grid.rest
    overlap = (gap < 0) & (np.hypot(grid.x[None] - px, grid.y[:, None] - py) < RADIUS)
    points = np.stack(np.broadcast_arrays(grid.x[None], grid.y[:, None], grid.rest), axis=-1)[overlap]
    distance = -sensor.camera.position[2]
    seen = points[:, :2] * distance / (distance + points[:, 2:]) / 0.0634e-3 + (160, 120)
    np.testing.assert_allclose(seen.mean(axis=0), (x, y), atol=0.15)
    area = overlap.sum() * grid.pitch[0] * grid.pitch[1] / 0.0634e-3**2
    assert math.sqrt(area / math.pi) == pytest.approx(r, rel=0.015)


def test_photographs_are_read_or_refused(sensor: SensorSpec, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tell a layout"):
        read_photographs(tmp_path, sensor)
    grey = np.full((240, 320, 3), 128, np.uint8)
    for name in ("background.png", "6.310mm_04.png", "6.310mm_05.png", "9.500mm_06.png"):
        write_png(tmp_path / name, grey)
    head, row = "diameter,index,cx_px,cy_px,r_px,fully_visible\n", "6.310mm,4,100.5,80,30,1\n"
    (tmp_path / "labels.csv").write_text(head + row + "6.310mm,5,1,1,30,0\n", "utf-8")
    found = read_photographs(tmp_path, sensor)
    assert found.radius == pytest.approx(RADIUS) and found.presses.shape == (1, 240, 320, 3)
    assert np.all(found.presses == 128) and np.all(found.background == 128)
    assert found.shrunk(8).background.shape == (30, 40, 3)
    assert found.distance(sensor)[0, 79, 100] == pytest.approx(math.hypot(0, 0.5) / 30)
    (tmp_path / "labels.csv").write_text(head + row + "9.500mm,6,100,80,30,1\n", "utf-8")
    with pytest.raises(InputError, match="one ball"):
        read_photographs(tmp_path, sensor)
    for name in ("background.png", "6.310mm_04.png"):
        write_png(tmp_path / name, grey[:200])
    (tmp_path / "labels.csv").write_text(head + row, "utf-8")
    with pytest.raises(InputError, match="sensor's size"):
        read_photographs(tmp_path, sensor)
