"""Press scenes: the shipped ones load; each rule is broken once and must be named with file, key and value."""

from __future__ import annotations

import dataclasses
import math
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from raytac.errors import MeshError, SpecError
from raytac.specs import available, load_press, load_sensor, validate_press

KINDS = {"soft_ball": "sphere"}
"""Of scenes that are not called by the kind of their object."""
MakePress = Callable[..., Path]
NAMES = ("coin", "cone", "cylinder", "edge", "mesh", "none", "pins", "soft_ball", "sphere", "torus")


def test_the_ten_scenes_are_shipped() -> None:
    assert available("press scene") == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenes_load_and_fit_every_sensor(name: str) -> None:
    scene = load_press(name)
    assert (scene.name, scene.object.kind) == (name, KINDS.get(name, name))
    assert scene == load_press(f"scenes/press/{name}.toml") == load_press(Path("scenes/press") / f"{name}.toml")
    assert math.hypot(*scene.object.quaternion) == pytest.approx(1.0, abs=1e-12)
    for sensor in available("sensor"):
        validate_press(load_sensor(sensor), scene)
    if name == "none":
        assert scene.trajectory == () and scene.peak_stage == -1
    else:
        assert scene.trajectory[-1].kind == "release"
        assert scene.peak_stage == len(scene.trajectory) - 2


def test_a_shipped_file_taken_for_a_path_that_is_not_here_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match=r"scenes/press/coin\.toml is not in .*taking the press scene that comes with raytac"):
        scene = load_press("scenes/press/coin.toml")
    assert scene == load_press("coin")
    own = tmp_path / "scenes" / "press" / "coin.toml"
    own.parent.mkdir(parents=True)
    shutil.copy(load_press("sphere").source or "", own)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_press("scenes/press/coin.toml").object.kind == "sphere"
        load_press(own)
    with pytest.raises(SpecError, match=r"scenes/press/coins\.toml.*does not exist, and none of this path comes with raytac"):
        load_press("scenes/press/coins.toml")


def test_the_scenes_cover_force_shear_and_twist() -> None:
    stages = [stage for name in NAMES for stage in load_press(name).trajectory]
    assert {stage.kind for stage in stages} == {"indent", "shear", "twist", "release"}
    assert any(stage.force for stage in stages) and any(stage.depth for stage in stages)


def test_torus_in_si() -> None:
    torus = load_press("torus")
    assert torus.object.params == {"major_radius": 0.004, "minor_radius": 0.0012}
    assert torus.trajectory[0].depth == pytest.approx(7e-4, rel=1e-12)
    assert torus.trajectory[0].force is None
    assert torus.trajectory[1].shear == (5e-4, 0.0)
    assert torus.trajectory[2].twist == pytest.approx(math.radians(12.0), rel=1e-15)


def test_the_quaternion_is_normalised(make_press: MakePress) -> None:
    scene = load_press(make_press("torus", {"object.quaternion_wxyz": [0.707, 0.0, 0.707, 0.0]}))
    assert scene.object.quaternion == pytest.approx((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0), rel=1e-12)


def test_either_side_can_move(make_press: MakePress) -> None:
    assert load_press("coin").moves == "object"
    assert load_press(make_press("coin", {"moves": "case"})).moves == "case"


ERRORS: list[tuple[str, str, Any, str]] = [
    ("coin", "moves", "sensor", "must be a known name; choose from: object, case"),
    ("none", "moves", "case", "must be absent where there is no object"),
    ("sphere", "object.kind", "sphre", "must be a known name; did you mean 'sphere'? choose from: none, sphere, cylinder"),
    ("sphere", "object.radius_mm", 0.0, "must be a number in (0, 100] mm"),
    ("sphere", "object.radius_mm", math.nan, "must be a number in (0, 100] mm"),
    ("sphere", "object.mass_kg", 0.0, "must be a number in [0.0001, 100] kg"),
    ("sphere", "object.position_mm", [0.0, 0.0, 0.0], "must be 2 numbers"),
    ("sphere", "object.quaternion_wxyz", [0.0, 0.0, 0.0, 0.0], "must be a unit quaternion w, x, y, z"),
    ("sphere", "object.quaternion_wxyz", [1.0, 1.0, 0.0, 0.0], "its length is 1.414"),
    ("cone", "object.tip_radius_mm", 5.0, "must be less than radius_mm = 5.0"),
    ("torus", "object.minor_radius_mm", 4.0, "must be less than major_radius_mm = 4.0"),
    ("pins", "object.pitch_mm", 0.9, "pins must not overlap: at least twice pin_radius_mm = 0.5"),
    ("pins", "object.rows", 0, "must be a whole number in [1, 50]"),
    ("pins", "object.rows", 2.5, "must be a whole number in [1, 50]"),
    ("coin", "object.relief_height_mm", 2.0, "must be less than thickness_mm = 1.6"),
    (
        "coin",
        "trajectory[0].kind",
        "indnt",
        "must be a known name; did you mean 'indent'? choose from: indent, shear, twist, tilt, release",
    ),
    ("coin", "trajectory[0].depth_mm", -0.5, "must be a number in (0, 50] mm"),
    ("coin", "trajectory[0].duration_s", 0.0, "must be a number in (0, 60] s"),
    ("coin", "trajectory[0].kind", "release", "unknown key"),
    ("torus", "trajectory[1].shear_mm", 0.5, "must be 2 numbers, each in [-50, 50] mm"),
    ("torus", "trajectory[2].twist_deg", 200.0, "must be a number in [-180, 180] °"),
    ("none", "trajectory", [{"kind": "indent", "depth_mm": 1.0}], "must be absent where there is no object"),
    ("coin", "trajectory", [], "at least one [[trajectory]] stage is needed"),
    ("coin", "trajectory", {"kind": "indent"}, "must be an array of tables [[trajectory]]"),
    ("mesh", "object.scale_m_per_unit", 0.0, "must be a number in (0, 10] m per file unit"),
    ("mesh", "object.scale_m_per_unit", 1.0, "scale is metres per file unit"),
    ("mesh", "object.path", "nowhere.stl", "the mesh file does not exist"),
    ("mesh", "object.path", "n" * 70 + ".stl", "the mesh file does not exist"),
    ("mesh", "object.path", "~nobody-of-this-name/a.stl", "the path has no meaning here"),
    ("mesh", "object.path", "mesh.toml", "unknown mesh format"),
]


@pytest.mark.parametrize(("name", "key", "value", "rule"), ERRORS)
def test_press_errors(make_press: MakePress, name: str, key: str, value: Any, rule: str) -> None:
    path = make_press(name, {key: value})
    with pytest.raises(SpecError) as caught:
        load_press(path)
    error = caught.value
    assert error.file == path
    assert rule in str(error)
    if rule == "unknown key":
        assert error.key == "trajectory[0].depth_mm"
    elif key == "trajectory":
        assert error.key == key
    else:
        assert str(error).startswith(f"{path}: {key} = {value!r}: ")


def test_both_depth_and_force_or_neither(make_press: MakePress, delete: object) -> None:
    path = make_press("coin", {"trajectory[0].force_n": 2.0})
    with pytest.raises(SpecError) as caught:
        load_press(path)
    assert (
        str(caught.value)
        == f"{path}: trajectory[0].depth_mm = 0.7: an indent needs exactly one of depth_mm and force_n, got both"
    )
    path = make_press("coin", {"trajectory[0].depth_mm": delete})
    with pytest.raises(SpecError) as caught:
        load_press(path)
    assert (
        str(caught.value) == f"{path}: trajectory[0].depth_mm: an indent needs exactly one of depth_mm and force_n, got neither"
    )


def test_a_key_of_another_kind_is_unknown(make_press: MakePress) -> None:
    with pytest.raises(SpecError, match=r"object\.length_mm: unknown key.* choose from: kind, radius_mm, position_mm"):
        load_press(make_press("sphere", {"object.length_mm": 3.0}))
    with pytest.raises(SpecError, match=r"trajectory\[2\]\.depth_mm: unknown key.* choose from: kind, duration_s"):
        load_press(make_press("sphere", {"trajectory[2].depth_mm": 3.0}))
    with pytest.raises(SpecError, match=r"trajectry: unknown key; did you mean 'trajectory'\?"):
        load_press(make_press("sphere", {"trajectry": []}))


@pytest.mark.parametrize("kind", ["shear", "twist", "tilt", "release"])
def test_only_an_indent_can_come_first_or_after_a_release(make_press: MakePress, kind: str) -> None:
    stage: dict[str, Any] = {"kind": kind, **({"shear_mm": [0.1, 0.0]} if kind == "shear" else {})}
    stage |= {"twist_deg": 5.0} if kind == "twist" else {"tilt_deg": [5.0, -1.0]} if kind == "tilt" else {}
    indent = {"kind": "indent", "depth_mm": 0.5}
    for stages, index in (([stage, indent], 0), ([indent, {"kind": "release"}, stage], 2)):
        path = make_press("torus", {"trajectory": stages})
        with pytest.raises(SpecError) as caught:
            load_press(path)
        assert (
            str(caught.value)
            == f"{path}: trajectory[{index}].kind = {kind!r}: must come after an indent that has not been released"
        )
    again = load_press(make_press("torus", {"trajectory": [indent, {"kind": "release"}, indent, stage]}))
    assert [s.kind for s in again.trajectory] == ["indent", "release", "indent", kind]


def test_a_mesh_path_is_relative_to_the_scene_and_errors_name_scene_and_mesh(make_press: MakePress, tmp_path: Path) -> None:
    (tmp_path / "open.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    path = make_press("mesh", {"object.path": "open.obj"})
    with pytest.raises(MeshError) as caught:
        load_press(path)
    assert str(caught.value).startswith(f"{path}: object.path = 'open.obj': the mesh must be watertight: 3 of 3 edges")
    assert str(tmp_path / "open.obj") in str(caught.value)


def test_a_press_must_be_less_deep_than_the_pad(make_press: MakePress) -> None:
    sensor = load_sensor("gelsight_mini")
    path = make_press("coin", {"trajectory[0].depth_mm": 4.0})
    with pytest.raises(SpecError) as caught:
        validate_press(sensor, load_press(path))
    rule = "the press must be less deep than the pad of gelsight_mini is thick, 4 mm"
    assert str(caught.value) == f"{path}: trajectory[0].depth_mm = 4.0: {rule}"
    validate_press(sensor, load_press(make_press("coin", {"trajectory[0].depth_mm": 3.99})))


def test_the_object_must_start_and_stay_on_the_pad(make_press: MakePress) -> None:
    sensor = load_sensor("gelsight_mini")
    path = make_press("torus", {"object.position_mm": [0.0, -11.0]})
    with pytest.raises(SpecError) as caught:
        validate_press(sensor, load_press(path))
    assert str(caught.value).startswith(
        f"{path}: object.position_mm = [0.0, -11.0]: the object must start on the pad of gelsight_mini"
    )
    path = make_press("torus", {"object.position_mm": [12.0, 0.0], "trajectory[1].shear_mm": [1.0, 0.0]})
    with pytest.raises(SpecError) as caught:
        validate_press(sensor, load_press(path))
    assert str(caught.value).startswith(
        f"{path}: trajectory[1].shear_mm = [1.0, 0.0]: the shear must leave the object on the pad"
    )
    validate_press(
        sensor, load_press(make_press("torus", {"object.position_mm": [12.0, 0.0], "trajectory[1].shear_mm": [-1.0, 0.0]}))
    )


def test_validate_press_works_for_scenes_made_in_code() -> None:
    scene = load_press("sphere")
    deep = dataclasses.replace(scene, trajectory=(dataclasses.replace(scene.trajectory[1], depth=0.01),), source=None)
    with pytest.raises(SpecError, match=r"^trajectory\[0\]\.depth_mm = 10\.0: the press must be less deep"):
        validate_press(load_sensor("gelsight_mini"), deep)
