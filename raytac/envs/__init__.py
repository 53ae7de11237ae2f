"""Gymnasium environments; importing this registers them.

``import raytac.envs; gymnasium.make("raytac/PushCube-v0")``
"""

from typing import Any

import lazy_loader

from raytac.envs.registration import register_envs
from raytac.errors import BackendError

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_LEARNERS = {"torch": "PyTorch", "tensordict": "tensordict", "rsl_rl": "rsl_rl", "stable_baselines3": "stable-baselines3"}


def __getattr__(name: str) -> Any:
    """Public name; raises ``BackendError`` where it needs a learner's library that is absent."""
    try:
        return _attribute(name)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _LEARNERS:
            raise
        raise BackendError(f"{name} needs {_LEARNERS[package]}, which is not installed: pip install 'raytac[rl]'") from error


register_envs()
