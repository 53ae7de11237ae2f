"""A press in the viewer: sliders take the object where they say, the scene's own motion is the pad's, nonsense is refused."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError, RaytacError
from raytac.physics.rigid.pad import RigidPad
from raytac.sensor import TactileSensor
from raytac.specs import load_press, load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.view.press_session import PressSession
from raytac.view.session import Snapshot

SENSOR = load_sensor("gelsight_mini_7x9")
BALL = ObjectSpec("sphere", {"radius": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05)
SCENE = PressScene("ball", BALL, (StageSpec("indent", depth=0.4e-3),))


def session(scene: PressScene = SCENE, **settings) -> PressSession:
    settings = {"physics": "rigid", "outputs": ("wrench", "traction"), "pitch": 0.2e-3, **settings}
    return PressSession(TactileSensor(SENSOR, **settings), scene)


def wrench(shot: Snapshot) -> np.ndarray:
    found = shot.pads[SENSOR.name].wrench
    assert found is not None
    return found


def driven(press: PressSession, **targets: float) -> Snapshot:
    press.drive(targets)
    for _ in range(200):
        if not press.advance():
            return press.snapshot()
    raise AssertionError("the target is never reached")


def limits(press: PressSession, name: str) -> tuple[float, float]:
    return next((control.low, control.high) for control in press.controls if control.name == name)


@pytest.fixture(scope="module")
def rigid() -> PressSession:
    return session()


@pytest.fixture(autouse=True)
def _from_the_start(rigid):
    rigid.reset()


def test_its_own_motion_is_that_of_the_pad(rigid):
    ran = list(RigidPad(SENSOR, SCENE, pitch=0.2e-3).run(20))
    poses = [rigid.snapshot().poses["object"]]
    while rigid.advance():
        poses.append(rigid.snapshot().poses["object"])
    np.testing.assert_allclose(poses, [state.pad_from_object[0] for state in ran])
    assert not rigid.advance()
    rigid.resume()  # again, from the start
    assert rigid.snapshot().controls["depth"] == 0.0 and rigid.advance()


def test_sliders_take_the_object_where_they_say(rigid):
    shot = driven(rigid, depth=0.5)
    view = shot.pads[SENSOR.name]
    assert shot.controls["depth"] == 0.5 and view.values["indentation"].max() == pytest.approx(0.5e-3, abs=2e-5)
    start = shot.poses["object"]
    shot = driven(rigid, shear_x=0.3)
    shot = driven(rigid, shear_y=-0.2)
    shot = driven(rigid, twist=10.0)
    moved = shot.poses["object"]
    assert moved[:3, 3] - start[:3, 3] == pytest.approx([0.3e-3, -0.2e-3, 0.0], abs=1e-9)
    assert np.degrees(np.arctan2(moved[1, 0], moved[0, 0])) == pytest.approx(10.0)
    assert wrench(shot)[0] > 0.0 > wrench(shot)[1] and wrench(shot)[5] > 0.0
    assert {name: shot.controls[name] for name in ("shear_x", "shear_y", "twist")} == {
        "shear_x": 0.3, "shear_y": -0.2, "twist": 10.0,
    }  # fmt: skip
    shot = driven(rigid, depth=0.0)
    assert shot.pads[SENSOR.name].values["indentation"].max() < 1e-9 and float(shot.facts["depth"].split()[0]) < -0.5


def test_the_twist_is_that_of_its_slider_after_a_tilt_of_the_scene():
    """The tilt stays; a twist of 0 is there already, and one of 10° turns the object by 10° about the normal."""
    stages = StageSpec("indent", depth=0.5e-3), StageSpec("tilt", tilt=(0.5, 0.5))
    press = session(replace(SCENE, trajectory=stages))
    while press.advance():
        pass
    tilted = press.snapshot()
    assert tilted.controls["twist"] == pytest.approx(0.0, abs=1e-9) and tilted.handle is not None
    np.testing.assert_allclose(tilted.handle.pose[:3, :3], np.eye(3), atol=1e-9)
    press.drive({"twist": 0.0})
    assert not press.advance()
    twisted = driven(press, twist=10.0)
    assert press._places()["twist"] == pytest.approx(10.0)
    about_z = twisted.poses["object"][:3, :3] @ tilted.poses["object"][:3, :3].T
    np.testing.assert_allclose(about_z[:, 2], (0.0, 0.0, 1.0), atol=1e-9)
    assert np.degrees(np.arctan2(about_z[1, 0], about_z[0, 0])) == pytest.approx(10.0)


def test_a_force_takes_over_from_a_depth_and_is_kept_through_a_shear(rigid):
    driven(rigid, depth=0.2)
    shot = driven(rigid, force=1.5)
    assert wrench(shot)[2] == pytest.approx(-1.5, rel=1e-3)
    assert shot.controls["depth"] > 0.2  # shows where the object is
    shot = driven(rigid, shear_x=0.2)
    assert wrench(shot)[2] == pytest.approx(-1.5, rel=1e-3)
    shot = driven(rigid, depth=0.3)
    assert shot.controls["depth"] == 0.3 and shot.controls["force"] < 1.5


def test_a_new_target_on_the_way_turns_the_object_round_and_older_ones_are_not_forgotten(rigid):
    rigid.drive({"depth": 1.2})
    for _ in range(4):
        rigid.advance()
    shot = driven(rigid, twist=5.0)
    assert rigid._places()["depth"] == pytest.approx(1.2, abs=0.01) and shot.controls["twist"] == 5.0
    rigid.drive({"depth": 0.2})
    depths = [rigid._places()["depth"] for _ in iter(rigid.advance, False)]
    assert depths[-1] == pytest.approx(0.2) and (np.diff(depths) < 0.0).all()


def test_the_object_moves_in_small_steps(rigid):
    rigid.drive({"depth": 1.0})
    depths = [0.0, *(rigid._places()["depth"] for _ in iter(rigid.advance, False))]
    assert max(np.diff(depths)) <= 0.1 + 1e-9 and len(depths) > 10


def test_play_after_the_sliders_begins_the_scene_anew(rigid):
    driven(rigid, shear_x=1.0)
    rigid.resume()
    shot = rigid.snapshot()
    assert shot.controls["shear_x"] == 0.0 and shot.facts["stage"].startswith("start")


def test_targets_out_of_reach_are_refused_and_leave_all_as_it_was(rigid):
    driven(rigid, depth=0.3)
    for name, value, rule in (("depth", 99.0, "within 0 and"), ("shear_x", -3.0, "within -2"), ("roll", 1.0, "depth, force")):
        with pytest.raises(InputError, match=rule):
            rigid.drive({name: value})
    assert rigid.snapshot().controls["depth"] == 0.3


def test_a_force_that_no_depth_bears_is_an_error_and_the_session_goes_on():
    soft = replace(SENSOR, gelpad=replace(SENSOR.gelpad, youngs_modulus=1e3))
    press = PressSession(TactileSensor(soft, physics="rigid", outputs=("wrench",), pitch=0.2e-3), SCENE)
    press.drive({"force": 20.0})
    with pytest.raises(RaytacError, match="deeper than the pad"):
        while press.advance():
            pass
    press.reset()
    assert press.advance() and press.snapshot().pads[SENSOR.name].wrench is not None


def test_the_object_is_drawn_where_the_pad_has_it(rigid):
    driven(rigid, depth=0.5)
    shot = rigid.snapshot()
    solid = next(s for s in rigid.solids if s.name == "object")
    lowest = (solid.vertices @ shot.poses["object"][:3, :3].T + shot.poses["object"][:3, 3])[:, 2].min()
    coat = shot.pads[SENSOR.name].vertices
    inside = np.hypot(coat[:, 0], coat[:, 1]) < 1e-3
    assert (
        lowest == pytest.approx(coat[inside, 2].min(), abs=6e-6) and solid.hides_pads
    )  # nodes are 0.2 mm apart, and 0.2² / 8 mm


@pytest.mark.parametrize("kind", ["none", "pins", "coin", "mesh", "torus", "cone", "edge"])
def test_every_kind_of_object_is_drawn(kind):
    press = session(load_press(kind))
    assert bool(press.controls) == (kind != "none")
    assert any(s.name == "object" for s in press.solids) == (kind != "none")
    assert np.isfinite(press.snapshot().pads[SENSOR.name].vertices).all()


@pytest.mark.renderer
def test_markers_follow_the_object_and_start_anew_on_reset():
    press = session(markers="fots", outputs=("wrench",))
    driven(press, depth=0.6)
    shot = driven(press, shear_x=0.5)
    view = shot.pads[SENSOR.name]
    assert view.rgb is None and view.markers_px is not None
    assert np.nanmax(np.linalg.norm(view.markers_px[1], axis=1)) > 0.5
    press.reset()
    again = press.snapshot().pads[SENSOR.name].markers_px
    assert again is not None and np.nanmax(np.abs(again[1])) < 1e-6


@pytest.mark.solver
def test_a_soft_pad_is_driven_too_and_shows_its_mesh():
    press = session(physics="ipc")
    rest = press.snapshot().reshaped["coat_mesh"]
    shot = driven(press, depth=0.3)
    view = shot.pads[SENSOR.name]
    assert press._places()["depth"] == pytest.approx(0.3, abs=0.005)
    assert view.values["indentation"].max() == pytest.approx(0.3e-3, rel=0.05)
    assert (shot.reshaped["coat_mesh"] - rest)[..., 2].min() < -0.2e-3
    assert "cells across" in shot.warning
    shot = driven(press, shear_x=0.1)
    assert wrench(shot)[0] > 0.01
    shot = driven(press, force=0.5)
    assert wrench(shot)[2] == pytest.approx(-0.5, rel=1e-3) and shot.controls["force"] == 0.5
    assert wrench(shot)[0] > 0.01  # eased, not lifted off and pressed again


@pytest.mark.parametrize("kind", ["torus", "pins"])
@pytest.mark.solver
def test_the_mesh_of_a_soft_pad_lies_on_the_coat_that_is_drawn(kind):
    """Above it everywhere, so that no line is broken, by no more than is needed for that."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    press = session(load_press(kind), physics="ipc", pitch=0.1e-3)
    shot = driven(press, depth=0.5)
    x, y, z = shot.pads[SENSOR.name].vertices.T
    drawn = LinearTriInterpolator(Triangulation(1e3 * x, 1e3 * y, press.pads[0].faces), 1e3 * z)
    lines = 1e3 * shot.reshaped["coat_mesh"]
    for share in (0.0, 0.25, 0.5, 0.75):
        points = lines[:, 0] + share * (lines[:, 1] - lines[:, 0])
        above = np.ma.filled(points[:, 2] - drawn(points[:, 0], points[:, 1]), np.nan)
        assert np.isfinite(above).mean() > 0.8  # the rest is the rim, and what came out over it
        assert (above[np.isfinite(above)] > 0.0).mean() > 0.995 and np.nanmedian(above) == pytest.approx(0.02, abs=1e-3)


def test_no_slider_shows_less_than_there_is():
    press = session(load_press("torus"))
    assert limits(press, "force") == (0.0, 20.0)
    shot = driven(press, depth=1.5)
    force = -wrench(shot)[2]
    assert 20.0 < force == pytest.approx(shot.controls["force"], rel=1e-3)
    assert force < limits(press, "force")[1] == 50.0
    shot = driven(press, force=25.0)  # what was reached may be asked for
    assert wrench(shot)[2] == pytest.approx(-25.0, rel=1e-3)
    press.reset()
    assert limits(press, "force") == (0.0, 20.0)


@pytest.mark.solver
def test_an_object_that_lies_free_is_played_and_not_driven():
    free = replace(SCENE, object=replace(BALL, dynamics="affine"), trajectory=(StageSpec("indent", force=0.5),))
    press = session(free, physics="ipc")
    assert press.controls == () and press.snapshot().controls == {}
    with pytest.raises(InputError, match="depth"):
        press.drive({"depth": 0.1})


@pytest.mark.solver
def test_a_soft_object_is_drawn_as_it_deforms():
    soft = replace(SCENE, object=replace(BALL, dynamics="soft", youngs_modulus=2e5))
    press = session(soft, physics="ipc")
    solid = next(s for s in press.solids if s.name == "object")
    shot = driven(press, depth=0.2)
    ball = shot.reshaped["object"]
    assert ball.shape == solid.vertices.shape and (shot.poses["object"] == np.eye(4)).all()
    flattened = np.ptp(ball[:, 2]) - np.ptp(solid.vertices[:, 2])
    assert -0.2e-3 < flattened < -0.04e-3  # the gel is as soft as the ball, and both give way


def test_times_include_the_wait_for_images(rigid):
    frame = rigid._sensor.update(rigid._state).with_values(images=lambda: time.sleep(0.05) or {})
    spent = rigid._drawn(frame).time_ms
    assert spent["optics"] >= 50.0 and spent["image"] >= spent["surface"] + spent["optics"]
