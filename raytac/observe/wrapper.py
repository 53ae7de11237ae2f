"""Gymnasium wrapper that adds observations of tactile sensors to an environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np

from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.observe.observer import TactileObserver
from raytac.observe.spaces import gymnasium_space

__all__ = ["AddTactile"]


class AddTactile(gymnasium.Wrapper):
    """Dict of the environment's observation (its keys if it is a Dict, else ``observation``) and the modalities of each sensor.

    .. code-block:: python

        env = AddTactile(MyEnv(world), {"left": observer}, world.observe)
        env.reset()[0]["left_rgb"]

    Names are flat, ``<sensor>_<modality>`` as in the tasks of ``raytac.envs``, since stable-baselines3 refuses a Dict in a Dict.

    ``reset(seed=…)`` seeds the observers' cameras too. Noise of markers is drawn by the sensor that gives the frames: seed that in the
    environment's own ``reset``.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        observers: Mapping[str, TactileObserver],
        frames: Callable[[], Mapping[str, TactileFrame]],
    ) -> None:
        """Wrap ``env``.

        Args:
            env: environment to wrap.
            observers: observer of each sensor, with one environment and without ``difference``.
            frames: function that returns the present frame of each sensor.

        Raises:
            InputError: an observer of several environments, or a name that the observation has already.
        """
        super().__init__(env)
        for name, observer in observers.items():
            if observer.num_envs != 1:
                raise InputError(f"observers[{name!r}]", value=observer.num_envs, rule="must be of one environment")
            if observer.settings.difference:
                raise InputError(f"observers[{name!r}]", value="difference", rule="needs the sensor: subtract in your loop")
        self.observers, self._frames = dict(observers), frames
        inner = env.observation_space
        spaces: dict[str, Any] = dict(inner.spaces) if isinstance(inner, gymnasium.spaces.Dict) else {"observation": inner}
        for name, observer in observers.items():
            for modality, box in gymnasium_space(observer.arrays).items():
                key = f"{name}_{modality}"
                if key in spaces:
                    raise InputError("observers", value=name, rule=f"gives {key!r}, which is a key of the observation already")
                spaces[key] = box
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment and every observer.

        Raises:
            InputError: an observer whose frame is not given; in ``step`` too.
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
        joined = dict(observation) if isinstance(observation, Mapping) else {"observation": observation}
        frames = self._frames()
        for name, observer in self.observers.items():
            if name not in frames:
                raise InputError("observers", value=name, rule="must be names of frames that are given", choices=tuple(frames))
            joined |= {f"{name}_{modality}": np.asarray(value[0]) for modality, value in observer.observe(frames[name]).items()}
        return joined
