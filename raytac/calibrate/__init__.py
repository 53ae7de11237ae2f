"""Real sensor images with known indenters: reading them, and fitting sensors to them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
