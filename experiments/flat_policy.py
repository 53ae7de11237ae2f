"""A policy that ``train_gpu.py`` has written, to be played."""

# pyright: reportMissingImports=false
# (rsl_rl and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

import raytac.envs
from raytac.envs import FlatVector
from raytac.errors import InputError

__all__ = ["FlatPolicy"]


class FlatPolicy:
    """Deterministic actions (B, k) from the observation ``actor`` (B, n) of a ``FlatVector``.

    Attributes:
        task, touch, history, physics: what it was trained with, in the words of ``train_gpu.py``.
    """

    def __init__(self, path: Path) -> None:
        """Load a ``policy.pt``. Raises ``InputError`` for a file that is none."""
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
            settings, weights = saved["settings"], saved["actor_state_dict"]
            self.task, self.touch, self.history = str(settings["task"]), str(settings["touch"]), int(settings["history"])
            self.physics = str(settings.get("physics", "rigid"))
            inputs, outputs = weights["mlp.0.weight"].shape[1], len(weights["distribution.log_std_param"])
            hidden = [settings["hidden"]] * 2
            gaussian = {"class_name": "GaussianDistribution", "std_type": "log"}
            seen = TensorDict({"actor": torch.zeros(1, inputs)}, batch_size=[1])
            groups = {"actor": ["actor"]}
            network: dict[str, Any] = {"hidden_dims": hidden, "activation": "elu", "obs_normalization": True}
            self._network = MLPModel(seen, groups, "actor", outputs, distribution_cfg=gaussian, **network)
            self._network.load_state_dict(weights)
        except FileNotFoundError as error:
            raise InputError("policy", value=path, rule="must be a file that exists") from error
        except Exception as error:
            raise InputError("policy", value=path, rule=f"must be a policy of train_gpu ({error})") from error
        self._network.eval()

    @staticmethod
    def is_one(path: Path) -> bool:
        """Whether the file says of itself that ``train_gpu.py`` has written it."""
        try:
            return "actor_state_dict" in torch.load(path, map_location="cpu", weights_only=True)
        except Exception:
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
        with torch.inference_mode():
            seen = TensorDict({"actor": torch.from_numpy(observation)}, batch_size=[len(observation)])
            return self._network(seen).numpy()
