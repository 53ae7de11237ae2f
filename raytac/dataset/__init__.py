"""Data sets of presses: plan, render in shards (here or on Ray), check, read, export."""

from typing import Any

import lazy_loader

from raytac.errors import BackendError

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Public name; raises ``BackendError`` where it needs PyTorch, which is absent."""
    try:
        return _attribute(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        raise BackendError(f"{name} needs PyTorch, which is not installed: pip install torch") from error
