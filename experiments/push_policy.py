"""Pushes the cube of a vector of ``PushCube`` environments; the same for every checkout that is timed.

Only what all of them offer is imported.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from raytac.observe import ObservationSettings

MODES: dict[str, ObservationSettings | None] = {
    "none": None,
    "fots": ObservationSettings(("markers",)),
    "touch": ObservationSettings(("markers", "wrench")),
    "table32": ObservationSettings(("rgb",), resolution=(32, 32), optics="taxim"),
    "raytrace64": ObservationSettings(("rgb",), resolution=(64, 64), optics="raytrace"),
    "raytrace320": ObservationSettings(("rgb",), resolution=(320, 240), optics="raytrace"),
}
"""What is observed, by its name in keys."""


class Policy:
    """Two hidden layers of 64 with tanh on all observations, flat."""

    def __init__(self, observation: dict[str, np.ndarray], actions: int) -> None:
        rng, size = np.random.default_rng(0), self.flat(observation).shape[1]
        sizes = (size, 64, 64, actions)
        self.weights = [rng.normal(0.0, a**-0.5, (a, b)).astype(np.float32) for a, b in itertools.pairwise(sizes)]

    @staticmethod
    def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate(
            [v.reshape(len(v), -1) / np.float32(255 if v.dtype == np.uint8 else 1) for v in observation.values()], axis=1
        )

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        values = self.flat(observation)
        for weights in self.weights:
            values = np.tanh(values @ weights)
        return values.astype(float)


class Pusher:
    """Steps of a vector of environments by the policy, whose pads press with about 1 N.

    Attributes:
        force: normal force on every pad before the last action [N], (B,).
    """

    def __init__(self, env: Any, seed: int) -> None:
        """Reset ``env``, a ``PushCubeVectorEnv``."""
        self.env, self.force = env, np.zeros(env.num_envs)
        self._observation, _ = env.reset(seed=seed)
        self._policy = Policy(self._observation, env.single_action_space.shape[0])

    def action(self) -> np.ndarray:
        """The next actions (B, 3)."""
        action = self._policy(self._observation)
        self.force = -self.env.batch.world.state().wrench["sensor"][:, 2]
        action[:, :2] *= 0.1  # so that the pad stays on the cube
        action[:, 2] = np.clip(0.3 * (self.force - 1.0), -1.0, 1.0)
        return action

    def step(self) -> None:
        """One control step of all environments."""
        self.take(self.action())

    def take(self, action: np.ndarray) -> None:
        """One control step with given actions."""
        self._observation = self.env.step(action)[0]
