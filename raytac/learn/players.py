"""Policies that can be played: files of ``raytac train``, shipped and scripted ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from raytac.envs.flat_policy import FlatPolicy
from raytac.envs.scripted import SCRIPTED
from raytac.envs.task_sensors import NODE_PITCH
from raytac.errors import InputError
from raytac.learn.evaluation import KINDS, Outcome, ShownEpisodes
from raytac.learn.policies import shipped_policies
from raytac.observe import MODALITIES, ObservationSettings
from raytac.optics.base import OpticsConfig

__all__ = ["PolicyPlayer", "ScriptedPlayer", "find_player", "shown_beside"]

_IMAGE = (160, 120)
"""Size of a film's tactile images [px]."""


def find_player(policy: str, task: str | None = None) -> PolicyPlayer | ScriptedPlayer:
    """The policy of a name or a file.

    Args:
        policy: ``scripted``, a shipped policy's name, or the path of a ``policy.pt``.
        task: of the scripted policy; a trained one knows its own.

    Raises:
        InputError: no such policy, a file that is none, an unknown task, a task beside a trained policy, none beside ``scripted``.
    """
    shipped = shipped_policies()
    if policy == "scripted":
        if task is None:
            raise InputError("task", rule="must be given with the policy 'scripted'", choices=tuple(SCRIPTED))
        return ScriptedPlayer(task)
    if task is not None:
        raise InputError("task", value=task, rule=f"belongs to the policy 'scripted'; {policy!r} knows its own: leave it out")
    path = Path(policy)
    if policy in shipped:
        path = shipped[policy]
    elif path.suffix != ".pt":
        rule = "must be the name of a policy, or the path of a file .pt"
        raise InputError("policy", value=policy, rule=rule, choices=("scripted", *shipped))
    return PolicyPlayer(path)


def shown_beside(felt: Sequence[str], shown: OpticsConfig | str) -> tuple[ObservationSettings, list[str]]:
    """Observation with image and markers, and those of its modalities that are not ``felt``."""
    every = tuple(name for name in MODALITIES if name in (*felt, "rgb", "markers"))
    return ObservationSettings(every, resolution=_IMAGE, optics=shown), [name for name in every if name not in felt]


class PolicyPlayer:
    """Policy of ``raytac train``, which NumPy computes."""

    def __init__(self, path: Path) -> None:
        """Load a ``policy.pt``. Raises ``InputError`` for a file that is none."""
        self.policy = FlatPolicy(path)
        self.name, self.task, self.physics = path.stem, self.policy.task, self.policy.physics

    def episodes(self, num_envs: int, *, physics: str, device: str, shown: OpticsConfig | str | None = None) -> ShownEpisodes:
        """As ``Player``; the policy is given what it was trained with, whatever is shown."""
        options: dict[str, Any] = {"physics": physics, "device": device}
        if shown is not None:
            options["render_mode"] = "rgb_array"
        if shown is not None and "rgb" not in self.policy.felt:  # else the images that it is given are shown
            tactile, hidden = shown_beside(self.policy.felt, shown)
            options |= {"tactile": tactile, "hidden": hidden, "pitch": NODE_PITCH}  # as in training
        return _PolicyEpisodes(self.policy, num_envs, options)


class _PolicyEpisodes:
    def __init__(self, policy: FlatPolicy, num_envs: int, options: dict[str, Any]) -> None:
        self._policy, self._vector = policy, policy.vector(num_envs, **options)
        self.num_envs, self.control_timestep = num_envs, self._vector.layout.control_timestep
        self.sensors = tuple(self._vector.env.batch.observers)

    def reset(self, seed: int) -> None:
        self._vector.reset(seed)

    def step(self) -> Outcome:
        seen = self._vector.buffers
        seen["action"][:] = self._policy(seen["actor"])
        self._vector.step()
        ended = np.maximum(seen["terminated"], seen["truncated"])
        return Outcome(*(array.copy() for array in (seen["reward"], ended, seen["success"], seen["failed"])))

    def picture(self) -> np.ndarray:
        pictures = self._vector.env.render()
        assert pictures is not None
        return pictures[0]


class ScriptedPlayer:
    """Policy written by hand from the state of a task."""

    physics = "rigid"

    def __init__(self, task: str) -> None:
        """Find the task's. Raises ``InputError`` for an unknown task."""
        if task not in SCRIPTED:
            raise InputError("task", value=task, rule="must be a known task", choices=tuple(SCRIPTED))
        self.name, self.task = f"{task}_scripted", task

    def episodes(self, num_envs: int, *, physics: str, device: str, shown: OpticsConfig | str | None = None) -> ShownEpisodes:
        """As ``Player``."""
        options: dict[str, Any] = {"tactile": None, "physics": physics, "device": device}
        if shown is not None:
            options |= {"tactile": shown_beside((), shown)[0], "render_mode": "rgb_array"}
        return _ScriptedEpisodes(self.task, num_envs, options)


class _ScriptedEpisodes:
    def __init__(self, task: str, num_envs: int, options: dict[str, Any]) -> None:
        self._policy, self._env, self.num_envs = SCRIPTED[task], KINDS[task](num_envs, **options), num_envs
        self.control_timestep, self.sensors = self._env.batch.control_timestep, tuple(self._env.batch.observers)

    def reset(self, seed: int) -> None:
        self._env.reset(seed=seed)

    def step(self) -> Outcome:
        _, reward, terminated, truncated, infos = self._env.step(np.clip(self._policy(self._env.batch), -1.0, 1.0))
        return Outcome(reward, terminated | truncated, infos["success"], infos["failed"])

    def picture(self) -> np.ndarray:
        pictures = self._env.render()
        assert pictures is not None
        return pictures[0]
