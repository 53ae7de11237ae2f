"""What does an error of the pressed surface cost? Height and force against a fine solution, beside the time of a step.

    python experiments/bench_ipc_accuracy.py --out runs/bench_ipc_accuracy       # some minutes on two cores
    python experiments/bench_ipc_accuracy.py --out runs/bench_ipc_accuracy --device cuda

The press of ``bench_ipc.py`` for each mesh and velocity tolerance; at the end of the way down the outer surface is compared with that of
the ``--reference`` mesh (mirrored cells) at ``--reference-tolerance`` and a linear tolerance of 1e-4, on a common grid of 0.1 mm: under
the contact (as far out as the reference carries load) and around it (twice as far). The sphere, d̂ and κ are the same in all of them, so
neither its facets nor the stand-off count as error. ``ipc.box_mesh`` says how cells are cut ``alike`` and ``mirrored``. The reference is
kept in DIR/references by content. docs/measurements/contact-solver.md says what came out.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
import warp as wp
from bench_ipc import compile_kernels, parse_numbers
from bench_ipc_scenes import (
    CELLS,
    D_HAT,
    DT,
    FRICTION,
    GAP,
    HOLD,
    MATERIAL,
    PRESS,
    RADIUS,
    ball_height,
    ball_surface,
    press_pad,
    press_world,
)
from numpy.typing import ArrayLike, NDArray

import ipc
from raytac.errors import InputError, RaytacError
from raytac.io import (
    VERSIONED,
    CommonOptions,
    Metric,
    SealError,
    npz_bytes,
    parse_names,
    read_sealed,
    result_folder,
    versions,
    write_metrics,
    write_sealed,
)
from raytac.report import machine

KINDS: tuple[ipc.Cut, ...] = ("alike", "mirrored")
"""How cells are cut, see ``ipc.box_mesh``: as in ``bench_ipc.py``, and as in raytac's soft pad."""
PITCH = 1e-4
"""Of the grid on which surfaces are compared [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure height and force errors of the press beside its time."""

    sizes: str = "300,1400,5300,18000"
    """About how many vertices, joined by commas; the reference's own shows what the tolerance alone does."""
    cells: str = "alike,mirrored"
    """How cells are cut into tetrahedra, joined by commas."""
    tolerances: str = "1e-2,1e-3,1e-4,1e-5"
    """Velocity tolerances [m/s], joined by commas."""
    reference: int = 18000
    """About how many vertices the reference has."""
    reference_tolerance: float = 1e-5
    """Of the reference [m/s]."""


@dataclass(frozen=True)
class Press:
    """A pad at the end of the way down.

    Attributes:
        points: vertices of the outer surface [m], shape (n, 3).
        triangles: in numbers of ``points``, shape (F, 3).
        contact_radius: largest distance of a loaded vertex from the axis [m].
        force, force_held: normal force on the sphere at the end of the way down and after the hold [N].
        ms, processor_ms: median time of a step on the way down by the clock and by the processor, the first left out [ms].
        newton: iterations a step on the way down.
        converged: all steps did.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    contact_radius: float
    force: float
    force_held: float
    ms: float
    processor_ms: float
    newton: float
    converged: bool


def surface_heights(points: ArrayLike, triangles: ArrayLike, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
    """Height z [m] over (x, y) of a triangulated surface, linear on each triangle.

    Args:
        points: displaced vertices [m], shape (n, 3); seen from above, no triangle may be flipped.
        triangles: vertex numbers, shape (F, 3).
        x, y: where [m], same shape.

    Returns:
        Heights of that shape; NaN beside the surface.
    """
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    p = np.asarray(points, dtype=np.float64)
    surface = Triangulation(p[:, 0], p[:, 1], np.asarray(triangles))
    return np.ma.filled(LinearTriInterpolator(surface, p[:, 2])(np.asarray(x), np.asarray(y)), np.nan)


def outer_surface(world: ipc.World) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The pad's mesh vertices on the outer surface (rest z = 0), and its triangles in numbers of those."""
    rest = world.bodies[0].mesh.vertices  # type: ignore[union-attr]
    vertices, faces = world.surface("pad")
    top = np.abs(rest[vertices, 2]) < 1e-9
    number = np.cumsum(top) - 1
    return vertices[top].astype(np.int64), number[faces[top[faces].all(axis=1)]].astype(np.int64)


def press(cells: tuple[int, int, int], cut: ipc.Cut, settings: ipc.Settings, device: str) -> Press:
    """Down and hold, timed."""
    world = press_world(cells, settings, 1, device, cut)
    vertices, triangles = outer_surface(world)
    seconds, busy, newton, converged = [], [], [], True
    points, radius, force = np.zeros(0), 0.0, 0.0
    for step in range(PRESS + HOLD):
        world.set_target("ball", (0, 0, ball_height(step)))
        wp.synchronize()
        start, cpu = time.perf_counter(), time.process_time()
        report = world.step()
        wp.synchronize()
        seconds.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
        newton.append(int(report.newton[0]))
        converged &= bool(report.converged[0])
        if step == PRESS - 1:
            points = world.positions("pad")[0][vertices]
            force = float(world.wrench("ball").force[0, 2])
            loaded = np.linalg.norm(world.contact_forces("pad")[0], axis=1) > 0
            at = world.positions("pad")[0][world.surface("pad")[0][loaded]]
            radius = float(np.hypot(at[:, 0], at[:, 1]).max())
    down = slice(1, PRESS)
    return Press(
        points=points,
        triangles=triangles,
        contact_radius=radius,
        force=force,
        force_held=float(world.wrench("ball").force[0, 2]),
        ms=1e3 * float(np.median(seconds[down])),
        processor_ms=1e3 * float(np.median(busy[down])),
        newton=float(np.mean(newton[down])),
        converged=converged,
    )


def reference_press(size: int, tolerance: float, device: str, folder: Path) -> Press:
    """The fine solution, computed unless ``folder`` holds one of the same mesh, sphere, drive and settings."""
    mesh, base = press_pad(CELLS[size], "mirrored")
    settings = ipc.Settings(dt=DT, d_hat=D_HAT, friction=FRICTION, velocity_tolerance=tolerance, linear_tolerance=1e-4)
    digest = hashlib.sha256(repr((asdict(settings), asdict(MATERIAL), RADIUS, GAP, PRESS, HOLD)).encode())
    ball = ball_surface()
    drive = np.array([ball_height(step) for step in range(PRESS + HOLD)])
    for array in (mesh.vertices, mesh.tets, base, ball.vertices, ball.faces, drive):
        digest.update(np.ascontiguousarray(array).tobytes())
    path = folder / f"press_{size}_{digest.hexdigest()[:12]}.npz"
    try:
        with np.load(io.BytesIO(read_sealed(path)), allow_pickle=False) as held:
            print(f"reference: {path}")
            return Press(**{name: held[name] if held[name].ndim else held[name].item() for name in held.files})
    except FileNotFoundError:
        pass
    except SealError as error:
        print(f"reference: {path} cannot be used ({error})")
    print(f"reference: {len(mesh.vertices)} vertices at {tolerance:g} m/s, kept as {path}", flush=True)
    done = press(CELLS[size], "mirrored", settings, device)
    write_sealed(path, npz_bytes(asdict(done)))
    return done


def errors(found: Press, truth: Press) -> dict[str, Metric]:
    """Root mean square and largest height error [µm] under and around the contact, and relative force errors."""
    a = truth.contact_radius
    line = np.arange(-np.ceil(2 * a / PITCH), np.ceil(2 * a / PITCH) + 1) * PITCH
    x, y = np.meshgrid(line, line)
    off = 1e6 * np.abs(
        surface_heights(found.points, found.triangles, x, y) - surface_heights(truth.points, truth.triangles, x, y)
    )
    r = np.where(np.isfinite(off), np.hypot(x, y), np.inf)  # twice the contact's radius may reach past a small pad
    metrics: dict[str, Metric] = {}
    for name, region in (("contact", r <= a), ("around", (r > a) & (r <= 2 * a))):
        metrics[f"rms_um.{name}"] = float(np.sqrt(np.mean(off[region] ** 2)))
        metrics[f"max_um.{name}"] = float(off[region].max())
    metrics["force_error"] = found.force / truth.force - 1
    metrics["force_held_error"] = found.force_held / truth.force_held - 1
    return metrics


@dataclass(frozen=True)
class Point:
    """What a tolerance on a mesh costs and brings: time of a step [ms], RMS height error under the contact [µm].

    Attributes:
        ms: median press step [ms].
        off: against the reference [µm]; None for the reference's own mesh.
        off_tolerance: against the same mesh at the least tolerance [µm]; None at that one.
    """

    ms: float
    off: float | None
    off_tolerance: float | None


def draw(points: dict[tuple[str, int, str], Point], axis_label: str, path: Path) -> None:
    """Height error against time of a step: all of it by kind of cells, and what the tolerance does of it on the last kind.

    Colours of Okabe and Ito, told apart by marker too.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator, NullLocator

    looks = {300: ("#D55E00", "s"), 1400: ("#E69F00", "^"), 5300: ("#009E73", "D"), 18000: ("#0072B2", "o")}
    sizes = [size for size in looks if any(s == size for _, s, _ in points)]
    kinds = [kind for kind in KINDS if any(k == kind for k, _, _ in points)]
    fills: dict[str, Any] = {"alike": ("--", "bottom"), "mirrored": ("-", "full")}
    style: dict[Any, Any] = {
        "font.size": 8,
        "axes.linewidth": 0.6,
        "axes.labelsize": 8,
        "legend.fontsize": 6.5,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
    }
    with plt.rc_context(style):
        figure, axes = plt.subplots(figsize=(3.5, 3.3), layout="constrained")
        for size in sizes:
            look: dict[str, Any] = {"color": looks[size][0], "marker": looks[size][1], "markersize": 4.5, "linewidth": 0.9}
            for kind in kinds:
                whole = [(p.ms, p.off) for (k, s, _), p in points.items() if (k, s) == (kind, size) and p.off]
                axes.plot(
                    [p[0] for p in whole], [p[1] for p in whole], linestyle=fills[kind][0], fillstyle=fills[kind][1], **look
                )
            alone = [
                (p.ms, p.off_tolerance, t) for (k, s, t), p in points.items() if (k, s) == (kinds[-1], size) and p.off_tolerance
            ]
            axes.plot([p[0] for p in alone], [p[1] for p in alone], linestyle=":", fillstyle="none", **look)
            names: list[str] = []
            for (ms, off, tolerance), after in zip(alone, [*alone[1:], None], strict=True):
                names.append(f"$10^{{{round(np.log10(float(tolerance)))}}}$")
                if after is not None and max(ms / after[0], after[0] / ms) < 1.3 and max(off / after[1], after[1] / off) < 1.6:
                    continue  # too close for two labels
                place = {"xytext": (4, -1) if len(names) == 1 else (-5, 6), "textcoords": "offset points"}
                axes.annotate(", ".join(names), (ms, off), fontsize=6, color=looks[size][0], **place)
                names = []
        axes.set(xscale="log", yscale="log", xlabel=axis_label, ylabel="height error under the contact, RMS [µm]")
        for axis in (axes.xaxis, axes.yaxis):
            low, high = axis.get_view_interval()
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 300 else (1,)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
        axes.grid(True, linewidth=0.3, color="0.88")
        axes.set_axisbelow(True)
        axes.margins(x=0.12, y=0.08)
        size_of: dict[str, Any] = {"markersize": 4.5, "linewidth": 0.9}
        handles = [
            Line2D([], [], color=looks[s][0], marker=looks[s][1], label=f"{vertices(s):,} vertices", **size_of) for s in sizes
        ]
        grey: dict[str, Any] = {"color": "0.3", "marker": "o", **size_of}
        handles += [
            Line2D([], [], label=f"{kind} cells", linestyle=fills[kind][0], fillstyle=fills[kind][1], **grey) for kind in kinds
        ]
        handles.append(Line2D([], [], label="tolerance [m/s] alone", linestyle=":", fillstyle="none", **grey))
        figure.legend(handles=handles, frameon=False, ncols=2, loc="outside upper center")
        figure.savefig(path, dpi=300)
        plt.close(figure)


def vertices(size: int) -> int:
    """Number of vertices of the structured pad."""
    return int(np.prod([n + 1 for n in CELLS[size]]))


def main(args: Args) -> int:
    begin = time.perf_counter()
    sizes = parse_numbers(args.sizes, "sizes", tuple(CELLS))
    tolerances, wanted_kinds = parse_names(args.tolerances, "tolerances"), parse_names(args.cells, "cells", KINDS)
    kinds: tuple[ipc.Cut, ...] = tuple(kind for kind in KINDS if kind in wanted_kinds)
    for tolerance in tolerances:
        try:
            good = 0 < float(tolerance) < np.inf
        except ValueError:
            good = False
        if not good:
            raise InputError("tolerances", value=tolerance, rule="must be positive numbers joined by commas, as in 1e-3,1e-4")
    if args.reference not in CELLS:
        raise InputError("reference", value=args.reference, rule="must be a known size", choices=tuple(map(str, CELLS)))
    out = args.out or Path("runs/bench_ipc_accuracy")
    metrics: dict[str, Metric] = machine() | {"compile_s": compile_kernels(args.device)}
    truth = reference_press(args.reference, args.reference_tolerance, args.device, out / "references")
    metrics |= {
        "reference.vertices": vertices(args.reference),
        "reference.tolerance": args.reference_tolerance,
        "reference.force_n": truth.force,
        "reference.force_held_n": truth.force_held,
        "reference.contact_radius_mm": 1e3 * truth.contact_radius,
        "reference.ms_per_step": truth.ms,
        "reference.processor_ms_per_step": truth.processor_ms,
        "reference.converged": int(truth.converged),
    }
    device = "cuda" if args.device == "cuda" or (args.device == "auto" and wp.is_cuda_available()) else "cpu"
    points: dict[tuple[str, int, str], Point] = {}
    for size, kind in itertools.product(sizes, kinds):
        own = size == args.reference and kind == "mirrored"
        wanted = [t for t in tolerances if not own or float(t) > args.reference_tolerance]
        settings = ipc.Settings(dt=DT, d_hat=D_HAT, friction=FRICTION)
        found = {t: press(CELLS[size], kind, replace(settings, velocity_tolerance=float(t)), args.device) for t in wanted}
        least = min(found, key=float, default="")
        for tolerance, run in found.items():
            key = f"{device}.{size}.{tolerance}" if kind == "alike" else f"{device}.{kind}.{size}.{tolerance}"
            off = errors(run, truth)
            alone = None
            if own:
                alone = float(off["rms_um.contact"])
            elif tolerance != least:
                alone = float(errors(run, found[least])["rms_um.contact"])
            ms = run.ms if device == "cuda" else run.processor_ms
            points[kind, size, tolerance] = Point(ms, None if own else float(off["rms_um.contact"]), alone)
            metrics |= {f"{key}.{name}": value for name, value in off.items()}
            metrics |= {
                f"{key}.force_n": run.force,
                f"{key}.force_held_n": run.force_held,
                f"{key}.ms_per_step": run.ms,
                f"{key}.processor_ms_per_step": run.processor_ms,
                f"{key}.newton_per_step": run.newton,
                f"{key}.converged": int(run.converged),
            }
            if alone is not None:
                metrics[f"{key}.tolerance_rms_um.contact"] = alone
            print(
                f"{key:24} {ms:9.2f} ms  newton {run.newton:5.2f}  contact {off['rms_um.contact']:8.3f} µm (max "
                f"{off['max_um.contact']:8.3f})  around {off['rms_um.around']:8.3f} µm (max {off['max_um.around']:8.3f})  "
                f"tolerance alone {alone or 0:7.3f} µm  force {100 * float(off['force_error']):+7.2f} %, "
                f"held {100 * float(off['force_held_error']):+7.2f} %",
                flush=True,
            )
    time_of = "time of a press step on one GPU [ms]" if device == "cuda" else "processor time of a press step, one CPU core [ms]"
    common = {"experiment": "bench_ipc_accuracy", "device": args.device, "seed": args.seed, **versions((*VERSIONED, "warp-lang"))}
    with result_folder(out, ("metrics.json", "error_cost.png")) as folder:
        draw(points, time_of, folder / "error_cost.png")
        write_metrics(folder / "metrics.json", {**common, **metrics, "wall_s": time.perf_counter() - begin})
    print(f"{out / 'metrics.json'}, {out / 'error_cost.png'}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except RaytacError as error:
        sys.exit(f"error: {error}")
