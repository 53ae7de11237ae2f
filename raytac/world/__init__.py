"""Worlds: robots, bodies and sensors in one MuJoCo model, for any number of environments."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
