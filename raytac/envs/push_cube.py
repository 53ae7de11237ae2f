"""``raytac/PushCube-v0``."""

from __future__ import annotations

import math
from typing import ClassVar

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import (
    Array,
    Motion,
    Starts,
    Task,
    TaskResult,
    TaskState,
    around,
    between,
    constant,
    distances,
    moved,
    near,
    turned,
)
from raytac.se3 import pose


class PushCube(Task):
    """Rules of ``PushCubeEnv``, as code."""

    scene: ClassVar = "push_cube"
    body: ClassVar = "cube"
    motion: ClassVar = Motion(("x", "y", "z"), (3e-3, 3e-3, 1e-3), (0.25, -0.25, 0.035), (0.65, 0.25, 0.10), leash=0.006)
    max_episode_steps: ClassVar = 150
    body_seen: ClassVar = True
    draws: ClassVar = 5

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        position = moved(body[:3, 3], between(u[:, 0], -0.01, 0.01), between(u[:, 1], -0.01, 0.01))
        rotation = turned(body[:3, :3], between(u[:, 2], -0.3, 0.3))
        goal = around(position, between(u[:, 3], -math.pi, math.pi), between(u[:, 4], 0.03, 0.10))
        return Starts(goal, {"cube": pose(rotation, position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        cube = state.body[:, :3, 3]
        top = cube + constant((0.0, 0.0, 0.02), cube)
        reach, distance = distances(state.tool[:, :3, 3], top), distances(cube[:, :2], state.goal[:, :2])
        force = -state.wrench["sensor"][:, 2]
        terms = {
            "reaching": near(reach, 0.1),
            "touching": 1.0 * ((force > 0.5) & (force < 10.0)),
            "target": 4.0 * near(distance, 0.1),
            "target_fine": 4.0 * near(distance, 0.02),
        }
        terminated = distances(state.tool[:, :3, 3], cube) > 1.0
        return TaskResult({**terms, **self.effort(state)}, terminated, distance < 0.01)


class PushCubeEnv(TactileEnv):
    r"""Slide a cube across a table to a goal by pressing on it with one sensor.

    A Panda carries a GelSight Mini (9 x 11 markers) pad down over a cube of 40 mm and 50 g on a table (scene `push_cube`). The pad must
    press hard enough to hold the cube by friction and softly enough to let it slide.

    Action, Box(-1, 1, (3,)): displacement of the pad's target along world x, y (3 mm a step at 1) and z (1 mm). The target leads the pad
    by at most 6 mm along an axis and stays in x 0.25 to 0.65, y ±0.25, z 0.035 to 0.10 m.
    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (12,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      last action (3);
    - `goal` (3,): goal from the tool / 0.1 m, world axes;
    - `body` (15,): of the cube, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); there unless `body_seen=False`;
    - `sensor_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/guide/learning.md).

    Reward: sum of the terms in `info["reward_terms"]`; d distances in m, a the action, q̇ joint speeds in rad/s.

    | term | value | source |
    | --- | --- | --- |
    | `reaching` | 1 − tanh(d(pad, centre of the cube's top) / 0.1) | form of the TacEx thesis, width of Isaac Lab's lift task |
    | `touching` | 1 if the pad is pressed with 0.5 to 10 N | form of TacEx's ball rolling; constants ours |
    | `target` | 4 (1 − tanh(d_xy(cube, goal) / 0.1)) | form of the TacEx thesis; constants ours |
    | `target_fine` | 4 (1 − tanh(d_xy(cube, goal) / 0.02)) | ours |
    | `action_rate` | −1e-4 \|a − a₋₁\|² | Isaac Lab's lift task |
    | `joint_speed` | −1e-4 \|q̇\|² | the same |

    Start: the pad is 2 mm above the centre of the cube's position in the scene. The cube is shifted by up to ±10 mm along x and y and
    turned by up to ±0.3 rad; the goal lies 30 to 100 mm from it in any direction.
    Termination: the pad is more than 1 m from the cube (TacEx thesis). Truncation: 150 steps (3 s), or the physics fails.
    Success: the cube is within 10 mm of the goal.

    Version 0: first release.
    """

    task = PushCube


class PushCubeVectorEnv(TactileVectorEnv):
    """B environments as ``PushCubeEnv`` specifies one, in one world."""

    task = PushCube
