"""``ProcessVectorEnv``: numbers, ends and infos are those of one vector; seeds differ; errors come back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.envs import ProcessVectorEnv, RollBallVectorEnv
from raytac.errors import InputError
from tests.envs.seeds import Seeds

OPTIONS: dict[str, Any] = {"tactile": ("wrench",), "max_episode_steps": 3}


def check_equal(one: Any, other: Any) -> None:
    """The same names and values, in dictionaries of dictionaries, and in objects, which are observations or None."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            check_equal(one[name], other[name])
    elif isinstance(one, np.ndarray) and one.dtype == object:
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert (a is None) == (b is None)
            if a is not None:
                check_equal(a, b)
    else:
        np.testing.assert_array_equal(one, other)


def test_processes_are_one_vector() -> None:
    """Also where one environment's episode ends alone, in a process whose neighbour has no final observation."""
    plain, spread = RollBallVectorEnv(2, **OPTIONS), ProcessVectorEnv(RollBallVectorEnv, 2, processes=2, **OPTIONS)
    try:
        assert spread.metadata["autoreset_mode"] == plain.metadata["autoreset_mode"]
        assert spread.observation_space == plain.observation_space and spread.action_space == plain.action_space
        check_equal(plain.reset(seed=3)[0], spread.reset(seed=3)[0])
        rng, ends = np.random.default_rng(0), []
        for k in range(7):
            if k == 1:
                mask = {"reset_mask": np.array([False, True])}
                check_equal(plain.reset(options=mask)[0], spread.reset(options=mask)[0])
            actions = rng.uniform(-1.0, 1.0, (2, 3))
            one, two = plain.step(actions), spread.step(actions)
            check_equal(dict(enumerate(one)), dict(enumerate(two)))
            ends.append((one[2] | one[3]).tolist())
        assert [True, False] in ends and [False, True] in ends, "the case that is tested has occurred"
    finally:
        spread.close()
    with pytest.raises(InputError, match="after close"):
        spread.step(np.zeros((2, 3)))


def test_no_two_environments_have_the_same_seed() -> None:
    env = ProcessVectorEnv(Seeds, 6, processes=2, seed=5)  # type: ignore[arg-type]
    try:
        assert env.reset()[0]["seed"].tolist() == [5, 6, 7, 8, 9, 10]
    finally:
        env.close()


def test_bad_input_comes_back() -> None:
    with pytest.raises(InputError, match="multiple of the number of processes"):
        ProcessVectorEnv(RollBallVectorEnv, 3, processes=2)
    with pytest.raises(InputError, match="modalities = 'taste': must be a known name"):
        ProcessVectorEnv(RollBallVectorEnv, 2, processes=1, tactile=("taste",))
    env = ProcessVectorEnv(RollBallVectorEnv, 2, processes=2, tactile=None)
    try:
        with pytest.raises(InputError, match="first reset"):
            env.reset(options={"reset_mask": np.array([True, False])})
        env.reset()
        with pytest.raises(InputError, match="must be one, or one for each of 2"):
            env.reset(seed=[1, 2, 3])
        actions = np.zeros((2, 3))
        actions[1, 2] = np.nan
        with pytest.raises(InputError, match="environment 1"):
            env.step(actions)
        with pytest.raises(InputError, match="must have the shape"):
            env.step(np.zeros((3, 3)))
        actions[1, 2] = 2.0
        with pytest.raises(InputError, match="must be finite and in") as caught:
            env.step(actions)
        assert "environments 1 to 1, in process 1" in caught.value.__notes__[0]
        assert env.step(np.zeros((2, 3)))[1].shape == (2,), "it goes on after a refused step"
    finally:
        env.close()
