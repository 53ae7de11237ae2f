"""Tasks on MuJoCo Warp as Gymnasium vectors of tensors and for stable-baselines3: episodes that end, modes, bad input."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("mujoco_warp")
pytest.importorskip("torch")

import torch

import raytac.envs
from raytac.envs import PushCube, WarpBatch, WarpVectorEnv
from raytac.errors import InputError
from raytac.observe import ObservationSettings

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes

SEEN = ObservationSettings(("markers", "wrench"), stack=2)
OPTIONS: dict[str, Any] = {"tactile": SEEN, "max_episode_steps": 6, "device": "cpu", "seed": 0}
DOWN = torch.tensor([[0.0, 0.0, -1.0], [0.3, 0.0, -0.5], [0.0, 0.2, -1.0]])


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], rows: list[int]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name][rows], b[name][rows]) for name in a)


def test_every_task_is_a_gymnasium_vector_of_tensors() -> None:
    for name in raytac.envs.WARP_IDS:
        env = gymnasium.make_vec(name, num_envs=2, tactile=("wrench",), device="cpu")
        seen, _ = env.reset(seed=1)
        action = torch.as_tensor(env.action_space.sample())
        seen, reward, terminated, truncated, infos = env.step(action)
        assert env.observation_space.contains({key: values.numpy() for key, values in seen.items()})
        for values, kind in (
            (reward, torch.float32),
            (terminated, torch.bool),
            (truncated, torch.bool),
            (infos["success"], torch.bool),
        ):
            assert values.shape == (2,) and values.dtype == kind
        terms = torch.stack(list(infos["reward_terms"].values()))
        torch.testing.assert_close(terms.sum(dim=0).float(), reward)
        env.close()
        with pytest.raises(InputError, match="closed"):
            env.step(action)


def test_an_episode_that_ends_shows_its_last_observation_in_every_mode() -> None:
    """Of the third environment alone, whose episode was set to end first; the others are the same to the bit."""
    options, last_step = {**OPTIONS, "max_episode_steps": 12}, 8
    envs = {mode: WarpVectorEnv("PushCube", 3, autoreset_mode=mode, **options) for mode in ("SameStep", "NextStep", "Disabled")}
    for env in envs.values():
        env.reset(seed=4)
        env.batch.steps[2] = 3  # of twelve
    last: dict[str, Any] = {}
    for step in range(last_step + 2):
        found = {mode: env.step(DOWN) for mode, env in envs.items()}
        ended = [step == last_step and b == 2 for b in range(3)]
        assert found["SameStep"][3].tolist() == found["NextStep"][3].tolist() == ended
        assert found["Disabled"][3].tolist() == [step >= last_step and b == 2 for b in range(3)]
        first = found["SameStep"]
        for mode in ("NextStep", "Disabled"):
            assert equal(found[mode][0], first[4]["final_obs"], [0, 1, 2] if step <= last_step else [0, 1]), (mode, step)
            torch.testing.assert_close(found[mode][1][:2], first[1][:2], rtol=0, atol=0)
        assert first[4]["_final_obs"].tolist() == ended
        assert equal(first[0], first[4]["final_obs"], [0, 1])
        if step == last_step:
            last = first[4]["final_obs"]
            begun = first[0]["state"][2]
            assert not torch.equal(begun, last["state"][2]) and not begun[-3:].any() and last["state"][2, -1] != 0.0
            assert last["sensor_markers"][2].abs().max() > 0.01  # the pad is pressed
    # In the step after the end an episode begins in place of one: reward 0, the first observation, twice in the stack.
    seen, reward, terminated, truncated, _ = found["NextStep"]
    assert reward[2] == 0.0 and not (terminated[2] or truncated[2]) and envs["NextStep"].batch.steps[2] == 0
    assert not seen["state"][2, -3:].any() and torch.equal(seen["sensor_markers"][2, 0], seen["sensor_markers"][2, 1])
    env = envs["Disabled"]
    kept = found["Disabled"][0]
    seen, _ = env.reset(options={"reset_mask": np.array([False, False, True])})
    assert equal(seen, kept, [0, 1]) and not seen["state"][2, -3:].any() and env.batch.steps.tolist() == [10, 10, 0]
    assert not env.step(DOWN)[3].any()


def test_a_failure_is_told_with_the_last_sound_observation() -> None:
    env = WarpVectorEnv("PushCube", 2, **{**OPTIONS, "max_episode_steps": 50})
    env.reset(seed=0)
    for _ in range(3):
        before = env.step(DOWN[:2])[0]
    env.batch._active[1] = False
    _, reward, terminated, truncated, infos = env.step(DOWN[:2])
    assert truncated.tolist() == infos["failed"].tolist() == [False, True] and not terminated.any() and reward[1] == 0.0
    assert torch.equal(infos["final_obs"]["sensor_markers"][1], before["sensor_markers"][1])
    assert not env.step(DOWN[:2])[3].any()


def test_stable_baselines3_takes_it() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from raytac.envs import TactileVecEnv

    env = TactileVecEnv(WarpVectorEnv("PushCube", 2, **{**OPTIONS, "tactile": ("wrench",), "max_episode_steps": 3}))
    env.seed(3)
    first: Any = env.reset()
    env.seed(3)
    again: Any = env.reset()
    assert all(isinstance(values, np.ndarray) and np.array_equal(values, again[name]) for name, values in first.items())
    seen: Any = first
    infos: list[dict[str, Any]] = []
    for step in range(3):
        seen, reward, done, infos = env.step(np.zeros((2, 3), np.float32))
        assert done.tolist() == [step == 2] * 2 and reward.dtype == np.float32
    for b in range(2):
        last = infos[b]["terminal_observation"]
        assert infos[b]["TimeLimit.truncated"] and not np.array_equal(last["goal"], seen["goal"][b])
    model = sb3.PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, device="cpu")
    model.learn(8)


def test_bad_input_is_named() -> None:
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"task": "Juggle"}, "PushCube"),
        ({"autoreset_mode": "Never"}, "NextStep"),
        ({"render_mode": "rgb_array"}, "None"),
    )
    for options, text in wrong:
        with pytest.raises(InputError, match=text):
            WarpVectorEnv(**{"task": "PushCube", "device": "cpu", **options})
    env = WarpVectorEnv(PushCube, 2, tactile=None, device="cpu")
    with pytest.raises(InputError, match="first reset"):
        env.reset(options={"reset_mask": torch.tensor([True, False])})
    env.reset()
    wrong = (({"seed": [1, 2]}, "one whole number"), ({"options": {"reset_mask": torch.ones(2)}}, "mask"))
    for options, text in wrong:
        with pytest.raises(InputError, match=text):
            env.reset(**options)
    batch = WarpBatch(PushCube(), num_envs=2, tactile=None, device="cpu")
    batch.reset()
    with pytest.raises(InputError, match="begin"):
        batch.step(torch.zeros(2, 3), torch.zeros(3, dtype=torch.bool))
