"""The gel's surface: heights on a grid, the coat's mesh, the elastic surround and traction."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
