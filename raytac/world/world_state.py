"""State of a world after a step, and the controllers that drive it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import summary

LARGEST_SPEED = 1e4
"""Joint speed [rad/s or m/s] beyond which an environment counts as failed."""

Controller = Callable[[mujoco.MjData, float], None]
"""Function that writes ``data.ctrl`` of one environment at a time since the reset [s].

It is called in every step of MuJoCo, when positions, velocities and bias forces are up to date, and before the contacts of rigid pads are
computed, which may close by these very controls."""
Drive = Callable[[Sequence[int] | np.ndarray], None]
"""Writes ``data.ctrl`` of the environments named, at the same moments."""


class BatchController(ABC):
    """Controller of all environments in one call."""

    @abstractmethod
    def drive(self, datas: Sequence[mujoco.MjData], envs: Sequence[int] | np.ndarray) -> None:
        """Write ``ctrl`` of ``datas[b]`` for b of ``envs``, as a ``Controller``; others have failed."""


Control = Controller | BatchController | Sequence[Controller] | np.ndarray
"""Controllers of a world: one for all, one each, or constant controls (nu,) or (B, nu)."""


@dataclass(frozen=True)
class WorldState:
    """B environments at one instant, world frame unless said otherwise.

    An environment that failed holds NaN.
    """

    time: np.ndarray
    """Time since the reset [s], shape (B,)."""
    joints: np.ndarray | None
    """Positions of the arm's joints [rad or m], shape (B, n); None without an arm."""
    world_from_pad: dict[str, np.ndarray]
    """Pose (B, 4, 4) of every sensor's pad frame."""
    world_from_body: dict[str, np.ndarray]
    """Pose (B, 4, 4) of every rigid body."""
    wrench: dict[str, np.ndarray]
    """Contact force [N] and torque about the origin [N m] on each pad, **pad frame**, (B, 6)."""
    failed: np.ndarray
    """Environments whose physics broke down, (B,), bool; they stand still until reset."""
    report: dict[str, np.ndarray] = field(default_factory=dict)
    """Report of the pads' solver on this step, each (B,); empty with the rigid pad."""

    def __repr__(self) -> str:
        return summary(self)


def check_controls(env: int, data: mujoco.MjData) -> None:
    """Raise ``InputError`` for a control that is not finite: MuJoCo would set all of them to 0."""
    if not np.isfinite(data.ctrl).all():
        k = int(np.flatnonzero(~np.isfinite(data.ctrl))[0])
        raise InputError(f"control[{k}]", value=float(data.ctrl[k]), rule=f"must be finite in environment {env}")


def constant_controls(control: np.ndarray, num_envs: int, count: int) -> np.ndarray:
    """Constant controls as (B, nu); ``count`` is nu.

    Raises ``InputError`` for another shape or a number that is not finite.
    """
    values = np.asarray(control, float)
    if values.shape not in ((count,), (num_envs, count)):
        raise InputError("control", value=values.shape, rule=f"is its shape, which must be ({count},) or ({num_envs}, {count})")
    for index in np.argwhere(~np.isfinite(values)).tolist():
        raise InputError(f"control{index}", value=float(values[tuple(index)]), rule="must be finite")
    return np.broadcast_to(values, (num_envs, count))


def lost(speed: np.ndarray, position: np.ndarray) -> np.ndarray:
    """True (n,) where ``qvel`` or ``qpos`` (n, …) is not finite or a joint is far too fast."""
    # One number that is not finite makes the sum such.
    return np.logical_not((np.abs(speed).max(axis=1, initial=0.0) < LARGEST_SPEED) & np.isfinite(position.sum(axis=1)))
