"""Gymnasium environments over ``TaskBatch``: one, and vectors that step all of theirs at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from raytac.envs.batch import Outcome, TaskBatch
from raytac.envs.picture import EnvironmentPicture
from raytac.envs.task import Task
from raytac.errors import InputError
from raytac.gel.surface import chosen_envs
from raytac.observe import gymnasium_space

__all__ = ["TactileEnv", "TactileVectorEnv"]

_RENDER_MODES = ("rgb_array",)
_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)


def _checked_render_mode(mode: str | None) -> str | None:
    if mode is not None and mode not in _RENDER_MODES:
        raise InputError("render_mode", value=mode, rule="must be None or a known mode", choices=_RENDER_MODES)
    return mode


def _check_open(closed: bool) -> None:
    if closed:
        raise InputError("environment", value="closed", rule="must not be used after close(): make another")


def _action_space(size: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)


class TactileEnv(gymnasium.Env):
    """One environment of a task; subclasses name the task, and their docstring specifies it.

    Keyword arguments are those of ``TaskBatch``, but for ``num_envs``. ``info`` holds ``reward_terms`` (name to value, their sum is the
    reward), ``success`` and ``failed``.
    """

    task: ClassVar[type[Task]]
    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES)}  # noqa: RUF012 (Gymnasium reads it from the class)

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        """``render_mode``: None, or ``rgb_array``. Raises as ``TaskBatch``; ``InputError`` for another render mode."""
        self.closed = False
        self.render_mode = _checked_render_mode(render_mode)
        self.batch = TaskBatch(self.task(), num_envs=1, **options)
        self.observation_space = gymnasium_space(self.batch.arrays)
        self.action_space = _action_space(self.batch.steering.size)
        self.metadata = {"render_modes": list(_RENDER_MODES), "render_fps": 1.0 / self.batch.control_timestep}
        self._seen: dict[str, np.ndarray] | None = None
        self._picture: EnvironmentPicture | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; a seed makes this and all later ones repeatable, sensors' noise too. ``options`` are not used.

        Raises ``InputError`` after ``close``.
        """
        _check_open(self.closed)
        super().reset(seed=seed)
        if seed is not None:
            self.batch.reseed([0], [seed])
        self._seen = self.batch.reset([0], [self.np_random])
        return _row(self._seen), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Raises ``InputError`` for an action of another shape, outside of [−1, 1] or not finite, or after ``close``."""
        _check_open(self.closed)
        out = self.batch.step(np.asarray(action)[None])
        self._seen = out.observation
        info = {
            "reward_terms": {name: float(term[0]) for name, term in out.terms.items()},
            "success": bool(out.success[0]),
            "failed": bool(out.failed[0]),
        }
        return _row(out.observation), float(out.reward[0]), bool(out.terminated[0]), bool(out.truncated[0]), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """8-bit picture (H, W, 3): the scene with the goal in green, and beside it what each sensor observes; None without a render mode.

        Raises:
            InputError: before the first ``reset``.
            BackendError: MuJoCo has no OpenGL to draw with (see ``SceneCamera``).
        """
        _check_open(self.closed)
        if self.render_mode is None:
            return None
        if self._seen is None:
            raise InputError("environment", value=0, rule="must be reset before it is drawn")
        if self._picture is None:
            self._picture = EnvironmentPicture(self.batch)
        return self._picture.draw(0, self._seen)

    def close(self) -> None:
        """Free the renderer, if there is one; the environment can then be neither reset nor stepped nor drawn."""
        self.closed = True
        if self._picture is not None:
            self._picture.close()
            self._picture = None


class TactileVectorEnv(gymnasium.vector.VectorEnv):
    """B environments of a task in one world: MuJoCo's states are stepped together, and each sensor sees all of them in one call.

    Subclasses name the task. Keyword arguments are those of ``TaskBatch``. ``infos`` hold arrays (B,): ``reward_terms`` (name to array),
    ``success``, ``failed``; where environments began anew in the same step also ``final_obs`` and ``final_info`` (arrays of objects), as
    Gymnasium's own vectors give them. Environment b is seeded with seed + b and does what the single environment of that seed does, noise
    of cameras and markers included.
    """

    task: ClassVar[type[Task]]
    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES)}  # noqa: RUF012 (Gymnasium reads it from the class)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """Compose the world.

        Args:
            num_envs: number of environments B.
            autoreset_mode: when an environment that has ended begins anew: in the same step, in the next one (whose action it ignores,
                with reward 0), or only by ``reset``.
            render_mode: None, or ``rgb_array``.
            options: of ``TaskBatch``.

        Raises:
            InputError: a value out of its choices.
        """
        self.render_mode = _checked_render_mode(render_mode)
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            choices = [mode.value for mode in _MODES]
            raise InputError("autoreset_mode", value=autoreset_mode, rule="must be a known mode", choices=choices) from error
        self.num_envs = num_envs
        self.batch = TaskBatch(self.task(), num_envs=num_envs, **options)
        self.single_observation_space = gymnasium_space(self.batch.arrays)
        self.single_action_space = _action_space(self.batch.steering.size)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = {
            "autoreset_mode": self._mode,
            "render_modes": list(_RENDER_MODES),
            "render_fps": 1.0 / self.batch.control_timestep,
        }
        self._seen: dict[str, np.ndarray] | None = None
        self._picture: EnvironmentPicture | None = None
        self._rngs = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin episodes: of all environments, or of those in ``options["reset_mask"]`` (B,).

        Raises:
            InputError: seeds of another number than environments, a mask of another shape, or after ``close``.
        """
        _check_open(self.closed)
        mask = (options or {}).get("reset_mask")
        envs = chosen_envs(mask, self.num_envs)
        if seed is not None:
            seeds = [seed + b for b in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
            if len(seeds) != self.num_envs:
                raise InputError("seed", value=len(seeds), rule=f"must be one, or one for each of {self.num_envs} environments")
            told = [b for b in envs if seeds[b] is not None]
            for b in told:
                self._rngs[b] = seeding.np_random(int(seeds[b]))[0]  # type: ignore[arg-type]
            self.batch.reseed(told, [int(seeds[b]) for b in told])  # type: ignore[arg-type]
        self._ended[envs] = False
        self._seen = self._again(envs)
        return self._seen, {}

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all; an action of an environment that begins anew in this step is ignored, whatever it holds.

        Raises ``InputError`` for actions of another shape, outside of [−1, 1] or not finite, naming the environment; or after ``close``.
        """
        _check_open(self.closed)
        late = np.flatnonzero(self._ended) if self._mode is AutoresetMode.NEXT_STEP else np.zeros(0, int)
        actions = np.asarray(actions)
        if len(late) and actions.ndim and len(actions) == self.num_envs:
            actions = actions.copy()
            actions[late] = 0.0
        out = self.batch.step(actions, np.isin(np.arange(self.num_envs), late) if len(late) else None)
        observation, terms = out.observation, {name: term.copy() for name, term in out.terms.items()}
        reward, terminated, truncated = out.reward.copy(), out.terminated.copy(), out.truncated.copy()
        success, failed = out.success.copy(), out.failed.copy()
        if len(late):
            observation = self._again(late)
            for values in (reward, terminated, truncated, success, failed, *terms.values()):
                values[late] = 0
        infos = _infos(self.num_envs, {"reward_terms": terms, "success": success, "failed": failed})
        self._ended = terminated | truncated
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            ended = np.flatnonzero(self._ended)
            infos |= self._final(out, ended)
            observation = self._again(ended)
            self._ended[:] = False
        self._seen = observation
        return observation, reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """One picture of each environment, as ``TactileEnv.render``; None without a render mode. Raises the same."""
        _check_open(self.closed)
        if self.render_mode is None:
            return None
        if self._seen is None:
            raise InputError("environment", value=0, rule="must be reset before it is drawn")
        if self._picture is None:
            self._picture = EnvironmentPicture(self.batch)
        return tuple(self._picture.draw(b, self._seen) for b in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderer, if there is one."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def _again(self, envs: Sequence[int] | np.ndarray) -> dict[str, np.ndarray]:
        return self.batch.reset([int(b) for b in envs], [self._rngs[b] for b in envs])

    def _final(self, out: Outcome, ended: np.ndarray) -> dict[str, Any]:
        last, told = np.full(self.num_envs, None, object), np.zeros(self.num_envs, bool)
        for b in ended:
            last[b] = {name: values[b].copy() for name, values in out.observation.items()}
        told[ended] = True
        terms = {name: np.where(told, term, 0.0) for name, term in out.terms.items()}
        final = {"reward_terms": terms, "success": out.success & told, "failed": out.failed & told}
        info = _infos(self.num_envs, final)
        return {"final_obs": last, "_final_obs": told, "final_info": info, "_final_info": told.copy()}


def _row(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: values[0] for name, values in observation.items()}


def _infos(num_envs: int, values: dict[str, Any]) -> dict[str, Any]:
    """With the masks beside every entry by which Gymnasium's vectors tell which environments have it."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found[name] = _infos(num_envs, value) if isinstance(value, dict) else value
        found[f"_{name}"] = np.ones(num_envs, bool)
    return found
