"""Policies written by hand from the batch's state, to show a task's return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from raytac.envs.batch import TaskBatch
from raytac.envs.insert_peg import RIM, SOCKET
from raytac.envs.open_drawer import handle_of

GAINS = np.array([-5.2, -5.0, -32.4, -4.6])
"""Feedback gains of x, ẋ, θ, θ̇ (see ``balance_pole``)."""


def push_cube(batch: TaskBatch) -> np.ndarray:
    """Press with some 5 N, then move along the cube's error, 2 mm a step at most."""
    cube = batch.body[:, :3, 3]
    force = -batch.world.state().wrench["sensor"][:, 2]
    pressed = force > 0.5
    error = np.where(pressed[:, None], batch.goal - cube, 0.0)
    action = np.zeros((len(cube), 3))
    action[:, :2] = np.clip(error[:, :2] / 0.012, -0.67, 0.67)
    action[:, 2] = np.clip(0.05 * (force - 6.0), -0.4, 0.3)
    return action


def roll_ball(batch: TaskBatch) -> np.ndarray:
    """Press with about 0.5 N and move the pad twice as far as the ball has to go."""
    ball, goal = batch.body[:, :3, 3], batch.goal
    force = -batch.world.state().wrench["sensor"][:, 2]
    action = np.zeros((len(ball), 3))
    action[:, :2] = np.where((force > 0.1)[:, None], np.clip((goal - ball)[:, :2] / 4e-3, -0.4, 0.4), 0.0)
    action[:, 2] = np.clip(0.3 * (force - 0.5), -0.5, 0.5)
    return action


def balance_pole(batch: TaskBatch) -> np.ndarray:
    """Linear quadratic regulator of a thin pole on a cart: θ̈ = 3g/2L θ − 3/2L ẍ."""
    axis, spin = batch.body[:, :3, 2], batch.body_speed[:, 3:]
    lean, rate = axis[:, :2], np.stack([spin[:, 1], -spin[:, 0]], axis=1)
    commanded = batch.action[:, :2] * 2e-3 / batch.control_timestep
    position = batch.target[:, :2, 3] - batch.start_tool[:2, 3]
    push = np.einsum("k,kbi->bi", GAINS, np.stack([position, commanded, lean, rate]))
    return np.clip((commanded - push * batch.control_timestep) * batch.control_timestep / 2e-3, -1.0, 1.0)


def lift_cube(batch: TaskBatch) -> np.ndarray:
    """Move over the cube, go down, close, carry it to the goal."""
    tool, cube, goal = batch.tool[:, :3, 3], batch.body[:, :3, 3], batch.goal
    force = np.minimum(*(-batch.world.state().wrench[name][:, 2] for name in ("left", "right")))
    off = cube - tool
    over, grasped = np.linalg.norm(off[:, :2], axis=1) < 4e-3, force > 4.0
    down = tool[:, 2] < cube[:, 2] + 3e-3
    target = np.where(grasped[:, None], goal - cube, np.where(over[:, None], off, off * [1.0, 1.0, 0.0]))
    action = np.zeros((len(tool), 4))
    action[:, :3] = np.clip(target / 5e-3, -1.0, 1.0) * np.where(grasped, 0.4, 1.0)[:, None]
    action[:, 3] = np.where(grasped, np.where(force > 12.0, 0.05, 0.0), np.where(over & down, -0.3, 0.0))
    return action


def insert_peg(batch: TaskBatch) -> np.ndarray:
    """Grasp the peg, lift it and put it in the socket, whose true place is not observed."""
    peg, axis, tool = batch.body[:, :3, 3], batch.body[:, :3, 2], batch.tool[:, :3, 3]
    tip = peg - 0.025 * axis
    grasped, action = _grasp(batch, peg + 0.011 * axis - tool)
    aside = np.concatenate([SOCKET - tip[:, :2], np.zeros((len(tip), 1))], axis=1)
    distance, high = np.linalg.norm(aside, axis=1), tip[:, 2] > RIM + 2e-3
    inside = (tip[:, 2] < RIM) & (distance < 1e-3)
    # The arm lags behind its target, which is to stop over the socket.
    carry = np.where((high | inside)[:, None], aside - (batch.target[:, :3, 3] - tool) * [1.0, 1.0, 0.0], 0.0)
    carry[:, 2] = np.where(inside | (distance < 3e-4), -4e-3, RIM + 6e-3 - tip[:, 2])
    action[grasped, :3] = 0.5 * np.clip(carry[grasped] / 4e-3, -1.0, 1.0)
    return action


def open_drawer(batch: TaskBatch) -> np.ndarray:
    """Grasp the handle and pull it to the goal."""
    handle = handle_of(batch.body)
    grasped, action = _grasp(batch, handle - batch.tool[:, :3, 3])
    action[grasped, :3] = 0.5 * np.clip((batch.goal - handle)[grasped] * [1.0, 0.0, 0.0] / 4e-3, -1.0, 1.0)
    return action


def _grasp(batch: TaskBatch, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pads that hold something (B,), and actions (B, 4) to close ``off`` [m] (B, 3) away."""
    force = np.minimum(*(-batch.world.state().wrench[name][:, 2] for name in ("left", "right")))
    grasped, over, down = force > 3.0, np.linalg.norm(off[:, :2], axis=1) < 2e-3, np.abs(off[:, 2]) < 2e-3
    action = np.zeros((len(off), 4))
    action[:, :3] = np.clip(np.where(over[:, None], off, off * [1.0, 1.0, 0.0]) / 4e-3, -1.0, 1.0)
    action[:, 3] = np.where(grasped, np.where(force > 8.0, 0.05, 0.0), np.where(over & down, -0.3, 0.0))
    return grasped, action


SCRIPTED: Final[Mapping[str, Callable[[TaskBatch], np.ndarray]]] = {
    "PushCube": push_cube,
    "BalancePole": balance_pole,
    "LiftCube": lift_cube,
    "RollBall": roll_ball,
    "InsertPeg": insert_peg,
    "OpenDrawer": open_drawer,
}
"""Actions (B, k) from a batch, by the name of the task."""
