"""What a pad's physics knows at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.specs.press import PressScene

__all__ = ["ContactState"]


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
