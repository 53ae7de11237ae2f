"""Observations as PyTorch tensors that share the arrays' memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from raytac.errors import BackendError

__all__ = ["as_tensors"]


def as_tensors(observation: Mapping[str, Any]) -> dict[str, Any]:
    """``torch.Tensor`` by name, through DLPack, without a copy; nested dictionaries stay nested.

    Raises:
        BackendError: PyTorch is not installed.
    """
    try:
        import torch  # pyright: ignore[reportMissingImports]  # gigabytes: the checks run without it
    except ImportError as error:
        raise BackendError(f"tensors need PyTorch ({error}): `pip install raytac[rl]`") from error
    return {
        name: torch.from_dlpack(value) if isinstance(value, np.ndarray) else as_tensors(value)
        for name, value in observation.items()
    }
