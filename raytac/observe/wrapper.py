"""Gymnasium wrappers that add tactile observations to an environment or a vector of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from raytac.errors import BackendError, InputError
from raytac.frame import TactileFrame
from raytac.observe.observer import TactileObserver
from raytac.observe.spaces import gymnasium_space

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
except ModuleNotFoundError as error:
    raise BackendError("Gymnasium is not installed: pip install 'raytac[envs]'") from error

Frames = Callable[..., Mapping[str, TactileFrame]]
"""Function that returns the present frame of each sensor, as ``TactileWorld.observe``.

Where some environments of a vector are reset, it is called with ``envs=``, a list of them, and returns frames of these alone."""


class AddTactile(gymnasium.Wrapper):
    """Dict of the environment's observation and the modalities of each sensor.

    The environment's observation keeps its keys if it is a Dict; else it is ``observation``.

    .. code-block:: python

        env = AddTactile(MyEnv(world), {"left": observer}, world.observe)
        env.reset()[0]["left_rgb"]

    Names are flat, ``<sensor>_<modality>`` as in the tasks of ``raytac.envs``, since stable-baselines3 refuses a Dict in a Dict.

    ``reset(seed=…)`` seeds the observers' cameras too. Noise of markers is drawn by the sensor that gives the frames: seed that in the
    environment's own ``reset``.
    """

    def __init__(self, env: gymnasium.Env, observers: Mapping[str, TactileObserver], frames: Frames) -> None:
        """Wrap ``env``.

        Args:
            observers: observer of each sensor, with one environment and without ``difference``.
            frames: function that returns the present frame of each sensor.

        Raises:
            InputError: an observer of several environments, or a name that the observation has already.
        """
        super().__init__(env)
        _check(observers, 1, frames)
        self.observers, self._frames = dict(observers), frames
        self.observation_space = _space(env.observation_space, observers)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment and every observer.

        Raises ``InputError``: an observer whose frame is not given; in ``step`` too.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        for observer in self.observers.values():
            if seed is not None:
                observer.reseed([0], [seed])
            observer.reset()
        return self._joined(observation), info

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._joined(observation), reward, terminated, truncated, info

    def _joined(self, observation: Any) -> dict[str, Any]:
        own = _observed(self.observers, self._frames())
        return _dict(observation) | {name: np.asarray(values[0]) for name, values in own.items()}


class AddTactileVector(gymnasium.vector.VectorWrapper):
    """The same of a vector environment: arrays (B, …), all environments observed at once.

    .. code-block:: python

        envs = AddTactileVector(MyVectorEnv(world), {"left": observer}, world.observe)

    An observer begins an episode when the environment does, in each of Gymnasium's modes of automatic resets. With ``SAME_STEP`` an
    observation in ``final_obs`` has no touch in it. Environment b is seeded by ``seed`` + b, or by the b-th of several.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv, observers: Mapping[str, TactileObserver], frames: Frames) -> None:
        """As ``AddTactile``, with observers of as many environments as ``env`` has.

        Raises ``InputError``: an observer of another number of environments, or a name that the observation has already.
        """
        super().__init__(env)
        _check(observers, env.num_envs, frames)
        self.observers, self._frames = dict(observers), frames
        self.single_observation_space = _space(env.single_observation_space, observers)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, env.num_envs)
        self._mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._ended = np.zeros(env.num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environments, or those of ``options["reset_mask"]``, and their observers.

        Raises ``InputError``: an observer whose frame is not given; in ``step`` too.
        """
        chosen = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        observation, info = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        seeds = [None if seed is None else seed + b for b in range(self.num_envs)] if not isinstance(seed, list) else seed
        drawn = [b for b in np.flatnonzero(chosen).tolist() if seeds[b] is not None]
        for observer in self.observers.values():
            observer.reseed(drawn, [int(seeds[b]) for b in drawn])  # type: ignore[arg-type]
            observer.reset(chosen)
        self._ended[chosen] = False
        return self._joined(observation, None if chosen.all() else np.flatnonzero(chosen).tolist()), info

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        ended = np.asarray(terminated) | np.asarray(truncated)
        begins = {AutoresetMode.NEXT_STEP: self._ended, AutoresetMode.SAME_STEP: ended}.get(self._mode, np.zeros_like(ended))
        if begins.any():
            for observer in self.observers.values():
                observer.reset(begins)
        self._ended = ended
        return self._joined(observation), reward, terminated, truncated, info

    def _joined(self, observation: Any, envs: list[int] | None = None) -> dict[str, Any]:
        frames = self._frames() if envs is None else self._frames(envs=envs)
        return _dict(observation) | _observed(self.observers, frames, envs)


def _check(observers: Mapping[str, TactileObserver], count: int, frames: Frames) -> None:
    if not callable(frames):
        rule = "must be a function that returns frames: pass the function, as world.observe, not its result"
        raise InputError("frames", value=type(frames).__name__, rule=rule)
    for name, observer in observers.items():
        if observer.num_envs != count:
            rule = "must be of one environment" if count == 1 else f"must be of {count} environments"
            raise InputError(f"observers[{name!r}]", value=observer.num_envs, rule=rule)
        if observer.settings.difference:
            raise InputError(f"observers[{name!r}]", value="difference", rule="needs the sensor: subtract in your loop")


def _space(inner: gymnasium.Space, observers: Mapping[str, TactileObserver]) -> gymnasium.spaces.Dict:
    spaces: dict[str, Any] = dict(inner.spaces) if isinstance(inner, gymnasium.spaces.Dict) else {"observation": inner}
    for name, observer in observers.items():
        for modality, box in gymnasium_space(observer.arrays).items():
            key = f"{name}_{modality}"
            if key in spaces:
                raise InputError("observers", value=name, rule=f"gives {key!r}, which is a key of the observation already")
            spaces[key] = box
    return gymnasium.spaces.Dict(spaces)


def _dict(observation: Any) -> dict[str, Any]:
    return dict(observation) if isinstance(observation, Mapping) else {"observation": observation}


def _observed(
    observers: Mapping[str, TactileObserver], frames: Mapping[str, TactileFrame], envs: list[int] | None = None
) -> dict[str, np.ndarray]:
    """Arrays (B, …) of all observers, by the names of the space."""
    result = {}
    for name, observer in observers.items():
        if name not in frames:
            raise InputError("observers", value=name, rule="must be names of frames that are given", choices=tuple(frames))
        result |= {f"{name}_{modality}": values for modality, values in observer.observe(frames[name], envs=envs).items()}
    return result
