"""Markers: how the dots on the coat move, by four models behind one interface; see docs/markers.md."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
