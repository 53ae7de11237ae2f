"""A scene of either kind is found by name or path, and a wrong name lists both kinds."""

from __future__ import annotations

import pytest

from raytac.errors import SpecError
from raytac.specs import PressScene, TaskScene, available, load_press, load_scene, load_task
from raytac.specs.files import find_file


def test_shipped_scenes_of_both_kinds_are_found_by_name():
    for name in available("press scene"):
        assert load_scene(name) == load_press(name) and isinstance(load_scene(name), PressScene)
    for name in available("task scene"):
        assert load_scene(name) == load_task(name) and isinstance(load_scene(name), TaskScene)


def test_no_name_means_two_scenes():
    assert not set(available("press scene")) & set(available("task scene"))


def test_files_are_told_apart_by_what_is_in_them(tmp_path):
    for kind, name in (("press scene", "coin"), ("task scene", "lift_cube")):
        copy = tmp_path / "scene.toml"
        copy.write_text(find_file(kind, name).read_text(encoding="utf-8"), encoding="utf-8")
        loaded = load_scene(copy)
        assert isinstance(loaded, PressScene if kind == "press scene" else TaskScene)
        assert loaded.name == "scene" and loaded.source == copy


def test_a_wrong_name_lists_presses_and_tasks(tmp_path):
    with pytest.raises(SpecError, match=r"did you mean 'lift_cube'.*coin.*ball_rolling"):
        load_scene("lift_cub")
    with pytest.raises(SpecError, match="does not exist"):
        load_scene(tmp_path / "none.toml")
