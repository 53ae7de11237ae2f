"""``raytac/InsertPeg-v0``."""

from __future__ import annotations

from typing import ClassVar

from array_api_compat import array_namespace

from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.task_rules import (
    Array,
    Motion,
    Starts,
    Task,
    TaskResult,
    TaskState,
    between,
    constant,
    distances,
    moved,
    near,
    turned,
)
from raytac.se3 import pose

SOCKET = (0.53, 0.0)
"""Centre of the socket's hole in the scene, x and y [m]."""
RIM = 0.016
"""Height of the socket's upper rim over the table [m]."""
_HALF = 0.025
"""Half of the peg's height [m]."""


class InsertPeg(Task):
    """Rules of ``InsertPegEnv``, as code."""

    scene: ClassVar = "insert_peg"
    body: ClassVar = "peg"
    motion: ClassVar = Motion(
        ("x", "y", "z", "grip"),
        (4e-3, 4e-3, 4e-3, 4e-3),
        (0.40, -0.08, 0.030),
        (0.58, 0.08, 0.20),
        leash=0.010,
        opening=(0.006, 0.06),
    )
    max_episode_steps: ClassVar = 250
    body_seen: ClassVar = True
    draws: ClassVar = 5

    def starts(self, u: Array, tool: Array, body: Array) -> Starts:
        position = moved(body[:3, 3], between(u[:, 0], -0.008, 0.008), between(u[:, 1], -0.008, 0.008))
        rotation = turned(body[:3, :3], between(u[:, 2], -0.1, 0.1))
        goal = moved(constant((*SOCKET, 0.0), body), between(u[:, 3], -1e-3, 1e-3), between(u[:, 4], -1e-3, 1e-3))
        return Starts(goal, {"peg": pose(rotation, position)})

    def evaluate(self, state: TaskState) -> TaskResult:
        xp, peg = array_namespace(state.body), state.body[:, :3, 3]
        tip, grip = (peg + side * _HALF * state.body[:, :3, 2] for side in (-1.0, 0.44))
        aside, height = distances(tip[:, :2], constant(SOCKET, tip)), tip[:, 2]
        inside = (aside < 2e-3) & (height < RIM)
        depth = xp.where(inside, 1.0 - (height / RIM).clip(0.0, 1.0), 0.0)
        carried = inside | ((height > 5e-3) & (state.body[:, 2, 2] > 0.8))
        above = distances(tip, constant((*SOCKET, RIM + 4e-3), tip))
        terms = {
            "reaching": near(distances(state.tool[:, :3, 3], grip), 0.05),
            "carried": 2.0 * carried,
            "above": 4.0 * carried * near(xp.where(inside, 0.0, above), 0.05),
            "aligned": 4.0 * carried * near(aside, 3e-3),
            "depth": 10.0 * depth,
        }
        terminated = distances(state.tool[:, :3, 3], peg) > 1.0
        return TaskResult({**terms, **self.effort(state)}, terminated, inside & (height < 3e-3))


class InsertPegEnv(TactileEnv):
    r"""Grasp a square peg between two sensors and put it into a socket that is 0.5 mm wider.

    A Panda's fingers are two GelSight Minis (9 x 11 markers) over a peg of 14 x 14 x 50 mm and 30 g that stands on a table, 80 mm from a
    socket of 14.5 mm, 16 mm deep (scene `insert_peg`). Where the socket is, is known to 1 mm only: the rest must be felt, from the
    shear that its rim gives the gels.

    Action, Box(-1, 1, (4,)): displacement of the target of the point between the pads along world x, y, z (4 mm a step at 1), and change
    of the commanded opening (4 mm). The target leads the tool by at most 10 mm along an axis and stays in x 0.40 to 0.58,
    y ±0.08, z 0.030 to 0.20 m; the opening stays in 6 to 60 mm.
    `action="joints"`: see docs/guide/learning.md. A step is 20 ms.

    Observations, float32:

    - `state` (14,): tool's position from its start / 0.1 m (3), its rotation vector from the start [rad] (3), its velocity [m/s] (3),
      gap between the pads / 0.1 m (1), last action (4);
    - `goal` (3,): middle of the socket's floor from the tool / 0.1 m, world axes, with an error of up to 1 mm along x and y that stays
      the same in an episode;
    - `body` (15,): of the peg, position from the tool / 0.1 m (3), first two columns of its rotation (6), velocity [m/s] and angular
      velocity [rad/s] (6); there unless `body_seen=False`;
    - `left_markers`, `right_markers` (99, 2): displacements of the markers / 1 mm. `tactile=` selects others (docs/guide/learning.md).

    Reward: sum of the terms in `info["reward_terms"]`, all ours; t the middle of the peg's lower end, g the place on its axis 11 mm above
    its middle, s the socket's axis. Inside: t is below the rim and within 2 mm of s. Carried: t is over 5 mm high and
    the peg stands within 37° of upright, or inside.

    | term | value |
    | --- | --- |
    | `reaching` | 1 − tanh(d(tool, g) / 0.05) |
    | `carried` | 2 if carried |
    | `above` | 4 (1 − tanh(d / 0.05)) if carried; d from t to the place 4 mm above the rim, 0 inside |
    | `aligned` | 4 (1 − tanh(d_xy(t, s) / 0.003)) if carried |
    | `depth` | 10 times the share of the socket's depth that t has reached, if inside |
    | `action_rate` | −1e-4 \|a − a₋₁\|² |
    | `joint_speed` | −1e-4 \|q̇\|² [rad/s] |

    Start: the open gripper is above the peg, which is shifted by up to ±8 mm along x and y and turned by up to ±0.1 rad.
    Termination: the tool is more than 1 m from the peg. Truncation: 250 steps (5 s), or the physics fails.
    Success: the peg is inside, less than 3 mm from the floor.

    Version 0: first release.
    """

    task = InsertPeg


class InsertPegVectorEnv(TactileVectorEnv):
    """B environments as ``InsertPegEnv`` specifies one, in one world."""

    task = InsertPeg
