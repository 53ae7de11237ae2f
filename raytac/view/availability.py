"""Packages of the viewer, which are an extra."""

from __future__ import annotations

import importlib.util

from raytac.errors import BackendError

PACKAGES = ("viser", "websockets", "msgspec")
"""Packages that the viewer imports."""
NOT_INSTALLED = "the viewer is not installed: pip install 'raytac[view]'"


def check_viewer() -> None:
    """Raise ``BackendError`` if a package of the viewer is not installed."""
    if not all(importlib.util.find_spec(package) for package in PACKAGES):
        raise BackendError(NOT_INSTALLED)
