"""Environments for rsl_rl and training with them: the same numbers in processes, ends, exact resuming, bad options."""

# pyright: reportMissingImports=false
# (rsl_rl and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rsl_rl.algorithms", exc_type=ImportError)

import torch

from raytac.cli import main
from raytac.envs import SCRIPTED, FlatPolicy, RollBallVectorEnv
from raytac.envs.rsl import RslVecEnv
from raytac.errors import InputError
from raytac.io import read_metrics
from raytac.learn import STEPS, PolicyPlayer, PpoSettings, Training, shipped_policies, success_rate, train_policies

OPTIONS = {"tactile": ("wrench",), "max_episode_steps": 4}
SMALL = PpoSettings(task="RollBall", num_envs=4, rollout=4, minibatches=2, epochs=2, episodes=4, hidden=8, evaluate_every=32)


def trained(out: Path, **options: object) -> dict:
    return train_policies(replace(SMALL, **options), out, device="cpu")  # type: ignore[arg-type]


def played(env: RslVecEnv) -> list[torch.Tensor]:
    seen = env.reset(3)
    env.episode_length_buf = torch.arange(4)
    found, rng = [seen["actor"], seen["critic"]], np.random.default_rng(0)
    for _ in range(6):
        actions = torch.from_numpy(rng.uniform(-1.5, 1.5, (4, 3)))
        seen, reward, done, extras = env.step(actions)
        found += [seen["actor"], seen["critic"], reward, done, extras["time_outs"], env.episode_length_buf]
    return found


def test_processes_give_the_numbers_of_one() -> None:
    alone = RslVecEnv(RollBallVectorEnv, num_envs=4, history=2, **OPTIONS)
    spread = RslVecEnv(RollBallVectorEnv, num_envs=4, history=2, processes=2, **OPTIONS)
    try:
        one, two = played(alone), played(spread)
        with pytest.raises(InputError, match="environment 3"):
            spread.step(torch.zeros(4, 3).index_fill(0, torch.tensor([3]), torch.nan))
    finally:
        spread.close()
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    dones = torch.stack(one[5::6])
    assert dones.sum(0).tolist() == [1, 1, 2, 2] and not torch.equal(dones[0], dones[1])


def test_nothing_is_expected_from_beyond_a_failure() -> None:
    env = RslVecEnv(RollBallVectorEnv, num_envs=2, tactile=None, max_episode_steps=2)
    env.reset(3)
    world = env._vector.env.batch.world  # type: ignore[union-attr]
    world.data[1].qpos[world.composed.bodies["ball"].qpos + 2] += 9e-3  # through the gel above it
    _, reward, done, extras = env.step(torch.zeros(2, 3))
    assert done.tolist() == [0, 1] and extras["failed"].tolist() == [0, 1]
    assert extras["time_outs"].tolist() == [0, 0] and reward[1] == 0.0
    _, _, done, extras = env.step(torch.zeros(2, 3))
    assert done[0] == 1.0 == extras["time_outs"][0]


def test_a_training_that_was_cut_ends_as_one_that_was_not(tmp_path: Path) -> None:
    whole = trained(tmp_path / "whole", steps=64)
    trained(tmp_path / "cut", steps=32)
    resumed = trained(tmp_path / "cut", steps=64)
    assert whole["wrench.seed0.env_steps"] == resumed["wrench.seed0.env_steps"] == 64
    one, two = (torch.load(tmp_path / name / "wrench/seed0/checkpoint.pt", weights_only=True) for name in ("whole", "cut"))
    for name in ("actor_state_dict", "critic_state_dict"):
        for key, tensor in one[name].items():
            assert torch.equal(tensor, two[name][key]), key
    first = torch.load(tmp_path / "cut/wrench/seed0/policy.pt", weights_only=True)
    assert (tmp_path / "cut/wrench/seed0/policy.pt").stat().st_size < 2e6 and first["settings"]["history"] == 3
    player = PolicyPlayer(tmp_path / "cut/wrench/seed0/policy.pt")
    rated = success_rate(player, 3)
    assert (player.task, rated.episodes) == ("RollBall", 3) and rated.mean_length > 1
    with pytest.raises(InputError, match="'hidden': 8"):
        trained(tmp_path / "cut", hidden=9)
    again = trained(tmp_path / "cut", steps=64)
    for name in ("minutes", "env_steps_per_s", "success"):
        assert again[f"wrench.seed0.{name}"] == resumed[f"wrench.seed0.{name}"], name
    assert len((tmp_path / "cut/wrench/seed0/evaluation.csv").read_text().splitlines()) == 3
    for wrong in ({"history": 0}, {"steps": -5}, {"touch": "wrench,taste"}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            replace(SMALL, **wrong)


def test_every_task_has_steps_to_train_for() -> None:
    assert set(STEPS) == set(SCRIPTED)


def test_observations_are_there_before_a_reset() -> None:
    env = RslVecEnv(RollBallVectorEnv, num_envs=2, tactile=("wrench",), seed=3)
    first = env.get_observations()
    assert first["actor"].abs().sum() > 0.0
    torch.testing.assert_close(env.reset(3), first)


def test_metrics_are_of_the_worst_seed_of_the_first_touch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    successes = iter([3, 1, 0, 0])
    played = Training.evaluate
    monkeypatch.setattr(Training, "evaluate", lambda self, *a, **k: replace(played(self, *a, **k), successes=next(successes)))
    found = trained(tmp_path, steps=16, seeds="0,1", touch="none,wrench")
    speeds = [float(found[f"none.seed{k}.train_env_steps_per_s"]) for k in (0, 1)]  # type: ignore[arg-type]
    assert found["cpu.train.env_steps_per_s"] == min(speeds) > 0.0 and found["none.seed0.worlds"] == "mujoco"
    assert found["cpu.RollBall.success"] == 0.25 and found["none.seed0.success"] == 0.75 and found["wrench.seed1.success"] == 0.0
    assert read_metrics(tmp_path / "metrics.json") == found
    rows = (tmp_path / "none/seed0/evaluation.csv").read_text().splitlines()
    assert len(rows) == 2 and rows[1].startswith("16,")


def test_a_policy_does_what_it_did_in_training(tmp_path: Path) -> None:
    trained(tmp_path, steps=16, touch="none")
    policy = FlatPolicy(tmp_path / "none/seed0/policy.pt")
    training = Training(SMALL, "none", 0, tmp_path / "none/seed0", "cpu")
    played = policy.vector(4)
    seen = training.env.reset(5)
    played.reset(5)
    for _ in range(3):
        actions = training.ppo.get_policy()(seen).detach()
        np.testing.assert_allclose(policy(played.buffers["actor"]), actions, atol=1e-6)
        played.buffers["action"][:] = actions
        played.step()
        seen, *_ = training.env.step(actions)
    training.close()
    (tmp_path / "other.pt").write_bytes(b"no policy")
    assert not FlatPolicy.is_one(tmp_path / "other.pt")
    with pytest.raises(InputError, match="must be a file of torch"):
        FlatPolicy(tmp_path / "other.pt")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"task": "Juggle"}, "PushCube"),
        ({"deviation_floor": 0.0}, "deviation_floor"),
        ({"gamma": 1.5}, "gamma"),
        ({"processes": -1}, "processes"),
        ({"seeds": "one"}, "seeds"),
        ({"touch": "taste"}, "taste"),
        ({"num_envs": 4, "processes": 3}, "multiple"),
    ],
)
def test_bad_options_are_named(tmp_path: Path, options: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        trained(tmp_path / "out", **options)


def test_policies_that_are_shipped_fit_their_environments() -> None:
    assert len(shipped_policies()) >= 4
    for path in shipped_policies().values():
        assert path.stat().st_size < 2e6 and FlatPolicy.is_one(path)
        policy = FlatPolicy(path)
        vector = policy.vector(1)
        actions = policy(vector.buffers["actor"])
        assert actions.shape == vector.buffers["action"].shape and np.isfinite(actions).all()


def test_the_command_trains_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = "--num-envs 4 --rollout 4 --minibatches 2 --epochs 1 --episodes 2 --hidden 8 --device cpu"
    asked = ["train", "--task", "RollBall", *small.split(), "--out", str(tmp_path)]
    assert main([*asked, "--steps", "16"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "metrics.json")
    assert PolicyPlayer(tmp_path / "wrench/seed0/policy.pt").task == "RollBall"
    assert main([*asked, "--steps", "32"]) == 0 and main([*asked, "--steps", "32"]) == 0
    assert "done before" in capsys.readouterr().err
    assert read_metrics(tmp_path / "metrics.json")["wrench.seed0.env_steps"] == 32
    assert main([*asked, "--gamma", "1.5"]) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("raytac: error: gamma = 1.5")
    assert main([*asked, "--touch", "none,taste"]) == 2
