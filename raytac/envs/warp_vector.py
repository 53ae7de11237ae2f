"""``WarpVectorEnv``: a task on MuJoCo Warp as a Gymnasium vector of PyTorch tensors."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import raytac.envs
from raytac.checks import check_known, is_whole
from raytac.envs.environments import checked_mode
from raytac.envs.registration import TASKS
from raytac.envs.task_rules import Task
from raytac.envs.vector_checks import check_open
from raytac.envs.warp_batch import WarpBatch
from raytac.errors import InputError
from raytac.observe import gymnasium_space


class WarpVectorEnv(gymnasium.vector.VectorEnv):
    """B environments of a task, as ``TactileVectorEnv``, with tensors (B, …) on the device.

    .. code-block:: python

        env = gymnasium.make_vec("raytac/PushCubeWarp-v0", num_envs=4096, tactile=("markers", "wrench"), device="cuda")
        observation, _ = env.reset(seed=0)
        observation, reward, terminated, truncated, infos = env.step(actions)  # a tensor (4096, 3)

    ``infos`` hold tensors: ``reward_terms`` (name to tensor), ``success``, ``failed``, and with "SameStep" ``final_obs`` (name to tensor
    of all environments) with ``_final_obs`` (B,), true where an episode has ended. "NextStep" costs less: it looks at the pads once a
    step. The spaces are those of the arrays that NumPy would hold. One seed is that of the batch (``WarpBatch``), since all is drawn on
    the device.

    Attributes:
        batch: the ``WarpBatch``.
    """

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: None = None,
        **options: Any,
    ) -> None:
        """Compose the worlds.

        Args:
            task: name of a task, such as "PushCube", or its class.
            num_envs: number of environments B.
            autoreset_mode: as of ``TactileVectorEnv``.
            render_mode: None: pictures are of environments on the CPU.
            options: of ``WarpBatch``.

        Raises ``InputError`` for a value out of its choices.
        """
        self._mode = checked_mode(autoreset_mode)
        if render_mode is not None:
            raise InputError("render_mode", value=render_mode, rule="must be None: pictures are of environments on the CPU")
        rules = getattr(raytac.envs, check_known("task", task, TASKS)) if isinstance(task, str) else task
        self.batch = WarpBatch(rules(), num_envs=num_envs, **options)
        self.num_envs = num_envs
        self.single_observation_space = gymnasium_space(self.batch.arrays)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.batch.size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self._none = torch.zeros(num_envs, dtype=torch.bool, device=self.batch.device)
        self._ended = self._none

    def reset(  # type: ignore[override]
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Begin episodes of all, or of those in ``options["reset_mask"]`` (B,), bool.

        Raises ``InputError`` for seeds of single environments, a mask of another shape, or after ``close``.
        """
        check_open(self.closed)
        if seed is not None and not is_whole(seed):
            raise InputError("seed", value=seed, rule="must be one whole number, of all environments")
        mask = (options or {}).get("reset_mask")
        mask = None if mask is None else torch.as_tensor(mask, device=self.batch.device)
        observation = self.batch.reset(None if seed is None else int(seed), mask)
        self._ended = self._none if mask is None else self._ended & ~mask
        return observation, {}

    def step(  # type: ignore[override]
        self, actions: torch.Tensor | np.ndarray
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Take one control step; ``actions`` (B, k) and errors are as of ``WarpBatch.step``.

        Raises ``InputError`` also after ``close``.
        """
        check_open(self.closed)
        same = self._mode is AutoresetMode.SAME_STEP
        begin = None if same else self._ended if self._mode is AutoresetMode.NEXT_STEP else self._none
        out = self.batch.step(torch.as_tensor(actions), begin, final=same)
        self._ended = out.terminated | out.truncated
        infos: dict[str, Any] = {"reward_terms": out.terms, "success": out.success, "failed": out.failed}
        if same:
            infos |= {"final_obs": out.final, "_final_obs": self._ended, "final_info": dict(infos), "_final_info": self._ended}
        return out.observation, out.reward.float(), out.terminated, out.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        self.batch.check()
