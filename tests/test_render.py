"""Height maps from elsewhere as frames, and the guide's pages that show how."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import raytac
from raytac.errors import InputError
from raytac.gel.surface import GelSurface

GUIDE = Path(__file__).parents[1] / "docs" / "guide"


@pytest.fixture(scope="module")
def sensor() -> raytac.TactileSensor:
    return raytac.TactileSensor(outputs=("rgb", "depth"), resolution=(80, 60))


@pytest.fixture(scope="module")
def coin(sensor: raytac.TactileSensor) -> raytac.TactileFrame:
    return sensor.press("coin")


def test_the_map_of_a_press_gives_the_image_of_the_press(sensor: raytac.TactileSensor, coin: raytac.TactileFrame) -> None:
    grid = coin.surface.grid
    frame = sensor.render(coin.surface.height[0] - grid.rest, grid.pitch)
    np.testing.assert_array_equal(frame.rgb, coin.rgb)
    np.testing.assert_array_equal(frame.surface.height, coin.surface.height)
    assert frame.label == "map+raytrace-fast" and "force" not in frame.outputs


def test_the_overlap_of_a_press_gives_the_surface_of_the_press(sensor: raytac.TactileSensor, coin: raytac.TactileFrame) -> None:
    grid, under = coin.surface.grid, sensor.object_height(coin.surface)
    assert under is not None
    frame = sensor.render(np.minimum(under - grid.rest, 0.0), grid.pitch, overlap=True)
    np.testing.assert_allclose(frame.surface.height, coin.surface.height, rtol=0.0, atol=1e-9)
    assert (frame.surface.contact != coin.surface.contact).mean() < 1e-4
    assert np.abs(frame.rgb.astype(int) - coin.rgb).max() <= 1
    assert frame.label == "overlap+raytrace-fast"


def test_zeros_are_the_pad_at_rest(sensor: raytac.TactileSensor) -> None:
    rest = sensor.rest()
    for overlap in (False, True):
        frame = sensor.render(np.zeros((5, 7)), overlap=overlap)
        np.testing.assert_array_equal(frame.rgb, rest.rgb)
        assert not frame.surface.contact.any() and np.isnan(frame.surface.contact_centre).all()


def test_axes_and_units_are_those_of_the_camera_s_view(sensor: raytac.TactileSensor) -> None:
    """Without a pitch the map covers the view: a dent in its upper right quarter is there in the image."""
    height = np.zeros((2, 48, 64))
    height[0, 6:18, 40:56] = -0.3e-3
    frame = sensor.render(height)
    assert frame.rgb.shape == (2, 60, 80, 3)
    nearer = frame.depth[1] - frame.depth[0]
    rows, columns = np.nonzero(nearer > 0.15e-3)
    assert rows.mean() == pytest.approx(60 * 12 / 48 - 0.5, abs=1.0) and columns.mean() == pytest.approx(
        80 * 48 / 64 - 0.5, abs=1.0
    )
    assert nearer.max() == pytest.approx(0.3e-3, rel=0.02)
    x, y = frame.surface.contact_centre[0]
    step = sensor.spec.camera.pitch_at((64, 48))
    assert (x, y) == pytest.approx((16 * step[0], -12 * step[1]), abs=0.05e-3)


def test_between_and_beyond_its_nodes(sensor: raytac.TactileSensor) -> None:
    y, x = 1e-3 * np.mgrid[-4:5, -3:4]
    surface = sensor.render(-0.2e-3 + 0.02 * x + 0.01 * y, 1e-3).surface
    grid = surface.grid
    inner = -0.2e-3 + 0.02 * np.clip(grid.x, -3e-3, 3e-3) + 0.01 * np.clip(grid.y, -4e-3, 4e-3)[:, None]
    np.testing.assert_allclose(surface.height[0], grid.rest + inner, atol=1e-9)


def test_contact_is_asked_for_or_taxim_s(sensor: raytac.TactileSensor) -> None:
    height = np.zeros((11, 11))
    height[3:8, 3:8], height[5, 5] = -0.1e-3, -0.3e-3
    (guess,) = sensor.render(height, 1e-3).surface.contact
    grid = sensor.grid
    assert guess[np.abs(grid.y).argmin(), np.abs(grid.x).argmin()] and not guess[:, np.abs(grid.x) > 1e-3].any()
    (given,) = sensor.render(height, 1e-3, contact=height < 0).surface.contact
    assert given[:, np.abs(grid.x) < 2.1e-3][np.abs(grid.y) < 2.1e-3].all() and not given[:, np.abs(grid.x) > 2.6e-3].any()


def test_markers_follow_a_map() -> None:
    sensor = raytac.TactileSensor("gelsight_mini_7x9", markers="fots", outputs=("height",))
    surface = sensor.press("sphere").surface
    frame = sensor.render(surface.height[0] - surface.grid.rest, surface.grid.pitch)
    assert np.abs(frame.markers.displacement).max() > 1e-5


@pytest.mark.parametrize(
    ("heights", "settings", "message"),
    [
        (np.zeros(5), {}, r"heights = \(5,\): must have shape \(rows, columns\)"),
        (np.zeros((1, 5)), {}, r"heights = \(1, 5\): must have shape"),
        (np.zeros((0, 5, 5)), {}, "must have shape"),
        ("map", {}, "heights = .*: must be real numbers"),
        (np.full((5, 5), np.nan), {}, "heights = nan: must be finite"),
        (np.full((5, 5), -0.3), {}, r"heights = \(-0.3, -0.3\): must be displacements in metres, within the gel's thickness"),
        (np.full((5, 5), 1e-4), {"overlap": True}, "within the gel's thickness of 0.004 m, and <= 0"),
        (np.full((5, 5), -3.9e-3), {"overlap": True}, "would press the gel below its bonded face"),
        (np.zeros((5, 5)), {"overlap": 1}, "overlap = 1: must be True or False"),
        (np.zeros((5, 5)), {"pitch": 1.0}, r"pitch = 1.0: must be a number in \(0, 0.01\] m"),
        (np.zeros((5, 5)), {"pitch": (1e-3, 1e-3, 1e-3)}, "must be one length or two"),
        (np.zeros((5, 5)), {"contact": np.zeros((5, 4), bool)}, "contact = .*must have shape"),
        (np.zeros((5, 5)), {"overlap": True, "contact": np.zeros((5, 5), bool)}, "contact: is computed with overlap=True"),
    ],
)
def test_what_is_no_height_map_is_refused(
    heights: Any, settings: dict[str, Any], message: str, sensor: raytac.TactileSensor
) -> None:
    with pytest.raises(InputError, match=message):
        sensor.render(heights, **settings)


def test_a_displaced_surface_keeps_its_contact_rule() -> None:
    grid = raytac.gel.make_grid(raytac.load_sensor("gelsight_mini").gelpad, 1e-3)
    moved = np.zeros((2, *grid.shape))
    moved[1, 2, 3], moved[1, 2, 4] = -1e-4, -3e-5
    surface = GelSurface.displaced(grid, moved)
    assert surface.contact.sum() == 1 and surface.contact[1, 2, 3]
    assert surface.contact_centre[1] == pytest.approx((grid.x[3], grid.y[2]))


@pytest.mark.parametrize("page", ["depth-maps", "own-part", "show-and-save"])
def test_the_pages_run_as_they_are(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    blocks = re.findall(r"```python\n(.*?)```", (GUIDE / f"{page}.md").read_text(encoding="utf-8"), flags=re.S)
    assert blocks
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
    assert names["frame"].rgb.shape == (1, 240, 320, 3)
