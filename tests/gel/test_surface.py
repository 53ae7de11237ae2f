"""Choices of environments."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import chosen_envs


def test_a_mask_a_list_and_none_name_environments() -> None:
    assert chosen_envs(None, 3) == [0, 1, 2]
    assert chosen_envs(np.array([True, False, True]), 3) == chosen_envs([0, 2], 3) == [0, 2]
    assert chosen_envs([2, 0], 3) == [2, 0]  # in its order: starts are given in it
    assert chosen_envs([], 3) == chosen_envs([False] * 3, 3) == []


@pytest.mark.parametrize("bad", [[3], [-1], [0.5], [True, False], np.ones((3, 1), bool)])
def test_environments_that_are_not_there(bad: object) -> None:
    with pytest.raises(InputError, match="envs"):
        chosen_envs(bad, 3)  # type: ignore[arg-type]
