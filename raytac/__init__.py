"""raytac: what the camera inside a GelSight sensor sees when something touches its gel.

Importing this package is cheap: the renderer, the physics engine and the plotting library load when a job first needs them. Public are
the names of this package and those that its sub-packages list in ``__all__``; ``__init__.pyi`` beside each says where they are written.
"""

import lazy_loader

from raytac.installation import warn_of_foreign_ipc

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]

warn_of_foreign_ipc()
