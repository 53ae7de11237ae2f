"""Environments for stable-baselines3: a vector of ours as its ``VecEnv``, and several of them in processes."""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from raytac.envs.environments import TactileVectorEnv, serve_vector
from raytac.errors import InputError

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Observations = dict[str, np.ndarray]
Step = tuple[Observations, np.ndarray, np.ndarray, list[dict[str, Any]]]


@contextmanager
def one_thread() -> Iterator[None]:
    """Give processes that start within one thread of BLAS each; many processes share the cores."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when NumPy loads, so they must stand before a process starts
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class _DictVecEnv(VecEnv):
    """Common part of both: attributes by name, and no wrappers."""

    def close(self) -> None:
        """Free nothing: there is only memory."""

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


class TactileVecEnv(_DictVecEnv):
    """A ``TactileVectorEnv`` as a ``VecEnv``: dictionary observations, for ``MultiInputPolicy``.

    ``infos`` hold ``success``, ``failed``, ``TimeLimit.truncated``, and ``terminal_observation`` of episodes that have ended. One that
    ended because its physics broke down is not ``TimeLimit.truncated``: a learner must not expect a return from beyond it.
    ``seed(s)`` before ``reset`` seeds environment b with s + b.
    """

    def __init__(self, env: TactileVectorEnv) -> None:
        """Wrap ``env``. Raises ``InputError`` for a vector that does not reset environments in the step in which they end."""
        mode = env.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise InputError("autoreset_mode", value=mode.value, rule="must be 'SameStep' for stable-baselines3")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.zeros((env.num_envs, *env.single_action_space.shape))  # type: ignore[misc]

    def reset(self) -> Observations:
        """Begin episodes in all environments, with the seeds that ``seed`` has set."""
        observation, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> Step:
        """Step with the actions kept. Raises ``InputError``, naming the environment, for one that is not finite or out of bounds."""
        return _vec_env_step(*self.env.step(self._actions))


class ProcessVecEnv(_DictVecEnv):
    """One ``VecEnv`` of ``processes`` vectors, each in a process with a world of its own.

    The physics of a world runs on one core, so this uses a machine of many cores. Ctrl-C reaches the caller alone, and workers end with it.
    """

    def __init__(self, kind: type[TactileVectorEnv], *, num_envs: int, processes: int, seed: int = 0, **options: Any) -> None:
        """Start the processes.

        Args:
            kind: the task's vector, such as ``PushCubeVectorEnv``.
            num_envs: number of environments in all, the same number in each process.
            processes: number of processes.
            seed: of what is drawn once for a world. Process k has seed + k num_envs / processes, so that no two environments have the same
                random stream.
            options: of ``TaskBatch``; they must pickle.

        Raises:
            InputError: a number of environments that the processes cannot share evenly; as ``TaskBatch``.
        """
        if processes < 1 or num_envs < 1 or num_envs % processes:
            rule = f"must be a multiple of the number of processes, which is {processes} and must be at least 1"
            raise InputError("num_envs", value=num_envs, rule=rule)
        each = num_envs // processes
        context = multiprocessing.get_context("spawn")
        self._workers: list[tuple[Any, Connection]] = []
        with one_thread():
            for k in range(processes):
                mine, theirs = context.Pipe()
                arguments = theirs, kind, each, {**options, "seed": seed + k * each}
                worker = context.Process(target=serve_vector, args=arguments, daemon=True, name=f"raytac-envs-{k}")
                worker.start()
                theirs.close()
                self._workers.append((worker, mine))
        self._each = each
        spaces = self._replies()
        super().__init__(num_envs, *spaces[0])

    def reset(self) -> Observations:
        """As ``TactileVecEnv.reset``."""
        for k, (_, pipe) in enumerate(self._workers):
            pipe.send(("reset", self._seeds[k * self._each : (k + 1) * self._each]))
        self._reset_seeds()
        self._reset_options()
        return _joined([observation for observation, _ in self._replies()])

    def step_async(self, actions: np.ndarray) -> None:
        """Start the step in all processes. Raises ``InputError``, naming the environment, for actions that are not finite."""
        actions = np.asarray(actions)
        if not np.isfinite(actions).all():
            env = int(np.argwhere(~np.isfinite(actions))[0, 0])
            raise InputError("actions", value=actions[env].tolist(), rule=f"must be finite; in environment {env} they are not")
        for (_, pipe), rows in zip(self._workers, np.split(actions, len(self._workers)), strict=True):
            pipe.send(("step", rows))

    def step_wait(self) -> Step:
        """Wait for the step. Raises as ``TactileVecEnv.step_wait``; the message names the process and its environments."""
        steps = [_vec_env_step(*reply) for reply in self._replies()]
        observations, rewards, dones, infos = zip(*steps, strict=True)
        return _joined(observations), np.concatenate(rewards), np.concatenate(dones), [info for part in infos for info in part]

    def close(self) -> None:
        """End the processes."""
        for worker, pipe in self._workers:
            pipe.close()
            worker.join(timeout=5.0)
            if worker.is_alive():
                worker.terminate()
        self._workers = []

    def _replies(self) -> list[Any]:
        """One reply of every process. All are read before an error is raised, so that none is mistaken for a later one."""
        replies = []
        for k, (worker, pipe) in enumerate(self._workers):
            try:
                replies.append(pipe.recv())
            except (EOFError, ConnectionResetError):
                replies.append((False, RuntimeError(f"process {k} ended by itself, exit code {worker.exitcode}"), ""))
        for k, (fine, value, where) in enumerate(replies):
            if not fine:
                name = f"environments {k * self._each} to {(k + 1) * self._each - 1}, in process {k}"
                value.add_note(f"raised by {name}:\n{where}")
                raise value
        return [value for _, value, _ in replies]


def _joined(parts: Sequence[Observations]) -> Observations:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _vec_env_step(
    observation: Observations, reward: np.ndarray, terminated: np.ndarray, truncated: np.ndarray, info: dict[str, Any]
) -> Step:
    """Step of a Gymnasium vector in the form of a ``VecEnv``."""
    infos: list[dict[str, Any]] = [
        {"success": bool(success), "failed": bool(failed), "TimeLimit.truncated": bool(cut and not failed)}
        for success, failed, cut in zip(info["success"], info["failed"], truncated, strict=True)
    ]
    for b in np.flatnonzero(terminated | truncated):
        infos[b]["terminal_observation"] = info["final_obs"][b]
    return observation, reward.astype(np.float32), terminated | truncated, infos
