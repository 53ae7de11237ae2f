"""Shapes of objects: primitives, meshes and reliefs, their undersides and surfaces."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
