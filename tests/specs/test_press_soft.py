"""Keys of press scenes and sensors that only the soft pad knows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from raytac.errors import SpecError
from raytac.specs import load_press, load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

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


@pytest.mark.solver
@pytest.mark.parametrize(
    "stage",
    [StageSpec("tilt", tilt=(0.2, 0.0)), StageSpec("twist", twist=0.1), StageSpec("shear"), StageSpec("indent", depth=1e-4)],
)
def test_a_free_body_made_in_python_is_only_laid_down_either(stage):
    """It would lie still through the stage; a further stage is refused by the same rule."""
    from raytac.physics import RigidPad

    ball = ObjectSpec("sphere", {"radius": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05, "affine")
    laid = PressScene("laid", ball, (StageSpec("indent", force=0.5), StageSpec("release")))
    rule = rf"object\.dynamics = 'affine'.*force_n.*trajectory\[{{}}\] has it \({stage.kind}\)"
    with pytest.raises(SpecError, match=rule.format(2)):
        replace(laid, trajectory=(*laid.trajectory, stage))
    pad = RigidPad(load_sensor("gelsight_mini"), laid, pitch=0.5e-3)
    with pytest.raises(SpecError, match=rule.format(0)):
        next(pad.follow(stage))


def test_the_case_holds_the_back_unless_the_sensor_says_more(tmp_path):
    assert load_sensor("gelsight_mini").gelpad.bonded == "back"
