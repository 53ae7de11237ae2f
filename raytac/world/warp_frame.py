"""``WarpFrame``: what one sensor of many worlds feels, as arrays of their device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl".)

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from raytac.errors import InputError

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class WarpFrame:
    """Readings of one sensor in B worlds; the arrays are overwritten by the next step.

    ``torch`` and ``numpy`` give them by name; a reading that was not asked for is not among them.
    """

    wrench: wp.array
    """On the pad about its origin, pad frame [N, N m], (B, 6), float64."""
    active: wp.array
    """Worlds that have not broken down; others are not stepped before a reset, (B,), bool."""
    height: wp.array | None = None
    """z of the gel's surface, pad frame [m], (B, Ny, Nx), float32."""
    contact: wp.array | None = None
    """1 where something touches, (B, Ny, Nx), uint8."""
    markers: wp.array | None = None
    """Displacements of the markers along x, y [m], (B, M, 2), float32."""
    traction: wp.array | None = None
    """Force per area at rest on a soft pad, pad frame [Pa], (B, Ny, Nx, 3), float32."""

    def torch(self) -> dict[str, torch.Tensor]:
        """Tensors by name, which share the arrays' memory. Raises ``InputError`` without PyTorch."""
        try:
            import torch  # noqa: F401
        except ImportError as error:
            raise InputError("torch", value="not installed", rule="is needed for tensors: pip install torch") from error
        return {name: wp.to_torch(array) for name, array in self._given().items()}

    def numpy(self) -> dict[str, np.ndarray]:
        """Copies on the host, by name; it waits for the device."""
        return {name: array.numpy().copy() for name, array in self._given().items()}

    def _given(self) -> dict[str, Any]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: array for name, array in values.items() if array is not None}
