"""Presses without a scene file: a mesh or a height map is pressed in to a depth, by ``press_of``, the sensor and the command."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from raytac.cli import main
from raytac.errors import InputError, MeshError, SpecError
from raytac.io.metrics import read_metrics
from raytac.physics.objects import object_parts
from raytac.sensor import TactileSensor
from raytac.shapes.triangulate import enclosed_volume, part_surface
from raytac.specs import ObjectSpec, PressScene, StageSpec, load_press, press_of

DEPTH = 0.8e-3


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A block of 6 mm × 4 mm × 3 mm, in millimetres, far from its file's origin."""
    path = tmp_path_factory.mktemp("part") / "part.stl"
    block = trimesh.creation.box(extents=(6.0, 4.0, 3.0))
    block.apply_translation((53.0, -32.0, 11.0))
    block.export(path)
    return path


@pytest.fixture(scope="module")
def sensor() -> TactileSensor:
    return TactileSensor(outputs=("height", "wrench"), pitch=0.1e-3)


def block_map() -> np.ndarray:
    """Heights of the same block's lower face, nodes 0.1 mm apart."""
    return np.full((41, 61), 3e-3)


def test_a_mesh_is_pressed_straight_down_with_its_middle_over_the_pad(part: Path, sensor: TactileSensor) -> None:
    scene = press_of(part, depth=DEPTH)
    assert (scene.name, scene.object.kind, scene.object.position) == ("part", "triangles", (0.0, 0.0, 0.0))
    assert scene.trajectory == (StageSpec("indent", depth=DEPTH),)
    frame = sensor.press(str(part), depth=DEPTH, scale=0.001)
    box = ObjectSpec("box", {"length": 6e-3, "width": 4e-3, "height": 3e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    exact = sensor.press(PressScene("box", box, scene.trajectory))
    np.testing.assert_allclose(frame.surface.height, exact.surface.height, atol=1e-9)
    assert frame.wrench is not None and exact.wrench is not None
    np.testing.assert_allclose(frame.wrench, exact.wrench, atol=1e-6)


def test_a_height_map_is_pressed_as_the_camera_sees_it(sensor: TactileSensor) -> None:
    heights = np.zeros((30, 61))
    heights[5:10, 45:55] = 1e-3  # right of the middle, and above it
    surface = sensor.press(heights, depth=0.3e-3, pitch=0.1e-3).surface
    x, y = surface.contact_centre[0]
    assert (x, y) == pytest.approx(((49.5 - 30.0) * 1e-4, (7.0 - 14.5) * 1e-4), abs=0.1e-3)
    assert surface.indentation.max() == pytest.approx(0.3e-3, rel=0.01)


def test_a_height_map_weighs_as_the_mesh_of_the_same_face(part: Path, sensor: TactileSensor) -> None:
    by_map = sensor.press(block_map(), depth=DEPTH, pitch=0.1e-3)
    by_mesh = sensor.press(part, depth=DEPTH)
    assert by_map.wrench is not None and by_mesh.wrench is not None
    # At its rim the map falls to 0 over one pitch, which widens the face by 0.03 mm a side at this depth.
    assert by_map.wrench[0, 2] == pytest.approx(by_mesh.wrench[0, 2], rel=0.03)


def test_a_soft_pad_gets_a_closed_surface_of_a_height_map() -> None:
    surface = part_surface(object_parts(press_of(block_map(), depth=DEPTH, pitch=1e-4).object)[0])
    edges = np.sort(np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert enclosed_volume(surface) == pytest.approx(6e-3 * 4e-3 * 3e-3, rel=0.1)


def test_scenes_pass_through() -> None:
    coin = load_press("coin")
    assert press_of("coin") == coin and press_of(coin) is coin


def test_height_maps_differ_by_their_heights() -> None:
    one = press_of(block_map(), depth=DEPTH, pitch=1e-4)
    assert one == press_of(block_map(), depth=DEPTH, pitch=1e-4)
    assert one != press_of(0.5 * block_map(), depth=DEPTH, pitch=1e-4)


@pytest.mark.parametrize(
    ("source", "settings", "message"),
    [
        ("none", {"depth": DEPTH}, "depth = 0.0008: needs an object, and the scene 'none' has none"),
        ("none", {"yaw": 0.1}, "yaw = 0.1: needs an object"),
        ("coin", {"depth": DEPTH, "force": 2.0}, "depth, force = .*: cannot both be given"),
        ("coin", {"repair": True}, "repair = True: belongs to a mesh"),
        ("coin", {"repair": "yes"}, "repair = 'yes': must be True or False"),
        ("coin", {"offset": 1e-3}, r"offset = 0.001: must have shape \(2,\), and is one number"),
        ("coin", {"yaw": "left"}, r"yaw = 'left': must be a number in \[-7, 7\] rad"),
        ("coin", {"tilt": 3}, r"tilt = 3: must be a number in \[-1.6, 1.6\] rad"),
        ("coin", {"scale": 0.001}, "scale = 0.001: belongs to a mesh: leave it out with a scene"),
        ("coin", {"depth": 0.8}, r"depth = 0.8: must be a number in \(0, 0.05\] m \(0.8e-3 is 0.8 mm"),
        ("part.stl", {}, "depth, force: one of the two must be given with a mesh or a height map"),
        ("part.step", {"depth": DEPTH}, r"scene = 'part.step': must be .* a mesh \(.stl, .obj, .ply, .off, .glb\)"),
        ("heights.npy", {"depth": DEPTH}, r"a height map is pressed in Python: sensor.press\(heights, pitch=..., depth=...\)"),
        (1e3 * block_map(), {"depth": DEPTH, "pitch": 1e-4}, r"heights = .*: must be in metres, at most 0.1 m"),
        ("part.stl", {"depth": DEPTH, "pitch": 1e-4}, "pitch = 0.0001: belongs to a height map"),
        (block_map(), {"depth": DEPTH}, "pitch: must be given with a height map, in metres"),
        (block_map(), {"depth": DEPTH, "pitch": 1.0}, r"pitch = 1.0: must be a number in \(0, 0.01\] m"),
        (-block_map(), {"depth": DEPTH, "pitch": 1e-4}, "must be >= 0 everywhere"),
        (0.0 * block_map(), {"depth": DEPTH, "pitch": 1e-4}, "> 0 somewhere"),
        (np.zeros((0, 5)), {"depth": DEPTH, "pitch": 1e-4}, "must be >= 0 everywhere"),
        (np.full((5, 5), np.nan), {"depth": DEPTH, "pitch": 1e-4}, "must be finite everywhere"),
        (np.zeros(5), {"depth": DEPTH, "pitch": 1e-4}, r"must have shape \(any, any\)"),
        (3, {}, "must be a name, a path, a PressScene, a trimesh.Trimesh or an array of heights, not int"),
    ],
)
def test_arguments_that_do_not_belong_together_are_refused(source: object, settings: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        press_of(source, **settings)  # type: ignore[arg-type]


def test_what_cannot_be_pressed_gives_the_errors_of_meshes_and_scenes(tmp_path: Path, part: Path, sensor: TactileSensor) -> None:
    with pytest.raises(MeshError, match="the mesh file does not exist"):
        press_of("no_such.stl", depth=DEPTH)
    hollow = trimesh.load_mesh(part)
    hollow.update_faces(np.arange(len(hollow.faces)) > 0)
    hollow.export(tmp_path / "open.stl")
    with pytest.raises(MeshError, match="must be watertight"):
        press_of(tmp_path / "open.stl", depth=DEPTH)
    (tmp_path / "empty.stl").write_text("solid empty\nendsolid empty\n")
    with pytest.raises(MeshError, match="empty"):
        press_of(tmp_path / "empty.stl", depth=DEPTH)
    with pytest.raises(MeshError, match=r"scale is metres per file unit; try 0.001 for a file in millimetres"):
        press_of(part, depth=DEPTH, scale=1.0)
    metres = trimesh.load_mesh(part)
    metres.apply_scale(1e-3)
    metres.export(tmp_path / "metres.stl")
    with pytest.raises(MeshError, match=r"scale is metres per file unit; try 1 for a file in metres"):
        press_of(tmp_path / "metres.stl", depth=DEPTH)
    for depth in (0.0, -1e-3, 1.0, float("nan")):
        with pytest.raises(InputError, match=rf"depth = {depth}: must be a number in \(0, 0.05\] m"):
            press_of(part, depth=depth)
    with pytest.raises(SpecError, match=r"depth_mm = 20.0: the press must be less deep than the pad"):
        sensor.press(part, depth=20e-3)
    with pytest.raises(SpecError, match="must be given for the kind"):
        dataclasses.replace(press_of(block_map(), depth=DEPTH, pitch=1e-4).object, heights=())


def test_the_command_takes_a_mesh_and_a_depth_in_millimetres(
    tmp_path: Path, part: Path, sensor: TactileSensor, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["press", str(part), "--outputs", "height,wrench", "--resolution", "80x60", "--device", "cpu"]
    assert main([*command, "--scale", "0.001", "--depth", "0.8", "--out", str(tmp_path / "out")]) == 0
    metrics = read_metrics(tmp_path / "out" / "metrics.json")
    assert metrics["scene"] == "part" and metrics["contact.max_indentation_mm"] == pytest.approx(0.8, rel=0.01)
    said = capsys.readouterr().err
    assert f"indentation up to {metrics['contact.max_indentation_mm']:.3f} mm; force on the pad" in said
    assert f"{metrics['contact.force_z_n']:.2f} N along x, y, z" in said
    assert main([*command, "--out", str(tmp_path / "none")]) == 2
    assert (
        "depth, force: one of the two must be given with a mesh" in capsys.readouterr().err and not (tmp_path / "none").exists()
    )
    assert main(["press", "coin", "--scale", "0.1", "--out", str(tmp_path / "none")]) == 2
    assert "scale = 0.1: belongs to a mesh: leave it out with a scene" in capsys.readouterr().err


def test_the_command_places_and_repairs_a_mesh(tmp_path: Path, part: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hollow = trimesh.load_mesh(part)
    hollow.update_faces(np.arange(len(hollow.faces)) > 0)
    hollow.export(tmp_path / "open.stl")
    command = ["press", str(tmp_path / "open.stl"), "--force", "2", "--x", "1.5", "--y", "-1", "--outputs", "wrench"]
    command += ["--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "open.stl: the mesh must be watertight" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert main([*command, "--repair", "--yaw", "90"]) == 0
    assert "open.stl: closed 1 hole, width 4 mm (3 edges)" in capsys.readouterr().err
    metrics = read_metrics(tmp_path / "out" / "metrics.json")
    assert metrics["contact.force_z_n"] == pytest.approx(-2.0, rel=0.01)
    assert (metrics["contact.centre_x_mm"], metrics["contact.centre_y_mm"]) == pytest.approx((1.5, -1.0), abs=0.15)


def test_a_mesh_in_memory_is_pressed_as_its_file(part: Path, sensor: TactileSensor) -> None:
    """In memory metres are the default, as everywhere in Python."""
    block = trimesh.load_mesh(part)
    by_file = sensor.press(part, force=2.0)
    np.testing.assert_array_equal(sensor.press(block, force=2.0, scale=0.001).surface.height, by_file.surface.height)
    block.apply_scale(1e-3)
    np.testing.assert_allclose(sensor.press(block, force=2.0).surface.height, by_file.surface.height, atol=1e-8)
    assert by_file.force[0, 2] == pytest.approx(-2.0, rel=1e-3)
    assert press_of(block, depth=DEPTH) == press_of(block.copy(), depth=DEPTH)
    assert press_of(block, depth=DEPTH) != press_of(trimesh.creation.box((6e-3, 4e-3, 2e-3)), depth=DEPTH)


def test_a_glb_is_in_metres_as_its_standard_says(tmp_path: Path) -> None:
    block = trimesh.creation.box((6e-3, 4e-3, 3e-3))
    block.export(tmp_path / "part.glb")
    (part,) = object_parts(press_of(tmp_path / "part.glb", depth=DEPTH).object)
    assert part.vertices is not None
    assert np.ptp(part.vertices, axis=0) == pytest.approx((6e-3, 4e-3, 3e-3), rel=1e-6)
    with pytest.raises(MeshError, match=r"the object is 0\.006 mm long"):
        press_of(tmp_path / "part.glb", depth=DEPTH, scale=0.001)


def test_plain_numbers_place_the_object(sensor: TactileSensor) -> None:
    """A block of 6 × 4 mm, turned by 90°, is 4 × 6 mm; a tilted one touches first with the side that is up in the image."""
    block = trimesh.creation.box((6e-3, 4e-3, 3e-3))
    x, y = sensor.grid.x, sensor.grid.y

    def sides(**place: Any) -> tuple[float, float, float, float]:
        contact = sensor.press(block, depth=0.3e-3, **place).surface.contact[0]
        across, down = x[contact.any(axis=0)], y[contact.any(axis=1)]
        return across[0], across[-1], down[0], down[-1]

    assert sides() == pytest.approx((-3e-3, 3e-3, -2e-3, 2e-3), abs=1.1e-4)
    assert sides(offset=(1e-3, -0.5e-3)) == pytest.approx((-2e-3, 4e-3, -2.5e-3, 1.5e-3), abs=1.1e-4)
    assert sides(yaw=np.pi / 2) == pytest.approx((-2e-3, 2e-3, -3e-3, 3e-3), abs=1.1e-4)
    angle = np.radians(15)
    edge = 2e-3 * np.cos(angle) - 1.5e-3 * np.sin(angle)
    """Distance of the edge that leads from the middle."""
    _, _, top, bottom = sides(tilt=angle)
    assert top == pytest.approx(-edge, abs=1.1e-4) and bottom < 0.0
    first, last, _, _ = sides(tilt=angle, yaw=np.pi / 2)  # that edge is turned clockwise, to the right
    assert last == pytest.approx(edge, abs=1.1e-4) and first > 0.0


def test_yaw_turns_clockwise_in_the_image(sensor: TactileSensor) -> None:
    heights = np.zeros((41, 41))
    heights[18:23, 33:38] = 1e-3  # 1.5 mm right of the middle
    x, y = sensor.press(heights, depth=0.3e-3, pitch=0.1e-3, yaw=np.pi / 2).surface.contact_centre[0]
    assert (x, y) == pytest.approx((0.0, 1.5e-3), abs=0.1e-3)


def test_a_scene_takes_one_press_in_place_of_its_trajectory(sensor: TactileSensor) -> None:
    scene = press_of("sphere", force=1.5, offset=(2e-3, 0.0))
    assert scene.trajectory == (StageSpec("indent", force=1.5),) and scene.object.params == load_press("sphere").object.params
    frame = sensor.press("sphere", force=1.5, offset=(2e-3, 0.0))
    assert frame.force[0, 2] == pytest.approx(-1.5, rel=1e-3)
    assert frame.surface.contact_centre[0] == pytest.approx((2e-3, 0.0), abs=5e-5)
    with pytest.raises(InputError, match=r"is not for a free body \(affine\)"):
        press_of(dataclasses.replace(scene, object=dataclasses.replace(scene.object, dynamics="affine")), depth=DEPTH)
    with pytest.raises(SpecError, match="the object must start on the pad"):
        sensor.press("sphere", offset=(50e-3, 0.0))
