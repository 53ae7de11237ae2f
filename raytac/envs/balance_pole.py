"""``raytac/BalancePole-v1``."""

from __future__ import annotations

import math
from typing import ClassVar

from array_api_compat import array_namespace

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import Array, Motion, Starts, Task, TaskResult, TaskState, between, distances
from raytac.se3 import pose, rotations


class BalancePole(Task):
    """Rules of ``BalancePoleEnv``, as code."""

    scene: ClassVar = "balance_pole"
    body: ClassVar = "pole"
    motion: ClassVar = Motion(("x", "y"), (2e-3, 2e-3), (0.35, -0.10, 0.55), (0.55, 0.10, 0.55), leash=0.02)
    max_episode_steps: ClassVar = 250
    body_seen: ClassVar = False
    draws: ClassVar = 4
    tactile: ClassVar = ("markers", "wrench")
    stands_on: ClassVar = "sensor"

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        xp = array_namespace(u)
        angle, tilt = between(u[:, 0], -math.pi, math.pi), between(u[:, 1], 0.0, math.radians(2.0))
        # The pole leans about an edge of its foot, which stays 0.1 mm above the pad.
        offset = [between(u[:, 2], -1e-3, 1e-3), between(u[:, 3], -1e-3, 1e-3), 1e-4 + 0.003 * xp.sin(tilt)]
        foot = tool[:3, 3] + xp.stack(offset, axis=1)
        rotation = rotations(xp.stack([tilt * xp.cos(angle), tilt * xp.sin(angle), xp.zeros_like(tilt)], axis=1))
        goal = xp.zeros_like(foot) + tool[:3, 3]
        return Starts(goal, {"pole": pose(rotation, foot + 0.15 * rotation[..., 2])})

    def evaluate(self, state: TaskState) -> TaskResult:
        xp, axis = array_namespace(state.body), state.body[:, :3, 2]
        tilt = xp.acos(axis[:, 2].clip(-1.0, 1.0))
        foot = state.body[:, :3, 3] - 0.15 * axis
        terminated = (distances(foot, state.tool[:, :3, 3]) > 0.05) | (state.body[:, 2, 3] < 0.4) | (tilt > math.pi / 6)
        terms = {
            "alive": 1.0 * ~terminated,
            "terminated": -2.0 * terminated,
            "tilt": -xp.square(tilt),
            "tool_speed": -0.01 * xp.sum(xp.abs(state.speed), axis=1),
            "pole_speed": -0.005 * xp.sum(xp.abs(state.body_speed[:, 3:]), axis=1),
        }
        return TaskResult({**terms, **self.effort(state)}, terminated, ~terminated & (tilt < math.radians(12.0)))


class BalancePoleEnv(TactileEnv):
    r"""Keep a pole upright that stands loosely on a sensor that looks up.

    A Panda holds a GelSight Mini (12 x 16 markers) pad up, 0.55 m high; on it stands a pole of 300 mm x 4 mm x 4 mm and 50 g (scene
    `balance_pole`). Only friction holds its foot, and without control it falls once it leans by more than about 1°.

    Action, Box(-1, 1, (2,)): displacement of the pad's target along world x and y (2 mm a step at 1). The target leads the pad by at most
    20 mm along an axis and stays in x 0.35 to 0.55, y ±0.10 m.

    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (11,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      last action (2);
    - `goal` (3,): goal from the tool / 0.1 m, world axes;
    - `body` (15,): of the pole, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); only with `body_seen=True`: without it the pole is known by touch alone;
    - `sensor_markers` (192, 2): displacements of the markers / 1 mm, which show where the pole stands. `tactile=` selects others
      (docs/guide/learning.md);
    - `sensor_wrench` (6,): force on the pad / 10 N and torque / 0.1 N m. A thin rod that pivots on its foot pushes
      sideways with 3/4 m g θ (for small θ), less the force of the pad's own acceleration, so that three steps determine the lean.

    Reward: sum of the terms in `info["reward_terms"]`; all but the last two are Isaac Lab's Cartpole with the tool as the cart.

    | term | value |
    | --- | --- |
    | `alive` | 1 |
    | `terminated` | −2 in the step that ends the episode, instead of `alive` |
    | `tilt` | −θ², θ the angle from the vertical [rad] |
    | `tool_speed` | −0.01 \|v\|₁ [m/s] |
    | `pole_speed` | −0.005 \|ω\|₁ [rad/s] |
    | `action_rate` | −1e-4 \|a − a₋₁\|² (Isaac Lab's lift task) |
    | `joint_speed` | −1e-4 \|q̇\|² [rad/s] (the same) |

    Start: the pole leans by 0 to 2° in any direction, its foot within ±1 mm of the pad's centre. The goal is the pad's start.
    Termination: the foot is more than 50 mm from the pad's centre (TacEx), the pole's centre below 0.4 m (TacEx thesis) or its tilt
    above 30°.
    Truncation: 250 steps (5 s), or the physics fails. Success: not terminated, and the tilt is below 12°.

    Version 1: an episode ends at a tilt of 30°, not of 90° (TacEx thesis). Nothing brings the pole back from there, and half of an
    untrained policy's steps were those of its fall.
    Version 0: first release.
    """

    task = BalancePole


class BalancePoleVectorEnv(TactileVectorEnv):
    """B environments as ``BalancePoleEnv`` specifies one, in one world."""

    task = BalancePole
