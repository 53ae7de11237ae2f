"""Rules of a task: motion of the tool, start, reward and end of an episode. Batches, SI units, world frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np


@dataclass(frozen=True)
class Motion:
    """Motion that an action commands. The tool is the site that the arm steers: the pad, or the midpoint of two pads."""

    axes: tuple[str, ...]
    """One component of the action each: ``x``, ``y``, ``z`` along and ``rx``, ``ry``, ``rz`` about the world's axes; last, ``grip`` the
    opening."""
    step: tuple[float, ...]
    """Change of the target in a control step for an action of 1 [m, rad]."""
    low: tuple[float, float, float]
    """Lower corner of the box that the target position stays in [m]."""
    high: tuple[float, float, float]
    """Upper corner of that box [m]."""
    leash: float = 0.01
    """Greatest lead of the target over the tool along an axis [m]; with the arm's springs it bounds the force of a press."""
    turn: float = 0.35
    """Greatest rotation of the target from the start [rad]."""
    opening: tuple[float, float] = (0.0, 0.08)
    """Least and greatest opening that an action can command [m]."""
    joint_step: float = 0.05
    """Change of a joint's target in a control step for an action of 1, with ``action="joints"`` [rad]."""
    joint_leash: float = 0.1
    """Greatest lead of a joint's target over the joint [rad]."""
    frequency: float = 30.0
    """Natural frequency of the joints' springs [rad/s]."""


@dataclass(frozen=True)
class Start:
    """Start of one episode."""

    goal: np.ndarray
    """Goal position (3,) [m]."""
    bodies: dict[str, np.ndarray] = field(default_factory=dict)
    """``world_from_body`` (4, 4) of bodies that do not start as in the scene."""


@dataclass(frozen=True)
class TaskState:
    """B environments after a step."""

    tool: np.ndarray
    """Pose (B, 4, 4)."""
    speed: np.ndarray
    """Mean velocity of the tool over the last step [m/s], (B, 3)."""
    body: np.ndarray
    """Pose (B, 4, 4) of the task's body."""
    body_speed: np.ndarray
    """Mean velocity [m/s] and angular velocity [rad/s] of the body over the last step, (B, 6)."""
    goal: np.ndarray
    """Goal positions (B, 3) [m]."""
    wrench: Mapping[str, np.ndarray]
    """Wrench (B, 6) of every sensor, pad frame."""
    joint_speed: np.ndarray
    """Joint speeds (B, n) [rad/s]."""
    action: np.ndarray
    """Action of this step (B, k)."""
    last_action: np.ndarray
    """Action of the step before (B, k)."""


@dataclass(frozen=True)
class TaskResult:
    """Reward and end of a step, in B environments."""

    terms: dict[str, np.ndarray]
    """Terms of the reward, each (B,); their sum is the reward."""
    terminated: np.ndarray
    """Episodes that end here, (B,), bool."""
    success: np.ndarray
    """Environments in which the task is done now, (B,), bool; this ends no episode."""


class Task(ABC):
    """One task: constants, starts, reward and end."""

    scene: ClassVar[str]
    """Task scene of the task."""
    body: ClassVar[str]
    """Body that the task is about."""
    motion: ClassVar[Motion]
    max_episode_steps: ClassVar[int]
    body_seen: ClassVar[bool]
    """Default of ``TaskBatch``'s ``body_seen``: the body's pose and velocity are observed."""
    tactile: ClassVar[tuple[str, ...]] = ("markers",)
    """Default modalities of every sensor."""

    stands_on: ClassVar[str | None] = None
    """Sensor whose pad carries the body at the start; None: something else does."""

    @abstractmethod
    def start(self, rng: np.random.Generator, tool: np.ndarray, body: np.ndarray) -> Start:
        """Draw an episode, given poses (4, 4) of tool and body in the scene."""

    @abstractmethod
    def evaluate(self, state: TaskState) -> TaskResult:
        """Reward and end of a step."""

    @staticmethod
    def effort(state: TaskState) -> dict[str, np.ndarray]:
        """Terms of every task: −1e-4 |a − a₋₁|² and −1e-4 |q̇|² (Isaac Lab's lift task, its weights at the start)."""
        return {
            "action_rate": -1e-4 * np.square(state.action - state.last_action).sum(axis=1),
            "joint_speed": -1e-4 * np.square(state.joint_speed).sum(axis=1),
        }


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (B,) of points (B, d)."""
    apart = a - b
    return np.sqrt(np.vecdot(apart, apart))


def near(distance: np.ndarray, width: float) -> np.ndarray:
    """1 − tanh(d / width): 1 at no distance, 0 far away."""
    return 1.0 - np.tanh(distance / width)
