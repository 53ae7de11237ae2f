"""Worlds with soft pads: readings, resets, failures and what is refused; of no mesh's accuracy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError, OverlapError
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.scene_state import SceneReport
from raytac.specs import BodySpec, RobotSpec, TaskScene
from raytac.world.world import TactileWorld
from tests.world.test_soft_world import BALL, UP

pytestmark = pytest.mark.usefixtures("few_cells")
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]
BESIDE = replace(BALL, position=(0.0152, 0.0, -0.001), params={"radius": 0.002})
"""A ball above the rim of the case, beside the gel: in the solver nothing is there to stop it."""


@pytest.mark.parametrize("device", DEVICES)
def test_a_soft_pad_gives_arrays_of_its_device_without_copies(device: str) -> None:
    """What ``read`` has is what ``observe`` shows, in memory that other libraries share and the next reading overwrites."""
    dotted = replace(UP, robot=RobotSpec("fixed_sensor", "gelsight_mini_7x9"))
    world = TactileWorld(dotted, outputs=("height", "wrench", "traction"), markers="surface", num_envs=2, device=device)
    for _ in range(3):
        world.step()
    frame = world.read("sensor")
    arrays, seen = frame.numpy(), world.observe()["sensor"]
    assert set(arrays) == {"wrench", "active", "height", "contact", "markers", "traction"} and arrays["active"].all()
    np.testing.assert_array_equal(arrays["height"], seen.height)
    np.testing.assert_array_equal(arrays["contact"].astype(bool), seen.surface.contact)
    np.testing.assert_array_equal(arrays["wrench"], seen.wrench)
    np.testing.assert_array_equal(arrays["traction"], seen.traction)
    assert np.abs(arrays["wrench"][:, 2]).min() > 0.1 and arrays["contact"].any(axis=(1, 2)).all()
    assert frame.height is not None
    tracked = seen.markers.displacement[..., :2]
    assert np.abs(arrays["markers"] - tracked).max() < 1e-9 and np.abs(tracked).max() > 1e-6
    heights: Any = np.from_dlpack(frame.height) if device == "cpu" else None
    world.reset()
    again = world.read("sensor")
    assert again.height is not None and again.height.ptr == frame.height.ptr
    assert np.abs(again.numpy()["height"] - arrays["height"]).max() > 1e-5
    assert heights is None or np.array_equal(heights, again.numpy()["height"])  # memory that NumPy shares
    with pytest.raises(InputError, match=r"sensor = 'finger'.*sensor of the world"):
        world.read("finger")


def test_some_environments_read_as_all_of_them_do() -> None:
    world = TactileWorld(UP, outputs=("wrench", "traction"), num_envs=2)
    for _ in range(3):
        world.step()
    whole, one = world.observe()["sensor"], world.observe(envs=[1])["sensor"]
    assert whole.surface.contact[1].any() and one.traction is not None and whole.traction is not None
    for all_of_them, alone in ((whole.surface.height, one.surface.height), (whole.traction, one.traction)):
        assert np.isfinite(alone).all()
        np.testing.assert_array_equal(alone[0], all_of_them[1])


def test_reset_restores_links_bodies_gels_and_the_coupling() -> None:
    """A gripper of servos closes on a cube of MuJoCo's, two-way, in one of two environments that is then reset and does the same again."""
    cube = BodySpec("cube", "box", {"length": 0.01, "width": 0.01, "height": 0.01}, dynamics="free", owner="mujoco", mass=0.02)
    gripper = RobotSpec("floating_gripper", opening=0.0102)
    scene = TaskScene("grip", gripper, (cube,), physics="ipc", timestep=0.002, gravity=(0.0, 0.0, 0.0))
    world = TactileWorld(scene, outputs=("wrench",), num_envs=2)
    opening = world.composed.opening
    assert opening is not None
    begin, gels = world.state(), {name: world.mesh(name)[0] for name in world.sensor_names}

    def close(data: mujoco.MjData, time: float) -> None:
        data.ctrl[:] = world.composed.ctrl
        data.ctrl[opening] -= min(0.02 * time, 4e-4)

    first = [world.step(close) for _ in range(4)]
    assert np.linalg.norm(first[-1].wrench["left"][1]) > 0.05 and world.data[1].xfrc_applied.any()
    at = world.reset([1])
    for field in ("time", "joints"):
        np.testing.assert_array_equal(getattr(at, field)[1], getattr(begin, field)[1])
    for name in world.sensor_names:
        np.testing.assert_array_equal(at.world_from_pad[name][1], begin.world_from_pad[name][1])
        np.testing.assert_array_equal(at.wrench[name][1], 0.0)
        np.testing.assert_array_equal(world.mesh(name)[0][1], gels[name][1])
    np.testing.assert_array_equal(at.world_from_body["cube"][1], begin.world_from_body["cube"][1])
    assert not world.data[1].xfrc_applied.any() and not world.data[1].qvel.any()
    np.testing.assert_array_equal(at.world_from_body["cube"][0], first[-1].world_from_body["cube"][0])
    again = [world.step(close) for _ in range(4)]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_allclose(other.world_from_body["cube"][1], one.world_from_body["cube"][1], atol=1e-9)
        for name in world.sensor_names:
            np.testing.assert_allclose(other.wrench[name][1], one.wrench[name][1], atol=1e-6)


def test_an_environment_whose_last_step_did_not_converge_has_failed_and_earlier_ones_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    falling = replace(BALL, position=(0.0, 0.0, 0.03))
    world = TactileWorld(replace(UP, bodies=(falling,), timestep=0.005, soft_timestep=0.005), outputs=("wrench",), num_envs=2)
    calls, unsolved, step = [], {1, 4}, SoftScene.step

    def told(scene: SoftScene, *args: Any) -> SceneReport:
        report = step(scene, *args)
        calls.append(report)
        bad = (np.arange(2) == 0) & (len(calls) in unsolved)
        count, ends = report.unconverged + bad, report.last_converged & ~bad
        return replace(report, converged=report.converged & ~bad, unconverged=count, last_converged=ends)

    monkeypatch.setattr(SoftScene, "step", told)
    state = world.step()  # the first of two steps
    frame = world.observe()["sensor"]
    assert len(calls) == 2 and not state.failed.any() and not state.report["converged"][0]
    assert state.report["unconverged"].tolist() == [1, 0] and frame.unconverged.tolist() == [1, 0]
    state = world.step()  # the last of two
    frame = world.observe(envs=[1, 0])["sensor"]
    assert state.failed.tolist() == [True, False] and frame.failed.tolist() == [False, True]
    assert frame.unconverged.tolist() == [0, 2] and np.isfinite(state.wrench["sensor"][1]).all()
    state = world.step()
    assert state.failed.tolist() == [True, False] and state.report["newton"][0] == 0 < state.report["newton"][1]
    assert world.reset([0]).report["unconverged"].tolist() == [0, 0]
    state, frame = world.step(), world.observe()["sensor"]
    assert not state.failed.any() and frame.unconverged.tolist() == [0, 0]


def test_forces_that_are_not_finite_fail_their_own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    gripper = RobotSpec("floating_gripper", opening=0.0102)
    cube = BodySpec("cube", "box", {"length": 0.01, "width": 0.01, "height": 0.01}, mass=0.02)
    scene = TaskScene("grip", gripper, (cube,), physics="ipc", gravity=(0.0, 0.0, 0.0), coupling="two_way")
    world, step = TactileWorld(scene, outputs=("wrench",), num_envs=2), SoftScene.step

    def spoilt(soft: SoftScene, *args: Any) -> SceneReport:
        report, host = step(soft, *args), soft.world.sums.host
        force = host["force"].copy()
        force[0] = np.nan
        host["force"] = force
        return report

    monkeypatch.setattr(SoftScene, "step", spoilt)
    assert world.step().failed.tolist() == [True, False]


def test_a_start_that_overlaps_is_refused() -> None:
    with pytest.raises(OverlapError, match="overlap where they start"):
        TactileWorld(replace(UP, bodies=(replace(BALL, position=(0.0, 0.0, 0.0047)),)))


def test_a_body_that_falls_through_the_case_is_told_once_and_reported() -> None:
    world = TactileWorld(replace(UP, bodies=(BESIDE,)), outputs=("wrench",))
    assert world.step().report["inside_robot"].tolist() == [0.0]
    with pytest.warns(RuntimeWarning, match="'ball' is .* mm inside the robot's geom 'sensor_case' .*pass through cases") as told:
        for _ in range(4):
            state = world.step()
    assert len([w for w in told if issubclass(w.category, RuntimeWarning)]) == 1
    # The case's top is the gel's back: as deep as the ball's lowest point lies below it, or as far as it is from the outer wall.
    spec = world.composed.sensor_specs[0]
    top, wall = -spec.gelpad.thickness, 0.5 * spec.case.size[0] + 0.8e-3
    ball = state.world_from_body["ball"][0, :3, 3]
    expected = min(top - (ball[2] - 0.002), wall - (ball[0] - 0.002))
    assert state.report["inside_robot"][0] == pytest.approx(expected, abs=2e-4) and expected > 1e-3
    assert world.reset().report["inside_robot"].tolist() == [0.0]


def test_a_start_inside_the_case_or_a_link_is_refused() -> None:
    inside = replace(BESIDE, position=(0.0152, 0.0, -0.008))
    with pytest.raises(OverlapError, match=r"'ball' starts .* mm inside the robot's geom 'sensor_case'"):
        TactileWorld(replace(UP, bodies=(inside,)))
    soft = replace(inside, kind="box", params=dict.fromkeys(("length", "width", "height"), 0.004), dynamics="soft", cell=0.002)
    with pytest.raises(OverlapError, match=r"'ball' starts .* mm inside the robot's geom 'sensor_case'"):
        TactileWorld(replace(UP, bodies=(soft,)))
    world = TactileWorld(replace(UP, bodies=(BESIDE,)))
    before = world.step()
    to = before.world_from_body["ball"].copy()
    to[0, 2, 3] = -0.008
    with pytest.raises(OverlapError, match="inside the robot's geom"):
        world.reset(bodies={"ball": to})
    np.testing.assert_array_equal(world.state().world_from_body["ball"], before.world_from_body["ball"])


def test_a_motion_that_cannot_be_resolved_is_refused() -> None:
    down = RobotSpec("floating_gripper", opening=0.04, position=(0.0, 0.0, 0.05), quaternion=(0.0, 1.0, 0.0, 0.0))
    box = BodySpec("box", "box", {"length": 0.03, "width": 0.03, "height": 0.03}, position=(0.0, 0.0, 0.05), dynamics="fixed")
    world = TactileWorld(replace(UP, robot=down, bodies=(box,)))

    def jump(data: mujoco.MjData, time: float) -> None:
        world.hold(data, time)
        data.qvel[1] = 2.0  # towards the box with one pad

    with pytest.raises(InputError, match="move slower or in more steps"):
        for _ in range(3):
            world.step(jump)
    time = world.data[0].time
    assert world.step().failed.all() and world.data[0].time == time  # MuJoCo was ahead of the solver
    world.reset()
    assert not world.step().failed.any()
    both = TactileWorld(world.scene, num_envs=2)
    with pytest.warns(RuntimeWarning, match="in environment 1 .*move slower or in more steps"):
        for _ in range(3):
            state = both.step([both.hold, jump])
    assert state.failed.tolist() == [False, True] and state.time[0] == pytest.approx(0.03)
    both.reset([1])
    assert not both.step().failed.any()


def test_what_mujoco_lost_is_not_shown_and_sensors_are_made_when_asked_for() -> None:
    slide = replace(UP, robot=RobotSpec("floating_gripper", opening=0.04, position=(0.0, 0.0, 0.1)))
    world = TactileWorld(slide, outputs=("wrench",), num_envs=2)
    assert not world._frames._made
    world.data[0].qvel[0] = 1e9
    assert world.step().failed.tolist() == [True, False]
    surface = world.observe()[world.sensor_names[0]].surface
    assert np.isnan(surface.height[0]).all() and np.isfinite(surface.height[1]).all()
    assert surface.grid is world.sensors[world.sensor_names[0]].grid
