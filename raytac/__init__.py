"""raytac: what the camera inside a GelSight sensor sees when something touches its gel.

Importing this package is cheap: the renderer, the physics engine and the plotting library load when a job first needs them.
"""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from raytac.device import resolve_device
    from raytac.errors import AssetError, BackendError, InputError, MeshError, RaytacError, SpecError
    from raytac.frame import TactileFrame
    from raytac.gel.surface import GelSurface, PadGrid
    from raytac.sensor import TactileSensor
    from raytac.specs import PressScene, SensorSpec, load_press, load_sensor

__version__ = "0.1.0"

__all__ = [
    "AssetError",
    "BackendError",
    "GelSurface",
    "InputError",
    "MeshError",
    "PadGrid",
    "PressScene",
    "RaytacError",
    "SensorSpec",
    "SpecError",
    "TactileFrame",
    "TactileSensor",
    "__version__",
    "foreign_ipc",
    "load_press",
    "load_sensor",
    "resolve_device",
]

_HOME = {
    "AssetError": "raytac.errors",
    "BackendError": "raytac.errors",
    "GelSurface": "raytac.gel.surface",
    "InputError": "raytac.errors",
    "MeshError": "raytac.errors",
    "PadGrid": "raytac.gel.surface",
    "PressScene": "raytac.specs",
    "RaytacError": "raytac.errors",
    "SensorSpec": "raytac.specs",
    "SpecError": "raytac.errors",
    "TactileFrame": "raytac.frame",
    "TactileSensor": "raytac.sensor",
    "load_press": "raytac.specs",
    "load_sensor": "raytac.specs",
    "resolve_device": "raytac.device",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'raytac' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def foreign_ipc() -> str | None:
    """Where ``import ipc`` would come from if that is not raytac's own ``ipc`` package; None if all is well.

    Nothing of the other package is run: its file is found and read as text.
    """
    spec = importlib.util.find_spec("ipc")
    if spec is None:
        return "nowhere: there is no package of that name"
    if spec.origin is None:  # a namespace package: a folder of that name without an __init__.py
        return ", ".join(spec.submodule_search_locations or ()) or "a folder without __init__.py"
    try:
        ours = 'RAYTAC_IPC_MARKER = "raytac-ipc"' in Path(spec.origin).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        ours = False
    return None if ours else spec.origin


def _warn_of_foreign_ipc() -> None:
    where = foreign_ipc()
    if where is not None:
        warnings.warn(
            f"`import ipc` finds {where}, not the solver that belongs to raytac; the rigid pad still works, the "
            "soft pad will not. Uninstall the other package, or put raytac first on the path (`raytac doctor` tells more).",
            RuntimeWarning,
            stacklevel=3,
        )


_warn_of_foreign_ipc()
