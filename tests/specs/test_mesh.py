"""Meshes: the formats agree, and everything that is not a solid of sensible size is refused."""

from __future__ import annotations

import os
import runpy
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from raytac.assets import asset_root
from raytac.errors import MeshError
from raytac.io.metrics import read_metrics
from raytac.specs import load_mesh

CUBE = trimesh.creation.box(extents=(10.0, 8.0, 6.0))


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".STL"])
def test_formats_agree(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube{suffix}"
    CUBE.export(path, file_type=suffix[1:].lower())
    vertices, faces = load_mesh(path, 0.001)
    assert (vertices.shape, vertices.dtype, faces.shape, faces.dtype) == ((8, 3), np.float64, (12, 3), np.int32)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.005, -0.004, -0.003], rtol=1e-6)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(480e-9, rel=1e-6)


def test_the_shipped_gear_is_small_and_solid() -> None:
    path = asset_root("scenes") / "meshes" / "gear.stl"
    assert path.stat().st_size < 200_000
    vertices, faces = load_mesh(path, 0.001)
    assert len(vertices) - 3 * len(faces) // 2 + len(faces) == 0  # Euler characteristic of a body with one bore
    np.testing.assert_allclose(np.hypot(vertices[:, 0], vertices[:, 1]).max(), 7e-3, rtol=1e-5)


@given(st.floats(1e-5, 0.035))
@settings(max_examples=20, deadline=None)
def test_scale_is_metres_per_file_unit(scale: float) -> None:
    vertices, _ = load_mesh(asset_root("scenes") / "meshes" / "gear.stl", scale)
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() == pytest.approx(7 * scale, rel=1e-5)


def stl(triangles: np.ndarray) -> bytes:
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *t.ravel(), 0) for t in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + records


def refused(path: Path, content: bytes | str, scale: float = 0.001) -> str:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(MeshError) as caught:
        load_mesh(path, scale)
    assert caught.value.file == path
    return str(caught.value)


def test_not_finite(tmp_path: Path) -> None:
    for bad in (np.nan, np.inf):
        triangles = np.array(CUBE.triangles)
        triangles[5, 1, 2] = bad
        assert "every vertex must be finite" in refused(tmp_path / "bad.stl", stl(triangles))
    assert "must be finite" in refused(tmp_path / "bad.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n")


def test_not_watertight(tmp_path: Path) -> None:
    message = refused(tmp_path / "open.stl", stl(CUBE.triangles[1:]))
    assert "the mesh must be watertight: 3 of 18 edges do not join exactly two faces" in message


def test_faces_that_disagree(tmp_path: Path) -> None:
    triangles = np.array(CUBE.triangles)
    triangles[3] = triangles[3, ::-1]
    assert "must all be oriented the same way" in refused(tmp_path / "mixed.stl", stl(triangles))


def test_inside_out(tmp_path: Path) -> None:
    message = refused(tmp_path / "inverted.stl", stl(CUBE.triangles[:, ::-1]))
    assert "must look outwards: its volume is -480 file units" in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.stl", stl(np.zeros((0, 3, 3)))),
        ("empty.obj", ""),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        (
            "points.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
        ),
        ("garbage.stl", b"\x01\x02garbage"),
        ("garbage.ply", "not a ply"),
        ("none.stl", b""),
        ("beyond.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
    ],
)
def test_empty_and_unreadable(tmp_path: Path, name: str, content: bytes | str) -> None:
    message = refused(tmp_path / name, content)
    assert any(rule in message for rule in ("the mesh is empty", "the mesh file cannot be read", "faces must index")), message


def test_missing_and_unknown_format(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"gone\.stl: the mesh file does not exist"):
        load_mesh(tmp_path / "gone.stl", 0.001)
    with pytest.raises(MeshError, match="the mesh file does not exist"):
        load_mesh(tmp_path / f"{'n' * 400}.stl", 0.001)
    with pytest.raises(
        MeshError, match=r"cube\.step: suffix = '\.step': unknown mesh format.*choose from: \.stl, \.obj, \.ply, \.off, \.glb"
    ):
        load_mesh(tmp_path / "cube.step", 0.001)


@pytest.mark.parametrize(
    ("scale", "rule"),
    [
        (1.0, "the object is 10000 mm long, must be 0.1 to 500 mm"),
        (1e-6, "the object is 0.01 mm long, must be 0.1 to 500 mm"),
        (0.0, "must be a finite number of metres per file unit > 0"),
        (float("nan"), "must be a finite number of metres per file unit > 0"),
    ],
)
def test_a_scale_that_cannot_be_meant(tmp_path: Path, scale: float, rule: str) -> None:
    message = refused(tmp_path / "cube.stl", stl(CUBE.triangles), scale)
    assert f"scale = {scale}: {rule}" in message


@given(st.binary(max_size=300), st.sampled_from([".stl", ".obj", ".ply", ".off", ".glb"]))
@settings(max_examples=60, deadline=None)
def test_random_bytes_are_refused_and_nothing_else_is_raised(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, suffix: str
) -> None:
    path = tmp_path_factory.mktemp("fuzz") / f"x{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError):
        load_mesh(path, 0.001)


def test_the_gear_is_what_its_script_writes(tmp_path: Path) -> None:
    script = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "make_gear_mesh.py"))
    script["main"](script["Args"](out=tmp_path))
    assert read_metrics(tmp_path / "metrics.json")["mesh.volume_mm3"] == pytest.approx(371.782, abs=1e-3)
    written, shipped = (load_mesh(root / "gear.stl", 0.001) for root in (tmp_path, asset_root("scenes") / "meshes"))
    np.testing.assert_allclose(written[0], shipped[0], atol=1e-9)
    np.testing.assert_array_equal(written[1], shipped[1])


def test_the_teeth_are_as_thick_on_the_pitch_circle_as_the_gaps() -> None:
    """The definition of an involute gear without backlash: half a pitch, π m / 2 of arc, is tooth."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "make_gear_mesh.py"))
    corners = script["outline"](12, 1.0)
    radius, angle = np.hypot(*corners.T), np.arctan2(corners[:, 1], corners[:, 0])
    on_pitch = np.isclose(radius, 6.0) & (np.abs(angle) < np.pi / 12)
    assert np.ptp(angle[on_pitch]) * 6.0 == pytest.approx(np.pi / 2, rel=1e-12)
    assert radius.max() == pytest.approx(7.0) and radius.min() == pytest.approx(4.75)
    assert (np.diff(np.unwrap(angle)) > 0).all()  # seen from the axis, every point of the outline is in sight


@pytest.mark.parametrize("first", ["mtllib pipe\nusemtl x\n", "mtllib a.mtl\nusemtl x\n", ""])
def test_files_that_a_mesh_names_are_not_opened(first: str, tmp_path: Path) -> None:
    """Who opened the pipe would wait for ever."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a.mtl").write_text("newmtl x\nmap_Kd pipe\n")
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    (tmp_path / "a.obj").write_text(first + str(box.export(file_type="obj")))
    vertices, faces = load_mesh(tmp_path / "a.obj", 1e-3)
    assert len(vertices) == 8 and len(faces) == 12
    (tmp_path / "pipe.obj").symlink_to("pipe")
    with pytest.raises(MeshError, match="does not exist"):
        load_mesh(tmp_path / "pipe.obj", 1e-3)


def test_vertices_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((4e38, 4.0, 4.0))
    box.export(tmp_path / "a.ply")
    with pytest.raises(MeshError, match="within 1e"):
        load_mesh(tmp_path / "a.ply", 1e-3)


@pytest.mark.parametrize("suffix", [".off", ".glb"])
def test_other_formats_agree_too(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cube{suffix}"
    CUBE.export(path)
    vertices, faces = load_mesh(path, 0.001)
    assert (vertices.shape, faces.shape) == ((8, 3), (12, 3))
    np.testing.assert_allclose(vertices.max(axis=0), [5e-3, 4e-3, 3e-3], rtol=1e-6)


def test_a_scene_of_several_placed_meshes_is_one_object(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(CUBE)
    scene.add_geometry(CUBE, transform=trimesh.transformations.translation_matrix((20.0, 0.0, 0.0)))
    scene.export(tmp_path / "two.glb")
    vertices, faces = load_mesh(tmp_path / "two.glb", 0.001)
    assert len(faces) == 24 and np.ptp(vertices[:, 0]) == pytest.approx(30e-3)


def test_an_open_mesh_names_the_repair(tmp_path: Path) -> None:
    assert "raytac press FILE --repair (in Python repair=True) closes holes" in refused(
        tmp_path / "open.stl", stl(CUBE.triangles[1:])
    )


LID = np.flatnonzero(CUBE.face_normals[:, 2] > 0.5).tolist()


@pytest.mark.parametrize("missing", [[0], LID, [0, 5, 9], [2, 3, 7]], ids=str)
def test_holes_are_closed_and_named(tmp_path: Path, missing: list[int], caplog: pytest.LogCaptureFixture) -> None:
    """Holes of a box in its planes: the closed box has the volume and the size of the whole one."""
    path = tmp_path / "open.stl"
    path.write_bytes(stl(np.delete(CUBE.triangles, missing, axis=0)))
    with pytest.raises(MeshError, match="watertight"):
        load_mesh(path, 0.001)
    mesh = trimesh.Trimesh(*load_mesh(path, 0.001, repair=True), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.bounds == pytest.approx(1e-3 * CUBE.bounds)
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"{path}: closed ") and " mm (" in line and "edges)" in line
    if missing in ([0], LID):
        assert mesh.volume == pytest.approx(480e-9) and "closed 1 hole, width " in line


def test_an_open_pipe_gets_two_lids(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pipe = trimesh.creation.cylinder(radius=4.0, height=6.0, sections=64)
    pipe.update_faces(np.abs(pipe.face_normals[:, 2]) < 0.5)
    pipe.export(tmp_path / "pipe.ply")
    mesh = trimesh.Trimesh(*load_mesh(tmp_path / "pipe.ply", 0.001, repair=True), process=False)
    whole = trimesh.creation.cylinder(radius=4.0, height=6.0, sections=64)
    assert mesh.is_watertight and mesh.volume == pytest.approx(1e-9 * whole.volume, rel=1e-6)
    assert "closed 2 holes, width 8 mm (64 edges), 8 mm (64 edges)" in caplog.text


def test_a_mesh_inside_out_is_turned_and_a_sound_one_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "cube.stl"
    path.write_bytes(stl(CUBE.triangles[:, ::-1]))
    assert trimesh.Trimesh(*load_mesh(path, 0.001, repair=True), process=False).volume == pytest.approx(480e-9)
    assert "turned its faces" in caplog.text
    caplog.clear()
    path.write_bytes(stl(CUBE.triangles))
    for kept, repaired in zip(load_mesh(path, 0.001), load_mesh(path, 0.001, repair=True), strict=True):
        np.testing.assert_array_equal(kept, repaired)
    assert not caplog.records


def test_every_load_tells_of_the_repair_by_the_path_as_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A file is read once; what is said of it does not depend on who read it before."""
    monkeypatch.chdir(tmp_path)
    path = Path("open.stl")
    path.write_bytes(stl(CUBE.triangles[1:]))
    for _ in range(2):
        with pytest.raises(MeshError, match="watertight") as caught:
            load_mesh(path, 0.001)
        assert caught.value.file == path
    spellings = [path, path, path.absolute(), path]
    for given_as in spellings:
        load_mesh(given_as, 0.001, repair=True)
    lines = [record.getMessage() for record in caplog.records]
    assert [line.partition(": closed 1 hole")[0] for line in lines] == [str(each) for each in spellings]


def test_the_same_relative_path_in_another_folder_is_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, scale in (("a", 1.0), ("b", 2.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cube.stl").write_bytes(stl(scale * CUBE.triangles))
        os.utime(tmp_path / name / "cube.stl", ns=(0, 0))
    lengths = []
    for name in "ab":
        monkeypatch.chdir(tmp_path / name)
        lengths.append(np.ptp(load_mesh("cube.stl", 0.001)[0][:, 0]))
    assert lengths == pytest.approx([10e-3, 20e-3])


def test_a_file_that_vanishes_while_it_is_asked_for_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("raytac.specs.mesh.is_file", lambda path: True)
    with pytest.raises(MeshError, match=r"cannot be read \(FileNotFoundError"):
        load_mesh(tmp_path / "gone.stl", 0.001)


def test_what_cannot_be_closed_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    triangles = np.array(CUBE.triangles)
    triangles[3] = triangles[3, ::-1]
    (tmp_path / "mixed.stl").write_bytes(stl(triangles))
    with pytest.raises(MeshError, match=r"edges with two faces on one side.*cannot be repaired: faces overlap, or are oriented"):
        load_mesh(tmp_path / "mixed.stl", 0.001, repair=True)
    fin = np.concatenate([CUBE.triangles, [[[-5.0, -4.0, -3.0], [5.0, -4.0, -3.0], [0.0, -9.0, 0.0]]]])  # a third face on an edge
    (tmp_path / "fin.stl").write_bytes(stl(fin))
    with pytest.raises(MeshError, match="cannot be repaired"):
        load_mesh(tmp_path / "fin.stl", 0.001, repair=True)
    assert not caplog.records


def test_a_file_is_read_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from raytac.specs import mesh as module

    path, reads = tmp_path / "cube.stl", []
    read = module._read
    monkeypatch.setattr(module, "_read", lambda file: reads.append(file) or read(file))
    CUBE.export(path)
    vertices, faces = load_mesh(path, 0.001)
    vertices[:], faces[:] = 0.0, 0  # the caller's own arrays
    again, _ = load_mesh(path, 0.001)
    assert np.ptp(again, axis=0) == pytest.approx([10e-3, 8e-3, 6e-3]) and len(reads) == 1
    load_mesh(path, 0.002)
    assert len(reads) == 2
    trimesh.creation.box(extents=(5.0, 4.0, 3.0)).export(path)
    assert np.ptp(load_mesh(path, 0.001)[0], axis=0) == pytest.approx([5e-3, 4e-3, 3e-3]) and len(reads) == 3
