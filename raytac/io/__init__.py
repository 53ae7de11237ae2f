"""Files: results that are whole or absent, caches, metrics, images, common options."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
