"""Environments for rsl_rl: our vectors as its ``VecEnv``, in one process or several."""

# pyright: reportMissingImports=false
# (rsl_rl and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from raytac.checks import check_whole
from raytac.envs.environments import TactileVectorEnv
from raytac.envs.flat import FlatLayout, FlatVector, serve_flat, shared_arrays, with_history
from raytac.envs.processes import Workers
from raytac.envs.vector_checks import check_finite_actions
from raytac.observe.settings import SCALES


class RslVecEnv(VecEnv):
    """Environments of one task with ``FlatVector``'s groups ``actor`` and ``critic``.

    ``extras`` of a step hold ``time_outs`` (an end by broken physics is none: no return is to be expected from beyond it), ``success``
    and ``failed``, each (B,), and in ``log`` the mean of every term of the reward.
    """

    def __init__(
        self,
        kind: type[TactileVectorEnv],
        *,
        num_envs: int,
        processes: int = 0,
        device: str = "cpu",
        reward_scale: float = 1.0,
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Make the environments; ``reset`` begins the episodes.

        Args:
            kind: the task's vector, such as ``PushCubeVectorEnv``.
            processes: processes that these are spread over, each with a world of its own; 0 is this process.
            device: of the tensors; that of the worlds is among ``options``, as ``world_device``.
            seed: of environment 0; environment b has seed + b.
            options: ``history`` of ``FlatVector``, and those of ``TaskBatch``.

        Raises:
            InputError: a number of environments that the processes cannot share evenly; as ``TaskBatch``.
        """
        options["device"] = options.pop("world_device", "cpu")
        self.num_envs, self.device, self.reward_scale = check_whole("num_envs", num_envs), device, reward_scale
        self._workers: Workers | None = None
        self._vector: FlatVector | None = None
        if processes:
            self._workers = Workers(serve_flat, kind, num_envs, processes, seed, **options)
            self.layout: FlatLayout = self._workers.made[0]
            size = 4 * num_envs * sum(int(np.prod(shape)) for shape in self.layout.fields.values())
            self._memory = SharedMemory(create=True, size=size)
            self._arrays = shared_arrays(self._memory, self.layout.fields, num_envs)
            each = self._workers.each
            self._ask("attach", [(self._memory.name, k * each, num_envs) for k in range(processes)])
        else:
            self._vector = FlatVector(kind, num_envs, seed=seed, **options)
            self.layout, self._arrays = self._vector.layout, self._vector.buffers
        self.num_actions, self.max_episode_length = self.layout.fields["action"][0], self.layout.max_episode_steps
        self.control_timestep = self.layout.control_timestep
        self.cfg = {"kind": kind.__name__, **{name: str(value) for name, value in options.items()}}

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """Steps (B,) since each episode's start; setting them ends episodes as much earlier."""
        return self._tensor("age").long()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._arrays["age"][:] = steps.cpu().numpy()

    def reset(self, seed: int | None = None) -> TensorDict:
        """Begin all episodes, environment b with seed + b; None goes on with the streams."""
        if self._workers is None:
            assert self._vector is not None
            self._vector.reset(seed)
        else:
            each = self._workers.each
            self._ask("reset", [None if seed is None else seed + k * each for k in range(len(self._workers))])
        return self.get_observations()

    def get_observations(self) -> TensorDict:
        """Observations after the last step or reset."""
        return TensorDict({name: self._tensor(name) for name in ("actor", "critic")}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Step all environments with actions (B, k), cut to [−1, 1]; those that end begin again.

        Raises ``InputError``: actions that are not finite; the message names the environment.
        """
        values = actions.detach().cpu().numpy()
        check_finite_actions(values)
        self._arrays["action"][:] = values
        if self._workers is None:
            assert self._vector is not None
            self._vector.step()
        else:
            self._ask("step", [None] * len(self._workers))
        terminated, truncated, failed = (self._tensor(name) for name in ("terminated", "truncated", "failed"))
        extras = {
            "time_outs": truncated * (1.0 - failed),
            "success": self._tensor("success"),
            "failed": failed,
            "log": {f"/reward/{name}": float(self._arrays["terms"][:, i].mean()) for i, name in enumerate(self.layout.terms)},
        }
        done = torch.maximum(terminated, truncated)
        return self.get_observations(), self.reward_scale * self._tensor("reward"), done, extras

    def close(self) -> None:
        """End the processes and free the shared memory."""
        if self._workers is not None:
            self._workers.close()
            self._arrays = {}
            self._memory.close()
            self._memory.unlink()
            self._workers = None

    def _tensor(self, name: str) -> torch.Tensor:
        """A copy on the device."""
        return torch.tensor(self._arrays[name], device=self.device)

    def _ask(self, command: str, values: list[Any]) -> None:
        assert self._workers is not None
        self._workers.send(command, values)
        self._workers.replies()


class RslWarpEnv(VecEnv):
    """Environments of one task on MuJoCo Warp, with ``RslVecEnv``'s observation groups.

    Nothing is copied to the host.
    ``extras`` are those of ``RslVecEnv``, with tensors in ``log``.
    """

    def __init__(
        self,
        kind: type[TactileVectorEnv],
        *,
        num_envs: int,
        device: str = "auto",
        history: int = 1,
        reward_scale: float = 1.0,
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Make the environments; ``reset`` begins the episodes.

        Args:
            kind: the task's vector, such as ``PushCubeVectorEnv``.
            num_envs, device, seed: as of ``WarpBatch``.
            history: number of steps whose observations the actor is given.
            options: of ``WarpBatch``; ``body_seen`` is whether the actor sees the body.

        Raises ``InputError`` as ``WarpBatch``.
        """
        from raytac.envs.warp_batch import WarpBatch  # MuJoCo Warp is an extra of its own

        self.batch = WarpBatch(kind.task(), num_envs=num_envs, device=device, seed=seed, **options)
        self.num_envs, self.device, self.reward_scale = num_envs, str(self.batch.device), reward_scale
        now = sum(int(np.prod(array.shape)) for array in self.batch.arrays.values())
        self._past = torch.zeros(num_envs, check_whole("history", history), now, device=self.device)
        self.num_actions, self.max_episode_length = self.batch.size, self.batch.max_episode_steps
        self.control_timestep = self.batch.control_timestep
        self._scale = torch.tensor(SCALES["wrench"], dtype=torch.float64, device=self.device)
        self._observed = TensorDict({}, batch_size=[num_envs])
        self.cfg = {"kind": kind.__name__, **{name: str(value) for name, value in options.items()}}

    @property
    def episode_length_buf(self) -> torch.Tensor:  # type: ignore[override]
        """Steps (B,) since each episode's start; setting them ends episodes as much earlier."""
        return self.batch.steps.clone()

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self.batch.steps.copy_(steps)

    def reset(self, seed: int | None = None) -> TensorDict:
        """Begin all episodes; None goes on with the present random stream."""
        observation = self.batch.reset(seed)
        begun = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._observe(observation, begun)
        return self.get_observations()

    def get_observations(self) -> TensorDict:
        """Observations after the last step or reset."""
        return self._observed

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Step all environments with actions (B, k), cut to [−1, 1]; those that end begin again."""
        result = self.batch.step(actions)
        done = result.terminated | result.truncated
        self._observe(result.observation, done)
        extras = {
            "time_outs": (result.truncated & ~result.failed).float(),
            "success": result.success.float(),
            "failed": result.failed.float(),
            "log": {f"/reward/{name}": term.mean() for name, term in result.terms.items()},
        }
        return self.get_observations(), self.reward_scale * result.reward.float(), done.float(), extras

    def close(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        self.batch.check()

    def _observe(self, observation: dict[str, torch.Tensor], begun: torch.Tensor) -> None:
        """Make both observations; the history where ``begun`` holds the first one alone."""
        now = torch.cat([values.reshape(self.num_envs, -1).float() for values in observation.values()], dim=1)
        self._past = with_history(self._past, now, begun)
        actor = self._past.reshape(self.num_envs, -1)
        felt = [(wrench / self._scale).float() for wrench in self.batch.wrench.values()]
        critic = torch.cat([actor, self.batch.body_observation, *felt], dim=1)
        self._observed = TensorDict({"actor": actor, "critic": critic}, batch_size=[self.num_envs])
