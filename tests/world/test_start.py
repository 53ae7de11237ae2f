"""Environments that start elsewhere: joints and bodies of those that are named, in both physics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError, OverlapError
from raytac.specs import load_sensor, load_task
from raytac.world.world import TactileWorld

pytestmark = pytest.mark.usefixtures("few_cells")


def shifted(world: TactileWorld, body: str, rows: int, by: float) -> np.ndarray:
    at = np.repeat(world.state().world_from_body[body][:1], rows, axis=0)
    at[:, 0, 3] += by
    return at


def test_named_environments_start_where_they_are_told_and_others_go_on() -> None:
    world = TactileWorld("roll_ball", outputs=("wrench",), num_envs=3)
    arm = world.arm
    assert arm is not None
    world.step()
    before = world.state()
    joints = np.repeat(world.composed.start[arm.qpos][None], 2, axis=0)
    joints[1, 0] += 0.1
    state = world.reset([0, 2], joints=joints, bodies={"ball": shifted(world, "ball", 2, 0.02)})
    np.testing.assert_allclose(state.time, [0.0, before.time[1], 0.0])
    assert state.joints is not None and before.joints is not None
    np.testing.assert_allclose(state.joints[[0, 2]], joints)
    np.testing.assert_array_equal(state.joints[1], before.joints[1])
    np.testing.assert_allclose(state.world_from_body["ball"][:, 0, 3], [0.47, 0.45, 0.47], atol=1e-6)
    np.testing.assert_allclose(world.reset().world_from_body["ball"][:, 0, 3], 0.45, atol=1e-12)


@pytest.mark.solver
def test_the_solver_s_bodies_start_elsewhere_too() -> None:
    world = TactileWorld("roll_ball", physics="ipc", outputs=("wrench",), num_envs=2)
    state = world.reset([1], bodies={"ball": shifted(world, "ball", 1, 0.02)})
    np.testing.assert_allclose(state.world_from_body["ball"][:, 0, 3], [0.45, 0.47], atol=1e-9)
    state = world.step()
    np.testing.assert_allclose(state.world_from_body["ball"][:, 0, 3], [0.45, 0.47], atol=1e-4)


def test_wrong_starts_are_refused_by_name_and_row() -> None:
    world = TactileWorld("roll_ball", outputs=("wrench",), num_envs=2)
    at = shifted(world, "ball", 2, 0.0)
    for bodies, text in (
        ({"bal": at}, "choose from: ball"),
        ({"table": at}, "free rigid body"),
        ({"ball": at[:1]}, r"shape \(2, 4, 4\)"),
        ({"ball": np.where(np.arange(2)[:, None, None] == 1, np.nan, at)}, "row 1"),
        ({"ball": 2.0 * at}, r"bodies\['ball'\].*rigid transforms"),
    ):
        with pytest.raises(InputError, match=text):
            world.reset(bodies=bodies)
    with pytest.raises(InputError, match=r"shape \(2, 7\)"):
        world.reset(joints=np.zeros((2, 6)))
    with pytest.raises(InputError, match="must be a controller"):
        world.step([0.0, 0.0])  # type: ignore[list-item]
    assert [data.time for data in world.data] == [0.0, 0.0]


def test_a_robot_can_carry_a_sensor_that_is_no_file() -> None:
    spec = load_sensor("gelsight_mini")
    soft = replace(spec, gelpad=replace(spec.gelpad, youngs_modulus=1e4))
    scene = load_task("roll_ball")
    world = TactileWorld(replace(scene, robot=replace(scene.robot, sensor=soft)), outputs=("wrench",))
    assert world.sensors["sensor"].spec.gelpad.youngs_modulus == 1e4


@pytest.mark.parametrize("physics", ["rigid", "ipc"])
@pytest.mark.solver
def test_a_start_that_cannot_be_changes_nothing(physics: str) -> None:
    world = TactileWorld("roll_ball", physics=physics, outputs=("wrench",), num_envs=2)
    before = world.step()
    at = shifted(world, "ball", 2, 0.0)
    tool = before.world_from_pad["sensor"][0, :3, 3]
    at[1, :3, 3] = tool - [0.0, 0.0, 0.003]  # in the pad
    deeper = at.copy()
    deeper[1, 2, 3] += 0.005  # in the case
    joints = np.repeat(world.composed.start[world.arm.qpos][None], 2, axis=0)  # type: ignore[union-attr]
    joints[1, 3] = 1.0
    wrong: list[tuple[dict[str, Any], str]] = [({"joints": joints}, "of environment 1 must be within")]
    if physics == "ipc":
        wrong += [
            ({"bodies": {"ball": at}}, "bodies overlap"),
            ({"bodies": {"ball": deeper}}, "inside the robot's geom 'sensor_case'"),
        ]
    for starts, text in wrong:
        with pytest.raises((InputError, OverlapError), match=text):
            world.reset(**starts)
        after = world.state()
        np.testing.assert_array_equal(after.time, before.time)
        np.testing.assert_array_equal(after.joints, before.joints)  # type: ignore[arg-type]
        np.testing.assert_array_equal(after.world_from_body["ball"], before.world_from_body["ball"])
    assert not world.step().failed.any()
