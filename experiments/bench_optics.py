"""How fast is the ray tracer, and how far is it from converged? Error beside time, for ``fast`` and for path tracing, in one run.

Every frame has a new surface, and everything from the height field to the 8-bit image counts:

    python experiments/bench_optics.py --out runs/bench_optics                      # about 20 minutes on two cores
    python experiments/bench_optics.py --out runs/bench_cuda --device cuda --parts speed,error
    python experiments/bench_optics.py --against ../raytac_b682ef2                      # frames in turn with another checkout's, on the CPU

docs/measurements/image-modes.md explains the figures. References are kept in DIR/references by content, so that an interrupted run goes on.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.running import recorded, run
from experiments.turns import in_turn
from raytac.errors import InputError, RaytacError
from raytac.gel import GelSurface
from raytac.io import CommonOptions, Metric, Progress, parse_names
from raytac.optics import RayTraced
from raytac.report import (
    References,
    Tracers,
    cost_at,
    machine,
    mae,
    moving,
    once,
    path_trace,
    press_peaks,
    psnr,
    rmse,
    spp_for_error,
    timed,
)
from raytac.specs import SensorSpec

PARTS = ("speed", "error", "peer", "stages", "memory", "first_image")
SPP = (1, 4, 16, 64)
"""Samples a pixel at which path tracing is measured."""
BATCHES = {"cpu": {"320x240": (1, 8), "640x480": (1,)}, "cuda": {"320x240": (1, 16, 64, 256), "640x480": (1, 256)}}
FAST_VARIANTS: dict[str, dict[str, Any]] = {"fast": {}, "fast_no_bounce": {"bounce": False}, "fast_4_rays": {"spp": 4}}

CHILD = """
import json, os, resource, sys, time
start = time.perf_counter()
import raytac
imported = time.perf_counter()
name, device, scene, updates, resolution = sys.argv[1:]
sensor = raytac.TactileSensor(name, outputs=("rgb",), device=device, resolution=tuple(map(int, resolution.split("x"))))
frame = sensor.press(scene)
done = time.perf_counter()
assert frame.rgb.max() > 0
result = {"import_s": imported - start, "first_image_s": done - start}
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20
if int(updates):
    import numpy as np
    from dataclasses import replace
    rest, height = frame.surface.grid.rest.astype(np.float32), frame.surface.height
    for k in range(-100, int(updates)):
        if k == 0:
            before = resident_mb()
        sensor.update(replace(frame.surface, height=rest + (0.7 + 0.3 * (0.618 * k % 1)) * (height - rest)))
    result |= {"before_mb": before, "after_mb": resident_mb()}
print(json.dumps(result | {"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10}))
"""
"""A process of its own: from nothing to the first image, then updates with a surface that changes."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure error and time of the optical modes."""

    parts: str = ",".join(PARTS)
    """What to measure, joined by commas: speed, error, peer, stages, memory, first_image."""
    scenes: str = "sphere,coin,pins"
    """Shipped press scenes or scene files, joined by commas, on which error and peers are measured."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    spp: int = 1024
    """Samples a pixel of the reference, without limit of depth; two independent halves give its noise."""
    frames: int = 60
    """Timed frames a figure (at least 40 for a median to quote)."""
    quick: bool = False
    """80x60, one scene, 16 samples, five frames: shows that all runs; its figures mean nothing."""
    against: Path | None = None
    """Checkout of another commit: only frames in turn with its own sensor of that name, one environment on the CPU (``turns.py``)."""


@dataclass(frozen=True)
class Bench:
    """What all parts share; ``surfaces`` are presses of one environment on the grid of ``size``."""

    args: Args
    device: str
    spec: SensorSpec
    size: tuple[int, int]
    surfaces: dict[str, GelSurface]
    frames: int
    spp: int
    peer_spp: tuple[int, ...]
    out: Path
    tracers: Tracers
    built: dict[str, Any] = field(default_factory=dict)
    """The last child's result."""

    @property
    def name(self) -> str:
        return f"{self.size[0]}x{self.size[1]}"

    @property
    def key(self) -> str:
        return f"{self.device}.{self.name}"

    def tracer(self, size: tuple[int, int] | None = None, **options: Any) -> Any:
        """Ray tracer of this size and device, as ``Tracers.get`` says."""
        return self.tracers.get(size or self.size, RayTraced(**options))


# ------------------------------------------------------------------------------------------------------------ building blocks


def kernels(call: Callable[[], object]) -> list[tuple[int, float]]:
    """(width, milliseconds) of every kernel that ``call`` launches."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        call()
        dr.sync_thread()
        return [(entry["size"], entry["execution_time"]) for entry in dr.kernel_history()]


def set_surface(tracer: Any, surface: GelSurface) -> None:
    """Vertex update, normals and BVH rebuild alone."""
    import drjit as dr

    tracer.scene.set_surface(surface.height[0])
    dr.sync_thread()


# ------------------------------------------------------------------------------------------------------------ parts


def speed(bench: Bench) -> dict[str, Metric]:
    """``fast`` over moving surfaces: NumPy in and out, and from heights on the device to an image on the device."""
    import drjit as dr

    plan = {bench.name: (1, 2)} if bench.args.quick else BATCHES[bench.device]
    metrics: dict[str, Metric] = {}
    for name, batches in plan.items():
        width, height = (int(n) for n in name.split("x"))
        surfaces = bench.surfaces
        if (width, height) != bench.size:
            surfaces = press_peaks(bench.args.sensor, parse_names(bench.args.scenes, "scenes"), (width, height), bench.args.seed)[
                1
            ]
        tracer = bench.tracer(None if (width, height) == bench.size else (width, height))
        for batch in Progress(batches, desc=f"speed {name}", leave=False):
            inputs = moving(list(surfaces.values()), batch, 6 if batch < 64 else 3)

            def on_device(heights: Any, tracer: Any = tracer) -> None:
                dr.eval(tracer.render_device(heights).rgb)
                dr.sync_thread()

            host = timed(tracer.render, inputs, bench.frames)
            uploaded = [tracer.mi.Float(s.height.astype(np.float32).ravel()) for s in inputs]
            device = timed(on_device, uploaded, bench.frames)
            key = f"fast.{bench.device}.{name}"
            for part, ms in (("", host), ("device_", device)):
                median = float(np.median(ms))
                metrics[f"{key}.batch{batch}.{part}fps"] = 1e3 * batch / median
                metrics[f"{key}.batch{batch}.{part}call_ms"] = median
                metrics[f"{key}.batch{batch}.{part}call_ms_p90"] = float(np.percentile(ms, 90))
            if batch == 1:
                metrics |= {f"{key}.fps": 1e3 / float(np.median(host)), f"{key}.ms": float(np.median(host))}
                metrics[f"{key}.ms_p90"] = float(np.percentile(host, 90))
    return metrics


def linear_image(tracer: Any, surface: GelSurface) -> np.ndarray:
    """Sum of the layers of ``fast``, (H, W, 3)."""
    return np.sum(list(tracer.render_layers(surface).values()), axis=0)[0]


def error(bench: Bench, references: References) -> dict[str, Metric]:
    """8-bit image of ``fast`` and its variants against the reference, over the image and in the contact's bounding box."""
    metrics: dict[str, Metric] = {"reference.spp": bench.spp}
    inputs = moving(list(bench.surfaces.values()), 1, 6)
    variants = {"fast": FAST_VARIANTS["fast"]} if bench.args.quick else FAST_VARIANTS
    for variant, options in Progress(variants.items(), desc="error", leave=False):
        tracer = bench.tracer(**options)
        encode, key = tracer.response.encode_numpy, f"{variant}.{bench.key}"
        for scene, surface in bench.surfaces.items():
            truth, image = encode(references.linear(scene, surface)), tracer.render(surface).rgb[0]
            box = bench.tracers.regions(bench.size, surface)["box"]
            box = box if box.any() else np.ones_like(box)
            metrics |= {
                f"{key}.psnr_db.{scene}": psnr(rmse(image, truth)),
                f"{key}.mae_levels.{scene}": mae(image, truth),
                f"{key}.box_psnr_db.{scene}": psnr(rmse(image[box], truth[box])),
                f"{key}.box_mae_levels.{scene}": mae(image[box], truth[box]),
            }
            if variant == "fast":
                # The halves are independent: half their difference has the variance of their mean.
                noise = rmse(*(encode(half) for half in references.halves(scene, surface))) / 2
                metrics |= {f"reference.noise_levels.{scene}": noise, f"reference.noise_psnr_db.{scene}": psnr(noise)}
                metrics[f"reference.mean_level.{scene}"] = float(truth.mean())
        metrics[f"{key}.psnr_db"] = min(float(metrics[f"{key}.psnr_db.{scene}"]) for scene in bench.surfaces)
        if variant != "fast":
            metrics[f"{key}.ms"] = float(np.median(timed(tracer.render, inputs, bench.frames)))
    return metrics


@dataclass(frozen=True)
class Row:
    """Path tracing at one number of samples: kernels alone and whole frame [ms], RMSE in levels and in linear light."""

    kernel_ms: float
    ms: float
    rmse_levels: float
    rmse_linear: float


def rebuild_ms(tracer: Any, surface: GelSurface, frames: int) -> float:
    return float(np.median(timed(functools.partial(set_surface, tracer), moving([surface], 1, 3), frames)))


def trace_rows(bench: Bench, tracer: Any, surface: GelSurface, linear: np.ndarray) -> list[Row]:
    """One row for each of ``peer_spp``: times are medians, errors root mean squares over independent images."""
    encode = tracer.response.encode_numpy
    truth, rows = encode(linear), []
    path_trace(tracer, surface, bench.peer_spp[0], 0)
    vertices = sum(ms for _, ms in kernels(lambda: set_surface(tracer, surface)))
    for spp in bench.peer_spp:
        # Seeds apart from those of the reference images: shared samples would share their error.
        seeds = [100_000 + 1_000 * bench.args.seed + k for k in range(3)]
        images, launched, whole = [], [], []

        def frame(seed: int, spp: int = spp, images: list[np.ndarray] = images) -> None:
            images.append(path_trace(tracer, surface, spp, seed))
            encode(images[-1])

        for seed in seeds:  # the first may compile; a median of three leaves it out
            start = time.perf_counter()
            launched.append(kernels(functools.partial(frame, seed)))
            whole.append(1e3 * (time.perf_counter() - start))
        off = [(rmse(encode(image), truth) ** 2, rmse(image, linear) ** 2) for image in images]
        levels, light = np.sqrt(np.mean(off, axis=0))
        kernel_ms = statistics.median(sum(ms for _, ms in frame_kernels) for frame_kernels in launched) - vertices
        rows.append(Row(kernel_ms, statistics.median(whole), float(levels), float(light)))
    return rows


def peer(bench: Bench, references: References) -> dict[str, Metric]:
    """What path tracing needs to reach the error of ``fast``: Mitsuba's ``path`` and our ``reference``, same surfaces, same run.

    Its cost is the least one could pay: vertex update with BVH rebuild, and kernels, without Python, transfer or response.
    The error of ``fast`` is taken with the reference's noise in it, which favours the peer.
    """
    fast, metrics, mine = bench.tracer(), {}, {}
    for scene, surface in bench.surfaces.items():
        linear = references.linear(scene, surface)
        ms = float(np.median(timed(fast.render, moving([surface], 1, 6), bench.frames)))
        levels = rmse(fast.render(surface).rgb[0], fast.response.encode_numpy(linear))
        mine[scene] = Row(ms, ms, levels, rmse(linear_image(fast, surface), linear))
        metrics[f"fast.{bench.key}.ms.{scene}"] = ms
    metrics |= combined(f"fast.{bench.key}.peer", list(mine.values()))
    for kind in ("path", "reference"):
        tracer = bench.tracer(integrator=kind, progress=kind == "reference")
        rows_of: list[list[Row]] = []
        ratios: dict[str, list[float]] = {"": [], "_linear": [], "_without_rebuild": []}
        for scene, surface in Progress(bench.surfaces.items(), desc=f"peer {kind}", leave=False):
            rows = trace_rows(bench, tracer, surface, references.linear(scene, surface))
            rebuild = rebuild_ms(tracer, surface, max(3, bench.frames // 6))
            rows_of.append(rows)
            needed = spp_for_error(bench.peer_spp, [row.rmse_levels for row in rows], mine[scene].rmse_levels)
            needed_linear = spp_for_error(bench.peer_spp, [row.rmse_linear for row in rows], mine[scene].rmse_linear)
            cost, cost_linear = (cost_at(bench.peer_spp, [row.kernel_ms for row in rows], n) for n in (needed, needed_linear))
            for unit, ms in (("", rebuild + cost), ("_linear", rebuild + cost_linear), ("_without_rebuild", cost)):
                ratios[unit].append(ms / mine[scene].ms)
            metrics[f"{kind}.{bench.key}.spp_for_equal_error.{scene}"] = needed
            metrics[f"fast.{bench.device}.speedup_vs_{kind}_equal_error.{scene}"] = ratios[""][-1]
        for k, spp in enumerate(bench.peer_spp):
            metrics |= combined(f"{kind}.{bench.key}.spp{spp}", [rows[k] for rows in rows_of])
        metrics |= {f"fast.{bench.device}.speedup_vs_{kind}_equal_error{unit}": min(values) for unit, values in ratios.items()}
    return metrics


def combined(key: str, rows: Sequence[Row]) -> dict[str, Metric]:
    """Over scenes: medians of times, root mean squares of errors."""
    metrics: dict[str, Metric] = {
        f"{key}.{name}": statistics.median(getattr(row, name) for row in rows) for name in ("kernel_ms", "ms")
    }
    for name in ("rmse_levels", "rmse_linear"):
        metrics[f"{key}.{name}"] = float(np.sqrt(np.mean([getattr(row, name) ** 2 for row in rows])))
    return metrics


def stages(bench: Bench) -> dict[str, Metric]:
    """Where a frame of ``fast`` goes, by leaving parts out and from its kernels; and what a rebuilt BVH would cost instead."""
    import drjit as dr

    inputs = moving(list(bench.surfaces.values()), 1, 6)
    tracers = {"whole": bench.tracer(), "direct": bench.tracer(bounce=False), "bare": bench.tracer(bounce=False, shadows=False)}
    mi, pixels = tracers["whole"].mi, bench.size[0] * bench.size[1]
    timings: dict[str, list[float]] = {}

    def note(name: str, ms: float) -> None:
        timings.setdefault(name, []).append(ms)

    def upload(surface: GelSurface) -> None:
        dr.eval(mi.Float(surface.height.astype(np.float32).ravel()))
        dr.sync_thread()

    for tracer in tracers.values():
        timed(tracer.render, inputs, 0)
    sampled = bench.tracer(integrator="reference", spp=1)
    sampled.render(inputs[0])
    set_surface(sampled, inputs[0])
    for k in range(bench.frames):  # in turn, so that a busy machine slows all alike
        surface = inputs[k % len(inputs)]
        for name, tracer in tracers.items():
            note(name, once(tracer.render, surface))
        launched = kernels(lambda surface=surface: tracers["bare"].render(surface))
        first = next((i for i, (width, _) in enumerate(launched) if width == pixels), len(launched))
        note("coat", sum(ms for _, ms in launched[:first]))
        note("shade", sum(ms for _, ms in launched[first:]))
        note("kernels", sum(ms for _, ms in kernels(lambda surface=surface: tracers["whole"].render(surface))))
        note("upload", once(upload, surface))
        image = mi.UInt8(dr.arange(mi.UInt32, 3 * pixels) + k)
        dr.eval(image)
        dr.sync_thread()
        note("read_back", once(np.array, image))
        if k < max(5, bench.frames // 4):
            note("rebuild", once(lambda s: set_surface(sampled, s), surface))
    ms = {name: statistics.median(values) for name, values in timings.items()}
    key = f"fast.{bench.key}.stage"
    return {
        f"{key}.whole_ms": ms["whole"],
        f"{key}.coat_ms": ms["coat"],
        f"{key}.bounce_ms": ms["whole"] - ms["direct"],
        f"{key}.shadows_ms": ms["direct"] - ms["bare"],
        f"{key}.shade_ms": ms["shade"],
        f"{key}.upload_ms": ms["upload"],
        f"{key}.read_back_ms": ms["read_back"],
        f"{key}.outside_kernels_ms": ms["whole"] - ms["kernels"],
        f"bvh.{bench.device}.rebuild_ms": ms["rebuild"],
        f"bvh.{bench.device}.triangles": 2 * (inputs[0].height.shape[1] - 1) * (inputs[0].height.shape[2] - 1),
    }


def child(bench: Bench, updates: int) -> dict[str, float]:
    """Run ``CHILD`` in a process of its own; adds ``process_s``, all of its time. With ``quick``, one run serves all."""
    if bench.args.quick and "child" in bench.built:
        return bench.built["child"]
    scene = parse_names(bench.args.scenes, "scenes")[0]
    start = time.perf_counter()
    command = [sys.executable, "-c", CHILD, bench.args.sensor, bench.device, scene, str(updates), bench.name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RaytacError(f"the process that measures the first image failed: {done.stderr.strip()[-500:]}")
    bench.built["child"] = json.loads(done.stdout.splitlines()[-1]) | {"process_s": time.perf_counter() - start}
    return bench.built["child"]


def memory(bench: Bench) -> dict[str, Metric]:
    """Resident memory over many updates of a sensor, in a process of its own."""
    updates = 50 if bench.args.quick else 2000
    result = child(bench, updates)
    return {
        f"memory.growth_mb_{updates}": result["after_mb"] - result["before_mb"],
        "memory.resident_mb": result["after_mb"],
        "memory.peak_mb": result["peak_mb"],
    }


def first_image(bench: Bench) -> dict[str, Metric]:
    """From nothing to the first image of a press, caches warm: the first process warms them and does not count."""
    runs = [child(bench, 0) for _ in range(1 if bench.args.quick else 4)][-3:]
    return {
        "first_image_s": statistics.median(run["first_image_s"] for run in runs),
        "first_image_process_s": statistics.median(run["process_s"] for run in runs),
        "import_raytac_s": statistics.median(run["import_s"] for run in runs),
        "first_image_peak_mb": max(run["peak_mb"] for run in runs),
    }


# ------------------------------------------------------------------------------------------------------------ what is shown


def as_text(metrics: dict[str, Metric], bench: Bench) -> str:
    """Time beside error, one line a mode, then the figures that have a bound to keep."""
    base = bench.key
    modes = [("fast", f"fast.{base}.peer")] + [
        (f"{k} {n} spp", f"{k}.{base}.spp{n}") for k in ("path", "reference") for n in bench.peer_spp
    ]
    lines = [f"{'mode':<20}{'ms a frame':>12}{'kernels ms':>12}{'RMSE levels':>13}{'PSNR dB':>9}"]
    for label, key in modes:
        if f"{key}.ms" in metrics:
            ms, kernel, off = (float(metrics[f"{key}.{column}"]) for column in ("ms", "kernel_ms", "rmse_levels"))
            lines.append(f"{label:<20}{ms:>12.2f}{kernel:>12.2f}{off:>13.3f}{psnr(off):>9.1f}")
    lines = lines if len(lines) > 1 else []
    others = {k: v for k, v in metrics.items() if not k.startswith(("versions.", "path.", "reference."))}
    return "\n".join(
        lines + [f"{key} = {value:.4g}" if isinstance(value, float) else f"{key} = {value}" for key, value in others.items()]
    )


def draw(metrics: dict[str, Metric], bench: Bench, path: Path) -> None:
    """Error against time of a frame; colours of Okabe and Ito, told apart by marker and line too."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullLocator

    base = bench.key
    style: dict[Any, Any] = {
        "font.size": 8,
        "axes.linewidth": 0.6,
        "axes.labelsize": 8,
        "legend.fontsize": 7,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
    }
    with plt.rc_context(style):
        figure, axes = plt.subplots(figsize=(3.5, 2.7), layout="constrained")
        lines = (("path", "Mitsuba path", "#D55E00", "s", "--"), ("reference", "raytac reference", "#009E73", "^", "-."))
        for kind, label, colour, marker, dash in lines:
            ms = [float(metrics[f"{kind}.{base}.spp{spp}.ms"]) for spp in bench.peer_spp]
            off = [float(metrics[f"{kind}.{base}.spp{spp}.rmse_levels"]) for spp in bench.peer_spp]
            axes.plot(ms, off, color=colour, marker=marker, linestyle=dash, linewidth=1.2, markersize=4, label=label)
            for x, y, spp in zip(ms, off, bench.peer_spp, strict=True):
                axes.annotate(f"{spp}", (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6, color=colour)
        fast = float(metrics[f"fast.{base}.peer.ms"]), float(metrics[f"fast.{base}.peer.rmse_levels"])
        axes.plot(*fast, color="#0072B2", marker="o", markersize=6, linestyle="none", label="raytac fast")
        axes.axhline(255 / 100, color="0.5", linewidth=0.8, linestyle=":")
        place = {"xycoords": ("axes fraction", "data"), "xytext": (3, 2), "textcoords": "offset points"}
        axes.annotate("40 dB", (0, 255 / 100), fontsize=6, color="0.4", **place)
        axes.set(xscale="log", yscale="log", xlabel=f"time of a frame, {bench.name} [ms]", ylabel="RMSE [levels of 255]")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
        axes.grid(True, linewidth=0.3, color="0.88")
        axes.set_axisbelow(True)
        axes.margins(x=0.12, y=0.12)
        axes.legend(frameon=False, title="numbers: samples a pixel", title_fontsize=6)
        figure.savefig(path, dpi=300)
        plt.close(figure)


def main(args: Args) -> None:
    parts = parse_names(args.parts, "parts", PARTS)
    scenes = parse_names(args.scenes, "scenes")
    if args.spp < 2 or args.frames < 1:
        raise InputError("spp, frames", value=(args.spp, args.frames), rule="must be at least 2 and 1")
    out = args.out if args.out is not None else Path("runs") / "bench_optics"
    if args.against is not None:
        with recorded(args, "bench_optics", device="cpu") as (_, metrics):
            metrics |= {**machine(), **in_turn(args.against, {"fast.cpu.320x240": f"frame:{args.sensor}"})}
        return
    from raytac.optics import load_mitsuba

    device = load_mitsuba(args.device)[1]
    size = (80, 60) if args.quick else (320, 240)
    spec, surfaces = press_peaks(args.sensor, scenes[:1] if args.quick else scenes, size, args.seed)
    frames, spp, peer_spp = (5, 16, SPP[:2]) if args.quick else (args.frames, args.spp, SPP)
    tracers = Tracers(spec, device, args.seed)
    bench = Bench(args, device, spec, size, surfaces, frames, spp, peer_spp, out, tracers)
    references = References(out / "references", tracers, size, spp)
    jobs: dict[str, Callable[[], dict[str, Metric]]] = {
        "speed": lambda: speed(bench),
        "error": lambda: error(bench, references),
        "peer": lambda: peer(bench, references),
        "stages": lambda: stages(bench),
        "memory": lambda: memory(bench),
        "first_image": lambda: first_image(bench),
    }
    with recorded(args, "bench_optics", device=device) as (folder, metrics):
        metrics |= {**machine(), "frames": bench.frames, "grid_pitch_mm": 1e3 * next(iter(surfaces.values())).grid.pitch[0]}
        for part in parts:
            began = time.perf_counter()
            metrics |= jobs[part]()
            metrics[f"wall_s.{part}"] = time.perf_counter() - began
            print(f"{part}: {metrics[f'wall_s.{part}']:.1f} s")
        if "peer" in parts:
            draw(metrics, bench, folder / "pareto.png")
        metrics["machine.load_at_end"] = os.getloadavg()[0]
    print(as_text(metrics, bench))


if __name__ == "__main__":
    run(main, Args)
