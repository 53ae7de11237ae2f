"""Observations that every task has, of B environments; NumPy, or PyTorch on a device."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from raytac.envs.task_rules import Array, namespace_of
from raytac.observe import ArraySpec, TactileObserver

_LENGTH, _SPEED = 0.1, 1.0
"""Scales of positions [m] and speeds [m/s, rad/s]."""


def state_and_goal(
    tool: Array, start: Array, turn: Array, speed: Array, opening: Array, action: Array, goal: Array
) -> dict[str, Array]:
    """``state`` (B, n) and ``goal`` (B, 3), float32.

    Args:
        tool, start: poses (B, 4, 4) of the tool and (4, 4) in the scene.
        turn: rotation vectors from the latter (B, 3) [rad].
        speed: of the tool (B, 3) [m/s].
        opening: gap between two pads (B, 1) [m]; (B, 0) without a gripper.
        action: last ones (B, k).
        goal: positions (B, 3) [m].
    """
    xp, position = namespace_of(tool), tool[:, :3, 3]
    parts = [(position - start[:3, 3]) / _LENGTH, turn, speed / _SPEED, opening / _LENGTH, action]
    values = {"state": xp.concat(parts, axis=1), "goal": (goal - position) / _LENGTH}
    return {name: xp.astype(array, xp.float32) for name, array in values.items()}


def body_from_tool(tool: Array, body: Array, speed: Array) -> Array:
    """``body`` (B, 15): position from the tool, two columns of the rotation, velocities."""
    xp = namespace_of(tool)
    place = (body[:, :3, 3] - tool[:, :3, 3]) / _LENGTH
    return xp.astype(xp.concat([place, body[:, :3, 0], body[:, :3, 1], speed / _SPEED], axis=1), xp.float32)


def observation_arrays(
    actions: int, *, has_grip: bool, body_seen: bool, observers: Mapping[str, TactileObserver]
) -> dict[str, ArraySpec]:
    """Shape, type and bounds of every observation of one environment.

    They are ``state``, ``goal``, perhaps ``body``, and ``<sensor>_<modality>``.

    Args:
        has_grip: there is a gap between two pads.
    """
    sizes = {"state": 9 + has_grip + actions, "goal": 3} | ({"body": 15} if body_seen else {})
    specs = {name: ArraySpec((n,), np.float32, -np.inf, np.inf) for name, n in sizes.items()}
    for name, observer in observers.items():
        specs |= {f"{name}_{modality}": spec for modality, spec in observer.arrays.items()}
    return specs
