"""Keys of press scenes and sensors that only the soft pad knows."""

from __future__ import annotations

import pytest

from raytac.errors import SpecError
from raytac.specs import load_press, load_sensor

SCENE = """{top}
[object]
kind = "sphere"
radius_mm = 4.0
{object}
[[trajectory]]
kind = "indent"
{indent}
"""


def write(tmp_path, top="", object="", indent="depth_mm = 0.5"):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.format(top=top, object=object, indent=indent))
    return path


def test_a_scene_can_ask_for_the_soft_pad(tmp_path):
    scene = load_press(write(tmp_path, 'physics = "ipc"\npad = "medium"', 'dynamics = "soft"\nyoungs_modulus_kpa = 200'))
    assert (scene.physics, scene.pad) == ("ipc", "medium")
    assert (scene.object.dynamics, scene.object.youngs_modulus, scene.object.poisson_ratio) == ("soft", 2e5, 0.4)
    plain = load_press(write(tmp_path))
    assert (plain.physics, plain.pad, plain.object.dynamics) == (None, None, "kinematic")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"top": 'physics = "ipc"\npad = "huge"'}, r"pad = 'huge'.*coarse, medium, fine"),
        ({"top": 'pad = "coarse"'}, r"pad = 'coarse'.*physics must be"),
        ({"object": 'dynamics = "liquid"'}, r"object\.dynamics = 'liquid'.*kinematic, affine, soft"),
        ({"object": "youngs_modulus_kpa = 100"}, r"object\.youngs_modulus_kpa = 100.*dynamics must be"),
        ({"object": 'dynamics = "affine"'}, r"object\.dynamics = 'affine'.*force_n"),
    ],
)
def test_contradictions_are_named(tmp_path, settings, words):
    with pytest.raises(SpecError, match=words):
        load_press(write(tmp_path, **settings))


def test_a_weight_needs_a_force(tmp_path):
    assert load_press(write(tmp_path, object='dynamics = "affine"', indent="force_n = 0.5")).object.dynamics == "affine"


def test_the_case_holds_the_back_unless_the_sensor_says_more(tmp_path):
    assert load_sensor("gelsight_mini").gelpad.bonded == "back"
