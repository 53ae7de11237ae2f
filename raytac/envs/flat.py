"""Vectors with two flat observations: the policy's, and its critic's in training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np

from raytac.checks import check_whole
from raytac.envs.environments import TactileVectorEnv
from raytac.envs.processes import serve
from raytac.observe.settings import SCALES


@dataclass(frozen=True)
class FlatLayout:
    """Arrays of a ``FlatVector``."""

    fields: dict[str, tuple[int, ...]]
    """Shape of one environment's row of every array."""
    terms: tuple[str, ...]
    """Names of the terms of the reward, in the order of the array ``terms``."""
    max_episode_steps: int
    control_timestep: float
    """Duration of a step [s]."""


class FlatVector:
    """``TactileVectorEnv`` with observations ``actor`` (B, n) and ``critic`` (B, m).

    The actor is given all that the task observes, one after the other, of the last ``history`` steps, newest first. The critic is given
    that and, whether the task shows them or not, pose and velocity of the body and the wrench of every sensor. Environments begin again
    in the step in which they end.

    Attributes:
        layout: names and shapes.
        buffers: arrays (B, …), float32. ``action`` is read; ``age``, the steps since an episode's start, is read and written; the others
            are written.
    """

    def __init__(
        self,
        kind: type[TactileVectorEnv],
        num_envs: int,
        *,
        history: int = 1,
        hidden: Sequence[str] = (),
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Make the vector.

        Args:
            kind: the task's vector, such as ``PushCubeVectorEnv``.
            history: number of steps whose observations the actor is given.
            hidden: modalities that neither is given, though ``tactile`` names them: for pictures.
            seed: of environment 0; environment b has seed + b.
            options: of ``kind``; ``body_seen`` is whether the actor sees the body.
        """
        seen = options.pop("body_seen", None)
        body_seen = kind.task.body_seen if seen is None else bool(seen)
        self.env = kind(num_envs, seed=seed, body_seen=True, **options)
        batch = self.env.batch
        unseen = tuple(f"_{modality}" for modality in hidden)
        self._names = [name for name in batch.arrays if (name != "body" or body_seen) and not name.endswith(unseen)]
        self._sensors = tuple(batch.world.sensor_names)
        now = sum(int(np.prod(batch.arrays[name].shape)) for name in self._names)
        self._past = np.zeros((num_envs, check_whole("history", history), now), np.float32)
        actor = now * history
        # The terms are known by name once a step was taken.
        self.env.reset(seed=[seed + b for b in range(num_envs)])
        given = self.env.step(np.zeros((num_envs, batch.control.size)))[4]["reward_terms"]
        terms = tuple(name for name in given if not name.startswith("_"))
        scalars: dict[str, tuple[int, ...]] = dict.fromkeys(("age", "reward", "terminated", "truncated", "success", "failed"), ())
        fields = {
            "action": (batch.control.size,),
            "actor": (actor,),
            "critic": (actor + 15 + 6 * len(self._sensors),),
            **scalars,
            "terms": (len(terms),),
        }
        self.layout = FlatLayout(fields, terms, batch.max_episode_steps, batch.control_timestep)
        self.buffers = {name: np.zeros((num_envs, *shape), np.float32) for name, shape in fields.items()}
        self.reset(seed)

    def attach(self, buffers: Mapping[str, np.ndarray]) -> None:
        """Read and write these arrays from now on, which get the present values."""
        for name, array in buffers.items():
            array[:] = self.buffers[name]
        self.buffers = dict(buffers)

    def reset(self, seed: int | None = None) -> None:
        """Begin all episodes, environment b with seed + b; None goes on with the streams."""
        count = self.env.num_envs
        observation, _ = self.env.reset(seed=None if seed is None else [seed + b for b in range(count)])
        for name in ("age", "reward", "terminated", "truncated", "success", "failed", "terms"):
            self.buffers[name][:] = 0.0
        self._observe(observation, np.ones(count, bool))

    def step(self) -> None:
        """Step with ``buffers["action"]``, cut to [−1, 1]; InputError if not finite."""
        out = self.buffers
        observation, reward, terminated, truncated, infos = self.env.step(np.clip(out["action"], -1.0, 1.0))
        out["age"] += 1.0
        ended = terminated | truncated
        # An age that was set from outside ends an episode early.
        early = (out["age"] >= self.layout.max_episode_steps) & ~ended
        if early.any():
            observation, _ = self.env.reset(options={"reset_mask": early})
        out["age"][ended | early] = 0.0
        out["reward"][:], out["terminated"][:], out["truncated"][:] = reward, terminated, truncated | early
        out["success"][:], out["failed"][:] = infos["success"], infos["failed"]
        out["terms"][:] = np.stack([infos["reward_terms"][name] for name in self.layout.terms], axis=1)
        self._observe(observation, ended | early)

    def _observe(self, observation: dict[str, np.ndarray], begun: np.ndarray) -> None:
        """Write both observations; the history where ``begun`` holds the first one alone."""
        count = self.env.num_envs
        now = np.concatenate([observation[name].reshape(count, -1) for name in self._names], axis=1)
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = now
        self._past[begun] = now[begun, None]
        actor = self._past.reshape(count, -1)
        state = self.env.batch.world.state()
        failed = state.failed[:, None]
        felt = [np.where(failed, 0.0, state.wrench[name] / SCALES["wrench"]) for name in self._sensors]
        self.buffers["actor"][:] = actor
        self.buffers["critic"][:] = np.concatenate([actor, observation["body"], *felt], axis=1)


def shared_arrays(memory: SharedMemory, fields: Mapping[str, tuple[int, ...]], rows: int) -> dict[str, np.ndarray]:
    """Arrays (rows, …), float32, one after the other in the memory."""
    arrays, first = {}, 0
    for name, shape in fields.items():
        arrays[name] = np.ndarray((rows, *shape), np.float32, memory.buf, first)
        first += arrays[name].nbytes
    return arrays


def serve_flat(pipe: Connection, kind: type[TactileVectorEnv], num_envs: int, options: dict[str, Any]) -> None:
    """Serve a ``FlatVector`` whose arrays are rows of shared memory, without a learner.

    No learner's library is imported.
    The first reply is its ``FlatLayout``. Commands: ``("attach", (name of the memory, first row, number of rows))``, ``("reset", seed)``
    and ``("step", None)``.
    """

    def make() -> tuple[Any, dict[str, Callable[[Any], Any]]]:
        vector = FlatVector(kind, num_envs, **options)
        memory: list[SharedMemory] = []

        def attach(where: tuple[str, int, int]) -> None:
            name, first, rows = where
            memory.append(SharedMemory(name))
            arrays = shared_arrays(memory[-1], vector.layout.fields, rows)
            vector.attach({field: array[first : first + num_envs] for field, array in arrays.items()})

        return vector.layout, {"attach": attach, "reset": vector.reset, "step": lambda _: vector.step()}

    serve(pipe, make)
