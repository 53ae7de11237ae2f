"""Gymnasium environments; importing this registers them.

``import raytac.envs; gymnasium.make("raytac/PushCube-v0")``
"""

import lazy_loader

from raytac.envs.registration import register_envs

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_envs()
