"""``TactileSensor`` with the simulated pad: chosen by name or by scene, same outputs and units as the rigid one."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.traction import cell_areas
from raytac.sensor import TactileSensor
from raytac.specs import load_press
from raytac.specs.press import StageSpec

OUTPUTS = ("height", "wrench", "traction")
SCENE = replace(load_press("sphere"), trajectory=(StageSpec("indent", depth=0.3e-3),))


@pytest.fixture(scope="module")
def frames():
    made = {}
    for physics in ("rigid", "ipc"):
        sensor = TactileSensor(outputs=OUTPUTS, physics=physics, pitch=0.2e-3, device="cpu")
        made[physics] = sensor, sensor.press(SCENE)
    return made


@pytest.mark.parametrize("physics", ["rigid", "ipc"])
def test_wrench_traction_and_area_mean_the_same(frames, physics):
    sensor, frame = frames[physics]
    assert frame.wrench.shape == (1, 6) and frame.traction.shape == (1, *sensor.grid.shape, 3)
    assert frame.wrench[0, :3] == pytest.approx(frame.force[0])
    total = (frame.traction[0].astype(float) * cell_areas(sensor.grid)[..., None]).sum(axis=(0, 1))
    assert total == pytest.approx(frame.wrench[0, :3], rel=1e-4, abs=1e-5)
    assert frame.wrench[0, 2] < -0.2
    assert frame.contact_area[0] == pytest.approx(frame.surface.contact.sum() * 0.2e-3**2, rel=0.01)
    assert (frame.force_law_area is None) == (physics == "ipc")


def test_both_pads_make_about_the_same_press(frames):
    rigid, soft = frames["rigid"][1], frames["ipc"][1]
    assert soft.surface.indentation.max() == pytest.approx(rigid.surface.indentation.max(), rel=0.03)
    assert soft.wrench[0, 2] == pytest.approx(rigid.wrench[0, 2], rel=0.5)  # coarse cells are stiff
    assert soft.surface.coat is not None and rigid.surface.coat is None


def test_labels_tell_the_pads_apart(frames):
    assert frames["rigid"][0].label == "rigid" and frames["ipc"][0].label == "ipc-coarse"


def test_the_scene_chooses_unless_the_caller_does():
    scene = replace(load_press("none"), physics="ipc", pad="medium")
    sensor = TactileSensor(outputs=("height",), pitch=0.5e-3, device="cpu")
    assert sensor.press(scene).surface.coat is not None and (sensor.physics, sensor.pad) == ("ipc", "medium")
    asked = TactileSensor(outputs=("height",), pitch=0.5e-3, device="cpu", physics="rigid")
    assert asked.press(scene).surface.coat is None and asked.pad == ""


def test_no_object_no_force():
    sensor = TactileSensor(outputs=OUTPUTS, physics="ipc", pitch=0.5e-3, device="cpu")
    frame = sensor.press("none")
    assert not frame.wrench.any() and not frame.traction.any() and frame.contact_area[0] == 0.0
    assert np.array_equal(frame.height[0], sensor.grid.rest.astype(np.float32))


def test_unknown_names_are_refused_with_the_choices():
    with pytest.raises(InputError, match=r"physics.*'mpm'.*rigid, ipc"):
        TactileSensor(physics="mpm")
    with pytest.raises(InputError, match=r"pad.*'huge'.*coarse, medium, fine"):
        TactileSensor(physics="ipc", pad="huge")
    with pytest.raises(InputError, match=r"pad.*physics='rigid' has none"):
        TactileSensor(physics="rigid", pad="fine")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("progress", [False, True])
def test_a_long_press_shows_its_stages_on_a_terminal(progress, monkeypatch):
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    TactileSensor(outputs=("height",), physics="ipc", pitch=0.2e-3, device="cpu").press(SCENE, progress=progress)
    assert ("stage 1 of 1: indent" in screen.getvalue() and "step" in screen.getvalue()) is progress
    if not progress:
        assert screen.getvalue() == ""
