"""How long does a press step take? One pad, one sphere, by number of vertices and of environments.

    python experiments/bench_ipc.py --sizes 300,1400,5300 --out runs/bench_ipc           # CPU or CUDA, whichever there is
    python experiments/bench_ipc.py --device cuda --sizes 300,1400,5300,18000 --envs 1,128,1024

A bonded pad of 20.75 × 25.25 × 4 mm (E = 0.1 MPa, ν = 0.45) and a sphere of 4 mm radius that is driven 1 mm in 20 steps of 10 ms and then
held for 5; d̂ = 0.1 mm, μ = 0.5, velocity tolerance 1e-4 m/s. The first step (compilation, first lists) is told apart. On a
machine that others use too, the processor time says more than the clock.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
import warp as wp

import ipc
from raytac.errors import RaytacError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.options import CommonOptions

CELLS = {300: (8, 10, 2), 1400: (16, 20, 3), 5300: (26, 32, 5), 18000: (40, 48, 8)}
RADIUS, GAP, DEPTH = 4e-3, 1.1e-4, 1e-3
PRESS, HOLD = 20, 5


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time the solver's press steps."""

    sizes: str = "300,1400,5300"
    """About how many vertices: any of 300, 1400, 5300, 18000, joined by commas."""
    envs: str = "1"
    """Numbers of environments, joined by commas; more than one environment is measured up to 1400 vertices."""
    friction: float = 0.5
    """μ."""


def measure(size: int, envs: int, args: Args) -> dict[str, Metric]:
    """One press: median step, throughput, iterations and stages."""
    mesh = ipc.domed_pad((20.75e-3, 25.25e-3), 4e-3, (np.inf, np.inf), CELLS[size])
    base = ipc.vertices_in_box(mesh, (-1, -1, -4e-3), (1, 1, -4e-3))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45, 1000.0), bonded=base)
    ball = ipc.KinematicBody("ball", ipc.icosphere(RADIUS, 3), ipc.Pose((0, 0, RADIUS + GAP)))
    settings = ipc.Settings(dt=0.01, d_hat=1e-4, friction=args.friction)
    world = ipc.World([pad, ball], settings, num_envs=envs, device=args.device)
    times, busy, newton, linear, converged = [], [], 0, 0, True
    for k in range(PRESS + HOLD):
        world.set_target("ball", (0, 0, RADIUS + GAP - DEPTH * min(k + 1, PRESS) / PRESS))
        wp.synchronize()
        start, cpu = time.perf_counter(), time.process_time()
        report = world.step()
        wp.synchronize()
        times.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
        newton, linear = newton + int(report.newton.max()), linear + int(report.linear.max())
        converged &= bool(report.converged.all())
        if k == 0:
            before = world.timers
    pressed = np.array(times[1:PRESS])
    key = f"{world.device.alias.split(':')[0]}.{size}" + (f"x{envs}" if envs > 1 else "")
    stages = {f"{key}.stage_ms.{n}": 1e3 * (t - before.get(n, 0)) / (PRESS + HOLD - 1) for n, t in world.timers.items()}
    press, hold = 1e3 * float(np.median(pressed)), 1e3 * float(np.median(times[PRESS:]))
    rate, mean_newton, mean_pcg = float(envs / np.mean(pressed)), newton / len(times), linear / len(times)
    print(
        f"{key:14} {len(mesh.vertices):6d} vertices  press {press:8.2f} ms  hold {hold:8.2f} ms  first {times[0]:6.2f} s  "
        f"{rate:9.1f} env-steps/s  processor {1e3 * np.median(busy[1:PRESS]):8.2f} ms  newton {mean_newton:.2f}  pcg {mean_pcg:.1f}"
    )
    return {
        f"{key}.vertices": len(mesh.vertices),
        f"{key}.ms_per_step": press,
        f"{key}.processor_ms_per_step": 1e3 * float(np.median(busy[1:PRESS])),
        f"{key}.ms_per_hold_step": hold,
        f"{key}.first_step_s": times[0],
        f"{key}.env_steps_per_s": rate,
        f"{key}.newton_per_step": mean_newton,
        f"{key}.pcg_per_step": mean_pcg,
        f"{key}.converged": int(converged),
        f"{key}.force_n": float(world.wrench("ball").force[0, 2]),
        **stages,
    }


def main(args: Args) -> int:
    begin = time.perf_counter()
    sizes, envs = [int(s) for s in args.sizes.split(",")], [int(e) for e in args.envs.split(",")]
    if not set(sizes) <= set(CELLS) or min(envs) < 1:
        print(
            f"--sizes {args.sizes} --envs {args.envs}: sizes are {', '.join(map(str, CELLS))}; environments at least 1",
            file=sys.stderr,
        )
        return 2
    metrics: dict[str, Metric] = {}
    for size in sizes:
        for count in envs:
            if count == 1 or size <= 1400:
                metrics |= measure(size, count, args)
    common = {"experiment": "bench_ipc", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(args.out or Path("runs/bench_ipc"), ("metrics.json",)) as folder:
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
