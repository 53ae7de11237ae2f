"""A policy that ``train_gpu.py`` has written, to be played."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import raytac.envs
from experiments.tensor_file import read_tensors
from raytac.envs import FlatVector
from raytac.errors import InputError

__all__ = ["FlatPolicy"]


_EPSILON = 1e-2
"""Added to the deviation of an observation, as rsl_rl's ``EmpiricalNormalization`` does."""


class FlatPolicy:
    """Deterministic actions (B, k) from the observation ``actor`` (B, n) of a ``FlatVector``.

    It is rsl_rl's network in NumPy, so that a policy plays without PyTorch: normalised observations, then layers with ELU in between.

    Attributes:
        task, touch, history, physics: what it was trained with, in the words of ``train_gpu.py``.
    """

    def __init__(self, path: Path) -> None:
        """Load a ``policy.pt``. Raises ``InputError`` for a file that is none."""
        saved = read_tensors(path)
        try:
            settings, weights = saved["settings"], saved["actor_state_dict"]
            self.task, self.touch, self.history = str(settings["task"]), str(settings["touch"]), int(settings["history"])
            self.physics = str(settings.get("physics", "rigid"))
            self._mean, self._deviation = weights["obs_normalizer._mean"], weights["obs_normalizer._std"]
            names = sorted((name for name in weights if name.startswith("mlp.") and name.endswith(".weight")), key=_layer)
            self._layers = [(weights[name].T, weights[name.replace("weight", "bias")]) for name in names]
            sizes = [self._mean.shape[1], *(len(bias) for _, bias in self._layers)]
            if [weight.shape for weight, _ in self._layers] != list(itertools.pairwise(sizes)):
                raise ValueError("its layers do not fit each other")
        except Exception as error:
            raise InputError("policy", value=path, rule=f"must be a policy of train_gpu ({error})") from error

    @staticmethod
    def is_one(path: Path) -> bool:
        """Whether the file says of itself that ``train_gpu.py`` has written it."""
        try:
            return "actor_state_dict" in read_tensors(path)
        except InputError:
            return False  # whoever loads it says what is wrong

    @property
    def tactile(self) -> Any:
        """What ``TaskBatch`` takes for what is felt."""
        return {"none": None, "task": "task"}.get(self.touch, tuple(self.touch.split("+")))

    def vector(self, num_envs: int, *, hidden: Sequence[str] = (), **options: Any) -> FlatVector:
        """Environments of its task, observed as it was trained; ``options`` of ``TactileVectorEnv`` in place of those."""
        kind = getattr(raytac.envs, f"{self.task}VectorEnv")
        return FlatVector(
            kind, num_envs, history=self.history, hidden=hidden, **{"tactile": self.tactile, "physics": self.physics, **options}
        )

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        values = (observation - self._mean) / (self._deviation + _EPSILON)
        for k, (weight, bias) in enumerate(self._layers):
            if k:
                values = np.where(values > 0.0, values, np.expm1(np.minimum(values, 0.0)))
            values = values @ weight + bias
        return values


def _layer(name: str) -> int:
    """Number of a layer in the name of its weights, ``mlp.<number>.weight``."""
    return int(name.split(".")[1])
