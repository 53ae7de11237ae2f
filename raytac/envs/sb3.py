"""``TactileVecEnv``: our vectors as the ``VecEnv`` of stable-baselines3."""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from raytac.envs.environments import TactileVectorEnv
from raytac.envs.process_vector import ProcessVectorEnv
from raytac.envs.warp_vector import WarpVectorEnv
from raytac.errors import InputError

Observations = dict[str, np.ndarray]
Step = tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]


class TactileVecEnv(VecEnv):
    """A Gymnasium vector of ours as a ``VecEnv`` for ``MultiInputPolicy``.

    It may be a ``TactileVectorEnv``, a ``ProcessVectorEnv`` or a ``WarpVectorEnv``. Stable-baselines3 takes arrays of NumPy: tensors of a
    ``WarpVectorEnv`` are copied to the host in every step.

    ``infos`` hold ``success``, ``failed``, ``TimeLimit.truncated``, and ``terminal_observation`` of episodes that have ended. One that
    ended because its physics broke down is not ``TimeLimit.truncated``: a learner must not expect a return from beyond it.
    ``seed(s)`` before ``reset`` seeds environment b with s + b, and a ``WarpVectorEnv`` with s.
    """

    def __init__(self, env: TactileVectorEnv | ProcessVectorEnv | WarpVectorEnv) -> None:
        """Wrap ``env``; InputError unless it resets environments in the step that ends them."""
        mode = env.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise InputError("autoreset_mode", value=mode.value, rule="must be 'SameStep' for stable-baselines3")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros((env.num_envs, *env.single_action_space.shape))  # type: ignore[misc]

    def reset(self) -> Observations:
        """Begin episodes in all environments, with the seeds that ``seed`` has set."""
        is_warp = isinstance(self.env, WarpVectorEnv)
        observation, _ = self.env.reset(seed=self._seeds[0] if is_warp else self._seeds)  # type: ignore[arg-type]
        self._reset_seeds()
        self._reset_options()
        return _on_host(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> Step:
        """Step with the actions kept; InputError names an environment not finite or out of bounds."""
        return _vec_env_step(*(_on_host(one) for one in self.env.step(self._actions)))

    def close(self) -> None:
        """Close the vector: processes end."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Attribute of the vector, repeated for every environment of ``indices``."""
        if attr_name != "render_mode":
            raise AttributeError(attr_name)
        return [None] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Raise ``InputError``: environments of one world share everything."""
        raise InputError("attr_name", value=attr_name, rule="cannot be set: environments of a vector share their world")

    def env_method(self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **kwargs: Any) -> list[Any]:
        """Raise ``InputError``: environments of one world have no methods of their own."""
        raise InputError("method_name", value=method_name, rule="cannot be called: environments of a vector share their world")

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """False for every environment."""
        return [False] * len(list(self._get_indices(indices)))


def _on_host(values: Any) -> Any:
    """Arrays of NumPy in place of tensors, in dictionaries too."""
    if isinstance(values, dict):
        return {name: _on_host(value) for name, value in values.items()}
    return values.cpu().numpy() if isinstance(values, torch.Tensor) else values


def _vec_env_step(
    observation: Observations, reward: np.ndarray, terminated: np.ndarray, truncated: np.ndarray, info: dict[str, Any]
) -> Step:
    """Step of a Gymnasium vector in the form of a ``VecEnv``."""
    infos: list[dict[str, Any]] = [
        {"success": bool(success), "failed": bool(failed), "TimeLimit.truncated": bool(cut and not failed)}
        for success, failed, cut in zip(info["success"], info["failed"], truncated, strict=True)
    ]
    for b in np.flatnonzero(terminated | truncated):
        final = info["final_obs"]
        infos[b]["terminal_observation"] = (
            {name: values[b].copy() for name, values in final.items()} if isinstance(final, dict) else final[b]
        )
    return observation, reward.astype(np.float32), terminated | truncated, infos
