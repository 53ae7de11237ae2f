"""A check that ``import ipc`` means raytac's own solver, not another package of that name."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path


def foreign_ipc() -> str | None:
    """Place of a foreign ``ipc`` that ``import ipc`` would take, or None; read, and not run."""
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


def warn_of_foreign_ipc() -> None:
    """Warn if ``import ipc`` is not raytac's own solver."""
    where = foreign_ipc()
    if where is not None:
        warnings.warn(
            f"`import ipc` finds {where}, not the solver that belongs to raytac; the rigid pad still works, the "
            "soft pad will not. Uninstall the other package, or put raytac first on the path (`raytac doctor` tells more).",
            RuntimeWarning,
            stacklevel=3,
        )
