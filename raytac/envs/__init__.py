"""Gymnasium environments; importing this registers them.

``import raytac.envs; gymnasium.make("raytac/PushCube-v0")``
"""

import lazy_loader

from raytac.envs.registration import public_names, register_envs

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = public_names(_attribute)


register_envs()
