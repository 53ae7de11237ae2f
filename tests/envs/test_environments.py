"""Environments: Gymnasium's and SB3's checks, seeds, vectors against single ones, resets, ends, bad input, and that tasks can be done."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import raytac.envs
from raytac.envs import (
    BalancePoleEnv,
    InsertPegEnv,
    LiftCubeEnv,
    LiftCubeVectorEnv,
    OpenDrawerEnv,
    PushCubeEnv,
    PushCubeVectorEnv,
    RollBallEnv,
    RollBallVectorEnv,
    scripted,
)
from raytac.envs.balance_pole import BalancePole
from raytac.envs.batch import TaskBatch
from raytac.envs.insert_peg import SOCKET, InsertPeg
from raytac.envs.lift_cube import LiftCube
from raytac.envs.open_drawer import OpenDrawer
from raytac.envs.push_cube import PushCube
from raytac.envs.roll_ball import RollBall
from raytac.envs.task_rules import TaskState
from raytac.errors import InputError
from raytac.markers import MarkerPerturbation
from raytac.observe import ObservationSettings, Randomization
from raytac.optics import RayTraced

ENVS = (PushCubeEnv, BalancePoleEnv, LiftCubeEnv, RollBallEnv, InsertPegEnv, OpenDrawerEnv)


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.renderer
def test_gymnasium_and_stable_baselines3_accept_it(kind: type) -> None:
    with warnings.catch_warnings():
        # Both warn of bounds at infinity and of arrays that are neither images nor vectors, which is as it should be.
        warnings.simplefilter("ignore")
        env = kind()
        check_env(env, skip_render_check=True)
        checker = pytest.importorskip("stable_baselines3.common.env_checker")
        checker.check_env(env, skip_render_check=True)


def test_every_name_is_registered_alone_and_as_a_vector() -> None:
    names = tuple(i for i in gymnasium.registry if i.startswith("raytac/"))
    assert sorted(names) == sorted((*raytac.envs.IDS, *raytac.envs.WARP_IDS)) and len(names) == 12
    env = gymnasium.make("raytac/RollBall-v2", tactile=None)
    assert isinstance(env.unwrapped, RollBallEnv) and "sensor_markers" not in env.observation_space.spaces  # type: ignore[attr-defined]
    many = gymnasium.make_vec("raytac/RollBall-v2", num_envs=3, vectorization_mode="vector_entry_point", tactile=None)
    assert isinstance(many.unwrapped, RollBallVectorEnv) and many.num_envs == 3


_BY_NAME = """
import sys, gymnasium
try:
    gymnasium.make("raytac/RollBall-v2")
except gymnasium.error.NamespaceNotFound:
    assert "raytac" not in sys.modules
    print("needs an import")
print(type(gymnasium.make("raytac.envs:raytac/RollBall-v2", tactile=None).unwrapped).__name__)
print(gymnasium.make_vec("raytac.envs:raytac/RollBall-v2", 2, "vector_entry_point", tactile=None).num_envs)
"""


@pytest.mark.script
def test_gymnasium_makes_it_without_an_import_of_ours() -> None:
    """Only with the module before the colon: an entry point would be of no use since Gymnasium 1.0, as docs/guide/learning.md says."""
    run = subprocess.run([sys.executable, "-c", _BY_NAME], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    lines = [line for line in run.stdout.splitlines() if line in ("needs an import", "RollBallEnv", "2")]
    assert lines == ["needs an import", "RollBallEnv", "2"]


@pytest.mark.renderer
def test_the_docstring_says_the_shapes_that_there_are() -> None:
    for kind in ENVS:
        text = " ".join((kind.__doc__ or "").split())
        env, motion = kind(), kind.task.motion
        for name, spec in env.batch.arrays.items():
            if name != "body":
                shown = f"({spec.shape[0]},)" if len(spec.shape) == 1 else f"({spec.shape[0]}, {spec.shape[1]})"
                assert f"`{name}`" in text and shown in text, (kind, name, shown)
        told = {float(number) for number in re.findall(r"\d+\.?\d*", text)}
        moved = ["xyz".index(axis) for axis in motion.axes if axis in "xyz"]
        lengths = [1e3 * step for step in motion.step] + [1e3 * motion.leash]
        bounds = [abs(bound[i]) for i in moved for bound in (motion.low, motion.high)]
        assert {round(value, 6) for value in (*lengths, *bounds)} <= told, kind
        assert f"Box(-1, 1, ({env.batch.control.size},))" in text and f"{kind.task.max_episode_steps} steps" in text
        env.reset(seed=0)
        info = env.step(np.zeros(env.batch.control.size, np.float32))[4]
        assert all(f"`{term}`" in text for term in info["reward_terms"])


@pytest.mark.renderer
def test_seeds_repeat_and_differ_with_noise_too() -> None:
    noisy = Randomization(markers=MarkerPerturbation(noise_px=0.3, dropout=0.1, shift=2e-4))
    env = RollBallEnv(randomization=noisy)

    def episode(seed: int) -> list[dict]:
        seen = [env.reset(seed=seed)[0]]
        for action in np.random.default_rng(0).uniform(-1, 1, (3, 3)):
            seen.append(env.step(action)[0])
        return seen

    one, same, other = episode(1), episode(1), episode(2)
    assert all(equal(a, b) for a, b in zip(one, same, strict=True))
    assert not equal(one[0], other[0]) and np.isfinite(one[3]["sensor_markers"]).all()


@pytest.mark.renderer
def test_a_vector_does_what_single_environments_of_its_seeds_do() -> None:
    many = PushCubeVectorEnv(2)
    first, _ = many.reset(seed=5)
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2, 3)).astype(np.float32)
    actions[..., 2] = -1.0  # down onto the cube
    steps = [many.step(a) for a in actions]
    for b in range(2):
        env = PushCubeEnv()
        alone, _ = env.reset(seed=5 + b)
        assert equal(alone, {name: values[b] for name, values in first.items()})
        for action, (seen, reward, *_, infos) in zip(actions[:, b], steps, strict=True):
            mine, earned, *_, info = env.step(action)
            for name, values in mine.items():
                np.testing.assert_allclose(values, seen[name][b], atol=1e-6)
            assert earned == pytest.approx(reward[b])
            assert info["reward_terms"]["reaching"] == pytest.approx(infos["reward_terms"]["reaching"][b])
    assert steps[-1][0]["sensor_markers"].any(), "nothing was touched"


@pytest.mark.renderer
def test_no_two_sensors_of_a_vector_have_the_same_noise() -> None:
    tactile = ObservationSettings(("rgb", "markers"), resolution=(16, 12), optics="phong")
    disturbed = Randomization(noise=4.0, markers=MarkerPerturbation(noise_px=0.3))
    seen, _ = LiftCubeVectorEnv(3, tactile=tactile, randomization=disturbed).reset(seed=5)
    for modality in ("rgb", "markers"):  # of pads at rest, so that noise alone tells them apart
        pads = np.concatenate([seen[f"{name}_{modality}"].reshape(3, -1) for name in ("left", "right")])
        assert len(np.unique(pads, axis=0)) == 6, modality


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.renderer
def test_with_noise_in_every_frame_too_when_they_begin_anew_at_different_times(mode: AutoresetMode) -> None:
    disturbed = MarkerPerturbation(noise_px=0.3, dropout=0.1, shift=5e-5)
    direct = RayTraced(bounce=False)  # quickest to build
    tactile = ObservationSettings(("rgb", "markers", "wrench"), resolution=(16, 12), difference=True, stack=2, optics=direct)
    options = {
        "tactile": tactile,
        "randomization": Randomization(noise=2.0, exposure=0.2, markers=disturbed),
        "max_episode_steps": 4,
    }
    many = RollBallVectorEnv(3, autoreset_mode=mode, **options)
    alone = [RollBallEnv(**options) for _ in range(3)]
    seen = many.reset(seed=7)[0]
    mine = [env.reset(seed=7 + b)[0] for b, env in enumerate(alone)]
    rng, late, begun = np.random.default_rng(0), np.zeros(3, bool), np.zeros(3, int)
    for step in range(11):
        for b in range(3):
            assert equal(mine[b], {name: values[b] for name, values in seen.items()}), (step, b)
        if step == 2:  # so that they end at different times
            seen = many.reset(options={"reset_mask": np.array([False, True, False])})[0]
            mine[1] = alone[1].reset()[0]
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        actions[:, 2] = -0.5
        seen, _, terminated, truncated, infos = many.step(actions)
        for b, env in enumerate(alone):
            if late[b]:
                mine[b], ended = env.reset()[0], False
            else:
                mine[b], _, over, cut, _ = env.step(actions[b])
                ended = over or cut
            assert ended == (terminated[b] or truncated[b])
            begun[b] += ended
            if ended and mode is AutoresetMode.SAME_STEP:
                assert equal(mine[b], infos["final_obs"][b])
                mine[b], ended = env.reset()[0], False
            late[b] = ended
    assert begun.min() >= 2 and len(np.unique(seen["sensor_rgb"][:2].reshape(2, -1), axis=0)) == 2


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_environments_begin_anew_when_the_mode_says(mode: AutoresetMode) -> None:
    many = RollBallVectorEnv(2, autoreset_mode=mode, max_episode_steps=3, tactile=("wrench",))
    many.reset(seed=0)
    still = np.zeros((2, 3), np.float32)
    many.step(still)
    many.reset(options={"reset_mask": np.array([False, True])})  # so that they end at different times
    many.step(still)
    seen, _, terminated, truncated, infos = many.step(still)
    assert truncated.tolist() == [True, False] and not terminated.any()
    assert ("final_obs" in infos) == (mode is AutoresetMode.SAME_STEP)
    time = many.batch.world.state().time
    assert (time[0] == 0.0) == (mode is AutoresetMode.SAME_STEP) and time[1] > 0.0
    if mode is AutoresetMode.SAME_STEP:
        assert infos["_final_obs"].tolist() == [True, False] and infos["final_obs"][1] is None
        assert not np.array_equal(infos["final_obs"][0]["goal"], seen["goal"][0])
        np.testing.assert_array_equal(seen["state"][0], 0.0)
    if mode is AutoresetMode.NEXT_STEP:
        seen, reward, terminated, truncated, _ = many.step(still)
        assert reward[0] == 0.0 and not truncated[0] and many.batch.world.state().time[0] == 0.0 and truncated[1]
        np.testing.assert_array_equal(seen["state"][0], 0.0)


def test_the_terms_add_up_and_are_what_their_formulas_say() -> None:
    batch = TaskBatch(PushCube(), num_envs=2, tactile=None)
    batch.reset([0, 1], [np.random.default_rng(b) for b in range(2)])
    first, second = np.full((2, 3), 0.5), np.full((2, 3), -0.5)
    batch.step(first)
    out = batch.step(second)
    np.testing.assert_allclose(sum(out.terms.values()), out.reward)
    state = batch.world.state()
    cube, pad = state.world_from_body["cube"][:, :3, 3], state.world_from_pad["sensor"][:, :3, 3]
    away = np.linalg.norm(pad - cube - [0, 0, 0.02], axis=1)
    np.testing.assert_allclose(out.terms["reaching"], 1 - np.tanh(away / 0.1))
    missing = np.linalg.norm((cube - batch.goal)[:, :2], axis=1)
    np.testing.assert_allclose(out.terms["target_fine"], 4 * (1 - np.tanh(missing / 0.02)))
    np.testing.assert_allclose(out.terms["action_rate"], -3e-4)
    np.testing.assert_allclose(out.observation["body"][:, :3], (cube - pad) / 0.1, atol=1e-6)


def test_a_policy_reads_the_state_of_the_batch_and_cannot_change_it() -> None:
    batch = TaskBatch(PushCube(), num_envs=2, tactile=None)
    first = batch.reset([0, 1], [np.random.default_rng(b) for b in range(2)])
    np.testing.assert_allclose(first["goal"], (batch.goal - batch.tool[:, :3, 3]) / 0.1, rtol=1e-6)
    lead = batch.target[:, :3, 3] - batch.tool[:, :3, 3]
    np.testing.assert_array_equal(lead, 0.0)
    actions = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    batch.step(actions)
    np.testing.assert_array_equal(batch.action, actions)
    assert batch.target[0, 0, 3] > batch.tool[0, 0, 3] and batch.target[1, 1, 3] < batch.tool[1, 1, 3]
    for name in ("tool", "body", "body_speed", "goal", "action", "target"):
        getattr(batch, name)[:] = np.nan
        assert np.isfinite(getattr(batch, name)).all(), name


def test_steps_of_joint_actions_are_the_motions() -> None:
    class Slow(RollBall):
        motion = replace(RollBall.motion, joint_step=0.01)

    moved = []
    for task in (RollBall(), Slow()):
        batch = TaskBatch(task, tactile=None, action="joints")
        batch.reset([0], [np.random.default_rng(0)])
        start = batch.world.state().joints
        assert start is not None
        for _ in range(5):
            batch.step(np.eye(7)[:1])
        joints = batch.world.state().joints
        assert joints is not None
        moved.append(float(np.abs(joints - start)[0, 0]))
    assert 0.01 < moved[1] < 0.4 * moved[0], moved


def test_the_shipped_policies_read_public_names_only() -> None:
    assert not re.findall(r"\w\._\w+", inspect.getsource(scripted))


def test_an_older_version_is_refused_with_the_name_of_the_present_one() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(gymnasium.error.DeprecatedEnv, match="raytac/LiftCube-v2"):
            gymnasium.make("raytac/LiftCube-v0")


def test_a_held_cube_is_worth_more_the_higher_it_is_and_a_loose_one_nothing() -> None:
    height = np.array([0.0151, 0.02, 0.03, 0.04, 0.08, 0.08])
    rows = len(height)
    poses = np.tile(np.eye(4), (rows, 1, 1))
    poses[:, 2, 3] = height
    wrench = np.zeros((rows, 6))
    wrench[:-1, 2] = -1.0  # of the last, only one pad is pressed
    state = TaskState(
        tool=poses, speed=np.zeros((rows, 3)), body=poses, body_speed=np.zeros((rows, 6)),
        goal=np.full((rows, 3), [0.0, 0.0, 0.08]), wrench={"left": wrench, "right": np.tile([0.0, 0, -1, 0, 0, 0], (rows, 1))},
        opening=np.array([[0.09], [0.05], [0.04], [0.03], [0.029], [0.03]]), joint_speed=np.zeros((rows, 7)),
        action=np.zeros((rows, 4)), last_action=np.zeros((rows, 4)),
    )  # fmt: skip
    terms = LiftCube().evaluate(state).terms
    rise = np.clip((height - 0.0155) / 0.0245, 0, 1) * [1, 1, 1, 1, 1, 0]
    np.testing.assert_allclose(terms["lifted"], 15 * rise)
    np.testing.assert_allclose(terms["goal"], 16 * rise * (1 - np.tanh((0.08 - height) / 0.3)))
    np.testing.assert_allclose(terms["closing"], [0, 0, 0.5, 1, 1, 1], atol=1e-12)
    assert terms["held"].tolist() == [2, 2, 2, 2, 2, 0] and (np.diff(terms["lifted"][:4]) > 0).all() and terms["lifted"][0] == 0
    assert LiftCube().evaluate(state).success.tolist() == [False] * 4 + [True] * 2


def test_a_pole_that_is_left_alone_falls_and_the_episode_ends() -> None:
    batch = TaskBatch(BalancePole(), num_envs=4, tactile=None)
    batch.reset(range(4), [np.random.default_rng(b) for b in range(4)])
    ended = np.zeros(4, bool)
    for _ in range(150):
        out = batch.step(np.zeros((4, 2)))
        fresh = out.terminated & ~ended
        assert (out.terms["terminated"][fresh] == -2.0).all() and (out.terms["alive"][fresh] == 0.0).all()
        ended |= out.terminated
        if ended.sum() >= 2:
            return
    pytest.fail(f"{ended.sum()} of 4 fell in 150 steps")


@pytest.mark.parametrize(
    ("task", "policy", "steps"),
    [
        (RollBall, scripted.roll_ball, 60),
        (BalancePole, scripted.balance_pole, 120),
        (InsertPeg, scripted.insert_peg, 180),
        (OpenDrawer, scripted.open_drawer, 120),
    ],
)
def test_the_task_can_be_done(task: type, policy, steps: int) -> None:
    batch = TaskBatch(task(), num_envs=2, tactile=None)
    batch.reset([0, 1], [np.random.default_rng(b) for b in range(2)])
    for _ in range(steps):
        out = batch.step(policy(batch))
        assert not out.terminated.any()
    assert out.success.all()


def test_a_peg_beside_its_socket_stays_outside_and_the_gels_feel_the_rim(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = TaskBatch(InsertPeg(), num_envs=2, tactile=None)
    batch.reset([0, 1], [np.random.default_rng(b) for b in range(2)])
    monkeypatch.setattr(scripted, "SOCKET", np.add(SOCKET, [1e-3, 0.0]))
    upward, overlap = np.zeros(2), 0.0
    for _ in range(150):
        out = batch.step(scripted.insert_peg(batch))
        wrench = batch.world.state().wrench
        upward = np.maximum(upward, -(wrench["left"] + wrench["right"])[:, 1])  # y of both pads is down
        overlap = max(overlap, *(-data.contact.dist.min(initial=0.0) for data in batch.world.data))
        assert not out.success.any() and not out.failed.any()
    assert (upward > 5.0).all() and overlap < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(("task", "policy"), [(PushCube, scripted.push_cube), (LiftCube, scripted.lift_cube)])
def test_the_long_tasks_can_be_done(task: type, policy) -> None:
    batch = TaskBatch(task(), num_envs=2, tactile=None)
    batch.reset([0, 1], [np.random.default_rng(b) for b in range(2)])
    for _ in range(batch.max_episode_steps):
        out = batch.step(policy(batch))
    assert out.success.all()


def test_joint_targets_are_actions_too() -> None:
    env = LiftCubeEnv(action="joints", tactile=None)
    env.reset(seed=0)
    before = env.batch.world.state().joints
    for _ in range(5):
        env.step(np.array([0, 0, 0, 0, 0, 0, 1, -1], np.float32))
    after = env.batch.world.state().joints
    assert before is not None and after is not None
    assert after[0, 6] - before[0, 6] == pytest.approx(0.25, abs=0.08)
    np.testing.assert_allclose(after[0, :6], before[0, :6], atol=0.01)


@pytest.mark.renderer
def test_images_in_a_vector() -> None:
    settings = ObservationSettings(("rgb", "markers"), resolution=(32, 32), optics="phong")
    many = RollBallVectorEnv(2, tactile=settings, randomization=Randomization(exposure=0.2))
    seen, _ = many.reset(seed=0)
    assert seen["sensor_rgb"].shape == (2, 32, 32, 3) and many.observation_space.contains(seen)
    for _ in range(4):
        touched = many.step(np.array([[0, 0, -1.0], [0, 0, 0.0]], np.float32))[0]["sensor_rgb"]
    changed = np.abs(touched.astype(int) - seen["sensor_rgb"]).max(axis=(1, 2, 3))
    assert changed[0] > 5 and changed[1] <= 1


def test_bad_input_names_the_environment() -> None:
    many = RollBallVectorEnv(3, tactile=None)
    with pytest.raises(InputError, match="must be reset"):
        many.step(np.zeros((3, 3)))
    many.reset(seed=0)
    for wrong in (np.nan, np.inf, 1.5):
        actions = np.zeros((3, 3))
        actions[2, 1] = wrong
        with pytest.raises(InputError, match="environment 2, component 1"):
            many.step(actions)
    with pytest.raises(InputError, match=r"\(3, 3\)"):
        many.step(np.zeros((2, 3)))
    for options, text in (
        ({"tactile": "touch"}, "modalities"),
        ({"action": "torque"}, "action"),
        ({"physics": "fem"}, "physics"),
        ({"max_episode_steps": 0}, "max_episode_steps"),
        ({"autoreset_mode": "never"}, "autoreset_mode"),
    ):
        with pytest.raises(InputError, match=text):
            RollBallVectorEnv(2, **options)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="3 environments"):
        many.reset(seed=[1, 2])
    with pytest.raises(InputError, match="mask"):
        many.reset(options={"reset_mask": np.array([True])})


def test_an_environment_that_fails_is_truncated_and_the_others_go_on() -> None:
    many = RollBallVectorEnv(2, tactile=("wrench",), autoreset_mode=AutoresetMode.DISABLED)
    many.reset(seed=0)
    many.batch.world.data[0].qvel[0] = 1e9
    seen, reward, terminated, truncated, infos = many.step(np.zeros((2, 3), np.float32))
    assert infos["failed"].tolist() == truncated.tolist() == [True, False] and not terminated.any()
    assert reward[0] == 0.0 and reward[1] > 0.0 and all(np.isfinite(values).all() for values in seen.values())


@pytest.mark.slow
def test_a_soft_pad_is_a_setting_that_changes_no_shape() -> None:
    rigid, soft = (RollBallVectorEnv(2, physics=p, tactile=("markers", "wrench")) for p in ("rigid", "ipc"))
    assert rigid.observation_space == soft.observation_space
    soft.reset(seed=0)
    for _ in range(2):  # up to first touch: a step in contact takes seconds
        seen = soft.step(np.array([[0, 0, -1.0], [0, 0, 0.0]], np.float32))[0]
    assert soft.observation_space.contains(seen) and seen["sensor_wrench"][0, 2] < 0.0 == seen["sensor_wrench"][1, 2]


@pytest.mark.renderer
def test_the_wrench_alone_is_the_wrench_that_is_seen_beside_markers() -> None:
    both, alone = (RollBallVectorEnv(2, tactile=t, max_episode_steps=5) for t in (("markers", "wrench"), ("wrench",)))
    seen = [env.reset(seed=0)[0]["sensor_wrench"] for env in (both, alone)]
    pressed = False
    for _ in range(7):
        np.testing.assert_array_equal(seen[0], seen[1])
        seen = [env.step(np.array([[0.2, 0, -1.0], [0, 0.1, -0.5]], np.float32))[0]["sensor_wrench"] for env in (both, alone)]
        pressed |= bool((seen[0][:, 2] < 0.0).any())
    assert pressed
    with pytest.raises(InputError, match="alone"):
        both.batch.observers["sensor"].observe_wrench(np.zeros((2, 6)), np.zeros(2, bool), np.ones(2, bool))


def test_an_action_that_is_ignored_may_hold_anything() -> None:
    many = RollBallVectorEnv(2, tactile=None, autoreset_mode=AutoresetMode.NEXT_STEP, max_episode_steps=2)
    many.reset(seed=0)
    many.step(np.zeros((2, 3), np.float32))
    many.reset(options={"reset_mask": np.array([True, False])})
    assert many.step(np.zeros((2, 3), np.float32))[3].tolist() == [False, True]
    ignored = np.array([[0.1, 0, 0], [np.nan, np.inf, 7.0]], np.float32)
    seen, reward, *_ = many.step(ignored)
    assert reward[1] == 0.0 and np.isfinite(seen["state"]).all() and np.isnan(ignored[1, 0])
    with pytest.raises(InputError, match="environment 1"):  # it has begun again: now it counts
        many.step(ignored)
