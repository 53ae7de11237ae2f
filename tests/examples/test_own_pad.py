"""The example of a physics of one's own: it runs, and its name is known wherever a name of a physics is."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac import InputError, SpecError, TactileSensor, TactileWorld, load_press
from raytac.cli import main
from raytac.physics import PHYSICS
from raytac.view.press_session import PressSession

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_pad.py"


@pytest.fixture(autouse=True)
def winkler(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example's physics under its name, for one test."""
    monkeypatch.setattr(PHYSICS, "_classes", dict(PHYSICS._classes))
    runpy.run_path(str(EXAMPLE))


def test_the_example_prints_its_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 60
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    told = capsys.readouterr().out
    assert told.startswith("TactileFrame(") and "label='winkler'" in told


def test_it_is_pressed_by_name_with_the_force_of_its_law() -> None:
    """A ball of radius R pressed δ deep into a flat Winkler foundation displaces a cap of π R δ² (to first order): F = k π R δ²."""
    depths = np.array([0.3e-3, 0.5e-3])
    sensor = TactileSensor("gelsight_mini", physics="winkler", outputs=("height", "traction"), num_envs=2, pitch=0.1e-3)
    frame = sensor.press(
        replace(load_press("torus"), object=replace(load_press("sphere").object, params={"radius": 4e-3})), depths=depths
    )
    flat = 1e8 * np.pi * 4e-3 * depths**2
    assert (-frame.force[:, 2] < flat).all() and -frame.force[:, 2] == pytest.approx(flat, rel=0.2)  # the gel is a dome
    assert frame.surface.indentation.max(axis=(1, 2)) == pytest.approx(depths, rel=0.01)
    assert frame.label == "winkler" and not frame.failed.any()


def test_a_scene_and_the_command_line_name_it(tmp_path: Path) -> None:
    sensor = TactileSensor("gelsight_mini", outputs=("height",), pitch=0.4e-3)
    assert sensor.press(replace(load_press("torus"), physics="winkler")).label == "winkler" and sensor.physics is None
    assert main(["press", "torus", "--physics", "winkler", "--outputs", "height,wrench", "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["mode"] == "winkler" and metrics["contact.force_z_n"] < 0.0


def test_it_is_viewed() -> None:
    sensor = TactileSensor("gelsight_mini", physics="winkler", outputs=("wrench", "traction"), pitch=0.4e-3)
    session = PressSession(sensor, load_press("torus"))
    session.drive({"depth": 0.3})
    while session.advance():
        pass
    shot = session.snapshot()
    assert shot.pads["gelsight_mini"].values["pressure"].max() == pytest.approx(1e8 * 0.3e-3, rel=0.05)
    with pytest.raises(InputError, match="press to a depth"):
        session.drive({"force": 1.0})
        session.advance()


def test_without_pads_for_worlds_it_is_refused_there_by_name() -> None:
    with pytest.raises(InputError, match=r"physics = 'winkler': has pads for presses only.*rigid, ipc"):
        TactileWorld("ball_rolling", physics="winkler")


def test_a_name_that_nobody_registered_is_refused_with_the_choices() -> None:
    with pytest.raises(InputError, match=r"did you mean 'winkler'.*rigid, ipc, winkler"):
        TactileSensor(physics="winkle")
    with pytest.raises(SpecError, match=r"physics = 'winkle'.*winkler"):
        TactileSensor(outputs="height").load(replace(load_press("torus"), physics="winkle"))
