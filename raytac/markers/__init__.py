"""Markers: motion of the dots on the coat by five models; see docs/concepts/markers.md."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
