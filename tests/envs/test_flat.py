"""Flat observations of policy and critic, their history, and episodes that are ended early."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.envs import PushCubeVectorEnv, RollBallVectorEnv
from raytac.envs.flat import FlatVector
from raytac.errors import InputError


def test_the_critic_is_given_what_the_policy_is_not() -> None:
    many = FlatVector(RollBallVectorEnv, 2, tactile=None)
    many.reset(3)
    many.buffers["action"][:, 2] = -1.0
    for _ in range(3):
        many.step()
    plain = RollBallVectorEnv(2, tactile=None, body_seen=True)
    plain.reset(seed=[3, 4])
    for _ in range(3):
        seen, reward, *_, infos = plain.step(many.buffers["action"])
    state = plain.batch.world.state()
    wrench = state.wrench["sensor"] / ([10.0] * 3 + [0.1] * 3)
    assert (wrench[:, 2] < 0.0).any(), "nothing was touched"
    np.testing.assert_array_equal(many.buffers["actor"], np.hstack([seen["state"], seen["goal"]]))
    np.testing.assert_allclose(many.buffers["critic"], np.hstack([seen["state"], seen["goal"], seen["body"], wrench]), rtol=1e-6)
    np.testing.assert_allclose(many.buffers["reward"], reward, rtol=1e-6)
    terms = dict(zip(many.layout.terms, many.buffers["terms"].T, strict=True))
    np.testing.assert_allclose(terms["goal_fine"], infos["reward_terms"]["goal_fine"], rtol=1e-6)
    np.testing.assert_allclose(many.buffers["terms"].sum(axis=1), reward, rtol=1e-5)
    assert PushCubeVectorEnv.task.body_seen and many.layout.fields["actor"] == (15,)
    shown = FlatVector(RollBallVectorEnv, 2, tactile=None, body_seen=True)
    assert shown.layout.fields["actor"] == (30,) and shown.layout.fields["critic"] == (30 + 15 + 6,)


def test_history_is_newest_first_and_does_not_reach_into_the_episode_before() -> None:
    many = FlatVector(RollBallVectorEnv, 2, history=3, tactile=None, max_episode_steps=4)
    many.reset(0)
    begun = many.buffers["actor"].reshape(2, 3, -1).copy()
    np.testing.assert_array_equal(begun[:, 0], begun[:, 2])
    many.buffers["age"][:] = [0.0, 2.0]
    seen = [begun[:, 0]]
    many.buffers["action"][:] = 0.3
    for _ in range(2):
        many.step()
        seen.append(many.buffers["actor"].reshape(2, 3, -1)[:, 0].copy())
    now = many.buffers["actor"].reshape(2, 3, -1)
    np.testing.assert_array_equal(now[0], [seen[2][0], seen[1][0], seen[0][0]])
    assert many.buffers["truncated"].tolist() == [0.0, 1.0] and many.buffers["age"].tolist() == [2.0, 0.0]
    np.testing.assert_array_equal(now[1], [seen[2][1]] * 3)
    np.testing.assert_array_equal(now[1, 0, :12], 0.0)  # at its start
    many.step()
    many.step()
    assert many.buffers["truncated"].tolist() == [1.0, 0.0] and many.buffers["age"].tolist() == [0.0, 2.0]


@pytest.mark.renderer
def test_what_is_hidden_is_for_pictures_alone() -> None:
    options = {"tactile": ("markers", "wrench"), "max_episode_steps": 3}
    all_seen, some = FlatVector(RollBallVectorEnv, 1, **options), FlatVector(RollBallVectorEnv, 1, hidden=("markers",), **options)
    assert all_seen.layout.fields["actor"] == (15 + 6 + 198,) and some.layout.fields["actor"] == (15 + 6,)


def test_actions_are_cut_to_the_range_and_must_be_finite() -> None:
    many = FlatVector(RollBallVectorEnv, 2, tactile=None)
    many.reset(0)
    many.buffers["action"][:] = [[3.0, 0.0, 0.0], [-9.0, 0.0, 0.0]]
    many.step()
    np.testing.assert_array_equal(many.env.batch.action[:, 0], [1.0, -1.0])
    many.buffers["action"][1, 0] = np.nan
    with pytest.raises(InputError, match="environment 1"):
        many.step()
    with pytest.raises(InputError, match="history"):
        FlatVector(RollBallVectorEnv, 2, history=0)
