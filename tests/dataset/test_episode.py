"""Episodes check their arrays, and record what an environment gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.dataset import Episode, record_episode
from raytac.errors import InputError


class Countdown:
    """Environment of Gymnasium's interface, without Gymnasium: ends when its number is 0."""

    def __init__(self, start: int = 3, **metadata: Any) -> None:
        self.metadata, self._start = metadata, start

    def _seen(self) -> dict[str, Any]:
        return {"number": np.float32(self._n), "touch": {"left": np.full((2, 2, 3), self._n, np.uint8)}}

    def reset(self, *, seed: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self._n = self._start if seed is None else seed
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self._n -= int(action[0])
        return self._seen(), 0.5 * self._n, self._n == 0, False, {"success": self._n == 0}


def by_one(observation: dict[str, Any]) -> np.ndarray:
    return np.array([1.0, observation["number"]], np.float32)


def test_a_frame_is_what_the_policy_saw_did_and_got() -> None:
    episode = record_episode(Countdown(render_fps=20), by_one, task="count down")
    assert len(episode) == 3 and episode.fps == 20.0 and episode.task == "count down"
    assert episode.arrays["number"].tolist() == [3.0, 2.0, 1.0]
    assert episode.arrays["touch.left"].shape == (3, 2, 2, 3) and episode.arrays["touch.left"].dtype == np.uint8
    assert episode.arrays["touch.left"][:, 0, 0, 0].tolist() == [3, 2, 1]
    np.testing.assert_array_equal(episode.arrays["action"], [[1, 3], [1, 2], [1, 1]])
    assert episode.arrays["reward"].tolist() == [1.0, 0.5, 0.0]
    assert episode.arrays["terminated"].tolist() == episode.arrays["success"].tolist() == [False, False, True]
    np.testing.assert_allclose(episode.time, [0.0, 0.05, 0.1])


def test_seed_length_and_rate_are_the_callers() -> None:
    episode = record_episode(Countdown(), by_one, seed=9, fps=5, max_steps=4)
    assert len(episode) == 4 and episode.fps == 5.0 and episode.arrays["number"].tolist() == [9.0, 8.0, 7.0, 6.0]
    with pytest.raises(InputError, match="no render_fps"):
        record_episode(Countdown(), by_one)
    with pytest.raises(InputError, match="max_steps = 0"):
        record_episode(Countdown(render_fps=20), by_one, max_steps=0)


class Named(Countdown):
    def _seen(self) -> dict[str, Any]:
        return {"number": 1.0, "reward": 2.0}


def test_an_observation_must_not_be_called_like_a_reward() -> None:
    with pytest.raises(InputError, match="observation = 'reward'"):
        record_episode(Named(render_fps=1), by_one)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"arrays": {}}, "at least one array"),
        ({"arrays": {"x": np.zeros(3), "y": np.zeros(2)}}, "as many frames as the others, 3"),
        ({"arrays": {"x": np.zeros(())}}, "time first"),
        ({"arrays": {"x": np.zeros((0, 2))}}, "time first"),
        ({"arrays": {"x": np.array(["a"])}}, "must be numbers"),
        ({"arrays": {"a/b": np.zeros(3)}}, "without '/'"),
        ({"arrays": {"x": np.zeros(3)}, "facts": {"x": 1}}, "must not have the name of an array"),
        ({"arrays": {"x": np.zeros(3)}, "facts": {"y": [1]}}, "a text or a number"),
        ({"arrays": {"x": np.zeros(3)}, "fps": 0.0}, "fps"),
    ],
)
def test_what_is_no_episode_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Episode(**{"fps": 10.0, **arguments})
