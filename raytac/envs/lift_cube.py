"""``raytac/LiftCube-v0``."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import Motion, Start, Task, TaskResult, TaskState, distances, near
from raytac.se3 import pose


class LiftCube(Task):
    """Rules of ``LiftCubeEnv``, as code."""

    scene: ClassVar = "lift_cube_env"
    body: ClassVar = "object"
    motion: ClassVar = Motion(
        ("x", "y", "z", "grip"),
        (5e-3, 5e-3, 5e-3, 4e-3),
        (0.30, -0.15, 0.012),
        (0.60, 0.15, 0.30),
        leash=0.015,
        opening=(0.02, 0.08),
    )
    max_episode_steps: ClassVar = 250
    body_seen: ClassVar = True

    def start(self, rng: np.random.Generator, tool: np.ndarray, body: np.ndarray) -> Start:
        position = body[:3, 3] + [*rng.uniform(-0.03, 0.03, 2), 0.0]
        goal = np.array([*(body[:2, 3] + rng.uniform(-0.05, 0.05, 2)), rng.uniform(0.08, 0.20)])
        return Start(goal, {"object": pose(body[:3, :3], position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        cube = state.body[:, :3, 3]
        lifted, distance = cube[:, 2] > 0.04, distances(cube, state.goal)
        terms = {
            "reaching": near(distances(state.tool[:, :3, 3], cube), 0.1),
            "lifted": 15.0 * lifted,
            "goal": 16.0 * lifted * near(distance, 0.3),
            "goal_fine": 5.0 * lifted * near(distance, 0.05),
        }
        terminated = distances(state.tool[:, :3, 3], cube) > 1.0
        return TaskResult({**terms, **self.effort(state)}, terminated, lifted & (distance < 0.02))


class LiftCubeEnv(TactileEnv):
    r"""Grasp a cube between two sensors and carry it to a goal in the air.

    A Panda's fingers are two GelSight Minis (9 x 11 markers) over a cube of 30 mm and 50 g on a table (scene `lift_cube_env`).

    Action, Box(-1, 1, (4,)): displacement of the target of the point between the pads along world x, y, z (5 mm a step at 1), and change
    of the commanded opening (4 mm). The target leads the tool by at most 15 mm along an axis and stays in x 0.30 to 0.60,
    y ±0.15, z 0.012 to 0.30 m; the opening stays in 20 to 80 mm.
    `action="joints"`: see docs/rl.md. A step is 20 ms.

    Observations, float32:

    - `state` (14,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      gap between the pads / 0.1 m (1), last action (4);
    - `goal` (3,): goal from the tool / 0.1 m, world axes;
    - `body` (15,): of the cube, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); there unless `body_seen=False`;
    - `left_markers`, `right_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/rl.md).

    Reward: sum of the terms in `info["reward_terms"]`, those of Isaac Lab's Isaac-Lift-Cube-Franka-v0.
    Lifted: the cube's centre is above 0.04 m.

    | term | value |
    | --- | --- |
    | `reaching` | 1 − tanh(d(tool, cube) / 0.1) |
    | `lifted` | 15 if lifted |
    | `goal` | 16 (1 − tanh(d(cube, goal) / 0.3)) if lifted |
    | `goal_fine` | 5 (1 − tanh(d(cube, goal) / 0.05)) if lifted |
    | `action_rate` | −1e-4 \|a − a₋₁\|² |
    | `joint_speed` | −1e-4 \|q̇\|² [rad/s] |

    Start: the open gripper is above the table, the cube within ±30 mm of its position in the scene along x and y; the goal is within ±50 mm
    of that position along x and y, 80 to 200 mm high.
    Termination: the tool is more than 1 m from the cube (TacEx thesis). Truncation: 250 steps (5 s, as Isaac Lab), or the physics fails.
    Success: lifted, and within 20 mm of the goal.

    Version 0: first release.
    """

    task = LiftCube


class LiftCubeVectorEnv(TactileVectorEnv):
    """B environments as ``LiftCubeEnv`` specifies one, in one world."""

    task = LiftCube
