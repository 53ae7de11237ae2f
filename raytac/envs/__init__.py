"""Gymnasium environments; importing this registers them.

``import raytac.envs; gymnasium.make("raytac/PushCube-v0")``
"""

from typing import Any

import lazy_loader

from raytac.envs.registration import raise_absent, register_envs

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Public name; raises ``BackendError`` where it needs a learner's library that is absent."""
    try:
        return _attribute(name)
    except ModuleNotFoundError as error:
        raise_absent(name, error)


register_envs()
