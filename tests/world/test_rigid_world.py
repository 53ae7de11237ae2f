"""Worlds with the rigid pad: composition, the gel's contact against the press and the load law, rolling, reset, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.physics.rigid.pad import RigidPad
from raytac.robots.impedance import JointImpedance
from raytac.specs import BodySpec, ObjectSpec, PressScene, RobotSpec, StageSpec, TaskScene, load_sensor, load_task
from raytac.world.world import TactileWorld
from raytac.world.world_state import BatchController

BALL = BodySpec("ball", "sphere", {"radius": 0.005}, position=(0.0, 0.0, 0.0051), mass=0.05)
UP = TaskScene("upward", RobotSpec("fixed_sensor"), (BALL,))
"""A sensor that lies on its back with a ball just above the middle of its pad; world and pad frame are one."""
G = 9.81


def settled(scene: TaskScene, steps: int = 60, **options) -> TactileWorld:
    world = TactileWorld(scene, **{"outputs": ("wrench",), **options})
    for _ in range(steps):
        world.step()
    return world


# By default every mass and both steps; their other combinations say the same.
@pytest.mark.parametrize(
    ("mass", "timestep"),
    [
        *((0.004, 0.0005), (0.05, 0.002), (0.5, 0.002)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0.004, 0.002), (0.05, 0.0005), (0.5, 0.0005))),
    ],
)
def test_a_resting_ball_weighs_what_it_weighs_and_sinks_in_as_the_press_says(mass: float, timestep: float) -> None:
    # The gel damps a heavy ball, which swings slowly, for longer.
    world = settled(replace(UP, timestep=timestep, bodies=(replace(BALL, mass=mass),)), 60 if mass < 0.1 else 180)
    state = world.state()
    np.testing.assert_allclose(state.wrench["sensor"][0], [0, 0, -mass * G, 0, 0, 0], atol=1e-6 * mass * G)
    assert np.abs(world.data[0].qvel).max() < 1e-6
    press = PressScene(
        "ball",
        ObjectSpec("sphere", {"radius": 0.005}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05),
        (StageSpec("indent", force=mass * G),),
    )
    pad = RigidPad(load_sensor("gelsight_mini"), press, pitch=0.1e-3)
    depth = float(pad.peak(pad.run()).depth[0])
    sunk = 0.005 - state.world_from_body["ball"][0, 2, 3]
    # The press settles to 1e-4 of its force; the rest is how both grids count a contact's area.
    assert sunk == pytest.approx(depth, rel=0.01)


def test_frame_has_the_names_units_and_totals_of_a_press() -> None:
    world = settled(UP, outputs=("wrench", "traction", "height"))
    frame = world.observe()["sensor"]
    wrench = world.state().wrench["sensor"]
    np.testing.assert_array_equal(frame.wrench, wrench)
    from raytac.gel.traction import cell_areas

    grid = frame.surface.grid
    force = frame.traction[0] * cell_areas(grid)[..., None]
    np.testing.assert_allclose(force.sum(axis=(0, 1)), wrench[0, :3], atol=1e-5)
    torque = (grid.x * force[..., 1] - grid.y[:, None] * force[..., 0]).sum()
    assert torque == pytest.approx(wrench[0, 5], abs=1e-9)
    assert frame.contact_area[0] > 1e-6 and "contact_cells" not in frame.outputs
    deepest = float(frame.surface.indentation.max())
    assert deepest == pytest.approx(0.005 - world.state().world_from_body["ball"][0, 2, 3], abs=2e-6)


def test_a_ball_on_the_dome_rolls_without_slipping() -> None:
    """At 4 mm from the middle of a dome of 210 mm it starts with 5/7 g sin θ (solid sphere), and its pad point stands still."""
    scene = replace(UP, bodies=(replace(BALL, position=(0.004, 0.0, 0.0052)),))
    world = settled(scene, steps=5)
    before = world.data[0].qvel.copy()
    world.step()
    rate = (world.data[0].qvel[0] - before[0]) / scene.control_timestep
    slope = world.state().world_from_body["ball"][0, 0, 3] / (0.210 + 0.005)
    # Rolling friction takes off 3/16 α a / R, with a about 1 mm: some 4e-3 of g against a slope of 19e-3.
    assert 0.5 * 5 / 7 * G * slope < rate < 5 / 7 * G * slope
    for _ in range(15):
        world.step()
    speed, spin = world.data[0].qvel[0], world.data[0].qvel[4]
    height = 0.005 - 0.5 * (0.005 - world.state().world_from_body["ball"][0, 2, 3])
    assert speed > 5e-3 and speed == pytest.approx(spin * height, rel=0.06)


def test_friction_holds_below_its_limit_and_lets_go_above() -> None:
    """A cube on a pad that is tilted by its gravity: tan θ against μ."""
    cube = BodySpec("cube", "box", {"length": 0.012, "width": 0.012, "height": 0.006}, position=(0.0, 0.0, 0.0031), mass=0.02)
    for mu, moves in ((0.6, False), (0.2, True)):
        down = TaskScene("tilt", RobotSpec("fixed_sensor"), (replace(cube, friction=mu),), gravity=(G * 0.371, 0.0, -G * 0.928))
        world = settled(down, steps=40)
        speed = abs(world.data[0].qvel[0])
        assert speed > 0.1 if moves else speed < 1e-5


def test_pad_frames_and_bodies_stand_where_the_scene_says() -> None:
    world = TactileWorld("ball_rolling")
    state = world.state()
    np.testing.assert_allclose(state.world_from_pad["sensor"][0, :3, 3], [0.45, 0.0, 0.011], atol=1e-6)
    np.testing.assert_allclose(state.world_from_pad["sensor"][0, :3, 2], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(state.world_from_body["ball"][0, :3, 3], [0.45, 0.0, 0.00505], atol=1e-12)
    gripper = TactileWorld(replace(load_task("twist"), bodies=(), physics="rigid")).state().world_from_pad
    np.testing.assert_allclose(gripper["left"][0, :3, 2], -gripper["right"][0, :3, 2], atol=1e-12)
    apart = gripper["left"][0, :3, 3] - gripper["right"][0, :3, 3]
    assert np.linalg.norm(apart) == pytest.approx(0.02) and gripper["left"][0, :3, 2] @ apart == pytest.approx(-0.02)


def test_a_cube_is_lifted_and_both_pads_together_carry_its_weight() -> None:
    world = TactileWorld("lift_cube", outputs=("wrench",))
    arm, opening = world.arm, world.composed.opening
    assert arm is not None
    law = JointImpedance(arm)

    def steer(data: mujoco.MjData, time: float) -> None:
        joints = world.composed.start[arm.qpos].copy()
        joints[1] -= 0.1 * float(np.clip((time - 0.25) / 0.3, 0.0, 1.0))
        arm.drive(data, law.torque(data, joints).torque)
        data.ctrl[opening] = max(0.028, 0.05 - 0.15 * time)

    for _ in range(75):
        state = world.step(steer)
    lifted = state.world_from_body["object"][0, 2, 3]
    assert lifted > 0.03
    up = sum(state.world_from_pad[name][0, :3, :3] @ state.wrench[name][0, :3] for name in ("left", "right"))
    np.testing.assert_allclose(up, [0, 0, -0.05 * G], atol=0.01 * 0.05 * G)


def test_a_cube_taller_than_the_pads_is_gripped_by_gel_alone() -> None:
    """The floating gripper's holders stand back from the pads: servo and gels are in balance, and nothing else touches."""
    cube = BodySpec("cube", "box", {"length": 0.03, "width": 0.03, "height": 0.04}, position=(0.0, 0.0, 0.0), mass=0.05)
    gripper = RobotSpec("floating_gripper", opening=0.0305, position=(0.0, 0.0, 0.0))
    world = TactileWorld(TaskScene("grip", gripper, (cube,), gravity=(0.0, 0.0, 0.0)), outputs=("wrench",))
    opening = world.composed.opening
    assert opening is not None

    def close(data: mujoco.MjData, time: float) -> None:
        data.ctrl[opening] = max(0.0298, 0.0305 - 0.01 * time)

    for _ in range(30):
        state = world.step(close)
    left, right = (state.world_from_pad[name][0, :3, 3] for name in ("left", "right"))
    squeeze = 1e4 * (np.linalg.norm(left - right) - 0.0298)  # the servo's gain [N/m]
    assert world.data[0].ncon == 2 and squeeze > 0.1
    for name in ("left", "right"):
        assert -state.wrench[name][0, 2] == pytest.approx(squeeze, rel=0.01)


def test_reset_restores_bit_by_bit_and_only_what_was_asked() -> None:
    world = TactileWorld(replace(UP, bodies=(replace(BALL, position=(0.003, 0.0, 0.0052)),)), outputs=("wrench",), num_envs=2)
    first = [world.step() for _ in range(12)]
    world.reset([1])
    state = world.state()
    assert state.time.tolist() == [first[-1].time[0], 0.0]
    np.testing.assert_array_equal(state.wrench["sensor"][1], 0.0)
    again = [world.step() for _ in range(12)]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.world_from_body["ball"][1], other.world_from_body["ball"][1])
        np.testing.assert_array_equal(one.wrench["sensor"][1], other.wrench["sensor"][1])
    assert not np.array_equal(first[-1].world_from_body["ball"][0], again[-1].world_from_body["ball"][0])


def test_a_batch_is_as_its_environments_alone() -> None:
    world = TactileWorld(UP, outputs=("wrench",), num_envs=2)
    world.data[1].qpos[0] = 0.003
    for _ in range(8):
        state = world.step()
    alone = TactileWorld(UP, outputs=("wrench",))
    alone.data[0].qpos[0] = 0.003
    for _ in range(8):
        one = alone.step()
    np.testing.assert_array_equal(state.wrench["sensor"][1], one.wrench["sensor"][0])
    frames = world.observe()["sensor"], alone.observe()["sensor"]
    np.testing.assert_array_equal(frames[0].surface.height[1], frames[1].surface.height[0])


def test_many_balls_at_many_places_are_each_as_alone() -> None:
    """On every grid of nodes at once, in windows of their own, off the pad and not touching at all."""
    at = np.array(
        [[0.0, 0.0, 0.0049], [0.0101, 0.0, 0.0046], [-0.0097, 0.0074, 0.0044], [0.003, -0.004, 0.02], [0.0196, 0.0, 0.004]]
    )
    cube = BodySpec("cube", "box", {"length": 0.03, "width": 0.03, "height": 0.01}, position=(0.0, 0.0, 0.05), mass=0.05)
    scene = replace(UP, bodies=(BALL, cube), gravity=(0.0, 0.0, 0.0))
    many = TactileWorld(scene, outputs=("wrench",), num_envs=len(at))

    def place(world: TactileWorld, b: int, k: int) -> None:
        world.data[b].qpos[:3] = at[k]
        if k == 3:
            world.data[b].qpos[7:10] = 0.001, 0.002, 0.0048

    for b in range(len(at)):
        place(many, b, b)
    state = many.step()
    frames = many.observe()["sensor"]
    pushed = [max(data.qvel[2], data.qvel[8]) > 1e-3 for data in many.data]
    assert pushed == [True, True, True, True, False]
    for b in range(len(at)):
        alone = TactileWorld(scene, outputs=("wrench",))
        place(alone, 0, b)
        np.testing.assert_array_equal(alone.step().wrench["sensor"][0], state.wrench["sensor"][b])
        np.testing.assert_array_equal(alone.data[0].qvel, many.data[b].qvel)
        np.testing.assert_array_equal(alone.observe()["sensor"].surface.height[0], frames.surface.height[b])


def test_a_controller_of_the_batch_drives_as_one_for_each_does() -> None:
    class Lift(BatchController):
        def drive(self, datas: Sequence[mujoco.MjData], envs: Sequence[int] | np.ndarray) -> None:
            for b in envs:
                datas[b].ctrl[:] = 0.03 - 0.002 * b

    slide = TaskScene("grip", RobotSpec("floating_gripper", opening=0.04), (), gravity=(0.0, 0.0, 0.0))
    batch, each, rows = (TactileWorld(slide, outputs=(), num_envs=2) for _ in range(3))
    nu = batch.model.nu
    for _ in range(3):
        seen = (
            batch.step(Lift()),
            each.step([lambda data, time, b=b: data.ctrl.fill(0.03 - 0.002 * b) for b in range(2)]),
            rows.step(np.array([[0.03] * nu, [0.03 - 0.002] * nu])),
        )
    for name in ("left", "right"):
        for other in seen[1:]:
            np.testing.assert_array_equal(seen[0].world_from_pad[name], other.world_from_pad[name])
        assert 1e-5 < np.ptp(seen[0].world_from_pad[name][:, :3, 3], axis=0).max() < 5e-3


def test_an_environment_that_breaks_down_fails_alone() -> None:
    world = TactileWorld(UP, outputs=("wrench",), num_envs=2)
    world.data[0].qvel[0] = 1e6
    state = world.step()
    assert state.failed.tolist() == [True, False] and np.isnan(state.wrench["sensor"][0]).all()
    frame = world.observe()["sensor"]
    assert frame.failed.tolist() == [True, False]
    assert np.isnan(frame.surface.height[0]).all() and np.isfinite(frame.surface.height[1]).all()
    world.data[1].qvel[0] = 1e6
    assert world.step().failed.all() and world.step().failed.all()
    assert not world.reset().failed.any()


def test_two_bodies_on_one_pad_add_up() -> None:
    balls = tuple(
        replace(BALL, name=f"ball{k}", params={"radius": 0.003}, position=(x, 0.0, 0.00305), mass=mass)
        for k, (x, mass) in enumerate(((-0.005, 0.01), (0.005, 0.03)))
    )
    world = settled(replace(UP, bodies=balls), steps=3)
    wrench = world.state().wrench["sensor"][0]
    world = settled(replace(UP, bodies=balls), steps=3)
    frame = world.observe()["sensor"]
    left, right = frame.surface.contact[0][:, :190], frame.surface.contact[0][:, 210:]
    assert left.any() and right.any() and not frame.surface.contact[0][:, 190:210].any()
    assert wrench[4] > 0.0  # the heavier ball is at +x: its force along −z turns the pad about +y


WRONG = [
    (replace(UP, bodies=(replace(BALL, dynamics="soft"),)), SpecError, "nothing deforms"),
    (replace(UP, bodies=(replace(BALL, position=(0.0, 0.0, 0.004)),)), InputError, "pressed into the pad of 'sensor'"),
    (
        replace(UP, bodies=(BALL, replace(BALL, name="other", position=(0.0, 0.0, 0.012)))),
        InputError,
        "overlap by 3.1 mm at the start",
    ),
    (replace(UP, bodies=(replace(BALL, name="sensor_body"),)), SpecError, "the robot has a body of this name"),
    (replace(UP, bodies=(replace(BALL, name="sensor"),)), SpecError, "body\\[0\\].name.*a sensor of the robot has this name"),
    (replace(UP, robot=RobotSpec("panda_one_sensor", joints=(3.0,) + (0.0,) * 6)), SpecError, "must be within joint1's"),
    (replace(UP, robot=RobotSpec("floating_gripper", opening=0.1)), SpecError, "as wide as the gripper opens"),
]


@pytest.mark.parametrize(("scene", "error", "rule"), WRONG)
def test_what_cannot_be_is_refused(scene: TaskScene, error: type[Exception], rule: str) -> None:
    with pytest.raises(error, match=rule):
        TactileWorld(scene)


def test_wrong_arguments_are_refused() -> None:
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"physics": "physx"}, "must be a known"),
        ({"coupling": "three_way"}, r"coupling = 'three_way': must be a known name.*two_way, one_way"),
        ({"coupling": ["two_way"]}, "coupling = "),
        ({"num_envs": 0}, "whole number"),
    )
    for options, rule in wrong:
        with pytest.raises(InputError, match=rule):
            TactileWorld(UP, **options)
    world = TactileWorld(UP, outputs=())
    with pytest.raises(InputError, match="must be a sensor of the world"):
        world.observe(["left"])
    with pytest.raises(InputError, match=r"envs.*one environment or more"):
        world.observe(envs=[False])
    with pytest.raises(InputError, match="is its shape, which must be"):
        world.step(np.zeros(3))
    with pytest.raises(InputError, match="one for each of 1"):
        world.step([world.hold, world.hold])
    with pytest.raises(InputError, match="environments 0 to 0"):
        world.reset([1])


def test_an_mjcf_robot_carries_its_sensors(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        """<mujoco><worldbody><body name="link" pos="0 0 0.2"><joint name="slide" type="slide" axis="0 0 1"/>
        <geom size="0.01" mass="1"/></body></worldbody><actuator><motor joint="slide" name="lift"/></actuator>
        <keyframe><key name="up" qpos="0.05"/></keyframe></mujoco>""",
        "utf-8",
    )
    (tmp_path / "scene.toml").write_text(
        '[robot]\nmodel = "arm.xml"\narm_joints = "slide"\nkeyframe = "up"\n[[robot.mount]]\nname = "tip"\nat = "link"\n'
        "position_mm = [0, 0, -30]\nquaternion_wxyz = [0, 1, 0, 0]\n",
        "utf-8",
    )
    world = TactileWorld(tmp_path / "scene.toml", outputs=())
    assert world.sensor_names == ("tip",) and world.arm is not None
    np.testing.assert_allclose(world.state().world_from_pad["tip"][0, :3, 3], [0.0, 0.0, 0.22], atol=1e-12)
    assert world.step().world_from_pad["tip"][0, 2, 3] == pytest.approx(0.22, abs=1e-6)  # held against gravity


def test_position_servos_hold_where_the_file_puts_them(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        """<mujoco><worldbody><body name="link" pos="0 0 0.2"><joint name="turn" type="hinge" axis="0 0 1" ref="40"/>
        <geom size="0.01" pos="0.1 0 0" mass="1"/></body></worldbody><actuator><position joint="turn" kp="50" gear="2"/></actuator>
        </mujoco>""",
        "utf-8",
    )
    (tmp_path / "scene.toml").write_text(
        '[robot]\nmodel = "arm.xml"\n[[robot.mount]]\nname = "tip"\nat = "link"\nposition_mm = [0, 0, 30]\n', "utf-8"
    )
    world = TactileWorld(tmp_path / "scene.toml", outputs=())
    assert world.composed.ctrl == pytest.approx(2.0 * np.radians(40.0))
    start = world.data[0].qpos.copy()
    for _ in range(5):
        world.step()
    np.testing.assert_allclose(world.data[0].qpos, start, atol=1e-9)


def test_a_contact_that_mujoco_has_no_room_for_fails_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    world = TactileWorld(UP, outputs=("wrench",), num_envs=2)
    while not world.step().wrench["sensor"].any():
        pass
    add, full = mujoco.mj_addContact, world.data[0]
    monkeypatch.setattr(mujoco, "mj_addContact", lambda model, data, contact: 1 if data is full else add(model, data, contact))
    assert world.step().failed.tolist() == [True, False]
