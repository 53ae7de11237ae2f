"""A task in the viewer: time runs, sliders steer the robot, pads and bodies are drawn where the world has them."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError, RaytacError
from raytac.robots import ik
from raytac.robots.mount import mount
from raytac.specs import BodySpec, RobotSpec, TaskScene, load_task
from raytac.view.world_session import WorldSession
from raytac.world.world import TactileWorld

GRIPPER_MODEL = Path(__file__).parents[2] / "examples" / "gripper.xml"
BALL = BodySpec("ball", "sphere", {"radius": 0.005}, position=(0.0, 0.0, 0.0051), mass=0.05, colour=(0.5, 0.0, 0.0))
UP = TaskScene("upward", RobotSpec("fixed_sensor"), (BALL,))
"""A sensor on its back under a ball; world and pad frame are one."""
GRIPPER = TaskScene("gripper", RobotSpec("floating_gripper", opening=0.02, position=(0.0, 0.0, 0.1)), (), timestep=0.001)


def session(scene: TaskScene | str, steps: int = 1, **settings) -> WorldSession:
    return WorldSession(TactileWorld(scene, **{"outputs": ("wrench", "traction"), **settings}), steps=steps)


def after(view: WorldSession, states: int, **targets: float):
    view.drive(targets)
    for _ in range(states):
        assert view.advance()
    return view.snapshot()


def test_time_runs_and_what_touches_is_felt_and_drawn():
    view = session(UP, steps=4)
    assert view.controls == () and view.snapshot().facts["time"] == "0.000 s"
    shot = after(view, 10)
    assert shot.facts["time"] == "0.400 s"
    pad = shot.pads["sensor"]
    assert pad.wrench is not None and pad.wrench[2] == pytest.approx(-0.05 * 9.81, rel=1e-3)
    assert pad.values["indentation"].max() > 1e-5 and pad.values["pressure"].max() > 1e3
    solid = next(s for s in view.solids if s.name.startswith("ball/"))
    assert solid.hides_pads and solid.colour == (128, 0, 0)
    ball = solid.vertices @ shot.poses[solid.name][:3, :3].T + shot.poses[solid.name][:3, 3]
    middle = np.hypot(pad.vertices[:, 0], pad.vertices[:, 1]) < 0.5e-3
    assert ball[:, 2].min() == pytest.approx(pad.vertices[middle, 2].min(), abs=1e-5)
    view.reset()
    again = view.snapshot()
    assert again.facts["time"] == "0.000 s" and again.poses[solid.name][2, 3] == pytest.approx(0.0051)


def test_a_driven_frame_goes_where_the_sliders_say_and_no_faster_than_it_may():
    view = session(GRIPPER)
    start = {name: pad.world_from_pad for name, pad in view.snapshot().pads.items()}
    assert view.snapshot().controls["opening"] == pytest.approx(20.0)
    shot = after(view, 10, x=10.0)
    way = shot.pads["left"].world_from_pad[0, 3] - start["left"][0, 3]
    assert 1e-3 < way < 5.5e-3  # 0.1 s at 50 mm/s, and the servo lags
    shot = after(view, 60, z=-5.0, yaw=20.0)
    for name, pad in shot.pads.items():
        turned = pad.world_from_pad[:3, :3] @ start[name][:3, :3].T
        assert np.degrees(np.arctan2(turned[1, 0], turned[0, 0])) == pytest.approx(20.0, abs=0.2)
    middle = np.mean([pad.world_from_pad[:3, 3] for pad in shot.pads.values()], axis=0)
    assert middle - np.mean([pose[:3, 3] for pose in start.values()], axis=0) == pytest.approx([0.01, 0.0, -0.005], abs=2e-4)
    shot = after(view, 60, opening=30.0)
    left, right = (shot.pads[name].world_from_pad[:3, 3] for name in ("left", "right"))
    assert np.linalg.norm(left - right) == pytest.approx(0.03, abs=5e-4)
    view.reset()
    assert view.snapshot().controls == {
        **dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0),
        "opening": pytest.approx(20.0),
    }
    assert view.snapshot().pads["left"].world_from_pad == pytest.approx(start["left"])


def test_an_arm_follows_the_sliders_by_inverse_kinematics():
    view = session("ball_rolling", steps=4)
    start = view.snapshot().pads["sensor"].world_from_pad
    shot = after(view, 30, y=20.0, z=15.0, yaw=15.0)
    pose = shot.pads["sensor"].world_from_pad
    assert pose[:3, 3] - start[:3, 3] == pytest.approx([0.0, 0.02, 0.015], abs=1e-3)
    turned = pose[:3, :3] @ start[:3, :3].T
    assert np.degrees(np.arctan2(turned[1, 0], turned[0, 0])) == pytest.approx(15.0, abs=0.5)
    assert shot.poses[next(s.name for s in view.solids if s.name.startswith("link7/"))][2, 3] > 0.05


def test_an_arm_presses_the_ball_and_the_sensor_feels_it():
    view = session("ball_rolling", steps=4)
    shot = after(view, 12, z=-1.3)
    pad = shot.pads["sensor"]
    assert pad.wrench is not None and pad.wrench[2] < -0.05
    ball = shot.poses[next(s.name for s in view.solids if s.name.startswith("ball/"))][:3, 3]
    deepest = pad.vertices[pad.values["indentation"].argmax()]
    touched = pad.world_from_pad[:3, :3] @ deepest + pad.world_from_pad[:3, 3]
    assert touched[:2] == pytest.approx(ball[:2], abs=1e-3)


def test_without_mink_the_joints_are_steered_alone_and_the_page_says_why(monkeypatch):
    def missing():
        raise ik.BackendError("mink is not installed")

    monkeypatch.setattr(ik, "_mink", missing)
    view = session("ball_rolling")
    assert [control.label for control in view.controls] == [f"joint{k} [°]" for k in range(1, 8)] and view.handle is None
    assert (view.controls[0].low, view.controls[0].high) == (-166.0, 166.0)  # whole steps within 166.003°
    start = view.snapshot().pads["sensor"].world_from_pad
    shot = after(view, 20)
    assert "mink is not installed" in shot.warning
    assert shot.pads["sensor"].world_from_pad[:3, 3] == pytest.approx(start[:3, 3], abs=1e-4)
    view.reset()
    first = view.snapshot().controls["joint joint7"]
    shot = after(view, 60, **{"joint joint7": first + 20.0})
    turned = shot.pads["sensor"].world_from_pad[:3, :3] @ start[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turned) - 1.0) / 2.0)) == pytest.approx(20.0, abs=0.5)


def test_joints_and_pose_take_over_from_each_other():
    view = session("ball_rolling", steps=2)
    first = view.snapshot().controls
    shot = after(view, 20, **{"joint joint1": first["joint joint1"] + 5.0})
    assert shot.controls["joint joint1"] == pytest.approx(first["joint joint1"] + 5.0)
    assert shot.controls["yaw"] == pytest.approx(5.0, abs=0.3) and abs(shot.controls["y"]) > 5.0  # the pose follows
    at = shot.pads["sensor"].world_from_pad[:3, 3]
    shot = after(view, 20, z=shot.controls["z"] + 10.0)
    assert shot.pads["sensor"].world_from_pad[:3, 3] - at == pytest.approx([0.0, 0.0, 0.01], abs=1.5e-3)
    assert abs(shot.controls["joint joint4"] - first["joint joint4"]) > 0.5  # and the joints follow the pose


def test_every_actuator_of_a_model_of_ones_own_has_a_slider_with_its_range():
    spec = mujoco.MjSpec.from_file(str(GRIPPER_MODEL))
    spec.actuator("lift").ctrllimited, spec.actuator("lift").ctrlrange = True, (-0.02, 0.08)
    mount(spec, "gelsight_mini_9x11", site="left_tip", name="left")
    mount(spec, "gelsight_mini", site="right_tip", name="right")
    world = TactileWorld(spec, touches=["cube"], control_timestep=0.02, outputs=("wrench",), pitch=0.4e-3)
    view = WorldSession(world)
    lift, left, right = view.controls
    assert (lift.label, lift.low, lift.high) == ("lift [mm]", pytest.approx(-20.0), pytest.approx(80.0))
    assert (left.label, right.label) == ("left [mm]", "right [mm]") and "no range" in left.hint and "no range" not in lift.hint
    shot = after(view, 20, **{"actuator left": -12.0, "actuator right": -12.0})
    wrench = shot.pads["left"].wrench
    assert wrench is not None and wrench[2] < -1.0 and shot.controls["actuator left"] == -12.0
    shot = after(view, 40, **{"actuator lift": 30.0})
    assert shot.poses[next(s.name for s in view.solids if s.name.startswith("cube/"))][2, 3] > 0.035  # carried


def test_everything_that_is_seen_is_drawn_once_and_the_gel_as_a_coat(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("raytac.robots.looks.panda_meshes", tuple)  # whatever packages are installed
    view = session("lift_cube")
    names = [solid.name for solid in view.solids]
    assert len(set(names)) == len(names) and [pad.name for pad in view.pads] == ["left", "right"]
    assert {"left_gel", "right_gel"} <= set(names)
    model = view._world.model
    shown = {int(name.rsplit("/", 1)[1]) for name in names if "/" in name}
    hidden = {int(model.geom(name).id) for name in ("left_gel", "right_gel")} | set(
        np.flatnonzero(model.geom_group >= 3).tolist()
    )
    assert shown == set(range(model.ngeom)) - hidden
    table = next(s for s in view.solids if s.name.startswith("table/"))
    assert not table.hides_pads and np.ptp(table.vertices[:, 0]) == pytest.approx(1.5)


def test_targets_out_of_reach_and_a_world_that_breaks_are_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes that its numbers are too large
    view = session(GRIPPER)
    with pytest.raises(InputError, match="within 0 and 80"):
        view.drive({"opening": 99.0})
    with pytest.raises(InputError, match="x, y, z"):
        view.drive({"depth": 1.0})
    view._world.data[0].qvel[:] = 1e9
    with pytest.raises(RaytacError, match="broke down"):
        view.advance()
    view.reset()
    assert view.advance() and np.isfinite(view.snapshot().pads["left"].world_from_pad).all()


@pytest.mark.slow
def test_soft_pads_and_soft_bodies_are_drawn_as_they_deform():
    twist = load_task("twist")
    beam = replace(twist.body("beam"), cell=12e-3)
    scene = replace(twist, bodies=(twist.body("plate"), beam), robot=replace(twist.robot, opening=0.0125))
    view = session(scene, coupling="one_way")
    first = view.snapshot()
    shot = after(view, 4, opening=10.0)
    solid = next(s for s in view.solids if s.name == "soft/beam")
    moved = np.linalg.norm(shot.reshaped["soft/beam"] - solid.vertices, axis=1)
    assert solid.hides_pads and 1e-5 < moved.max() < 5e-3
    assert moved[solid.vertices[:, 2] < 1e-5].max() < 1e-6  # held by the plate
    edges = shot.reshaped["left_coat_mesh"]
    assert edges.shape == first.reshaped["left_coat_mesh"].shape and (edges != first.reshaped["left_coat_mesh"]).any()
    assert shot.pads["left"].values["indentation"].max() > 2e-5
    assert float(shot.facts["least gap"].split()[0]) > 0.0


def test_times_include_the_wait_for_images():
    view = session(UP)
    frames = {name: f.with_values(images=lambda: time.sleep(0.05) or {}) for name, f in view._world.observe().items()}
    assert view._drawn(frames).time_ms["optics"] >= 50.0
