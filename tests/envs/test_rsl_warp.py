"""Tasks on MuJoCo Warp as environments of rsl_rl: sizes, ends, history."""

# pyright: reportMissingImports=false
# (MuJoCo Warp, rsl_rl and PyTorch belong to extras, which the tests do without.)

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco_warp")
pytest.importorskip("rsl_rl.algorithms", exc_type=ImportError)

import torch

from raytac.envs import FlatPolicy, RollBallVectorEnv
from raytac.envs.rsl import RslVecEnv, RslWarpEnv
from raytac.learn import PpoSettings, train_policies

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes


def test_rsl_rl_trains_on_observations_of_the_same_sizes() -> None:
    """Markers, in four environments, for 30 steps of episodes of 12."""
    options = {"num_envs": 4, "history": 2, "tactile": ("markers",), "max_episode_steps": 12}
    env = RslWarpEnv(RollBallVectorEnv, device="cpu", reward_scale=0.5, **options)
    sizes = {name: array.shape for name, array in RslVecEnv(RollBallVectorEnv, **options).reset(3).items()}
    assert {name: array.shape for name, array in env.reset(3).items()} == sizes
    actor = sizes["actor"][1]
    actions = torch.tensor([[0.0, 0.0, -1.0]] * 3 + [[0.0, 0.0, 1.0]])
    ends, marked = torch.zeros(4), torch.zeros(4)
    for k in range(30):
        seen, reward, done, extras = env.step(actions)
        assert all(array.shape == sizes[name] and array.dtype == torch.float32 for name, array in seen.items())
        assert all(torch.isfinite(array).all() for array in (seen["actor"], seen["critic"], reward))
        logged = sum(float(value) for value in extras["log"].values())
        assert logged == pytest.approx(2.0 * float(reward.mean()), rel=1e-6)
        assert done.tolist() == [float(k % 12 == 11)] * 4 == extras["time_outs"].tolist()
        half = seen["actor"].reshape(4, 2, actor // 2)
        begun = bool(done[0])
        assert torch.equal(half[:, 0], half[:, 1]) == begun, "of an episode that begins, the history holds the first observation"
        markers = half[:, 0, -2 * 99 :].abs().amax(dim=1)
        assert not begun or not markers.any()
        ends, marked = ends + done, torch.maximum(marked, markers)
        assert torch.equal(seen["critic"][:, :actor], seen["actor"])
    assert ends.tolist() == [2.0] * 4 and (marked[:3] > 0.01).all() and marked[3] == 0.0
    env.episode_length_buf = torch.full((4,), 11)
    assert env.step(actions)[2].tolist() == [1.0] * 4 and env.episode_length_buf.tolist() == [0] * 4
    env.close()


def test_a_training_on_mujoco_warp_writes_what_the_benchmarks_ask_for(tmp_path: Path) -> None:
    """One iteration in four worlds, with markers and wrench, and its policy is played."""
    args = PpoSettings(
        task="PushCube", touch="markers+wrench", worlds="mujoco_warp", num_envs=4, rollout=4, steps=16, minibatches=2, epochs=1,
        episodes=2, hidden=8,
    )  # fmt: skip
    found = train_policies(args, tmp_path, device="cpu")
    assert 0.0 <= float(found["cpu.PushCube.success"]) <= 1.0 and float(found["cpu.PushCube.minutes"]) > 0.0
    assert float(found["cpu.train.env_steps_per_s"]) > 0.0 and found["markers_wrench.seed0.worlds"] == "mujoco_warp"
    assert FlatPolicy(tmp_path / "markers+wrench/seed0/policy.pt").tactile == ("markers", "wrench")
