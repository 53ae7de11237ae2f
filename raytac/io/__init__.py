"""Files: results written whole or not at all, caches, metrics, images and the options that all commands share."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
