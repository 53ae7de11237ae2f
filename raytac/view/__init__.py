"""A scene in the browser: ``raytac view SCENE`` (docs/viewer.md). Needs ``raytac[view]``.

The page has a 3-D view, tactile images and sliders.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
