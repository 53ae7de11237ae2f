"""How small must MuJoCo's step be in the shipped task scenes, so that no contact of a rigid pad is lost and no body sinks or tilts?

    python experiments/scene_steps.py --device cpu --out runs/scene_steps

Every scene is played by its task's scripted policy. Where a body lies on a table it is also *pressed*: the pad goes down on it, stands
still and then slides or rolls it at a constant speed. A contact is lost where a pad that pressed feels nothing at the end of the next
control step; a body sinks by how far its lowest point is below the table. The control step stays the scene's: only the number of
MuJoCo's steps in it changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np

from experiments.running import recorded, run
from raytac.envs import SCRIPTED, BalancePole, InsertPeg, LiftCube, OpenDrawer, PushCube, RollBall, Starts, Task, TaskBatch
from raytac.errors import InputError
from raytac.io import CommonOptions
from raytac.shapes import object_bounds
from raytac.specs import load_task

_PRESSED, _NOTHING = 0.05, 1e-6
"""Force from which a pad counts as pressed, and up to which as not touched [N]."""
_SETTLED, _SLIDING, _END = 15, 25, 60
"""Control steps of a press: looked at from the first on, standing still up to the second."""
_HOWS = ("scripted", "pressed")


class LiftHere(LiftCube):
    """The cube where the scene has it, between the pads, and a goal 40 mm above it."""

    draws = 0

    def starts(self, u: np.ndarray, tool: np.ndarray, body: np.ndarray) -> Starts:
        return Starts(np.repeat(body[None, :3, 3] + [0.0, 0.0, 0.04], len(u), axis=0))


@dataclass(frozen=True)
class Case:
    """A shipped scene and how it is played."""

    task: Task
    policy: str
    down: tuple[int, float] | None = None
    """Control steps in which the pad goes down, and its action then; None where nothing lies on a table to be pressed."""
    slide: float = 0.0
    """Action along x, y of a pad that slides."""


CASES = {
    "push_cube": Case(PushCube(), "PushCube", (8, -0.5), 0.67),
    "balance_pole": Case(BalancePole(), "BalancePole"),
    "roll_ball": Case(RollBall(), "RollBall", (4, -0.4), 0.2),
    "ball_rolling": Case(RollBall(), "RollBall", (4, -0.4), 0.2),
    "lift_cube_env": Case(LiftCube(), "LiftCube"),
    "lift_cube": Case(LiftHere(), "LiftCube"),
    "lift_sphere": Case(LiftHere(), "LiftCube"),
    "insert_peg": Case(InsertPeg(), "InsertPeg"),
    "open_drawer": Case(OpenDrawer(), "OpenDrawer"),
}
"""The shipped task scenes with rigid pads."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure contact losses, sink and tilt of every shipped task scene by MuJoCo's step."""

    scenes: tuple[str, ...] = tuple(CASES)
    """Task scenes with rigid pads."""
    steps_ms: tuple[float, ...] = (10.0, 5.0, 2.0, 1.0)
    """MuJoCo's steps to be tried [ms]."""
    episodes: int = 8
    """Of each scene and step."""


@dataclass(frozen=True)
class Played:
    """What became of the episodes of one scene."""

    lost: float
    """Contacts lost in an episode, the mean over episodes."""
    sink_mm: float | None
    """How far the body was below the table at most; None without a table."""
    tilt_deg: float | None
    """How far a box that was pressed leant at most; None of what rolls, is lifted or balanced."""
    failed: int
    """Episodes whose physics broke down."""
    success: int
    """Episodes that ended with the task done."""


def main(args: Args) -> None:
    for name in args.scenes:
        if name not in CASES:
            raise InputError("scenes", value=name, rule="must be a shipped scene with rigid pads", choices=CASES)
    with recorded(args, "scene_steps") as (_, metrics):
        for name in args.scenes:
            metrics[f"scene_steps.{name}.shipped_ms"] = 1e3 * load_task(name).timestep
            for step in args.steps_ms:
                for how in _HOWS if CASES[name].down else _HOWS[:1]:
                    played = play(name, how, args.episodes, args.seed, 1e-3 * step)
                    print(
                        f"{name}, {step:g} ms, {how}: "
                        + ", ".join(f"{k} {v}" for k, v in asdict(played).items() if v is not None)
                    )
                    for key, value in asdict(played).items():
                        if value is not None:
                            metrics[f"scene_steps.{name}.{step:g}ms.{how}.{key}"] = value


def play(name: str, how: str, episodes: int, seed: int, timestep: float | None = None) -> Played:
    """Episodes of a shipped scene, ``scripted`` or ``pressed``, with another step of MuJoCo [s] if one is given."""
    case, scene = CASES[name], load_task(name)
    if timestep is not None:
        scene = replace(scene, timestep=timestep)
    batch = TaskBatch(case.task, num_envs=episodes, tactile=None, physics="rigid", scene=scene, seed=seed, device="cpu")
    batch.reset(range(episodes), [np.random.default_rng((seed, b)) for b in range(episodes)])
    pressed = how == "pressed"
    act = _press(case, episodes, batch.control.size) if pressed else lambda _: SCRIPTED[case.policy](batch)
    body, world = batch.world.composed.bodies[case.task.body], batch.world
    upright = world.state().world_from_body[case.task.body][:, :3, 2]
    forces, lowest, cosines = [], [], []
    for k in range(_END if pressed else case.task.max_episode_steps):
        out = batch.step(act(k))
        if pressed and k < _SETTLED:
            continue
        state = world.state()
        poses = state.world_from_body[case.task.body][~state.failed]
        forces.append([-state.wrench[sensor][:, 2] for sensor in world.sensor_names])
        lowest += [float(object_bounds(body.parts, pose)[0][2]) for pose in poses]
        cosines += np.vecdot(poses[:, :3, 2], upright[~state.failed]).tolist()
    force = np.array(forces)
    table = any(one.is_plane for one in world.composed.touched)
    return Played(
        float(((force[1:] < _NOTHING) & (force[:-1] > _PRESSED)).sum() / episodes),
        max(-1e3 * min(lowest), 0.0) if table else None,
        float(np.degrees(np.arccos(min(min(cosines), 1.0)))) if pressed and scene.body(body.name).kind == "box" else None,
        int(world.state().failed.sum()),
        int(out.success.sum()),
    )


def _press(case: Case, episodes: int, size: int) -> Callable[[int], np.ndarray]:
    """Actions by the control step: down, still, and each environment along a direction of its own."""
    angle = 2.0 * np.pi * np.arange(episodes) / episodes
    assert case.down is not None
    steps, down = case.down

    def act(k: int) -> np.ndarray:
        actions = np.zeros((episodes, size))
        if k < steps:
            actions[:, 2] = down
        elif k >= _SLIDING:
            actions[:, :2] = case.slide * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return actions

    return act


if __name__ == "__main__":
    run(main, Args)
