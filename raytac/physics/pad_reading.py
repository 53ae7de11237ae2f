"""What any pad's physics tells a sensor about one instant: the surface and what touches does to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from raytac.gel.surface import GelSurface

__all__ = ["PadReading"]


@dataclass(frozen=True)
class PadReading:
    """B pads of one sensor at one instant; pad frame.

    A press knows one object and its load (``ContactState``); in a world a pad is touched by whatever comes, and this is what is left.
    """

    surface: GelSurface
    wrench: np.ndarray
    """Force of all that touches on the pad [N] and its torque about the pad frame's origin [N m], shape (B, 6)."""
    failed: np.ndarray
    """Environments whose physics broke down, shape (B,), bool."""
    traction: Callable[[], np.ndarray]
    """Computes the traction on the pad [Pa], shape (B, Ny, Nx, 3), as ``TactileFrame.traction``; called only if it is asked for."""
    unconverged: np.ndarray | None = None
    """Steps of the solver since the reset that did not meet its tolerance, shape (B,), int; None for rigid pads."""

    def of(self, envs: Sequence[int] | np.ndarray) -> PadReading:
        """The same of the environments named, one row each."""
        whole, rows = self.surface, np.asarray(envs)
        coat = None if whole.coat is None else replace(whole.coat, positions=whole.coat.positions[rows])
        others = {
            name: None if values is None else values[rows]
            for name, values in (("pad_from_object", whole.pad_from_object), ("ink", whole.ink))
        }
        surface = replace(
            whole,
            height=whole.height[rows],
            contact=whole.contact[rows],
            contact_centre=whole.contact_centre[rows],
            coat=coat,
            **others,
        )
        unconverged = None if self.unconverged is None else self.unconverged[rows]
        return PadReading(surface, self.wrench[rows], self.failed[rows], lambda: self.traction()[rows], unconverged)

    @property
    def force(self) -> np.ndarray:
        """Force on the pad [N], shape (B, 3)."""
        return self.wrench[:, :3]
