"""Rules of a task: motion of the tool, start, reward and end. Batches, SI, world frame.

Arrays are NumPy's, or PyTorch's on any device: rules are written once, by the functions that both have (array API standard). They copy
nothing between host and device and never wait, so that a step can be recorded as a CUDA graph. (Hence the arrays' method ``clip``: the
function of array-api-compat 1.11 and 1.12 waits for the device.)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from array_api_compat import array_namespace, device

from raytac.se3 import rotations

Array = Any
"""Array of NumPy or PyTorch."""
_NAMESPACES: dict[type, Any] = {}


def namespace_of(array: Array) -> Any:
    """Functions of the array API for an array, looked up once for its type."""
    kind = type(array)
    if kind not in _NAMESPACES:
        _NAMESPACES[kind] = array_namespace(array)
    return _NAMESPACES[kind]


@dataclass(frozen=True)
class Motion:
    """Motion that an action commands of the tool: the pad, or the midpoint of two pads."""

    axes: tuple[str, ...]
    """Components of the action: ``x``, … along, ``rx``, … about world axes; last ``grip``, gap."""
    step: tuple[float, ...]
    """Change of the target in a control step for an action of 1 [m, rad]."""
    low: tuple[float, float, float]
    """Lower corner of the box that the target position stays in [m]."""
    high: tuple[float, float, float]
    """Upper corner of that box [m]."""
    leash: float = 0.01
    """Greatest lead of the target over the tool along an axis [m]; it bounds a press's force."""
    turn: float = 0.35
    """Greatest rotation of the target from the start [rad]."""
    opening: tuple[float, float] = (0.0, 0.08)
    """Least and greatest opening that an action can command [m]."""
    joint_step: float = 0.05
    """Change of a joint's target in a step for an action of 1, with ``joints`` [rad]."""
    joint_leash: float = 0.1
    """Greatest lead of a joint's target over the joint [rad]."""
    frequency: float = 30.0
    """Natural frequency of the joints' springs [rad/s]."""


@dataclass(frozen=True)
class Starts:
    """Starts of n episodes."""

    goal: Array
    """Goal positions (n, 3) [m]."""
    bodies: dict[str, Array] = field(default_factory=dict)
    """``world_from_body`` (n, 4, 4) of bodies that do not start as in the scene."""


@dataclass(frozen=True)
class TaskState:
    """B environments after a step."""

    tool: Array
    """Pose (B, 4, 4)."""
    speed: Array
    """Mean velocity of the tool over the last step [m/s], (B, 3)."""
    body: Array
    """Pose (B, 4, 4) of the task's body."""
    body_speed: Array
    """Mean velocity [m/s] and angular velocity [rad/s] of the body over the last step, (B, 6)."""
    goal: Array
    """Goal positions (B, 3) [m]."""
    wrench: Mapping[str, Array]
    """Wrench (B, 6) of every sensor, pad frame."""
    opening: Array
    """Gap between two pads (B, 1) [m]; (B, 0) without a gripper."""
    joint_speed: Array
    """Joint speeds (B, n) [rad/s]."""
    action: Array
    """Action of this step (B, k)."""
    last_action: Array
    """Action of the step before (B, k)."""


@dataclass(frozen=True)
class TaskResult:
    """Reward and end of a step, in B environments."""

    terms: dict[str, Array]
    """Terms of the reward, each (B,); their sum is the reward."""
    terminated: Array
    """Episodes that end here, (B,), bool."""
    success: Array
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
    draws: ClassVar[int]
    """Number of random numbers that a start needs."""
    tactile: ClassVar[tuple[str, ...]] = ("markers",)
    """Default modalities of every sensor."""

    stands_on: ClassVar[str | None] = None
    """Sensor whose pad carries the body at the start; None: something else does."""

    @abstractmethod
    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        """Starts of n episodes from uniform ``u`` (n, ``draws``) in [0, 1) and scene poses (4, 4)."""

    @abstractmethod
    def evaluate(self, state: TaskState) -> TaskResult:
        """Reward and end of a step."""

    @staticmethod
    def effort(state: TaskState) -> dict[str, Array]:
        """Terms of every task: −1e-4 |a − a₋₁|² and −1e-4 |q̇|², as Isaac Lab's lift task starts."""
        return {
            "action_rate": -1e-4 * squared(state.action - state.last_action),
            "joint_speed": -1e-4 * squared(state.joint_speed),
        }


def distances(a: Array, b: Array) -> Array:
    """Distances (B,) of points (B, d), or from one point (d,)."""
    xp, apart = namespace_of(a), a - b
    return xp.sqrt(xp.vecdot(apart, apart))


def squared(vectors: Array) -> Array:
    """Squared lengths (B,) of vectors (B, d)."""
    xp = namespace_of(vectors)
    return xp.sum(xp.square(vectors), axis=1)


def near(distance: Array, width: float) -> Array:
    """1 − tanh(d / width): 1 at no distance, 0 far away."""
    return 1.0 - namespace_of(distance).tanh(distance / width)


def constant(values: Sequence[float], like: Array) -> Array:
    """Vector of another array's type, made on its device: nothing is copied from the host."""
    result = namespace_of(like).empty((len(values),), dtype=like.dtype, device=device(like))
    for k, value in enumerate(values):
        result[k : k + 1] = value  # a slice is filled on the device, a single element would be copied there
    return result


def between(u: Array, low: float, high: float) -> Array:
    """Numbers in an interval from those in [0, 1), as ``numpy.random.Generator.uniform``."""
    return low + (high - low) * u


def moved(point: Array, x: Array, y: Array) -> Array:
    """Points (n, 3): one point (3,), or points (n, 3), moved horizontally by x and y, each (n,)."""
    xp = namespace_of(x)
    return point + xp.stack([x, y, xp.zeros_like(x)], axis=1)


def around(points: Array, angle: Array, distance: Array) -> Array:
    """Points (n, 3) at a distance from ``points`` along a horizontal angle [rad], (n,)."""
    xp = namespace_of(points)
    return moved(points, distance * xp.cos(angle), distance * xp.sin(angle))


def turned(rotation: Array, angle: Array) -> Array:
    """Rotations (n, 3, 3): ``rotation`` (3, 3) turned about world z by angles (n,) [rad]."""
    xp = namespace_of(angle)
    zero = xp.zeros_like(angle)
    return rotations(xp.stack([zero, zero, angle], axis=1)) @ rotation
