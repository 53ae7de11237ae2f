"""Tasks on MuJoCo Warp: the same episodes as on C MuJoCo, and as environments of rsl_rl."""

# pyright: reportMissingImports=false
# (MuJoCo Warp, rsl_rl and PyTorch belong to extras, which the tests do without.)

from __future__ import annotations

import numpy as np
import pytest

from raytac.envs import (
    SCRIPTED,
    BalancePole,
    InsertPeg,
    LiftCube,
    OpenDrawer,
    PushCube,
    RollBall,
    RollBallVectorEnv,
    Task,
    TaskBatch,
)
from raytac.errors import InputError

pytest.importorskip("mujoco_warp")
pytest.importorskip("torch")
import torch

from raytac.envs.warp_batch import WarpBatch

SLOW = [
    pytest.param(kind, steps, marks=pytest.mark.slow) for kind, steps in ((LiftCube, 150), (InsertPeg, 90), (OpenDrawer, 120))
]


class Drawn:
    """Generator that gives numbers drawn before."""

    def __init__(self, numbers: np.ndarray) -> None:
        self._numbers = numbers

    def random(self, count: int) -> np.ndarray:
        return self._numbers[:count]


@pytest.mark.parametrize(("kind", "steps"), [(PushCube, 40), (RollBall, 30), (BalancePole, 30), *SLOW])
def test_an_episode_is_that_of_c_mujoco(kind: type[Task], steps: int) -> None:
    """In two environments, with the actions of a scripted policy on C MuJoCo: tool and body to 0.5 mm, contacts on the same steps, give or
    take one, and forces of contacts that last to 3 %. (A peg that meets its socket's rim is not repeatable.)
    """
    ours = WarpBatch(kind(), num_envs=2, tactile=("wrench",), device="cpu", body_seen=True)
    other = TaskBatch(kind(), num_envs=2, tactile=("wrench",), device="cpu", body_seen=True)
    u = torch.rand(2, kind.draws, generator=torch.Generator().manual_seed(7), dtype=torch.float64).numpy()
    seen, expected = ours.reset(7), other.reset([0, 1], [Drawn(row) for row in u])  # type: ignore[list-item]
    assert list(seen) == list(other.arrays) and all(seen[name].dtype == torch.float32 for name in seen)
    for name, array in expected.items():
        np.testing.assert_allclose(seen[name].numpy(), array, atol=2e-5, err_msg=name)
    wrenches = []
    for k in range(steps):
        actions = SCRIPTED[kind.__name__](other)
        step, wanted = ours.step(torch.asarray(actions)), other.step(actions)
        assert list(step.terms) == list(wanted.terms) and not step.failed.any() and not wanted.failed.any()
        np.testing.assert_array_equal(step.terminated.numpy(), wanted.terminated)
        assert not step.truncated.any() and step.reward.dtype == torch.float64
        for name in ("goal", "body"):  # in units of 0.1 m
            apart = np.abs(step.observation[name].numpy() - wanted.observation[name])[:, :3].max()
            assert apart < 5e-3, (k, name, apart)
        np.testing.assert_allclose(step.observation["state"][:, -ours.size :].numpy(), actions, atol=1e-6)
        wrench = other.world.state().wrench
        wrenches.append([np.concatenate([wrench[name], ours.wrench[name].numpy()], axis=1) for name in wrench])
    ours.check()
    both = np.array(wrenches)
    forces, found = both[..., :3], both[..., 6:9]
    touch, other_touch = (np.linalg.norm(one, axis=-1) > 0.05 for one in (found, forces))
    for one, two in ((touch, other_touch), (other_touch, touch)):
        near = two[1:-1] | two[:-2] | two[2:]
        assert not (one[1:-1] & ~near).any()
    # A step earlier or later at the first touch is another force in the steps after it.
    settled = np.lib.stride_tricks.sliding_window_view(touch & other_touch, 6, axis=0).all(axis=-1)
    assert settled.any(axis=0).all()
    assert np.linalg.norm((found - forces)[5:][settled]) < 0.03 * np.linalg.norm(forces[5:][settled])


def test_an_episode_that_ends_begins_again_and_the_others_go_on() -> None:
    batch = WarpBatch(RollBall(), num_envs=3, tactile=None, device="cpu", max_episode_steps=6)
    first = {name: array.clone() for name, array in batch.reset(3).items()}
    batch.steps += torch.tensor([0, 3, 0])
    still = torch.zeros(3, 3)
    for k in range(6):
        step = batch.step(still)
        assert step.truncated.tolist() == [k == 5, k == 2, k == 5] and not step.terminated.any()
        if k == 2:
            np.testing.assert_array_equal(batch.steps.numpy(), [3, 0, 3])
            np.testing.assert_array_equal(step.observation["state"][1].numpy(), 0.0)
            assert not torch.equal(step.observation["goal"][1], first["goal"][1])
            torch.testing.assert_close(step.observation["goal"][[0, 2]], first["goal"][[0, 2]], rtol=0, atol=1e-4)
    again = batch.reset(3)
    torch.testing.assert_close(again, first, rtol=0, atol=0)
    with pytest.raises(InputError, match="actions"):
        batch.step(torch.zeros(2, 3))
    with pytest.raises(InputError, match="reset"):
        WarpBatch(RollBall(), num_envs=3, tactile=None, device="cpu").step(still)


@pytest.mark.renderer  # markers
def test_rsl_rl_trains_on_observations_of_the_same_sizes() -> None:
    """Markers, in four environments, for 30 steps of episodes of 12."""
    pytest.importorskip("rsl_rl.env", exc_type=ImportError)
    from raytac.envs.rsl import RslVecEnv, RslWarpEnv

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
