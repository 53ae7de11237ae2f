"""Policies for the tasks of ``raytac.envs``: training by PPO, held-out evaluation, play."""

import lazy_loader

from raytac.envs.registration import public_names

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = public_names(_attribute)
