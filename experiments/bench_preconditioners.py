"""Which preconditioner makes a press step fast? Block-Jacobi, the rest inverse with and without contacts, and FSAI.

    python experiments/bench_preconditioners.py --sizes 300,1400 --out runs/bench_preconditioners
    python experiments/bench_preconditioners.py --device cuda --sizes 300,1400,5300 --envs 1,128 --linear-tolerance 1e-6

The press of ``experiments/bench_ipc.py`` at ν = 0.45 and 0.49. Block-Jacobi has kernels of its own, all iterations of an environment in
one thread on the CPU and in one block of threads on CUDA; the others are applied from the common loop, launch by launch.
FSAI is Warp's (adaptive, 32 entries a row, single precision, refitted in every Newton iteration to the matrix with the diagonal blocks
of the contacts). Times are medians over the steps after the first; on a machine that others use too, the processor time says more than
the clock, with one thread of BLAS (OPENBLAS_NUM_THREADS=1). On CUDA the stages are those of further steps launch by launch.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
import warp as wp
from bench_ipc_scenes import CELLS, D_HAT, DT, FRICTION, GAP, MATERIAL, PRESS, RADIUS, TRAVEL, ball_surface, press_pad

import ipc
from ipc.solver import block_jacobi, linear
from ipc.solver.preconditioners import RestInverse
from raytac.errors import RaytacError
from raytac.io import VERSIONED, CommonOptions, Metric, result_folder, versions, write_metrics

KINDS = ("block_jacobi", "fsai", "rest_alone", "rest_inverse", "rest_whole")
STAGED = 3
"""Steps on CUDA whose stages are timed."""
FSAI_ROW = 32


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time the preconditioners of the solver."""

    sizes: str = "300,1400"
    """About how many vertices: any of 300, 1400, 5300, 18000, joined by commas."""
    envs: str = "1"
    """Numbers of environments, joined by commas."""
    poisson: str = "0.45,0.49"
    """Poisson's ratios, joined by commas."""
    linear_tolerance: float = ipc.Settings.linear_tolerance
    """Relative residual of the linear solves."""
    kinds: str = "block_jacobi,fsai,rest_alone,rest_inverse"
    """Which: block_jacobi, fsai, rest_alone (without contacts), rest_inverse, rest_whole (never condensed), joined by commas."""


class RestAlone(RestInverse):
    """The rest inverse without the contacts of the moment."""

    def update(self, system: Any, contacts: Any, rows: int, active: wp.array) -> None:
        self.jacobi.update(system, contacts, rows, active)


@wp.kernel
def fill_blocks(
    system: linear.SystemView,  # pyright: ignore[reportGeneralTypeIssues]
    contact: wp.array2d(dtype=wp.mat33d),  # pyright: ignore[reportInvalidTypeForm]
    row_start: wp.array(dtype=wp.int32),  # pyright: ignore[reportInvalidTypeForm]
    count: wp.int32,
    values: wp.array(dtype=wp.mat33d),  # pyright: ignore[reportInvalidTypeForm]
):
    """The matrix on the unknowns with the contacts' diagonal blocks, one environment after the other; identity on bonded nodes."""
    env, i = wp.tid()  # pyright: ignore[reportGeneralTypeIssues, reportAssignmentType]
    k = system.row_base[i]
    for s in range(system.row_length[i]):
        block = wp.mat33d()
        if system.free[i] != 0 and system.free[system.col[k]] != 0:
            block = system.blocks[env, k]
        if system.col[k] == i:
            if system.free[i] != 0:
                block += contact[env, i]
            else:
                block = wp.identity(n=3, dtype=wp.float64)
        values[env * count + row_start[i] + s] = block
        k += system.stride


class Fsai:
    """Warp's factorised sparse approximate inverse (Kolotilina, Yeremin 1993) as a ``Preconditioner``; the mask is not looked at."""

    on_host = True

    def __init__(self, layout: Any, batch: int, lanes: int, device: wp.Device) -> None:
        from warp.sparse import bsr_zeros

        self.batch, self.lanes, self.device, count = batch, lanes, device, len(layout.node_rest)
        self.blocks = len(layout.col)
        self.row_start = wp.array(layout.row_start, dtype=wp.int32, device=device)
        block_type: Any = wp.mat33d
        self.matrix: Any = bsr_zeros(batch * count, batch * count, block_type=block_type, device=device)
        shift = np.arange(batch)[:, None]
        offsets = np.concatenate([(layout.row_start[:-1] + shift * self.blocks).ravel(), [batch * self.blocks]])
        self.matrix.offsets = wp.array(offsets, dtype=wp.int32, device=device)
        self.matrix.columns = wp.array((layout.col + shift * count).ravel(), dtype=wp.int32, device=device)
        self.matrix.values = wp.zeros(batch * self.blocks, dtype=wp.mat33d, device=device)
        self.matrix.notify_nnz_changed(nnz=batch * self.blocks)
        self.contact = wp.zeros((batch, count), dtype=wp.mat33d, device=device)
        self.factor: Any = None

    def update(self, system: Any, contacts: Any, rows: int, active: wp.array) -> None:
        from warp.optim.linear import FSAI

        self.contact.zero_()
        inputs, dim = [system, contacts, False, active, self.lanes], (self.batch, self.lanes)
        wp.launch(block_jacobi.diagonal_rows, dim=dim, inputs=inputs, outputs=[self.contact], device=self.device)
        inputs = [system, self.contact, self.row_start, self.blocks, self.matrix.values]
        wp.launch(fill_blocks, dim=self.contact.shape, inputs=inputs, device=self.device)
        if self.factor is None:
            options: dict = {"factor_dtype": wp.float32, "reuse_pattern": True, "regularize_refit": True}
            self.factor = FSAI(self.matrix, max_row_size=FSAI_ROW, max_step_size=4, validate_topology=False, **options)
        else:
            self.factor.update()

    def apply(self, r: wp.array, running: wp.array, z: wp.array) -> None:
        flat = [a.reshape((-1,)) for a in (r, z)]
        self.factor.matvec(flat[0], flat[1], flat[1], alpha=1.0, beta=0.0)


def time_calls(call: Callable[[], None], device: wp.Device) -> float:
    """Milliseconds a call: on CUDA in a graph of 20, on the CPU one by one; median of 9."""
    call()
    repeats, graph = 1, None
    if device.is_cuda:
        repeats = 20
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(repeats):
                call()
        graph = capture.graph
        assert graph is not None
        wp.capture_launch(graph)
    times = []
    for _ in range(9):
        wp.synchronize()
        start = time.perf_counter()
        wp.capture_launch(graph) if graph is not None else call()
        wp.synchronize()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times)) / repeats


def measure(size: int, envs: int, poisson: float, kind: str, args: Args) -> dict[str, Metric]:
    """One press."""
    mesh, base = press_pad(CELLS[size], "alike")
    pad = ipc.SoftBody("pad", mesh, replace(MATERIAL, poisson=poisson), bonded=base)
    ball = ipc.KinematicBody("ball", ball_surface(), ipc.Pose((0, 0, RADIUS + GAP)))
    # With the rest inverse the solver keeps the whole matrix, which the others are given in its place.
    name: Any = kind if kind == "block_jacobi" else "rest_inverse"
    settings = ipc.Settings(dt=DT, d_hat=D_HAT, friction=FRICTION, preconditioner=name, linear_tolerance=args.linear_tolerance)
    world = ipc.World([pad, ball], settings, num_envs=envs, device=args.device)
    solver, begin = world._newton, time.perf_counter()
    lanes, on = solver.potential.collision.lanes, world.device
    if kind == "fsai":
        solver.preconditioner = Fsai(world.layout, envs, lanes, on)
    elif kind != "block_jacobi":
        form = RestAlone if kind == "rest_alone" else RestInverse
        patches = 0 if kind == "rest_whole" else None
        solver.preconditioner = form(world.layout, settings, envs, lanes, on, patches=patches)
    setup = time.perf_counter() - begin
    times, busy, newton, pcg = [], [], 0, 0
    # The first step compiles, launch by launch; on CUDA the last ones do that again, for their stages.
    for k in range(PRESS + (STAGED if on.is_cuda else 0)):
        staged = k >= PRESS or not on.is_cuda
        solver.settings = replace(settings, graph=not staged and k > 0)
        if k == (PRESS if on.is_cuda else 1):
            solver.timers.clear()
        world.set_target("ball", (0, 0, RADIUS + GAP - TRAVEL * (k + 1) / PRESS))
        wp.synchronize()
        start, cpu = time.perf_counter(), time.process_time()
        report = world.step()
        wp.synchronize()
        if not report.converged.all():
            print(f"step {k} did not converge", file=sys.stderr)
        if k < PRESS:
            times.append(time.perf_counter() - start)
            busy.append(time.process_time() - cpu)
            newton, pcg = newton + int(report.newton.max()), pcg + int(report.linear.max())
    staged = STAGED if on.is_cuda else PRESS - 1
    stages = {name: 1e3 * solver.timers.get(name, 0.0) / staged for name in ("preconditioner", "pcg")}
    device = world.device.alias.split(":")[0]
    key = f"{device}.{size}{f'x{envs}' if envs > 1 else ''}.nu{round(100 * poisson)}.{kind}"
    r, z = (wp.zeros((envs, len(world.layout.node_rest)), dtype=wp.vec3d, device=world.device) for _ in range(2))
    mask = wp.full(envs, 1, dtype=wp.int32, device=world.device)
    # With lines of nodes (ipc/solver/lines.py) the conjugate gradients apply it themselves.
    alone = getattr(solver.preconditioner, "lines", None) is None
    apply = {"apply_ms": time_calls(lambda: solver.preconditioner.apply(r, mask, z), world.device)} if alone else {}
    step, processor = 1e3 * float(np.median(times[1:])), 1e3 * float(np.median(busy[1:]))
    print(
        f"{key:32} setup {setup:6.2f} s  step {step:8.2f} ms  processor {processor:8.2f} ms  newton {newton / PRESS:5.2f}  "
        f"pcg/solve {pcg / newton:6.1f}  update {stages['preconditioner']:7.2f} pcg {stages['pcg']:8.2f} ms/step"
        + "".join(f"  apply {value:7.4f} ms" for value in apply.values()),
        flush=True,
    )
    found: dict[str, Metric] = {
        f"{key}.setup_s": setup,
        f"{key}.ms_per_step": step,
        f"{key}.processor_ms_per_step": processor,
        f"{key}.newton_per_step": newton / PRESS,
        f"{key}.pcg_per_solve": pcg / newton,
        f"{key}.update_ms_per_step": stages["preconditioner"],
        f"{key}.pcg_ms_per_step": stages["pcg"],
        f"{key}.env_steps_per_s": envs / float(np.mean(times[1:])),
    }
    return found | {f"{key}.{name}": value for name, value in apply.items()}


def main(args: Args) -> int:
    begin = time.perf_counter()
    sizes, envs = [int(s) for s in args.sizes.split(",")], [int(e) for e in args.envs.split(",")]
    poisson, kinds = [float(p) for p in args.poisson.split(",")], args.kinds.split(",")
    if not set(sizes) <= set(CELLS) or not set(kinds) <= set(KINDS) or min(envs) < 1:
        print(
            f"--sizes {args.sizes} --kinds {args.kinds} --envs {args.envs}: sizes are {', '.join(map(str, CELLS))}; "
            f"kinds are {', '.join(KINDS)}; environments at least 1",
            file=sys.stderr,
        )
        return 2
    metrics: dict[str, Metric] = {}
    for size in sizes:
        for count in envs:
            for nu in poisson:
                for kind in kinds:
                    metrics |= measure(size, count, nu, kind, args)
    versioned = versions((*VERSIONED, "warp-lang"))
    run = {"device": args.device, "seed": args.seed, "linear_tolerance": args.linear_tolerance}
    common = {"experiment": "bench_preconditioners", **run, **versioned}
    with result_folder(args.out or Path("runs/bench_preconditioners"), ("metrics.json",)) as folder:
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
