"""``raytac/OpenDrawer-v0``."""

from __future__ import annotations

from typing import ClassVar

from array_api_compat import array_namespace

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import Array, Motion, Starts, Task, TaskResult, TaskState, between, constant, distances, moved, near
from raytac.se3 import pose

HANDLE = (-0.09, 0.0, 0.034)
"""Place at which a gripper holds the handle, drawer frame [m]."""


class OpenDrawer(Task):
    """Rules of ``OpenDrawerEnv``, as code."""

    scene: ClassVar = "open_drawer"
    body: ClassVar = "drawer"
    motion: ClassVar = Motion(
        ("x", "y", "z", "grip"),
        (4e-3, 4e-3, 4e-3, 4e-3),
        (0.32, -0.05, 0.030),
        (0.50, 0.05, 0.12),
        leash=0.010,
        opening=(0.006, 0.06),
    )
    max_episode_steps: ClassVar = 200
    body_seen: ClassVar = True
    draws: ClassVar = 2

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        xp = array_namespace(u)
        zero, pulled, goal = xp.zeros_like(u[:, 0]), between(u[:, 0], 0.0, 0.01), between(u[:, 1], 0.04, 0.09)
        position = moved(body[:3, 3], -pulled, zero)
        return Starts(moved(body[:3, 3] + constant(HANDLE, body), -goal, zero), {"drawer": pose(body[:3, :3], position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        xp, handle = array_namespace(state.body), handle_of(state.body)
        reach, distance = distances(state.tool[:, :3, 3], handle), xp.abs(handle[:, 0] - state.goal[:, 0])
        pinched = xp.minimum(*(-state.wrench[name][:, 2] for name in ("left", "right")))
        terms = {
            "reaching": near(reach, 0.05),
            "holding": 1.0 * (pinched > 1.0),
            "target": 4.0 * near(distance, 0.05),
            "target_fine": 4.0 * near(distance, 0.01),
        }
        terminated = reach > 1.0
        return TaskResult({**terms, **self.effort(state)}, terminated, distance < 5e-3)


def handle_of(body: Array) -> Array:
    """Place (B, 3) where a gripper holds the handle [m], of drawers with poses (B, 4, 4)."""
    return array_namespace(body).vecdot(body[:, :3, :3], constant(HANDLE, body)) + body[:, :3, 3]


class OpenDrawerEnv(TactileEnv):
    r"""Pull a drawer open by its handle, held between two sensors, to a given place.

    A Panda's fingers are two GelSight Minis (9 x 11 markers) over the handle of a drawer of 0.5 kg, which slides on a table in a cabinet
    with 0.5 mm of play (scene `open_drawer`). Held too softly the handle slips out of the gels. The cabinet has no back wall: who pushes
    slides the drawer out behind.

    Action, Box(-1, 1, (4,)): displacement of the target of the point between the pads along world x, y, z (4 mm a step at 1), and change
    of the commanded opening (4 mm). The target leads the tool by at most 10 mm along an axis and stays in x 0.32 to 0.50,
    y ±0.05, z 0.030 to 0.12 m; the opening stays in 6 to 60 mm.
    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (14,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      gap between the pads / 0.1 m (1), last action (4);
    - `goal` (3,): where the handle is to be, from the tool / 0.1 m, world axes;
    - `body` (15,): of the drawer, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); there unless `body_seen=False`;
    - `left_markers`, `right_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/guide/learning.md).

    Reward: sum of the terms in `info["reward_terms"]`, all ours; h the place at which the handle is held, g the goal.

    | term | value |
    | --- | --- |
    | `reaching` | 1 − tanh(d(tool, h) / 0.05) |
    | `holding` | 1 if both pads are pressed with over 1 N |
    | `target` | 4 (1 − tanh(d_x(h, g) / 0.05)) |
    | `target_fine` | 4 (1 − tanh(d_x(h, g) / 0.01)) |
    | `action_rate` | −1e-4 \|a − a₋₁\|² |
    | `joint_speed` | −1e-4 \|q̇\|² [rad/s] |

    Start: the open gripper is above the handle, the drawer is open by up to 10 mm; the goal is 40 to 90 mm from where it is closed.
    Termination: the tool is more than 1 m from the handle. Truncation: 200 steps (4 s), or the physics fails.
    Success: the handle is within 5 mm of the goal along x.

    Version 0: first release.
    """

    task = OpenDrawer


class OpenDrawerVectorEnv(TactileVectorEnv):
    """B environments as ``OpenDrawerEnv`` specifies one, in one world."""

    task = OpenDrawer
