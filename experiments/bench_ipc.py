"""How long does a step take? One pad and a sphere, by number of vertices and environments; or two pads that put a peg into a hole.

    python experiments/bench_ipc.py --sizes 300,1400,5300 --out runs/bench_ipc           # CPU or CUDA, whichever there is
    python experiments/bench_ipc.py --device cuda --sizes 300,1400,5300,18000 --envs 1,128,1024
    python experiments/bench_ipc.py --sizes 300,1400 --against ../raytac_b682ef2         # steps in turn with another checkout's, on the CPU
    python experiments/bench_ipc.py --device cuda --pads peg --envs 256,4096 --out runs/bench_ipc_peg

Press: a bonded pad of 20.75 × 25.25 × 4 mm (E = 0.1 MPa, ν = 0.45) and a sphere of 4 mm radius that is driven down 1 mm in 20 steps of
10 ms and then held for 5; d̂ = 0.1 mm, μ = 0.5, velocity tolerance 1e-4 m/s. Peg: see ``bench_ipc_scenes.peg_world``.

The first step (first lists, and what was not compiled yet) is told apart. Memory: on CUDA, bytes in use in Warp's memory pool, on the
CPU, growth of the resident set, both from before the world is made to after the last step. On a machine that others use too, the
processor time says more than the clock.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
import warp as wp
from bench_ipc_scenes import (
    CELLS,
    D_HAT,
    DT,
    FRICTION,
    GAP,
    HOLD,
    PEG_CLOSE,
    PEG_LOWER,
    PRESS,
    RADIUS,
    ball_height,
    peg_drive,
    peg_world,
    press_world,
)
from turns import in_turn

import ipc
from raytac.errors import InputError, RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, parse_names, result_folder, versions, write_metrics

CUT: ipc.Cut = "alike"
"""Cells of the pad (``ipc.box_mesh``): docs/measurements/contact-solver.md has figures of these, also pyuipc's."""
BATCHED = 1400
"""The most vertices that are measured with more than one environment."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time the solver's steps."""

    pads: Literal["press", "peg"] = "press"
    """One pad and a sphere, or two pads, a peg and a hole."""
    sizes: str = "300,1400,5300"
    """About how many vertices the pad of the press has: any of 300, 1400, 5300, 18000, joined by commas."""
    envs: str = "1"
    """Numbers of environments, joined by commas; the press measures more than one environment up to 1400 vertices."""
    friction: float = FRICTION
    """μ of the press."""
    spread: float = 0.0
    """Share by which environments of the press differ in depth, drawn at random; 0: all do the same. In [0, 1)."""
    stages: bool = False
    """Go through each scene once more, kernel by kernel: a step that is one recorded graph does not tell its stages apart."""
    against: Path | None = None
    """Checkout of another commit: only steps of the press in turn with its own, one environment on the CPU (``turns.py``)."""
    limit_s: float = 120.0
    """A measurement stops after the step in which this time is up [s]; its steps so far count."""


@dataclass(frozen=True)
class Run:
    """A world that was stepped through its scene, B environments, S steps.

    Attributes:
        world: as the last step left it.
        first_s: time of making the world and of the first step [s].
        seconds, busy: clock and processor time of steps 1 to S − 1 [s].
        reports: one a step.
        phases: names of the parts of the scene, one a step.
        stages: seconds a step in each stage, the first step left out.
        memory: bytes an environment.
    """

    world: ipc.World
    first_s: tuple[float, float]
    seconds: np.ndarray
    busy: np.ndarray
    reports: tuple[ipc.StepReport, ...]
    phases: tuple[str, ...]
    stages: dict[str, float]
    memory: float


def memory_in_use(device: str) -> int:
    """Bytes in use: Warp's memory pool on CUDA (the card's, without a pool), the process's resident set on the CPU."""
    chosen = wp.get_device({"auto": "cuda" if wp.is_cuda_available() else "cpu"}.get(device, device))
    if not chosen.is_cuda:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return wp.get_mempool_used_mem_current(chosen) if wp.is_mempool_enabled(chosen) else chosen.total_memory - chosen.free_memory


def compile_kernels(device: str) -> float:
    """Seconds until a first small press has taken two steps: mostly compiling or loading kernels."""
    begin = time.perf_counter()
    world = press_world((2, 2, 1), ipc.Settings(dt=DT, d_hat=D_HAT, friction=FRICTION), 1, device, CUT)
    for step in range(2):
        world.set_target("ball", (0, 0, ball_height(step)))
        world.step()
    return time.perf_counter() - begin


def run(world_of: Iterator[tuple[ipc.World, str]], num_envs: int, device: str, limit: float) -> Run:
    """Step through a scene: an iterator that first makes its world, then sets the targets of each step and names its phase."""
    before, begin = memory_in_use(device), time.perf_counter()
    seconds, busy, reports, phases, timers = [], [], [], [], {}
    made = 0.0
    for world, phase in world_of:
        wp.synchronize()
        if not seconds:
            made = time.perf_counter() - begin
        start, cpu = time.perf_counter(), time.process_time()
        reports.append(world.step())
        wp.synchronize()
        seconds.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
        phases.append(phase)
        timers = timers or world.timers
        if time.perf_counter() - begin > limit and len(seconds) > 1:
            print(f"  stopped after {len(seconds)} steps: {limit:g} s are up")
            break
    count = max(1, len(seconds) - 1)
    stages = {name: (total - timers.get(name, 0.0)) / count for name, total in world.timers.items()}
    memory = (memory_in_use(device) - before) / num_envs
    return Run(
        world,
        (made, seconds[0]),
        np.array(seconds[1:]),
        np.array(busy[1:]),
        tuple(reports),
        tuple(phases),
        stages,
        memory,
    )


def press_scene(size: int, envs: int, args: Args, graph: bool = True) -> Iterator[tuple[ipc.World, str]]:
    """Down for ``PRESS`` steps, then at rest."""
    settings = ipc.Settings(dt=DT, d_hat=D_HAT, friction=args.friction, graph=graph)
    world = press_world(CELLS[size], settings, envs, args.device, CUT)
    share = 1 - args.spread * np.random.default_rng(args.seed).random(envs)
    for step in range(PRESS + HOLD):
        target = np.zeros((envs, 3))
        target[:, 2] = RADIUS + GAP + share * (ball_height(step) - RADIUS - GAP)
        world.set_target("ball", target)
        yield world, "press" if step < PRESS else "hold"


def peg_scene(envs: int, args: Args, graph: bool = True) -> Iterator[tuple[ipc.World, str]]:
    """Close the grip, then lower the peg into the hole."""
    world = peg_world(envs, args.device, graph)
    for phase in peg_drive(world):
        yield world, phase


def stages_apart(done: Run, again: Callable[[], Run], args: Args) -> dict[str, float]:
    """Seconds a step in each stage: where ``--stages`` asks, of a run without a recorded graph."""
    return again().stages if args.stages else done.stages


def common_metrics(key: str, run: Run, timed: tuple[str, ...], envs: int, stages: dict[str, float]) -> dict[str, Metric]:
    """What both scenes tell: times over the phases ``timed``, without the first step."""
    chosen = np.isin(run.phases[1:], timed)
    newton = np.array([report.newton.max() for report in run.reports])
    linear = np.array([report.linear.max() for report in run.reports])
    seconds = run.seconds[chosen]
    return {
        f"{key}.ms_per_step": 1e3 * float(np.median(seconds)),
        f"{key}.processor_ms_per_step": 1e3 * float(np.median(run.busy[chosen])),
        f"{key}.env_steps_per_s": float(envs / seconds.mean()),
        f"{key}.steps": len(run.reports),
        f"{key}.world_s": run.first_s[0],
        f"{key}.first_step_s": run.first_s[1],
        f"{key}.memory_mb_per_env": run.memory / 2**20,
        f"{key}.newton_per_step": float(newton.mean()),
        f"{key}.newton_most": int(newton.max()),
        f"{key}.pcg_per_step": float(linear.mean()),
        f"{key}.converged": int(all(report.converged.all() for report in run.reports)),
        f"{key}.not_converged_env_steps": int(sum((~report.converged).sum() for report in run.reports)),
        f"{key}.min_gap_um": 1e6 * float(min(report.min_gap.min() for report in run.reports)),
        **{f"{key}.stage_ms.{name}": 1e3 * seconds for name, seconds in stages.items()},
    }


def say(key: str, metrics: dict[str, Metric]) -> None:
    """One line, the stages on a second."""
    get = {name.removeprefix(f"{key}."): value for name, value in metrics.items()}
    print(
        f"{key:18} {get['vertices']:6d} vertices  {get['ms_per_step']:9.2f} ms  {get['env_steps_per_s']:9.1f} env-steps/s  "
        f"processor {get['processor_ms_per_step']:9.2f} ms  first {get['first_step_s']:6.2f} s  newton {get['newton_per_step']:.2f}  "
        f"pcg {get['pcg_per_step']:.1f}  {get['memory_mb_per_env']:.2f} MB an environment  converged {get['converged']}"
    )
    stages = {name.removeprefix("stage_ms."): value for name, value in get.items() if name.startswith("stage_ms.")}
    print(
        "   stages [ms]: "
        + "  ".join(f"{name} {value:.2f}" for name, value in sorted(stages.items(), key=lambda s: -float(s[1])))
    )


def measure_press(size: int, envs: int, args: Args) -> dict[str, Metric]:
    """One press."""
    done = run(press_scene(size, envs, args), envs, args.device, args.limit_s)
    key = f"{done.world.device.alias.split(':')[0]}.{size}" + (f"x{envs}" if envs > 1 else "")
    hold = done.seconds[np.isin(done.phases[1:], ("hold",))]
    stages = stages_apart(done, lambda: run(press_scene(size, envs, args, graph=False), envs, args.device, args.limit_s), args)
    metrics = common_metrics(key, done, ("press",), envs, stages) | {
        f"{key}.vertices": len(done.world.positions("pad")[0]),
        f"{key}.force_n": float(done.world.wrench("ball").force[:, 2].max()),
    }
    if len(hold):
        metrics[f"{key}.ms_per_hold_step"] = 1e3 * float(np.median(hold))
    say(key, metrics)
    return metrics


def measure_peg(envs: int, args: Args) -> dict[str, Metric]:
    """One insertion; how well the grip held tells whether the time was spent on physics."""
    done = run(peg_scene(envs, args), envs, args.device, args.limit_s)
    world = done.world
    vertices = 2 * len(world.positions("left")[0])
    key = f"{world.device.alias.split(':')[0]}.peg{vertices // 2}" + (f"x{envs}" if envs > 1 else "")
    A, p = world.affine_pose("peg")
    slip = p[:, 2] - world.frame("left")[1][:, 2]
    stages = stages_apart(done, lambda: run(peg_scene(envs, args, graph=False), envs, args.device, args.limit_s), args)
    metrics = common_metrics(key, done, ("close", "lower"), envs, stages) | {
        f"{key}.vertices": vertices,
        f"{key}.grip_n": float(world.wrench("right").force[:, 0].max()),
        f"{key}.hole_force_n": float(np.linalg.norm(world.wrench("hole").force, axis=1).max()),
        f"{key}.slip_um": 1e6 * float(np.abs(slip).max()),
        f"{key}.tilt_deg": float(np.degrees(np.arccos(np.clip(A[:, 2, 2], -1, 1))).max()),
        f"{key}.lowered_mm": -1e3 * float(p[:, 2].max()),
    }
    lower = done.seconds[np.isin(done.phases[1:], ("lower",))]
    if len(lower):
        metrics[f"{key}.ms_per_lower_step"] = 1e3 * float(np.median(lower))
    say(key, metrics)
    return metrics


def parse_numbers(text: str, option: str, choices: tuple[int, ...] | None = None) -> tuple[int, ...]:
    """``"1,128"`` to positive whole numbers.

    Raises:
        InputError: something else, or a number that is not in ``choices`` (None is any).
    """
    names = parse_names(text, option, None if choices is None else tuple(map(str, choices)))
    for name in names:
        if not name.isdecimal() or int(name) < 1:
            raise InputError(option, value=name, rule="must be whole numbers from 1, joined by commas")
    return tuple(map(int, names))


def alone(args: Args, sizes: tuple[int, ...], envs: tuple[int, ...]) -> dict[str, Metric]:
    """All that this checkout is asked for."""
    metrics: dict[str, Metric] = {"compile_s": compile_kernels(args.device)}
    if args.pads == "peg":
        print(f"peg: {PEG_CLOSE} steps to close, {PEG_LOWER} to lower")
        for count in envs:
            metrics |= measure_peg(count, args)
        return metrics
    for size in sizes:
        for count in envs:
            if count == 1 or size <= BATCHED:
                metrics |= measure_press(size, count, args)
    return metrics


def main(args: Args) -> int:
    begin = time.perf_counter()
    sizes, envs = parse_numbers(args.sizes, "sizes", tuple(CELLS)), parse_numbers(args.envs, "envs")
    if not 0 <= args.spread < 1:
        raise InputError("spread", value=args.spread, rule="must lie in [0, 1)")
    if not args.limit_s > 0:
        raise InputError("limit-s", value=args.limit_s, rule="must be positive")
    if args.against is not None:
        metrics = in_turn(args.against, {f"cpu.{size}": f"press:{size}" for size in sizes})
    else:
        metrics = alone(args, sizes, envs)
    common = {"experiment": "bench_ipc", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/bench_ipc"), ("metrics.json",)) as folder:
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
