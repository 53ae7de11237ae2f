"""A vector of environments that only tell their seeds; processes that import this file import no PyTorch."""

from __future__ import annotations

from typing import ClassVar

import gymnasium
import numpy as np


class Seeds:
    """In place of a vector: what environments see is the seed that each had when the vector was made."""

    single_observation_space = gymnasium.spaces.Dict({"seed": gymnasium.spaces.Box(0, 99, (), np.int64)})
    single_action_space = gymnasium.spaces.Box(-1, 1, (3,))
    metadata: ClassVar[dict] = {}

    def __init__(self, num_envs: int, seed: int) -> None:
        self.seeds = seed + np.arange(num_envs)

    def reset(self, seed: list[int | None], options: dict | None) -> tuple[dict[str, np.ndarray], dict]:
        return {"seed": self.seeds}, {}

    def step(self, actions: np.ndarray) -> None:
        """Never asked for."""
