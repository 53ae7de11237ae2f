"""The preview shows what it was given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.text import Text

from raytac.gel.surface import GelSurface
from raytac.io.images import read_png
from raytac.report.preview import (
    DIFFERENCE_RANGE,
    PreviewData,
    camera_extent_mm,
    difference_to_rest,
    draw_preview,
    write_preview,
)
from raytac.specs.sensor import SensorSpec
from tests.conftest import ball_under, make_surface, shade


@pytest.fixture(scope="module")
def data(sensor_spec: SensorSpec, ball_surface: GelSurface) -> PreviewData:
    frame, rest = shade(ball_surface, (80, 60), sensor_spec), shade(make_surface(0.0), (80, 60), sensor_spec)
    return PreviewData(
        title="test",
        grid=ball_surface.grid,
        height=ball_surface.height[0],
        contact=ball_surface.contact[0],
        extent_mm=camera_extent_mm(sensor_spec.camera),
        object_height=ball_under(ball_surface.grid),
        rgb=frame.rgb[0],
        rest_rgb=rest.rgb[0],
        normals=frame.normals[0],
        section=(0.0, 0.0),
    )


def titles(data: PreviewData, sensor: SensorSpec) -> list[str]:
    return [axes.get_title(loc="left") for axes in draw_preview(data, sensor).axes if axes.get_title(loc="left")]


def test_all_panels_are_there_and_none_is_empty(data: PreviewData, sensor_spec: SensorSpec, tmp_path: Path) -> None:
    write_preview(tmp_path / "preview.png", data, sensor_spec, dpi=100)
    image = read_png(tmp_path / "preview.png").astype(float)
    height, width = image.shape[:2]
    assert width == 716
    for row in range(2):
        for column in range(3):
            panel = image[row * height // 2 : (row + 1) * height // 2, column * width // 3 : (column + 1) * width // 3]
            assert panel.std() > 10.0, (row, column)
            assert (panel.min(axis=2) < 250).mean() > 0.1, (row, column)
    assert [title[:3] for title in titles(data, sensor_spec)] == ["(a)", "(b)", "(c)", "(d)", "(e)", "(f)"]


def test_a_press_changes_the_picture(data: PreviewData, sensor_spec: SensorSpec, tmp_path: Path) -> None:
    untouched = replace(data, height=data.grid.rest, contact=np.zeros_like(data.contact), rgb=data.rest_rgb)
    write_preview(tmp_path / "a.png", data, sensor_spec, dpi=60)
    write_preview(tmp_path / "b.png", untouched, sensor_spec, dpi=60)
    assert np.abs(read_png(tmp_path / "a.png").astype(int) - read_png(tmp_path / "b.png")).max() > 50


def test_what_was_not_computed_has_no_panel(data: PreviewData, sensor_spec: SensorSpec) -> None:
    bare = replace(data, rgb=None, rest_rgb=None, normals=None, object_height=None)
    assert titles(bare, sensor_spec) == ["(a) object: none", titles(bare, sensor_spec)[1], "(c) indentation [mm]"]
    assert titles(bare, sensor_spec)[1].startswith("(b) section")


@pytest.mark.parametrize("without", [(), ("rgb", "rest_rgb"), ("normals",), ("rgb", "rest_rgb", "normals")])
def test_no_panel_runs_into_another(without: tuple[str, ...], data: PreviewData, sensor_spec: SensorSpec) -> None:
    """Bars with figures of four signs, and whatever outputs are left out."""
    traction = np.full((*data.height.shape, 3), -1e6 / 3)
    deep = data.grid.rest + 0.25 * (data.height - data.grid.rest)
    shown = replace(data, height=deep, traction=traction, traction_at_rest=True, **dict.fromkeys(without))
    figure = draw_preview(shown, sensor_spec)
    figure.set_dpi(300)
    figure.canvas.draw()
    found = {axes.get_title(loc="left"): axes.get_tightbbox() for axes in figure.axes if axes.get_title(loc="left")}
    boxes = {title: box for title, box in found.items() if box is not None}
    assert len(boxes) == 8 - len(without)
    for a, first in boxes.items():
        assert first.x0 >= 0.0 and first.x1 <= figure.bbox.x1, a
        for b, second in boxes.items():
            assert a == b or not first.overlaps(second), (a, b)


@pytest.mark.parametrize(
    ("without", "pressed", "sheared", "span"),
    [((), False, False, 1), ((), True, False, 3), ((), True, True, 2), (("normals",), False, False, 2)],
)
def test_the_section_leaves_no_place_empty(
    without: tuple[str, ...], pressed: bool, sheared: bool, span: int, data: PreviewData, sensor_spec: SensorSpec
) -> None:
    """Right edges of the last panel of every row agree, and so does what the section says of its stretch, however wide it is."""
    traction = np.zeros((*data.height.shape, 3))
    traction[..., 2], traction[..., 0] = -1e3, 10.0 * sheared
    figure = draw_preview(replace(data, traction=traction if pressed else None, **dict.fromkeys(without)), sensor_spec)
    boxes = [axes.get_position() for axes in figure.axes if axes.get_title(loc="left")]
    edges = {round(box.y0, 6): max(b.x1 for b in boxes if abs(b.y0 - box.y0) < 1e-6) for box in boxes}
    assert len(edges) == -(-(len(boxes) + span - 1) // 3) and np.ptp(list(edges.values())) < 1e-9
    (section,) = (axes for axes in figure.axes if "section" in axes.get_title(loc="left"))
    column = boxes[0].width + (boxes[1].x0 - boxes[0].x1)
    assert section.get_position().width == pytest.approx(boxes[0].width + (span - 1) * column)
    check_stretch(section)


def texts(data: PreviewData, sensor: SensorSpec, title: str) -> list[str]:
    """Words inside of the panel whose title ends so."""
    (axes,) = (axes for axes in draw_preview(data, sensor).axes if axes.get_title(loc="left").endswith(title))
    return [text.get_text() for text in axes.texts]


def test_traction_says_whether_it_lies_where_the_coat_was_at_rest(data: PreviewData, sensor_spec: SensorSpec) -> None:
    now = replace(data, traction=np.ones((*data.height.shape, 3)))
    for kind in ("normal traction [kPa]", "shear traction [kPa]"):
        assert texts(now, sensor_spec, kind) == []
        assert texts(replace(now, traction_at_rest=True), sensor_spec, kind) == ["at the place of rest"]


def test_without_shear_there_is_no_black_panel_of_it(data: PreviewData, sensor_spec: SensorSpec) -> None:
    traction = np.zeros((*data.height.shape, 3))
    traction[..., 2] = -1e3
    shown = replace(data, traction=traction)
    assert sum("traction" in title for title in titles(shown, sensor_spec)) == 1
    assert texts(shown, sensor_spec, "normal traction [kPa]") == ["no shear"]


def test_no_title_runs_beyond_its_panel(data: PreviewData, sensor_spec: SensorSpec) -> None:
    """Over the colour bar or out of the sheet."""
    for traction in (np.ones((*data.height.shape, 3)), np.array([0.0, 0.0, -1e3]) * np.ones((*data.height.shape, 1))):
        figure = draw_preview(replace(data, traction=traction, traction_at_rest=True), sensor_spec)
        figure.set_dpi(300)
        figure.canvas.draw()
        for axes in (axes for axes in figure.axes if axes.get_title(loc="left")):
            title = next(text for text in axes.findobj(Text) if text.get_text() == axes.get_title(loc="left"))
            assert title.get_window_extent().x1 <= axes.get_window_extent().x1 + 3, axes.get_title(loc="left")


def test_the_section_is_never_at_minus_zero(data: PreviewData, sensor_spec: SensorSpec) -> None:
    grid = replace(data.grid, y=data.grid.y - data.grid.y[len(data.grid.y) // 2] - 1e-6)
    (title,) = (title for title in titles(replace(data, grid=grid), sensor_spec) if "section" in title)
    assert "y = 0.0 mm" in title


def check_stretch(axes: Axes) -> None:
    """The label of a section's axis is the ratio of its scales."""
    box, (left, right), (low, high) = axes.get_position(), axes.get_xlim(), axes.get_ylim()
    width, height = axes.figure.get_size_inches()  # type: ignore[union-attr]
    stretch = (box.height * height / (high - low)) / (box.width * width / (right - left))
    assert axes.get_ylabel() == f"z [mm], stretched {stretch:.1f} ×"


def test_the_key_of_the_normals_lies_beside_the_image(data: PreviewData, sensor_spec: SensorSpec) -> None:
    figure = draw_preview(data, sensor_spec)
    (panel,) = (axes for axes in figure.axes if "normals" in axes.get_title(loc="left"))
    (key,) = panel.child_axes
    figure.canvas.draw()
    assert key.get_position().x0 >= panel.get_position().x1
    assert all(key.get_position().x1 < axes.get_position().x0 for axes in figure.axes if "(f)" in axes.get_title(loc="left"))


def test_difference_is_grey_for_none_and_saturates_at_the_stated_range() -> None:
    rest = np.full((1, 1, 3), 100, np.uint8)
    assert (difference_to_rest(rest, rest) == 0.5).all()
    assert (difference_to_rest(rest + np.uint8(DIFFERENCE_RANGE), rest) == 1.0).all()
    assert (difference_to_rest(rest - np.uint8(DIFFERENCE_RANGE), rest) == 0.0).all()
    assert difference_to_rest(rest + np.uint8(16), rest) == pytest.approx(0.5 + 16 / (2 * DIFFERENCE_RANGE))


def test_extent_is_the_camera_footprint(sensor_spec: SensorSpec) -> None:
    camera = replace(sensor_spec.camera, principal_point=(150.0, 125.0), position=(1e-3, -2e-3, -28e-3))
    left, right, bottom, top = camera_extent_mm(camera)
    assert right - left == pytest.approx(320 * 0.0634) and bottom - top == pytest.approx(240 * 0.0634)
    assert left == pytest.approx(1.0 - 150 * 0.0634) and top == pytest.approx(-2.0 - 125 * 0.0634)
