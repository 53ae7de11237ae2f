"""Data sets of presses: planned from a sweep, rendered in shards on one machine or on Ray, checked, and read back."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
