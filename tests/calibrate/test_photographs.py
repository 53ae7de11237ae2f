"""Photographs: read, shrunk, and refused where they do not fit the sensor."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate.photographs import read_photographs, shrunk
from raytac.errors import InputError
from raytac.io.images import write_png
from raytac.specs import SensorSpec, load_sensor

RADIUS = 3.155e-3


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    return load_sensor("gelsight_mini")


def test_photographs_are_read_or_refused(sensor: SensorSpec, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tell a layout"):
        read_photographs(tmp_path, sensor)
    grey = np.full((240, 320, 3), 128, np.uint8)
    for name in ("background.png", "6.310mm_04.png", "6.310mm_05.png", "9.500mm_06.png"):
        write_png(tmp_path / name, grey)
    head, row = "diameter,index,cx_px,cy_px,r_px,fully_visible\n", "6.310mm,4,100.5,80,30,1\n"
    (tmp_path / "labels.csv").write_text(head + row + "6.310mm,5,1,1,30,0\n", "utf-8")
    found = read_photographs(tmp_path, sensor)
    assert found.radius == pytest.approx([RADIUS, RADIUS]) and found.presses.shape == (2, 240, 320, 3)
    assert found.fully_visible.tolist() == [True, False], "presses at the border are read, and marked"
    assert np.all(found.presses == 128) and np.all(found.background == 128)
    assert found.shrunk(8).background.shape == (30, 40, 3)
    assert found.distance(sensor)[0, 79, 100] == pytest.approx(math.hypot(0, 0.5) / 30)
    (tmp_path / "labels.csv").write_text(head + row + "9.500mm,6,100,80,30,1\n", "utf-8")
    assert read_photographs(tmp_path, sensor).radius == pytest.approx([RADIUS, 4.75e-3])
    (tmp_path / "labels.csv").write_text(head + "6.310mm,4,160,120,55,1\n", "utf-8")
    with pytest.raises(InputError, match="smaller than the ball"):
        read_photographs(tmp_path, sensor)
    (tmp_path / "labels.csv").write_text(head + "6.310mm,4,5,120,30,0\n", "utf-8")
    with pytest.raises(InputError, match="lies in the image"):
        read_photographs(tmp_path, sensor)
    for name in ("background.png", "6.310mm_04.png"):
        write_png(tmp_path / name, grey[:200])
    (tmp_path / "labels.csv").write_text(head + row, "utf-8")
    with pytest.raises(InputError, match="sensor's size"):
        read_photographs(tmp_path, sensor)


def test_images_are_shrunk_by_whole_blocks_alone() -> None:
    images = np.random.default_rng(0).uniform(size=(2, 4, 6, 3))
    np.testing.assert_allclose(shrunk(images, 2), images.reshape(2, 2, 2, 3, 2, 3).mean(axis=(2, 4)), rtol=1e-12)
    for shape in ((4, 5, 3), (5, 4, 3), (2, 8, 6, 3)):
        with pytest.raises(InputError, match="must be a multiple of 4"):
            shrunk(np.ones(shape), 4)
