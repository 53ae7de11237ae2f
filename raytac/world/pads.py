"""Pads of a world: their protocol, and the implementations by name of the physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from raytac.gel.surface import PadGrid
from raytac.physics.base import PadReading
from raytac.registry import Registry
from raytac.world.world_state import Drive

if TYPE_CHECKING:
    from raytac.physics.soft.scene import SoftScene

WORLD_PADS: Registry[Any] = Registry(
    "physics", {"rigid": "raytac.world.rigid_pads:rigid_pads", "ipc": "raytac.world.c_soft_pads:CSoftPads"}
)
"""Makers of pads, called with ``(composed, models, datas, *, physics, coupling, device)``.

``physics`` is the configuration."""


class WorldPads(Protocol):
    """All pads of a world, B environments."""

    report: dict[str, np.ndarray]
    """Figures of the solver in the last step, each (B,); empty without one."""

    @property
    def soft(self) -> SoftScene | None:
        """The contact solver's scene; None without one."""
        ...

    @property
    def meshes(self) -> tuple[str, ...]:
        """Names of all that ``soft`` has a surface of."""
        ...

    def reset(self, envs: Sequence[int], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Put environments back to the start, where MuJoCo's states are.

        Args:
            bodies: not None if bodies or the robot start elsewhere: name to poses (n, 4, 4).

        Raises:
            OverlapError: bodies overlap there.
        """
        ...

    def advance(self, drive: Drive, failed: np.ndarray) -> None:
        """One control step; environments that break down are in ``failed`` (B,) and stand still."""
        ...

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) of what touches a pad, about its origin, pad frame."""
        ...

    def reading(self, name: str, grid: PadGrid, failed: np.ndarray, envs: Sequence[int] | None = None) -> PadReading:
        """Surface and forces of one sensor on ``grid``, a row for each of ``envs`` (None: all)."""
        ...

    def overlap(self, env: int) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at the present poses of an environment."""
        ...
