"""A scene in the browser: ``raytac view`` (docs/guide/viewer.md); needs ``raytac[view]``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
