"""The sensor as one object: pad, optical mode, markers and forces behind ``TactileSensor``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
