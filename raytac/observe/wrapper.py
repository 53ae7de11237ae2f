"""A Gymnasium wrapper that adds what tactile sensors observe to an environment of one's own."""

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
    """Observations become a Dict: the environment's own (its keys if it is a Dict, else ``observation``) and the modalities of each sensor.

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
        """``observers``: one a sensor, of one environment, without ``difference``; ``frames``: gives the present frame of each.

        Raises:
            InputError: an observer of several environments, or a name that is in the observation already.
        """
        super().__init__(env)
        for name, observer in observers.items():
            if observer.num_envs != 1:
                raise InputError(f"observers[{name!r}]", value=observer.num_envs, rule="must be of one environment")
            if observer.settings.difference:
                raise InputError(f"observers[{name!r}]", value="difference", rule="needs the sensor: subtract in your loop")
        self.observers, self._frames = dict(observers), frames
        own = env.observation_space
        spaces: dict[str, Any] = dict(own.spaces) if isinstance(own, gymnasium.spaces.Dict) else {"observation": own}
        for name, observer in observers.items():
            for modality, box in gymnasium_space(observer.arrays).items():
                key = f"{name}_{modality}"
                if key in spaces:
                    raise InputError("observers", value=name, rule=f"gives {key!r}, which is a key of the observation already")
                spaces[key] = box
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment and begin anew in every observer.

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
        made = dict(observation) if isinstance(observation, Mapping) else {"observation": observation}
        frames = self._frames()
        for name, observer in self.observers.items():
            if name not in frames:
                raise InputError("observers", value=name, rule="must be names of frames that are given", choices=tuple(frames))
            made |= {f"{name}_{modality}": np.asarray(value[0]) for modality, value in observer.observe(frames[name]).items()}
        return made
