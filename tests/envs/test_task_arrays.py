"""Rewards, ends, starts, targets and observations are the same for NumPy arrays and PyTorch tensors, and wait for no device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from raytac.envs import (
    BalancePole,
    InsertPeg,
    LiftCube,
    Motion,
    OpenDrawer,
    PushCube,
    RollBall,
    Starts,
    Task,
    TaskBatch,
    TaskState,
)
from raytac.envs.action_targets import ToolTargets, joint_targets
from raytac.envs.insert_peg import SOCKET
from raytac.envs.open_drawer import HANDLE
from raytac.envs.task_observation import body_from_tool, state_and_goal
from raytac.envs.task_progress import task_outcome
from raytac.robots.pose_errors import PoseErrors
from raytac.se3 import pose, pose_error

torch = pytest.importorskip("torch")

PLACES: dict[type[Task], tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    PushCube: ((0.45, 0.0, 0.02), (0.45, 0.0, 0.04), (0.45, 0.0, 0.02)),
    BalancePole: ((0.45, 0.0, 0.70), (0.45, 0.0, 0.55), (0.45, 0.0, 0.55)),
    LiftCube: ((0.45, 0.0, 0.10), (0.45, 0.0, 0.10), (0.45, 0.0, 0.10)),
    RollBall: ((0.45, 0.0, 0.005), (0.45, 0.0, 0.011), (0.45, 0.0, 0.005)),
    InsertPeg: ((0.53, 0.0, 0.0265), (0.53, 0.0, 0.036), (0.53, 0.0, 0.0)),
    OpenDrawer: ((0.50, 0.0, 0.03), (0.41, 0.0, 0.064), (0.41, 0.0, 0.064)),
}
"""Places of body, tool and goal at which a task is done."""
TASKS = list(PLACES)
ROWS = 300


def states(kind: type[Task], seed: int = 0) -> TaskState:
    """States whose distances from success go from 0.1 mm to 3 m."""
    rng = np.random.default_rng(seed)
    off = 10.0 ** rng.uniform(-4.0, 0.5, (ROWS, 1))

    def poses(place: tuple[float, ...]) -> np.ndarray:
        turn = np.minimum(off, 1.0) * rng.normal(0.0, 1.0, (ROWS, 3))
        return pose(Rotation.from_rotvec(turn).as_matrix(), place + off * rng.normal(0.0, 1.0, (ROWS, 3)))

    def wrench() -> np.ndarray:
        return np.concatenate([rng.normal(0.0, 1.0, (ROWS, 2)), -rng.uniform(0.0, 12.0, (ROWS, 1)), np.zeros((ROWS, 3))], axis=1)

    body, tool, goal = PLACES[kind]
    size = len(kind.motion.axes)
    return TaskState(
        tool=poses(tool), speed=rng.normal(0.0, 0.1, (ROWS, 3)), body=poses(body), body_speed=rng.normal(0.0, 0.1, (ROWS, 6)),
        goal=goal + off * rng.normal(0.0, 1.0, (ROWS, 3)), wrench={name: wrench() for name in ("sensor", "left", "right")},
        opening=rng.uniform(0.0, 0.09, (ROWS, 1)), joint_speed=rng.normal(0.0, 0.5, (ROWS, 7)), action=rng.uniform(-1, 1, (ROWS, size)),
        last_action=rng.uniform(-1, 1, (ROWS, size)),
    )  # fmt: skip


def as_tensors(state: TaskState, dtype: Any, device: str = "cpu") -> TaskState:
    def tensor(values: Any) -> Any:
        return torch.asarray(values, dtype=dtype, device=device)

    values = {f.name: getattr(state, f.name) for f in fields(state)}
    wrench = {name: tensor(array) for name, array in values.pop("wrench").items()}
    return TaskState(**{name: tensor(array) for name, array in values.items()}, wrench=wrench)


def scene_poses(kind: type[Task], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Poses (4, 4) of tool and body in a scene, neither upright."""
    body, tool, _ = PLACES[kind]
    turns = Rotation.random(2, np.random.default_rng(seed)).as_matrix()
    return pose(turns[0], np.array(tool)), pose(turns[1], np.array(body))


@pytest.mark.parametrize("kind", TASKS)
def test_rewards_and_ends_are_those_of_numpy(kind: type[Task]) -> None:
    state, task = states(kind), kind()
    expected = task.evaluate(state)
    assert 0 < expected.success.sum() < ROWS and 0 < expected.terminated.sum() < ROWS
    assert all(np.ptp(term) > 0.0 for term in expected.terms.values())
    found = task.evaluate(as_tensors(state, torch.float64))
    assert list(found.terms) == list(expected.terms)
    for name, term in expected.terms.items():
        np.testing.assert_allclose(found.terms[name].numpy(), term, rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(found.terminated.numpy(), expected.terminated)
    np.testing.assert_array_equal(found.success.numpy(), expected.success)


@pytest.mark.parametrize("kind", TASKS)
def test_single_precision_gives_the_same_to_a_hundred_thousandth(kind: type[Task]) -> None:
    single = as_tensors(states(kind), torch.float32)
    rounded = as_tensors(single, torch.float64)
    steps, failed = torch.zeros(ROWS, dtype=torch.int64), torch.zeros(ROWS, dtype=torch.bool)
    found, expected = (task_outcome(kind(), state, steps, 9, failed) for state in (single, rounded))
    same = (found.terminated == expected.terminated) & (found.success == expected.success)
    assert same.float().mean() > 0.99  # but for states that are at a limit
    for name, term in expected.terms.items():
        assert found.terms[name].dtype == torch.float32
        # A place 0.53 m away is known to 0.03 µm, which is 1e-5 of the 3 mm over which this one falls.
        error = 1e-4 if name == "aligned" else 1e-5 * max(1.0, float(term.abs().max()))
        assert ((found.terms[name] - term).abs() < error).float().mean() > 0.99, name
    assert found.reward.dtype == torch.float32


@pytest.mark.parametrize("kind", TASKS)
def test_nothing_in_a_task_waits_for_a_device_or_holds_arrays_of_the_host(kind: type[Task]) -> None:
    """Tensors of the device ``meta`` have no values: what reads one, or meets an array of the host, raises."""
    state, task = as_tensors(states(kind), torch.float32, "meta"), kind()
    tool, body = (torch.asarray(one, dtype=torch.float32, device="meta") for one in scene_poses(kind))
    starts = task.starts(torch.empty((5, task.draws), device="meta"), tool, body)
    arrays = [starts.goal, *starts.bodies.values()]
    failed, steps = (torch.empty(ROWS, dtype=dtype, device="meta") for dtype in (torch.bool, torch.int64))
    end = task_outcome(task, state, steps, 9, failed)
    arrays += [end.reward, end.terminated, end.truncated, end.success, *end.terms.values()]
    targets = ToolTargets(replace(task.motion, axes=("x", "rx", "rz", "grip"), step=(1.0,) * 4), state.tool, 0.05)
    actions = torch.empty((ROWS, 4), device="meta")
    targets.move(actions, state.tool[:, :3, 3])
    targets.grip(actions)
    targets.begin(failed, state.tool)
    joints = state.joint_speed
    arrays += [targets.pose, targets.turn, targets.gap]
    arrays += [joint_targets(task.motion, torch.empty_like(joints), joints, joints, torch.empty((7, 2), device="meta"))]
    turn, opening = state.speed, state.speed[:, :1]
    arrays += state_and_goal(state.tool, tool, turn, state.speed, opening, actions, state.goal).values()
    arrays += [body_from_tool(state.tool, state.body, state.body_speed)]
    assert all(array.device.type == "meta" for array in arrays)


def drawn(task: Task, rng: np.random.Generator, tool: np.ndarray, body: np.ndarray) -> Starts:
    """Start of one episode as the docstrings of the environments describe it, drawn by ``uniform``."""
    place, rotation = body[:3, 3].copy(), body[:3, :3]

    def shift(width: float) -> np.ndarray:
        return np.array([*rng.uniform(-width, width, 2), 0.0])

    def goal_around(least: float, most: float) -> np.ndarray:
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(least, most)
        return place + distance * np.array([np.cos(angle), np.sin(angle), 0.0])

    if isinstance(task, PushCube):
        place += shift(0.01)
        rotation = Rotation.from_euler("z", rng.uniform(-0.3, 0.3)).as_matrix() @ rotation
        goal = goal_around(0.03, 0.10)
    elif isinstance(task, BalancePole):
        angle, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, np.radians(2.0))
        foot = tool[:3, 3] + shift(1e-3) + [0.0, 0.0, 1e-4 + 0.003 * np.sin(tilt)]
        rotation = Rotation.from_rotvec(tilt * np.array([np.cos(angle), np.sin(angle), 0.0])).as_matrix()
        place, goal = foot + 0.15 * rotation[:, 2], tool[:3, 3]
    elif isinstance(task, LiftCube):
        middle = place.copy()
        place += shift(0.03)
        goal = np.array([*(middle[:2] + rng.uniform(-0.05, 0.05, 2)), rng.uniform(0.08, 0.20)])
    elif isinstance(task, RollBall):
        place += shift(2e-3)
        goal = goal_around(5e-3, 10e-3)
    elif isinstance(task, InsertPeg):
        place += shift(0.008)
        rotation = Rotation.from_euler("z", rng.uniform(-0.1, 0.1)).as_matrix() @ rotation
        goal = np.array([*(SOCKET + rng.uniform(-1e-3, 1e-3, 2)), 0.0])
    else:
        closed = place.copy()
        place[0] -= rng.uniform(0.0, 0.01)
        goal = closed + HANDLE - [rng.uniform(0.04, 0.09), 0.0, 0.0]
    return Starts(goal[None], {task.body: pose(rotation, place)[None]})


@pytest.mark.parametrize("kind", TASKS)
def test_starts_are_those_that_generators_draw_one_by_one(kind: type[Task]) -> None:
    task, (tool, body) = kind(), scene_poses(kind)
    u = np.stack([np.random.default_rng(seed).random(task.draws) for seed in range(20)])
    found = task.starts(u, tool, body)
    for seed in range(20):
        expected = drawn(task, np.random.default_rng(seed), tool, body)
        np.testing.assert_allclose(found.goal[seed], expected.goal[0], rtol=0.0, atol=1e-15)
        assert list(found.bodies) == list(expected.bodies)
        np.testing.assert_allclose(found.bodies[task.body][seed], expected.bodies[task.body][0], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("kind", TASKS)
@pytest.mark.parametrize(("dtype", "error"), [("float64", 1e-12), ("float32", 1e-5)])
def test_starts_are_those_of_numpy(kind: type[Task], dtype: str, error: float) -> None:
    task, poses = kind(), scene_poses(kind)
    u = np.random.default_rng(3).random((50, task.draws))
    expected = task.starts(u, *poses)
    found = task.starts(*(torch.asarray(values, dtype=getattr(torch, dtype)) for values in (u, *poses)))
    pairs = [(found.goal, expected.goal), *((found.bodies[name], expected.bodies[name]) for name in expected.bodies)]
    for tensor, array in pairs:
        assert tensor.dtype == getattr(torch, dtype)
        np.testing.assert_allclose(tensor.numpy(), array, rtol=0.0, atol=error)


def test_an_environment_starts_as_its_own_generator_says() -> None:
    batch = TaskBatch(LiftCube(), num_envs=3, tactile=None)
    batch.reset(range(3), [np.random.default_rng(b) for b in range(3)])
    before = batch.goal
    batch.reset([2, 0], [np.random.default_rng(7), np.random.default_rng(8)])
    for env, seed in ((2, 7), (0, 8)):
        expected = drawn(batch.task, np.random.default_rng(seed), batch.start_tool, batch.start_body)
        np.testing.assert_allclose(batch.goal[env], expected.goal[0], rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(batch.body[env], expected.bodies["object"][0], atol=1e-12)
    np.testing.assert_array_equal(batch.goal[1], before[1])
    with pytest.raises(ValueError, match="zip"):
        batch.reset([0, 1], [np.random.default_rng(0)])
    batch.reset([], [])


def test_a_failed_environment_has_no_reward_and_is_truncated() -> None:
    state = states(PushCube)
    state.body[1] = np.nan
    failed, steps = np.zeros(ROWS, bool), np.zeros(ROWS, int)
    failed[[1, 2]], steps[[3, 4]] = True, [9, 8]
    for convert in (lambda values: values, torch.asarray):
        given_state = state if convert is not torch.asarray else as_tensors(state, torch.float64)
        end = task_outcome(PushCube(), given_state, convert(steps), 9, convert(failed))
        reward, truncated, terminated = (np.asarray(array) for array in (end.reward, end.truncated, end.terminated))
        assert np.isfinite(reward).all() and (reward[failed] == 0.0).all() and (reward[~failed] != 0.0).all()
        np.testing.assert_array_equal(truncated, (failed | (steps >= 9)) & ~terminated)
        assert truncated[[1, 2, 3]].tolist() == [True, True, not terminated[3]] and not truncated[4]
        assert not np.asarray(end.success)[failed].any() and not terminated[failed].any()
        np.testing.assert_allclose(sum(np.asarray(term) for term in end.terms.values()), reward, rtol=1e-12)


TURNING = Motion(
    ("x", "z", "ry", "rz", "grip"), (3e-3, 2e-3, 0.05, 0.1, 4e-3), (0.4, -0.1, 0.0), (0.5, 0.1, 0.2), leash=5e-3, turn=0.3,
    opening=(0.02, 0.08),
)  # fmt: skip
UNIT = st.floats(-1.0, 1.0)


@settings(deadline=None, max_examples=40)
@given(steps=st.lists(st.tuples(*[UNIT] * 5, *[st.floats(-0.02, 0.02)] * 2), min_size=1, max_size=8))
def test_targets_stay_in_box_leash_and_turn_in_both_libraries(steps: list[tuple[float, ...]]) -> None:
    """Two environments, of which the second is given the opposite actions; the tools move by themselves."""
    tool = np.repeat(pose(np.eye(3), np.array([0.45, 0.05, 0.1]))[None], 2, axis=0)
    one, two = ToolTargets(TURNING, tool, 0.05), ToolTargets(TURNING, torch.asarray(tool), 0.05)
    for x, z, ry, rz, grip, dx, dz in steps:
        actions = np.array([[x, z, ry, rz, grip], [-x, -z, -ry, -rz, -grip]])
        now = tool[:, :3, 3] + [dx, 0.0, dz]
        before = one.pose
        for targets, convert in ((one, np.asarray), (two, torch.asarray)):
            targets.move(convert(actions), convert(now))
            targets.grip(convert(actions))
        for name in ("pose", "turn", "gap"):
            np.testing.assert_allclose(getattr(two, name).numpy(), getattr(one, name), rtol=0.0, atol=1e-14)
        place = one.pose[:, :3, 3]
        assert (np.abs(place - now)[:, [0, 2]] <= 5e-3 + 1e-12).all()  # the tools stay in the box
        assert (place >= np.array(TURNING.low) - 1e-12).all() and (place <= np.array(TURNING.high) + 1e-12).all()
        assert (place[:, 1] == 0.05).all() and (np.linalg.norm(one.turn, axis=1) <= 0.3 + 1e-12).all()
        np.testing.assert_allclose(one.pose[:, :3, :3], Rotation.from_rotvec(one.turn).as_matrix(), atol=1e-14)
        assert (one.gap >= 0.02).all() and (one.gap <= 0.08).all() and one.pose is not before
        free = np.abs(place - now)[:, 0] < 5e-3 - 1e-9
        np.testing.assert_allclose((place - before[:, :3, 3])[free, 0], 3e-3 * actions[free, 0], atol=1e-12)


def test_a_target_that_nothing_has_turned_keeps_the_rotation_at_which_it_began() -> None:
    turn = Rotation.from_euler("x", [[0.0], [0.2], [0.4]]).as_matrix()
    tool = pose(turn, np.tile([0.45, 0.0, 0.1], (3, 1)))
    targets = ToolTargets(TURNING, tool, 0.05)
    actions = np.zeros((3, 5))
    actions[2, 3] = 1.0
    targets.move(actions, tool[:, :3, 3])
    np.testing.assert_array_equal(targets.pose[:2], tool[:2])
    np.testing.assert_allclose(targets.pose[2, :3, :3], Rotation.from_euler("z", 0.1).as_matrix(), atol=1e-15)
    targets.grip(actions + 1.0)
    targets.begin(np.array([False, False, True]), tool)
    np.testing.assert_array_equal(targets.pose, tool)
    np.testing.assert_array_equal(targets.turn, 0.0)
    np.testing.assert_allclose(targets.gap, [0.054, 0.054, 0.05])


@settings(deadline=None, max_examples=40)
@given(values=st.lists(st.tuples(UNIT, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), min_size=1, max_size=6))
def test_joint_targets_stay_in_leash_and_limits_in_both_libraries(values: list[tuple[float, float, float]]) -> None:
    motion, limits = RollBall.motion, np.array([[-0.25, 0.25]] * 2)
    actions, target, joints = (np.repeat(column[:, None], 2, axis=1) for column in np.array(values).T)
    joints = joints.clip(-0.25, 0.25)
    found = joint_targets(motion, actions, target, joints, limits)
    tensors = (torch.asarray(array) for array in (actions, target, joints, limits))
    np.testing.assert_array_equal(joint_targets(motion, *tensors).numpy(), found)
    assert (np.abs(found - joints) <= 0.1 + 1e-12).all() and (np.abs(found) <= 0.25).all()
    wished = target + 0.05 * actions
    free = (np.abs(wished - joints) <= 0.1) & (np.abs(wished) <= 0.25)
    np.testing.assert_array_equal(found[free], wished[free])


def test_observations_are_those_of_numpy_and_as_the_docstrings_say() -> None:
    state, rng = states(LiftCube), np.random.default_rng(5)
    start, turn, opening = state.tool[0], rng.normal(size=(ROWS, 3)), rng.uniform(0.0, 0.08, (ROWS, 1))
    arguments = (state.tool, start, turn, state.speed, opening, state.action, state.goal)
    expected = state_and_goal(*arguments) | {"body": body_from_tool(state.tool, state.body, state.body_speed)}
    tensors = as_tensors(state, torch.float64)
    found = state_and_goal(*(torch.asarray(array) for array in arguments))
    found["body"] = body_from_tool(tensors.tool, tensors.body, tensors.body_speed)
    assert list(found) == list(expected) == ["state", "goal", "body"]
    for name, array in expected.items():
        assert found[name].dtype == torch.float32 and array.dtype == np.float32
        np.testing.assert_allclose(found[name].numpy(), array, rtol=1e-6)
    place, k = state.tool[:, :3, 3], 17
    parts = [(place[k] - start[:3, 3]) / 0.1, turn[k], state.speed[k], opening[k] / 0.1, state.action[k]]
    np.testing.assert_allclose(expected["state"][k], np.concatenate(parts), rtol=1e-6)
    np.testing.assert_allclose(expected["goal"][k], (state.goal[k] - place[k]) / 0.1, rtol=1e-6)
    body = state.body[k]
    parts = [(body[:3, 3] - place[k]) / 0.1, body[:3, 0], body[:3, 1], state.body_speed[k]]
    np.testing.assert_allclose(expected["body"][k], np.concatenate(parts), rtol=1e-6)


def test_differences_of_poses_of_tensors_are_those_of_arrays() -> None:
    state = states(PushCube)
    a, b = torch.asarray(state.tool), torch.asarray(state.body, dtype=torch.float32)
    errors: Callable[..., Any] = PoseErrors(ROWS, 2, device="cpu")
    found = errors((a, b), (a, torch.eye(4)))
    expected = [pose_error(state.tool, b.numpy().astype(float)), pose_error(state.tool, np.eye(4))]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-7)  # rotations of single precision are not quite orthonormal
    np.testing.assert_allclose(found[1].numpy(), expected[1], atol=1e-14)
    errors((b, b), (b, b))
    np.testing.assert_allclose(found[1].numpy(), expected[1], atol=1e-14)  # a later call leaves it as it is
