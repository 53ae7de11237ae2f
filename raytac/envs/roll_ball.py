"""``raytac/RollBall-v2``."""

from __future__ import annotations

import math
from typing import ClassVar

from array_api_compat import array_namespace

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import Array, Motion, Starts, Task, TaskResult, TaskState, around, between, distances, moved, near
from raytac.se3 import pose


class RollBall(Task):
    """Rules of ``RollBallEnv``, as code."""

    scene: ClassVar = "roll_ball"
    body: ClassVar = "ball"
    motion: ClassVar = Motion(("x", "y", "z"), (2e-3, 2e-3, 1e-3), (0.40, -0.05, 0.007), (0.50, 0.05, 0.02), leash=0.004)
    max_episode_steps: ClassVar = 150
    body_seen: ClassVar = False
    draws: ClassVar = 4

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        position = moved(body[:3, 3], between(u[:, 0], -2e-3, 2e-3), between(u[:, 1], -2e-3, 2e-3))
        goal = around(position, between(u[:, 2], -math.pi, math.pi), between(u[:, 3], 5e-3, 10e-3))
        return Starts(goal, {"ball": pose(body[:3, :3], position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        xp, ball, pad = array_namespace(state.body), state.body[:, :3, 3], state.tool[:, :3, 3]
        aside, distance = distances(ball[:, :2], pad[:, :2]), distances(ball[:, :2], state.goal[:, :2])
        force = -state.wrench["sensor"][:, 2]
        touching = (force > 0.05) & (force < 5.0)
        terms = {
            "touching": 1.0 * touching,
            "aside": -0.05 * xp.square(100.0 * aside),
            "lost_height": -15.0 * (ball[:, 2] > 0.025),
            "goal_fine": 4.0 * near(distance, 0.005),
            "reached": 5.0 * ((distance < 0.002) & touching),
        }
        off = (xp.abs(ball[:, 0] - 0.5) > 0.3) | (xp.abs(ball[:, 1]) > 0.4) | (distance > 0.75)
        terminated = off | (aside > 0.015) | (pad[:, 2] < 0.002)
        return TaskResult({**terms, **self.effort(state)}, terminated, distance < 0.002)


class RollBallEnv(TactileEnv):
    r"""Roll a ball between a pad and a table to a goal.

    A Panda carries a GelSight Mini (9 x 11 markers) pad down over a steel ball of 5 mm radius (scene `roll_ball`). The ball moves half as
    far as the pad and is known by touch alone, as in TacEx's tuned task.

    Action, Box(-1, 1, (3,)): displacement of the pad's target along world x, y (2 mm a step at 1) and z (1 mm). The target leads the pad
    by at most 4 mm along an axis and stays in x 0.40 to 0.50, y ±0.05, z 0.007 to 0.02 m.
    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (12,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      last action (3);
    - `goal` (3,): goal from the tool / 0.1 m, world axes;
    - `body` (15,): of the ball, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); only with `body_seen=True`;
    - `sensor_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/guide/learning.md).

    Reward: sum of the terms in `info["reward_terms"]`, those of TacEx's ball rolling, with its constants unless a difference is given.
    d = d_xy(ball, goal). Touching: the pad is pressed with 0.05 to 5 N (TacEx: a depth of 0.5 to 4 mm).

    | term | value |
    | --- | --- |
    | `touching` | 1 if touching (TacEx: 0.25) |
    | `aside` | −0.05 (d_xy(ball, pad) in cm)² |
    | `lost_height` | −15 if the ball's centre is above 25 mm |
    | `goal_fine` | 4 (1 − tanh(d / 0.005)); ours |
    | `reached` | 5 if d < 2 mm (TacEx: 5 mm, for goals half a metre away) and touching |
    | `action_rate`, `joint_speed` | −1e-4 \|a − a₋₁\|², −1e-4 \|q̇\|² |

    TacEx's penalty of a tilted pad is left out, since no action tilts it. So are its three terms of the goal, made for goals half a metre
    away: over the 10 mm of this task they change by 0.03 of 3.7.

    Start: the pad is 0.95 mm above the ball's position in the scene, the ball within ±2 mm of it along x and y. The goal is 5 to 10 mm from
    the ball in any direction, so that one stroke of the pad reaches it (TacEx draws goals over half a metre).
    Termination (TacEx): the ball's x is not in 0.2 to 0.8 m, |y| > 0.4 m, d > 0.75 m, d_xy(ball, pad) > 15 mm, or the pad is below 2 mm.
    Truncation: 150 steps (3 s), or the physics fails. Success: d < 2 mm.

    Version 2: without TacEx's three terms of the goal. They were nine tenths of what a pad earned that stands still above the ball,
    and one training of three never did more than that. Touch is paid 1 instead of 0.25.
    Version 1: `goal_fine`, beside these terms.
    Version 0: first release.
    """

    task = RollBall


class RollBallVectorEnv(TactileVectorEnv):
    """B environments as ``RollBallEnv`` specifies one, in one world."""

    task = RollBall
