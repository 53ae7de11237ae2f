"""Incremental potential contact for soft gel pads: a package of its own that never imports ``raytac``.

The solver is not written yet; this package holds its place and its marker.
"""

from __future__ import annotations

__all__ = ["RAYTAC_IPC_MARKER", "__version__"]

RAYTAC_IPC_MARKER = "raytac-ipc"
"""Tells this package from the other ``ipc`` packages that can be installed; ``raytac`` looks for it."""

__version__ = "0.1.0"
