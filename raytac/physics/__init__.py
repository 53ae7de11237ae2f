"""Pads: a rigid one whose gel yields by a load law, and a soft one solved by ``ipc``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
