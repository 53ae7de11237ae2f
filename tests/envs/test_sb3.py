"""Environments for stable-baselines3, and training with them: the same numbers as the vector's, alone and in processes; exact resuming."""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from raytac.envs import ProcessVectorEnv, RollBallVectorEnv
from raytac.errors import InputError
from raytac.observe import ObservationSettings, TactileObserver
from raytac.observe.wrapper import AddTactile

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.torch_layers import CombinedExtractor

from experiments import train_ppo
from experiments.imitation import imitate, regress
from experiments.ppo_learner import SMALLEST_SIDE, Checkpoint, Learner, Recipe, evaluate_learner, tactile_settings
from experiments.ppo_training import Training
from raytac.envs.roll_ball import RollBall
from raytac.envs.sb3 import TactileVecEnv


def played(env: TactileVecEnv, steps: int) -> list[tuple]:
    env.seed(3)
    first = {name: values.copy() for name, values in env.reset().items()}
    rng = np.random.default_rng(0)
    return [(first, None, None, None), *(env.step(rng.uniform(-1, 1, (env.num_envs, 3))) for _ in range(steps))]


def test_nothing_is_expected_from_beyond_a_failure() -> None:
    """PPO adds the value of what follows a ``TimeLimit.truncated``: an end by broken physics is none."""
    vector = RollBallVectorEnv(2, tactile=("wrench",), max_episode_steps=2)
    env = TactileVecEnv(vector)
    env.seed(3)
    env.reset()
    world = vector.batch.world
    world.data[1].qpos[world.composed.bodies["ball"].qpos + 2] += 9e-3  # through the gel above it
    _, reward, done, infos = env.step(np.zeros((2, 3)))
    assert done.tolist() == [False, True] and infos[1]["failed"] and not infos[1]["TimeLimit.truncated"] and reward[1] == 0.0
    _, _, done, infos = env.step(np.zeros((2, 3)))
    assert done[0] and infos[0]["TimeLimit.truncated"] and not infos[0]["failed"]


def test_it_is_the_vector_and_so_are_processes_of_it() -> None:
    options = {"tactile": ("wrench",), "max_episode_steps": 3}
    plain = RollBallVectorEnv(2, **options)
    first, _ = plain.reset(seed=3)
    alone, spread = (
        TactileVecEnv(RollBallVectorEnv(2, **options)),
        TactileVecEnv(ProcessVectorEnv(RollBallVectorEnv, 2, processes=2, **options)),
    )
    try:
        one, two = played(alone, 4), played(spread, 4)
    finally:
        spread.close()
    rng = np.random.default_rng(0)
    ended = 0
    for k, ((seen, reward, done, infos), (same, earned, over, told)) in enumerate(zip(one, two, strict=True)):
        if k:
            first, expected, terminated, truncated, _ = plain.step(rng.uniform(-1, 1, (2, 3)))
            np.testing.assert_allclose(reward, expected, rtol=1e-6)
            np.testing.assert_array_equal(done, terminated | truncated)
            np.testing.assert_array_equal(reward, earned)
            np.testing.assert_array_equal(done, over)
            for b in np.flatnonzero(done):
                assert infos[b]["TimeLimit.truncated"] and told[b]["TimeLimit.truncated"]
                assert not np.array_equal(infos[b]["terminal_observation"]["goal"], seen["goal"][b])
                np.testing.assert_array_equal(infos[b]["terminal_observation"]["state"], told[b]["terminal_observation"]["state"])
                ended += 1
        for name in first:
            np.testing.assert_array_equal(seen[name], first[name])
            np.testing.assert_array_equal(seen[name], same[name])
    assert ended == 2


def test_bad_input() -> None:
    with pytest.raises(InputError, match="SameStep"):
        TactileVecEnv(RollBallVectorEnv(1, tactile=None, autoreset_mode="NextStep"))


RECIPE = Recipe(
    "RollBall", "wrench", 0, 64, num_envs=2, n_steps=16, segment=1, history=2, n_epochs=2, batch_size=16, hidden=8
)  # two segments


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> int:
    """A fifth of the task's, for evaluations whose result does not matter."""
    monkeypatch.setattr(RollBall, "max_episode_steps", 30)
    return 30


def test_a_training_that_was_interrupted_ends_with_the_same_weights(tmp_path: Path, short_episodes: int) -> None:
    whole = Training(RECIPE, tmp_path / "whole", evaluation=1, say=lambda _: None)
    before = {name: value.clone() for name, value in whole.learner.model.policy.state_dict().items()}
    while not whole.is_done:
        whole.run_segment()
    first = Training(RECIPE, tmp_path / "cut", evaluation=1, say=lambda _: None)
    first.run_segment()
    with (tmp_path / "cut" / "progress.csv").open("a", encoding="utf-8") as file:
        file.write("48,9.0,0,,,,0.3\n")  # what a training that was killed may leave beyond its checkpoint
    first.close()
    second = Training(RECIPE, tmp_path / "cut", evaluation=1, say=lambda _: None)
    assert second.steps == 32 and not second.is_done
    second.run_segment()
    for name, value in whole.learner.model.policy.state_dict().items():
        assert np.array_equal(value, second.learner.model.policy.state_dict()[name]), name
        assert not name.endswith("weight") or not np.array_equal(value, before[name]), f"{name} was not trained"
    a, b = (Checkpoint.load(tmp_path / name / "checkpoint.pt") for name in ("whole", "cut"))
    assert (
        a.steps == b.steps == 64
        and a.normaliser["observation"]["state"]["count"] == b.normaliser["observation"]["state"]["count"]
    )
    for name in ("progress.csv", "evaluation.csv"):
        rows = [list(csv.DictReader((tmp_path / run / name).open(encoding="utf-8"))) for run in ("whole", "cut")]
        assert [row["steps"] for row in rows[0]] == [row["steps"] for row in rows[1]] == ["32", "64"]
    assert [row["return"] for row in rows[0]] == [row["return"] for row in rows[1]]
    whole.close()
    second.close()
    with pytest.raises(InputError, match="'gamma'"):
        Training(replace(RECIPE, gamma=0.5), tmp_path / "cut")


def test_a_second_training_stays_out_of_the_folder_of_the_first(tmp_path: Path, short_episodes: int) -> None:
    first = Training(RECIPE, tmp_path / "run", evaluation=1, say=lambda _: None)
    first.run_segment()
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    for recipe in (RECIPE, replace(RECIPE, seed=1)):
        with pytest.raises(InputError, match="in use by another run"):
            Training(recipe, tmp_path / "run", evaluation=1)
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    first.close()
    with pytest.raises(InputError, match="another recipe"):
        Training(replace(RECIPE, seed=1), tmp_path / "run")
    second = Training(RECIPE, tmp_path / "run", evaluation=1)  # the refusal gave the folder back
    assert second.steps == 32
    second.close()


def test_a_policy_is_saved_without_code_and_plays_the_same(tmp_path: Path, short_episodes: int) -> None:
    learner = Learner(RECIPE)
    observation = learner.normaliser.reset()
    learner.normaliser.step(np.zeros((2, 3)))  # so that the normaliser has statistics
    learner.checkpoint().save(tmp_path / "policy.pt", resumable=False)
    other = Learner(replace(RECIPE, seed=5))
    assert not np.array_equal(other.predict(observation), learner.predict(observation))  # type: ignore[arg-type]
    other.restore(Checkpoint.load(tmp_path / "policy.pt"))
    np.testing.assert_array_equal(other.predict(observation), learner.predict(observation))  # type: ignore[arg-type]
    mine, its = learner.normaliser.obs_rms, other.normaliser.obs_rms
    np.testing.assert_array_equal(mine["goal"].mean, its["goal"].mean)  # type: ignore[index]
    result = evaluate_learner(other, 3)
    assert result.episodes == 3 and result.mean_length <= short_episodes
    assert evaluate_learner(other, 1).episodes == 1
    (tmp_path / "wrong.pt").write_text("no checkpoint")
    for name in ("wrong.pt", "missing.pt"):
        with pytest.raises(InputError, match="checkpoint"):
            Checkpoint.load(tmp_path / name)


def test_a_pupil_learns_what_it_is_shown_and_in_the_same_way_each_time() -> None:
    recipe = replace(RECIPE, imitation_steps=64, total_timesteps=64, n_epochs=20, hidden=32, learning_rate=3e-3)
    one, two = Learner(recipe), Learner(recipe)
    for learner in (one, two):
        learner.normaliser.seed(1)
        imitate(learner)
    assert one.model.num_timesteps == 32
    for a, b in zip(one.model.policy.parameters(), two.model.policy.parameters(), strict=True):
        assert np.array_equal(a.detach(), b.detach())
    rng = np.random.default_rng(0)
    space = one.normaliser.observation_space
    seen = {name: rng.standard_normal((200, *box.shape)).astype(np.float32) for name, box in space.spaces.items()}  # type: ignore[attr-defined]
    wanted = np.tanh(seen["goal"][:, :3])
    errors = []
    for _ in range(12):
        errors.append(np.square(one.predict(seen) - wanted).mean())
        regress(one, seen, wanted, rng)
    assert errors[-1] < 0.2 * errors[0], errors
    with pytest.raises(InputError, match="while a scripted policy teaches"):
        Learner(replace(recipe, processes=2))


def test_time_of_imitation_counts_after_a_resume(tmp_path: Path) -> None:
    recipe = replace(RECIPE, tactile="none", imitation_steps=64)
    first = Training(recipe, tmp_path, evaluation=1, say=lambda _: None)
    first.run_segment()
    assert not (tmp_path / "progress.csv").exists(), "no rollout of PPO yet"
    first.close()
    second = Training(recipe, tmp_path, evaluation=1)
    assert second.wall_s == pytest.approx(first.wall_s, abs=0.01) and first.wall_s > 0.01
    second.close()


def test_modalities_by_name() -> None:
    assert tactile_settings("none", "48x36") is None and tactile_settings("task", "48x36") == "task"
    felt = tactile_settings("rgb+wrench", "40x50")
    assert isinstance(felt, ObservationSettings) and felt.modalities == ("rgb", "wrench") and felt.resolution == (40, 50)
    with pytest.raises(InputError, match=r"modalities = 'taste'.*rgb, markers"):
        tactile_settings("markers+taste", "48x36")
    with pytest.raises(InputError, match="task"):
        Learner(replace(RECIPE, task="Juggle"))


class Turning(gymnasium.Env):
    """Nothing but an angle; what is pressed comes from elsewhere."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.zeros(2, np.float32), float(action[0]), False, False, {}


def test_an_environment_of_ones_own_with_two_sensors_is_trained() -> None:
    """``AddTactile`` gives what ``MultiInputPolicy`` takes, at the smallest size of an image."""
    settings = ObservationSettings(("rgb", "wrench"), resolution=(SMALLEST_SIDE, SMALLEST_SIDE), optics="phong")
    observers = {name: TactileObserver("gelsight_mini", settings) for name in ("left", "right")}
    frame = observers["left"].make_sensor(device="cpu", pitch=0.4e-3).press("sphere")
    env = AddTactile(Turning(), observers, lambda: {"left": frame, "right": frame})
    check_env(env, warn=False)
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    assert {"observation", "left_rgb", "left_wrench", "right_rgb", "right_wrench"} == set(model.observation_space.spaces)  # type: ignore[attr-defined]
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(8)
    name = next(name for name in before if "left_rgb" in name and name.endswith("weight"))
    assert not np.array_equal(model.policy.state_dict()[name], before[name]), "the image was not learned from"


def test_the_smallest_image_is_what_the_network_takes() -> None:
    def network(height: int, width: int) -> None:
        CombinedExtractor(gymnasium.spaces.Dict({"rgb": gymnasium.spaces.Box(0, 255, (3, height, width), np.uint8)}))

    network(SMALLEST_SIDE, SMALLEST_SIDE)
    for height, width in ((SMALLEST_SIDE - 1, 64), (64, SMALLEST_SIDE - 1)):
        with pytest.raises(RuntimeError, match="Kernel size"):
            network(height, width)


def test_images_that_are_too_small_are_refused_with_the_smallest_size(tmp_path: Path) -> None:
    for size in ("32x32", "35x64", "64x35"):
        with pytest.raises(InputError, match=f"resolution = '{size}': .*takes 36x36 pixels or more"):
            train_ppo.main(train_ppo.Args(tactile="none,rgb", resolution=size, out=tmp_path / "out"))
        with pytest.raises(InputError, match="36x36"):
            Learner(replace(RECIPE, tactile="rgb", resolution=size))
    assert not (tmp_path / "out").exists()
    small = ObservationSettings(("rgb",), resolution=(64, 32), optics="phong")
    with pytest.raises(InputError, match=r"resolution = '64x32'.*36x36"):
        Learner(RECIPE, tactile=small)


def test_a_policy_that_sees_images_is_made_at_the_default_size() -> None:
    width, height = (int(side) for side in Recipe.resolution.split("x"))
    seen = ObservationSettings(("rgb",), resolution=(width, height), optics="phong")
    learner = Learner(replace(RECIPE, tactile="rgb"), tactile=seen, pitch=0.4e-3)
    assert learner.normaliser.observation_space["sensor_rgb"].shape == (height, width, 6)  # type: ignore[index]  # a history of 2
    assert np.isfinite(learner.predict(learner.normaliser.reset())).all()  # type: ignore[arg-type]
