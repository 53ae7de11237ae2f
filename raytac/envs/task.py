"""What a task is: how the tool moves, where an episode starts, what a step is worth and when it ends. Batches, SI units, world frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from raytac.se3 import rotations

__all__ = ["Motion", "Situation", "Start", "Task", "Verdict", "far", "near", "placed", "turned"]


@dataclass(frozen=True)
class Motion:
    """What an action moves. The tool is the site that the arm is steered by: the pad, or the middle between two pads."""

    axes: tuple[str, ...]
    """One component of the action each: ``x``, ``y``, ``z`` along and ``rx``, ``ry``, ``rz`` about the world's axes; last, ``grip`` the
    opening."""
    step: tuple[float, ...]
    """What an action of 1 moves the target by in a control step [m, rad]."""
    low: tuple[float, float, float]
    """Corner of the box that the target of the tool's position stays in [m]."""
    high: tuple[float, float, float]
    leash: float = 0.01
    """How far the target may be ahead of the tool [m]: with the arm's springs, what the tool can press with."""
    turn: float = 0.35
    """How far the target may be turned from the start [rad]."""
    opening: tuple[float, float] = (0.0, 0.08)
    """Least and greatest opening that can be asked for [m]."""


@dataclass(frozen=True)
class Start:
    """Where one episode begins."""

    goal: np.ndarray
    """(3,) [m]."""
    bodies: dict[str, np.ndarray] = field(default_factory=dict)
    """``world_from_body`` (4, 4) of bodies that do not start as in the scene."""


@dataclass(frozen=True)
class Situation:
    """B environments after a step."""

    tool: np.ndarray
    """Pose (B, 4, 4)."""
    speed: np.ndarray
    """Velocity of the tool over the last step [m/s], (B, 3)."""
    body: np.ndarray
    """Pose (B, 4, 4) of the task's body."""
    body_speed: np.ndarray
    """Its velocity [m/s] and angular velocity [rad/s] over the last step, (B, 6)."""
    goal: np.ndarray
    """(B, 3) [m]."""
    wrench: Mapping[str, np.ndarray]
    """Of every sensor, pad frame, (B, 6)."""
    joint_speed: np.ndarray
    """[rad/s], (B, n)."""
    action: np.ndarray
    """(B, k)."""
    last_action: np.ndarray
    """(B, k)."""


@dataclass(frozen=True)
class Verdict:
    """What B environments earned in a step, and which of them have ended."""

    terms: dict[str, np.ndarray]
    """Terms of the reward, each (B,); their sum is the reward."""
    terminated: np.ndarray
    """(B,), bool."""
    success: np.ndarray
    """Whether the task is done now, (B,), bool; ends nothing."""


class Task(ABC):
    """One task: constants, starts, reward and end."""

    scene: ClassVar[str]
    """Task scene that it is played in."""
    body: ClassVar[str]
    """Body that it is about."""
    motion: ClassVar[Motion]
    max_episode_steps: ClassVar[int]
    body_seen: ClassVar[bool]
    """Whether the body's pose is observed unless said otherwise."""
    tactile: ClassVar[tuple[str, ...]] = ("markers",)
    """Modalities of every sensor unless said otherwise."""

    stands_on: ClassVar[str | None] = None
    """Sensor whose pad the body stands on at the start; None: on something else."""

    @abstractmethod
    def start(self, rng: np.random.Generator, tool: np.ndarray, body: np.ndarray) -> Start:
        """Draw an episode, given poses (4, 4) of tool and body in the scene."""

    @abstractmethod
    def judge(self, now: Situation) -> Verdict:
        """Reward and end of a step."""

    @staticmethod
    def effort(now: Situation) -> dict[str, np.ndarray]:
        """Terms of every task: −1e-4 |a − a₋₁|² and −1e-4 |q̇|² (Isaac Lab's lift task, its weights at the start)."""
        return {
            "action_rate": -1e-4 * np.square(now.action - now.last_action).sum(axis=1),
            "joint_speed": -1e-4 * np.square(now.joint_speed).sum(axis=1),
        }


def far(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (B,) of points (B, d)."""
    return np.linalg.norm(a - b, axis=-1)


def near(distance: np.ndarray, width: float) -> np.ndarray:
    """1 − tanh(d / width): 1 at no distance, 0 far away."""
    return 1.0 - np.tanh(distance / width)


def placed(pose: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The pose (4, 4) moved to a position."""
    moved = pose.copy()
    moved[:3, 3] = position
    return moved


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation (3, 3) about a unit axis."""
    return rotations((angle * axis)[None])[0]
