"""Task scenes: shipped files, defaults, and every rule that a file can break."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from raytac.assets import asset_root
from raytac.errors import SpecError
from raytac.specs import available, load_task
from raytac.specs.task import (
    BODY_SCHEMA,
    COUPLINGS,
    MOTIONS,
    MOUNT_SCHEMA,
    OWNERS,
    ROBOT_SCHEMA,
    ROBOTS,
    SHAPE_SCHEMA,
    TASK_SCHEMA,
)
from raytac.specs.toml import ANY, Number

SCENE = """
timestep_s = 0.002
[robot]
model = "fixed_sensor"
[[body]]
name = "table"
kind = "plane"
dynamics = "fixed"
[[body]]
name = "ball"
kind = "sphere"
radius_mm = 5
position_mm = [10, 20, 30]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("name", available("task scene"))
def test_shipped_scenes_load(name: str) -> None:
    scene = load_task(name)
    assert scene.name == name and scene.source is not None


def test_values_are_si_and_defaults_are_there(tmp_path: Path) -> None:
    scene = load_task(written(tmp_path, SCENE))
    table, ball = scene.bodies
    assert ball.params == {"radius": 0.005} and ball.position == (0.01, 0.02, 0.03)
    assert (ball.dynamics, ball.owner, ball.mass, ball.friction) == ("free", "ipc", None, None)
    assert table.params == {} and table.dynamics == "fixed"
    assert (scene.timestep, scene.soft_timestep, scene.control_timestep) == (0.002, 0.01, 0.01)
    assert scene.robot.joints is None and scene.coupling == "two_way" and scene.gravity == (0.0, 0.0, -9.81)
    assert scene.body("ball") is ball


WRONG = [
    ("timestep_s = 0.002", "timestep_s = 0.003", "soft_timestep_s", "must be a whole multiple of timestep_s = 0.003"),
    ("timestep_s = 0.002", "timestep_s = 0.02", "soft_timestep_s", "must be a whole multiple of timestep_s = 0.02"),
    ("timestep_s = 0.002", 'pad = "fine"', "pad", 'physics must be "ipc"'),
    ('"fixed_sensor"', '"pandaa"', "robot.model", "must be a robot that raytac builds"),
    ('"fixed_sensor"', '"nowhere.xml"', "robot.model", "the model file does not exist"),
    ('"fixed_sensor"', '"fixed_sensor"\nopening_mm = 3', "robot.opening_mm", "is no key of this robot"),
    ('"fixed_sensor"', '"panda_one_sensor"\njoints_deg = [1, 2]', "robot.joints_deg", "must be the seven angles"),
    ('dynamics = "fixed"', 'dynamics = "free"', "body[0].dynamics", "half-space that cannot move"),
    ('dynamics = "fixed"', 'dynamics = "fixed"\nmass_kg = 1', "body[0].mass_kg", "belongs to a body with dynamics free"),
    ('name = "ball"', 'name = "table"', "body[1].name", "another body has this name"),
    ("radius_mm = 5", "", "body[1].radius_mm", "missing key"),
    ("radius_mm = 5", "radius_mm = -5", "body[1].radius_mm", "must be a number in (0, 100] mm"),
    ("radius_mm = 5", "radius_mm = 5\nyoungs_modulus_kpa = 3", "body[1].youngs_modulus_kpa", "dynamics soft"),
    ("radius_mm = 5", "radius_mm = 5\nmass_kg = 1\ndensity_kg_m3 = 1", "body[1].density_kg_m3", "not both"),
    ("radius_mm = 5", 'radius_mm = 5\ndynamics = "soft"\nheld_by = "tabel"', "body[1].held_by", "name of a fixed body"),
    ("radius_mm = 5", "radius_mm = 5\nquaternion_wxyz = [1, 1, 0, 0]", "body[1].quaternion_wxyz", "unit quaternion"),
    ("radius_mm = 5", "radius_mm = 5\nmas_kg = 1", "body[1].mas_kg", "unknown key"),
    ('kind = "sphere"', 'kind = "none"', "body[1].kind", "must be a known name"),
]


@pytest.mark.parametrize(("old", "new", "key", "rule"), WRONG)
def test_a_broken_rule_names_file_key_and_rule(tmp_path: Path, old: str, new: str, key: str, rule: str) -> None:
    path = written(tmp_path, SCENE.replace(old, new))
    with pytest.raises(SpecError) as caught:
        load_task(path)
    assert caught.value.key == key and rule in str(caught.value) and str(path) in str(caught.value)


def test_mounts_are_read_and_checked(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text("<mujoco/>", "utf-8")
    robot = '"arm.xml"\narm_joints = "a b"\n[[robot.mount]]\nname = "tip"\nat = "hand"\nposition_mm = [0, 0, 30]'
    scene = load_task(written(tmp_path, SCENE.replace('"fixed_sensor"', robot)))
    assert scene.robot.arm_joints == ("a", "b") and scene.robot.mounts[0].position == (0.0, 0.0, 0.03)
    assert scene.robot.model == str(tmp_path / "arm.xml")
    for wrong, rule in (
        ('"arm.xml"', "needs at least one"),
        (robot + '\n[[robot.mount]]\nname = "tip"\nat = "hand"', "two sensors have this name"),
    ):
        with pytest.raises(SpecError, match=rule):
            load_task(written(tmp_path, SCENE.replace('"fixed_sensor"', wrong)))


def test_readme_lists_every_key_with_its_range() -> None:
    text = (asset_root("scenes") / "README.md").read_text("utf-8").split("## Task scenes")[1]
    rows = [line.split("|")[1:4] for line in text.splitlines() if line.startswith("| `")]
    for schema in (TASK_SCHEMA, ROBOT_SCHEMA, MOUNT_SCHEMA, BODY_SCHEMA):
        for key, field in schema.items():
            found = [row for row in rows if f"`{key}`" in row[0]]
            assert found or key == "model", key
            if isinstance(field, Number) and "as above" not in found[0][1]:
                many = {0: "", ANY: "a list of "}.get(field.length, f"{field.length} × ")
                assert any(f"{many}`{field.interval}`" in row[1] for row in found), key
    for word in (*ROBOTS, *OWNERS, *MOTIONS, *COUPLINGS, *(set(SHAPE_SCHEMA) & {"plane", "box"})):
        assert re.search(rf"`{word}`", text), word
