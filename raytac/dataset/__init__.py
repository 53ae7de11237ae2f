"""Data sets of presses: plan, render in shards (on one machine or on Ray), check, read."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
