"""Checks of what vectors of environments are given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError


def check_open(closed: bool) -> None:
    """Raise ``InputError`` for an environment after ``close``."""
    if closed:
        raise InputError("environment", value="closed", rule="must not be used after close(): make another")


def env_seeds(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """Seed of each of B environments; None for one that keeps its random stream.

    One number gives ``seed`` + b. Raises ``InputError``: seeds of another number than environments.
    """
    if seed is None:
        return [None] * num_envs
    seeds = [seed + b for b in range(num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
    if len(seeds) != num_envs:
        raise InputError("seed", value=len(seeds), rule=f"must be one, or one for each of {num_envs} environments")
    return [None if one is None else int(one) for one in seeds]


def check_finite_actions(actions: np.ndarray) -> None:
    """Raise ``InputError`` for actions (B, k) that are not finite; it names an environment."""
    bad = np.argwhere(~np.isfinite(actions))
    if len(bad):
        env = int(bad[0, 0])
        raise InputError("actions", value=actions[env].tolist(), rule=f"must be finite; in environment {env} they are not")
