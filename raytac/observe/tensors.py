"""Observations as PyTorch tensors that share the arrays' memory, on the host or on a device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from raytac.errors import BackendError


def as_tensors(observation: Mapping[str, Any]) -> dict[str, Any]:
    """``torch.Tensor`` by name, through DLPack, without a copy; nested dictionaries stay nested.

    Raises:
        BackendError: PyTorch is not installed.
    """
    try:
        import torch  # pyright: ignore[reportMissingImports]  # gigabytes: the checks run without it
    except ImportError as error:
        raise BackendError(f"tensors need PyTorch ({error}): `pip install 'raytac[rl]'`") from error
    return {
        name: as_tensors(value) if isinstance(value, Mapping) else torch.from_dlpack(value) for name, value in observation.items()
    }
