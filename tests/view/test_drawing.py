"""What goes to the browser: meshes with colours, scales, images with arrows."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from raytac.gel.surface import make_grid
from raytac.specs import load_sensor
from raytac.view.pictures import ARROW_SCALE, picture
from raytac.view.scene_view import ColourScale, coloured_glb, legend_html, vertex_normals
from raytac.view.sensor_view import grid_faces, sensor_lines, sensor_solids, strided
from raytac.view.session import QUANTITIES, PadView


def test_another_reader_finds_the_mesh_and_its_colours():
    ball = trimesh.creation.icosphere(subdivisions=2)
    colours = np.random.default_rng(0).integers(0, 256, ball.vertices.shape)
    data = coloured_glb(ball.vertices, ball.faces, colours)
    (mesh,) = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    np.testing.assert_allclose(mesh.vertices, ball.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    np.testing.assert_allclose(mesh.vertex_normals, vertex_normals(ball.vertices, ball.faces), atol=1e-6)
    linear = mesh.visual.vertex_attributes["color"][:, :3] / 255.0
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    bright = colours > 60  # 8 bits of linear light are coarse in the dark
    assert np.abs(255.0 * encoded - colours)[bright].max() < 6.0


def test_normals_of_a_ball_point_away_from_it_and_of_nothing_up():
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert np.einsum("ij,ij->i", vertex_normals(ball.vertices, ball.faces), ball.vertices).min() > 0.999
    assert vertex_normals(np.zeros((3, 3)), np.array([[0, 1, 2]])).tolist() == [[0.0, 0.0, 1.0]] * 3


def test_a_scale_grows_to_round_numbers_and_forgets_on_reset():
    scale = ColourScale(QUANTITIES["indentation"])
    scale.include(np.array([0.3e-3, np.nan, np.inf]))
    assert scale.full == 0.5
    scale.include(np.array([0.1e-3]))
    assert scale.full == 0.5  # colours keep their meaning in a motion
    assert [f">{figure}<" in legend_html(scale) for figure in ("0", "0.25", "0.5")] == [True] * 3
    scale.reset()
    assert scale.full == 0.1


def test_colours_get_lighter_with_the_value_and_what_is_not_finite_is_grey():
    scale = ColourScale(QUANTITIES["pressure"])
    scale.include(np.array([10e3]))
    colours = scale.colours(np.array([-5e3, 0.0, 5e3, 10e3, np.nan]))
    luminance = colours.astype(float) @ [0.2126, 0.7152, 0.0722]
    assert luminance[0] == luminance[1] < luminance[2] < luminance[3]
    assert colours[4].tolist() == [128] * 3


def test_a_drawn_grid_is_thin_keeps_its_edges_and_faces_the_object():
    grid = make_grid(load_sensor("gelsight_mini").gelpad, 0.05e-3)
    thin = strided(grid)
    assert thin.x.size * thin.y.size <= 12_000 < grid.x.size * grid.y.size
    assert (thin.x[[0, -1]] == grid.x[[0, -1]]).all() and (thin.y[[0, -1]] == grid.y[[0, -1]]).all()
    x, y = np.meshgrid(thin.x, thin.y)
    vertices = np.stack([x.ravel(), y.ravel(), thin.rest.ravel()], axis=1)
    faces = grid_faces(thin)
    corner = vertices[faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2]
    assert area.min() > 0.0
    assert 0.5 * area.sum() == pytest.approx(np.ptp(grid.x) * np.ptp(grid.y))


def test_the_sensor_is_drawn_with_its_own_measures():
    spec = load_sensor("gelsight_mini")
    solids = {solid.name: solid for solid in sensor_solids(spec)}
    gel = trimesh.Trimesh(solids["gel"].vertices, solids["gel"].faces, process=False)
    assert gel.extents[:2] == pytest.approx(spec.gelpad.size)
    assert gel.vertices[:, 2].min() == pytest.approx(-spec.gelpad.thickness)
    assert len([name for name in solids if name.startswith("leds/")]) == len(spec.lights.leds)
    case, view = sensor_lines(spec)
    assert np.ptp(case.segments.reshape(-1, 3), axis=0)[:2] == pytest.approx(spec.case.size)
    assert view.segments[0, 0] == pytest.approx(spec.camera.position)


def pad_view(**fields) -> PadView:
    return PadView(np.eye(4), np.zeros((3, 3)), {"indentation": np.zeros(3)}, **fields)


def test_arrows_go_over_the_image_only_where_markers_moved_and_are_wanted():
    rgb = np.full((60, 80, 3), 100, np.uint8)
    rest, moved = np.array([[20.0, 30.0], [60.0, 30.0], [40.0, 10.0]]), np.array([[3.0, 0.0], [0.0, 0.0], [np.nan, 0.0]])
    view = pad_view(rgb=rgb, markers_px=(rest, moved))
    assert picture(view, arrows=False) is rgb and picture(pad_view(), arrows=True) is None
    drawn = picture(view, arrows=True)
    assert drawn is not None and drawn.shape == (360, 480, 3)
    inked = np.argwhere((drawn != 100).any(axis=-1)) / 6.0
    near = [np.abs(inked - at[::-1]).max(axis=1) < 2.0 for at in rest]
    along = (inked[:, 1] > 20.0) & (inked[:, 1] < 33.0) & (np.abs(inked[:, 0] - 30.0) < 2.0)
    assert near[0].any() and near[1].any() and not near[2].any()
    assert inked[along][:, 1].max() == pytest.approx(20.0 + 3.0 * ARROW_SCALE, abs=0.5)
