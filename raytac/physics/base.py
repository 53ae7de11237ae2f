"""What any pad's physics tells a sensor about one instant: the surface and what touches does to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.specs.press import PressScene

__all__ = ["ContactState", "PadReading"]


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


@dataclass(frozen=True)
class ContactState:
    """B environments at one instant. Forces are those of the object on the gel, pad frame.

    pad_from_object, shape (B, 4, 4): pose of the object. world_from_pad, shape (B, 4, 4): pose of the case; the identity unless the
    scene moves it (world and pad frame are one at first touch). depth [m], (B,): travel below first touch at zero shear and twist;
    negative when lifted. normal_force [N], (B,): towards −z, >= 0. shear_force [N], (B, 2): along x and y. twist_torque [N m],
    (B,): about +z. force_law_area [m²], (B,): area of contact by the load law, which the forces follow. failed, (B,) bool: the
    state of this environment is not finite, did not settle, or did not converge (its pose is then NaN).
    """

    stage: int
    """Index in the trajectory; −1 before the first stage."""
    kind: str
    """Kind of that stage, or ``start``."""
    fraction: float
    """How much of the stage is done, in (0, 1]."""
    pad_from_object: np.ndarray
    world_from_pad: np.ndarray
    depth: np.ndarray
    normal_force: np.ndarray
    shear_force: np.ndarray
    twist_torque: np.ndarray
    force_law_area: np.ndarray
    failed: np.ndarray
    scene: PressScene | None = None
    """Scene that the object belongs to; None if it is not known."""
    unconverged: np.ndarray | None = None
    """Steps of the solver since the start that did not meet its tolerance, (B,), int; None for the rigid pad, which has no solver."""
