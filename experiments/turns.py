"""Steps of this checkout and of another one, in turn: how much faster is one of them, on a machine that others use too?

    git worktree add --detach ../raytac_b682ef2 b682ef2
    python experiments/bench_ipc.py --sizes 300,1400 --against ../raytac_b682ef2 --out runs/bench_ipc_against
    python experiments/bench_soft.py --levels coarse --against ../raytac_b682ef2 --out runs/bench_soft_against
    python experiments/bench_optics.py --against ../raytac_b682ef2 --out runs/bench_optics_against
    python experiments/bench_rl.py --against ../raytac_b682ef2 --out runs/bench_rl_against

Each checkout has a process of its own, or several, which wait while the other makes its step: a load that comes and goes slows both alike.
Of worlds a turn is several steps, as a training makes them, with its memory at hand. What is compared is processor time, of all threads:
those that wait for work count as well, so that wall time is compared too. The scenes are those of this checkout, made with what both
offer; those of worlds are each checkout's own, with its own steps. Each process runs

    PYTHONPATH=CHECKOUT python experiments/turns.py SCENE

and answers a line on its input by a line with the processor and the wall time of its next step [s].
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

# Nothing of the package is imported here: it would be this checkout's.

ROUNDS = 3
"""Runs of a scene; the first compiles and is not counted."""
TOGETHER = {"push": 20, "ball": 20}
"""Steps of a turn, where it is not one."""


class Turn:
    """A checkout's processes, which step at the same time."""

    def __init__(self, checkout: Path, scene: str, processes: int) -> None:
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
        self._processes = [
            subprocess.Popen(
                [sys.executable, str(Path(__file__).resolve()), scene],
                cwd=checkout,
                env={**os.environ, **threads, "PYTHONPATH": str(checkout)},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for _ in range(processes)
        ]

    def step(self) -> tuple[float, float]:
        """Processor time of the next step, of all processes, and wall time of the slowest [s].

        NaN for a step that is not counted. Raises ``ChildProcessError``: a process ended, with its last line.
        """
        for process in self._processes:
            assert process.stdin is not None
            try:
                process.stdin.write("\n")
                process.stdin.flush()
            except BrokenPipeError:
                pass
        processor, wall = zip(*map(self._seconds, self._processes), strict=True)
        return sum(processor), max(wall)

    @staticmethod
    def _seconds(process: subprocess.Popen[str]) -> tuple[float, float]:
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            if line.startswith("seconds "):
                processor, wall = line.split()[1:]
                return float(processor), float(wall)
        last = (process.stderr.read().strip() or "no message").splitlines()[-1]
        raise ChildProcessError(f"the step process ended with {process.wait()}: {last}")

    def end(self) -> None:
        for process in self._processes:
            process.kill()
            process.communicate()


def speedup(ours: Path, theirs: Path, scene: str, rounds: int = ROUNDS, processes: int = 1) -> dict[str, float]:
    """Times of a scene's steps, a turn each, and how many times this checkout is faster.

    ``processes``: of each checkout, which make the scene at the same time.

    Returns:
        ``ms``, ``their_ms``: medians over the counted steps.    ``speedup``: ratio of the two.    ``least``, ``most``: of single rounds.
        ``wall_speedup``: of wall times.
    """
    steps = steps_of(scene)
    turns = [Turn(checkout, scene, processes) for checkout in (ours, theirs)]
    times = np.empty((rounds, steps, 2, 2))
    try:
        for k in range(rounds * steps):
            order = (0, 1) if k % 2 == 0 else (1, 0)
            for which in order:
                times[k // steps, k % steps, which] = turns[which].step()
    finally:
        for turn in turns:
            turn.end()
    counted, wall = np.moveaxis(1e3 * times[1:], -1, 0)
    mine, other = np.nanmedian(counted, axis=(0, 1))
    single = np.divide(*np.nanmedian(counted, axis=1).T[::-1])
    return {
        "ms": float(mine),
        "their_ms": float(other),
        "speedup": float(other / mine),
        "least": float(single.min()),
        "most": float(single.max()),
        "wall_speedup": float(np.divide(*np.nanmedian(wall, axis=(0, 1))[::-1])),
    }


def in_turn(
    against: Path, scenes: dict[str, str], rounds: int = ROUNDS, processes: int = 1
) -> dict[str, str | int | float | bool]:
    """Metrics of scenes by their keys; prints a line for each. ``rounds``, ``processes``: as of ``speedup``.

    Raises ``InputError``: no checkout of this project.
    """
    from raytac.errors import InputError, RaytacError

    ours, theirs = Path(__file__).resolve().parents[1], against.resolve()
    if not (theirs / "ipc" / "world.py").is_file():
        raise InputError("against", value=against, rule="must be a checkout of this project")
    name = commit(theirs)
    metrics: dict[str, str | int | float | bool] = {"against": name, "commit": commit(ours)}
    for key, scene in scenes.items():
        try:
            values = speedup(ours, theirs, scene, rounds, processes)
        except ChildProcessError as error:
            raise RaytacError(f"{scene}: {error}") from error
        metrics |= {f"{key}.processor_ms_per_step": values["ms"], f"{key}.processor_ms_per_step_{name}": values["their_ms"]}
        metrics |= {f"{key}.speedup_vs_{name}": values["speedup"], f"{key}.wall_speedup_vs_{name}": values["wall_speedup"]}
        metrics |= {f"{key}.speedup_least": values["least"], f"{key}.speedup_most": values["most"]}
        print(
            f"{key}: {values['ms']:.2f} ms against {values['their_ms']:.2f} of {name}, {values['speedup']:.2f} times, "
            f"{values['wall_speedup']:.2f} by wall time",
            flush=True,
        )
    return metrics


def commit(checkout: Path) -> str:
    """Short name of a checkout's commit; the folder's name where git knows none."""
    ended = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], cwd=checkout, capture_output=True, text=True, check=False)
    return ended.stdout.strip() if ended.returncode == 0 else checkout.name


def steps_of(scene: str) -> int:
    """Steps of a round, of worlds turns."""
    return {"press": 20, "pad": 9, "frame": 40, "push": 4, "ball": 10}[scene.partition(":")[0]]


def press(size: str) -> Iterator[Callable[[], object]]:
    """Steps of the press of ``bench_ipc``, rounds without end; ``size``: about how many vertices."""
    from bench_ipc_scenes import CELLS, D_HAT, DT, FRICTION, GAP, PRESS, RADIUS, ball_height, press_world

    import ipc

    assert steps_of("press") == PRESS
    world = press_world(CELLS[int(size)], ipc.Settings(dt=DT, d_hat=D_HAT, friction=FRICTION), 1, "cpu", "alike")
    while True:
        world.set_target("ball", (0.0, 0.0, RADIUS + GAP))
        world.reset()
        for k in range(PRESS):
            world.set_target("ball", (0.0, 0.0, ball_height(k)))
            yield world.step


def pad(level: str) -> Iterator[Callable[[], object]]:
    """Steps of the press of ``bench_soft`` with its image, which is read: until then it may still be computed.

    Nine a round, the first at rest.
    """
    from raytac.sensor import TactileSensor
    from raytac.specs import StageSpec, load_press, load_sensor

    soft: dict[str, Any]
    try:
        from raytac.physics import Ipc

        soft = {"physics": Ipc(level)}
    except ImportError:  # an older checkout
        soft = {"physics": "ipc", "pad": level}
    scene = load_press("sphere")
    scene = replace(scene, trajectory=(StageSpec("indent", depth=0.8e-3),), object=replace(scene.object, dynamics="kinematic"))
    sensor = TactileSensor(load_sensor("gelsight_mini"), device="cpu", seed=0, **soft)
    sensor.rest()
    loaded = sensor.load(scene)
    while True:
        states = loaded.run(8)
        for _ in range(steps_of("pad")):
            yield lambda states=states: np.asarray(sensor.update(next(states)).rgb)


def frame(name: str) -> Iterator[Callable[[], object]]:
    """Images by ``fast`` of the sensor ``name``, 320 × 240.

    Presses of the rigid pad take turns, at 70 to 100 % of their depths.
    """
    from raytac.sensor import TactileSensor

    sensor = TactileSensor(name, outputs=("rgb",), device="cpu", seed=0)
    surfaces = [sensor.press(scene).surface for scene in ("sphere", "coin", "pins", "cone")]
    rest, k = surfaces[0].grid.rest.astype(np.float32), 0
    while True:
        surface = surfaces[k % len(surfaces)]
        share = np.float32(0.7 + 0.3 * (0.618034 * k % 1))
        moved = replace(surface, height=rest + share * (surface.height - rest))
        yield lambda moved=moved: np.asarray(sensor.update(moved).rgb)
        k += 1


def push(name: str) -> Iterator[Callable[[], object]]:
    """Control steps of ``bench_rl`` with policy; ``name``: observed, then the number of environments."""
    from push_policy import MODES, Pusher

    from raytac.envs import PushCubeVectorEnv

    mode, _, envs = name.partition(":")
    pusher = Pusher(PushCubeVectorEnv(int(envs), tactile=MODES[mode], seed=0, device="cpu"), 0)
    while True:
        yield pusher.step


def ball(name: str) -> Iterator[Callable[[], object]]:
    """Control steps of the checkout's own ``ball_rolling`` with image and markers; ``name``: pad."""
    from experiments.ball_rolling import STROKES, Args, make_world
    from experiments.rolling_control import RollingController

    args = Args(device="cpu")
    world = make_world(args, name)
    sensor = world.sensor_names[0]
    state, frame, controller = world.reset(), world.observe()[sensor], None

    def step() -> None:
        nonlocal state, frame, controller
        if controller is None or controller.done:
            state, frame = world.reset(), world.observe()[sensor]
            goals = state.world_from_body["ball"][0, :2, 3] + 1e-3 * np.asarray(args.goals_mm)
            controller = RollingController(world, 0, goals, STROKES[name])
        force = max(-float(state.wrench[sensor][0, 2]), 0.0)
        controller.update(state.world_from_pad[sensor][0], frame.surface.contact_centre[0], force)
        state = world.step(controller)
        frame = world.observe()[sensor]

    while True:
        yield step


def main(scene: str) -> None:
    """Make a step for every line of the input."""
    kind, _, size = scene.partition(":")
    first = 2 if kind == "pad" else 0  # steps of a round that are not counted: at rest, and before anything touches
    for k, step in enumerate({"press": press, "pad": pad, "frame": frame, "push": push, "ball": ball}[kind](size)):
        if not sys.stdin.readline():
            return
        count = TOGETHER.get(kind, 1)
        began = time.process_time(), time.perf_counter()
        for _ in range(count):
            step()
        ended = time.process_time(), time.perf_counter()
        seconds = [
            (end - begin) / count if k % steps_of(scene) >= first else np.nan for begin, end in zip(began, ended, strict=True)
        ]
        print("seconds", *seconds, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
