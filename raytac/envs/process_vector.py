"""``ProcessVectorEnv``: a vector of environments divided among processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from raytac.device import cpu_cores
from raytac.envs.environments import TactileVectorEnv
from raytac.envs.processes import Workers, serve
from raytac.envs.vector_checks import check_finite_actions, check_open, env_seeds
from raytac.errors import InputError
from raytac.gel.surface import chosen_envs


class ProcessVectorEnv(gymnasium.vector.VectorEnv):
    """B environments of a task in processes, each with a world on one core.

    It gives what a ``TactileVectorEnv`` of as many environments gives, except that what is drawn once a world differs between processes,
    and there are no pictures. A script that makes one must do so under ``if __name__ == "__main__":``, since processes import it. Ctrl-C
    reaches the caller alone.
    """

    def __init__(
        self, kind: type[TactileVectorEnv], num_envs: int, *, processes: int | None = None, seed: int = 0, **options: Any
    ) -> None:
        """Start the processes; return once every world is made.

        Args:
            kind: the task's vector, such as ``PushCubeVectorEnv``.
            num_envs: number of environments B, the same number in each process.
            processes: number of processes; None is one a core.
            seed: of what is drawn once for a world. Process k has seed + k B / processes, so that no two environments have the same random
                stream.
            options: other keyword arguments of ``kind``; they must pickle.

        Raises:
            InputError: a number of environments that the processes cannot share evenly; as ``kind``.
        """
        self.num_envs, count = num_envs, cpu_cores() if processes is None else processes
        self._workers = Workers(_serve_vector, kind, num_envs, count, seed, **options)
        self.single_observation_space, self.single_action_space, self.metadata = self._workers.made[0]
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin episodes, as ``TactileVectorEnv.reset``; environment b has seed + b.

        Raises ``InputError`` as it, and for a mask at the first reset, which must be of all.
        """
        check_open(self.closed)
        mask = (options or {}).get("reset_mask")
        if mask is not None and not self._begun:
            raise InputError("reset_mask", value="given", rule="must be None at the first reset, which is of all environments")
        chosen = np.isin(np.arange(self.num_envs), chosen_envs(mask, self.num_envs))
        seeds, each = env_seeds(seed, self.num_envs), self._workers.each
        parts = [slice(k * each, (k + 1) * each) for k in range(len(self._workers))]
        self._workers.send("reset", [(seeds[part], chosen[part]) for part in parts])
        observations = self._workers.replies()
        self._begun = True
        return _joined_arrays(observations), {}

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one control step, as ``TactileVectorEnv.step``.

        Raises ``InputError`` as it, with a note of the process: no process steps if an action is not finite or has another shape.
        """
        check_open(self.closed)
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise InputError("actions", value=actions.shape, rule=f"must have the shape {self.action_space.shape}")
        check_finite_actions(actions)
        self._workers.send("step", np.split(actions, len(self._workers)))
        observations, rewards, terminated, truncated, infos = zip(*self._workers.replies(), strict=True)
        ended = np.concatenate(terminated), np.concatenate(truncated)
        return _joined_arrays(observations), np.concatenate(rewards), *ended, _joined_infos(infos, self._workers.each)

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        self._workers.close()


def _serve_vector(pipe: Connection, kind: type[TactileVectorEnv], num_envs: int, options: dict[str, Any]) -> None:
    """Serve a vector (``raytac.envs.processes.serve``); no learner's library is imported.

    The first reply holds observation and action space of one environment and the metadata; commands are ``("reset", (seeds, mask))``, where
    a mask without True begins no episode, and ``("step", actions)``.
    """

    def make() -> tuple[Any, dict[str, Callable[[Any], Any]]]:
        env = kind(num_envs, **options)
        last: dict[str, np.ndarray] = {}

        def reset(given: tuple[list[int | None], np.ndarray]) -> dict[str, np.ndarray]:
            nonlocal last
            seeds, mask = given
            if mask.any():
                last, _ = env.reset(seed=seeds, options=None if mask.all() else {"reset_mask": mask})
            return last

        def step(actions: np.ndarray) -> Any:
            nonlocal last
            result = env.step(actions)
            last = result[0]
            return result

        return (env.single_observation_space, env.single_action_space, env.metadata), {"reset": reset, "step": step}

    serve(pipe, make)


def _joined_arrays(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _joined_infos(parts: Sequence[dict[str, Any]], each: int) -> dict[str, Any]:
    """Infos of all processes; where one has no entry, as without an episode's end, it is blank."""
    result: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        one = next(part[name] for part in parts if name in part)
        if isinstance(one, dict):
            result[name] = _joined_infos([part.get(name, {}) for part in parts], each)
        else:
            blank = np.full(each, None, object) if one.dtype == object else np.zeros(one.shape, one.dtype)
            result[name] = np.concatenate([part.get(name, blank) for part in parts])
    return result
