"""``raytac/LiftCube-v2``."""

from __future__ import annotations

from typing import ClassVar

from array_api_compat import array_namespace

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import Array, Motion, Starts, Task, TaskResult, TaskState, between, distances, moved, near
from raytac.se3 import pose

_WIDTH, _OPEN = 0.03, 0.05
"""Of the cube, and greatest opening [m]."""
_LIFTED = 0.04
"""Height of the centre of a lifted cube [m]; at rest it is 0.015."""


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
        opening=(0.02, _OPEN),
    )
    max_episode_steps: ClassVar = 250
    body_seen: ClassVar = True
    draws: ClassVar = 5

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        position = moved(body[:3, 3], between(u[:, 0], -0.03, 0.03), between(u[:, 1], -0.03, 0.03))
        goal = moved(body[:3, 3], between(u[:, 2], -0.05, 0.05), between(u[:, 3], -0.05, 0.05))
        goal[:, 2] = between(u[:, 4], 0.08, 0.20)
        return Starts(goal, {"object": pose(body[:3, :3], position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        xp, cube = array_namespace(state.body), state.body[:, :3, 3]
        reach, distance = distances(state.tool[:, :3, 3], cube), distances(cube, state.goal)
        held = xp.minimum(-state.wrench["left"][:, 2], -state.wrench["right"][:, 2]) > 0.5
        rise = held * ((cube[:, 2] - 0.0155) / (_LIFTED - 0.0155)).clip(0.0, 1.0)
        terms = {
            "reaching": near(reach, 0.1),
            "reaching_fine": near(reach, 0.02),
            "closing": near(reach, 0.02) * (1.0 - ((state.opening[:, 0] - _WIDTH) / (_OPEN - _WIDTH)).clip(0.0, 1.0)),
            "held": 2.0 * held,
            "lifted": 15.0 * rise,
            "goal": 16.0 * rise * near(distance, 0.3),
            "goal_fine": 5.0 * rise * near(distance, 0.05),
        }
        success = (cube[:, 2] > _LIFTED) & (distance < 0.02)
        return TaskResult({**terms, **self.effort(state)}, reach > 1.0, success)


class LiftCubeEnv(TactileEnv):
    r"""Grasp a cube between two sensors and carry it to a goal in the air.

    A Panda's fingers are two GelSight Minis (9 x 11 markers) over a cube of 30 mm and 50 g on a table (scene `lift_cube_env`).

    Action, Box(-1, 1, (4,)): displacement of the target of the point between the pads along world x, y, z (5 mm a step at 1), and change
    of the commanded opening (4 mm). The target leads the tool by at most 15 mm along an axis and stays in x 0.30 to 0.60,
    y ±0.15, z 0.012 to 0.30 m; the opening stays in 20 to 50 mm.
    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (14,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      gap between the pads / 0.1 m (1), last action (4);
    - `goal` (3,): goal from the tool / 0.1 m, world axes;
    - `body` (15,): of the cube, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); there unless `body_seen=False`;
    - `left_markers`, `right_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/guide/learning.md).

    Reward: sum of the terms in `info["reward_terms"]`, those of Isaac Lab's Isaac-Lift-Cube-Franka-v0 and three that lead up to them.
    Held: both pads are pressed with more than 0.5 N. r rises from 0 where the cube's centre is 15.5 mm high, which is a hair above rest,
    to 1 at 40 mm; it is 0 if the cube is not held.

    | term | value | source |
    | --- | --- | --- |
    | `reaching` | 1 − tanh(d(tool, cube) / 0.1) | Isaac Lab |
    | `reaching_fine` | 1 − tanh(d(tool, cube) / 0.02) | ours |
    | `closing` | (1 − tanh(d(tool, cube) / 0.02)) c; c rises from 0 with the pads 50 mm apart to 1 at the cube's 30 mm | ours |
    | `held` | 2 if held | ours |
    | `lifted` | 15 r | Isaac Lab, where r is 1 above 40 mm, else 0 |
    | `goal` | 16 r (1 − tanh(d(cube, goal) / 0.3)) | the same |
    | `goal_fine` | 5 r (1 − tanh(d(cube, goal) / 0.05)) | the same |
    | `action_rate` | −1e-4 \|a − a₋₁\|² | Isaac Lab |
    | `joint_speed` | −1e-4 \|q̇\|² [rad/s] | Isaac Lab |

    Start: the open gripper is above the table, the cube within ±30 mm of its position in the scene along x and y; the goal is within ±50 mm
    of that position along x and y, 80 to 200 mm high.
    Termination: the tool is more than 1 m from the cube (TacEx thesis). Truncation: 250 steps (5 s, as Isaac Lab), or the physics fails.
    Success: the cube's centre is above 40 mm and within 20 mm of the goal.

    Version 2: closing the hand about the cube is worth something, and the hand opens by 50 mm, not 80. In version 1 it had to close in a
    dozen steps in turn to hold the cube; chance opens it as often, and PPO stayed at reaching the cube with an open hand.
    Version 1: a lift is worth more the higher it is, and a grasp is worth something. In version 0 nothing was worth anything between
    reaching the cube and having it 25 mm above the table, and PPO stayed at reaching it.
    Version 0: first release.
    """

    task = LiftCube


class LiftCubeVectorEnv(TactileVectorEnv):
    """B environments as ``LiftCubeEnv`` specifies one, in one world."""

    task = LiftCube
