"""A scene in the browser: 3-D view, tactile images, sliders; ``raytac view SCENE`` (see docs/viewer.md). Needs ``raytac[view]``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
