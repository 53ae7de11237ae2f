"""How fast are the table modes, and how far is the baked table from the ray tracer? Error beside time, in one run.

Every frame has a new surface, and everything from the height field to the 8-bit image counts:

    python experiments/bench_taxim.py --out runs/bench_taxim                       # CPU
    python experiments/bench_taxim.py --out runs/bench_taxim_cuda --device cuda

docs/measurements/image-modes.md has the figures. The table is baked unless the cache has it. The package taxim joins as a peer if it is
installed (``pip install taxim[jax-cpu]``); it is timed with its own sensor, and its time includes its own deformation of the gel.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.running import recorded, run
from raytac.device import resolve_device
from raytac.errors import BackendError
from raytac.gel import GelSurface
from raytac.io import CommonOptions, Metric, Progress, parse_names
from raytac.optics import Phong, RayTraced, Taxim
from raytac.report import error_metrics, machine, moving, press_peaks, table_errors, timed, timed_within
from raytac.specs import SensorSpec

SCENES = "sphere,coin,cone,cylinder,edge,mesh,pins,torus,none"
SIZES = {"320x240": (320, 240), "640x480": (640, 480)}
BATCHES = {"cpu": (1, 8), "cuda": (1, 64)}
PEER_BUDGET_S = 30.0
"""Longest time for one timing of the peer [s]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure time of the table and of Phong's model, and the error of the baked table."""

    scenes: str = SCENES
    """Shipped press scenes or scene files, joined by commas, for the errors; the first three are timed."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    frames: int = 60
    """Timed frames a figure (at least 40 for a median to quote)."""
    quick: bool = False
    """One small size, few presses and frames: shows that all runs; its figures mean nothing."""


def mode_of(spec: SensorSpec, family: str, size: tuple[int, int], device: str, table: Any) -> Any:
    """Optical mode ``taxim``, ``taxim_shadow`` or ``phong``."""
    if family == "phong":
        return Phong().build(spec, resolution=size, device=device)
    return Taxim(calibration=table, shadows=family == "taxim_shadow").build(spec, resolution=size, device=device)


def speed(
    spec: SensorSpec, surfaces: Sequence[GelSurface], name: str, size: tuple[int, int], device: str, table: Any, args: Args
) -> dict[str, Metric]:
    """Frames a second and milliseconds a frame of each mode, NumPy to NumPy and on the device, by batch."""
    frames = 5 if args.quick else args.frames
    metrics: dict[str, Metric] = {}
    jobs = [
        (family, batch) for family in ("taxim", "taxim_shadow", "phong") for batch in ((1, 2) if args.quick else BATCHES[device])
    ]
    modes: dict[str, Any] = {}
    for family, batch in Progress(jobs, desc=f"speed {name}", leave=False):
        mode = modes.setdefault(family, mode_of(spec, family, size, device, table))
        inputs = moving(surfaces, batch, 6 if batch < 64 else 3)
        host = timed(mode.render, inputs, frames)
        resident = timed(device_call(mode), [uploaded(mode, one) for one in inputs], frames)
        key = f"{family}.{device}.{name}"
        for part, ms in (("", host), ("device_", resident)):
            median = float(np.median(ms))
            metrics[f"{key}.batch{batch}.{part}fps"] = 1e3 * batch / median
            metrics[f"{key}.batch{batch}.{part}ms_per_frame"] = median / batch
            metrics[f"{key}.batch{batch}.{part}call_ms_p90"] = float(np.percentile(ms, 90))
        if batch == 1:
            metrics |= {f"{key}.fps": 1e3 / float(np.median(host)), f"{key}.ms_per_frame": float(np.median(host))}
        if batch >= 64:  # what a solver on the same device pays, and what a script with NumPy arrays pays
            metrics[f"{key}.ms_per_frame"] = float(np.median(resident)) / batch
            metrics[f"{key}.numpy_ms_per_frame"] = float(np.median(host)) / batch
    return metrics


def uploaded(mode: Any, surface: GelSurface) -> tuple[Any, Any]:
    """(heights, contact) on the device."""
    import drjit as dr

    heights = mode.mi.Float(np.ascontiguousarray(surface.height, dtype=np.float32).ravel())
    contact = mode.mi.UInt8(np.ascontiguousarray(surface.contact).view(np.uint8).ravel())
    dr.eval(heights, contact)
    dr.sync_thread()
    return heights, contact


def device_call(mode: Any) -> Callable[[Any], None]:
    """From heights on the device to an image on the device."""
    import drjit as dr

    def call(arrays: tuple[Any, Any]) -> None:
        frame = mode.render_device(*arrays)
        dr.eval(frame.rgb, frame.flags)
        dr.sync_thread()

    return call


def peer(surfaces: Sequence[GelSurface], name: str, size: tuple[int, int], device: str, args: Args) -> dict[str, Metric]:
    """Time of the package ``taxim`` on the same contacts; empty, with a word, where it does not run."""
    from raytac.report import PeerTaxim

    metrics: dict[str, Metric] = {}
    for family, shadow in (("peer", False), ("peer_shadow", True)):
        try:
            mode = PeerTaxim(size, shadow=shadow, device=device)
        except BackendError as error:
            print(f"peer left out: {error}")
            return {"peer.left_out": str(error)}
        ms = timed_within(mode.render, moving(surfaces, 1, 6), 3 if args.quick else args.frames, PEER_BUDGET_S)
        metrics |= {f"{family}.{device}.{name}.ms_per_frame": float(np.median(ms)), f"{family}.label": mode.label}
    return metrics


def error(
    spec: SensorSpec, surfaces: dict[str, GelSurface], table: Any, size: tuple[int, int], device: str, seed: int
) -> dict[str, Metric]:
    """Contact MAE and PSNR in the box of every scene, against ``fast``."""
    tracer = RayTraced().build(spec, resolution=size, outputs=("rgb",), device=device, seed=seed)
    return error_metrics(table_errors(spec, surfaces, table, tracer))


def main(args: Args) -> None:
    from raytac.optics import BakeSettings, baked_table

    device = resolve_device(args.device)
    scenes = parse_names(args.scenes, "scenes")[: 1 if args.quick else None]
    sizes = {"80x60": (80, 60)} if args.quick else SIZES
    first = next(iter(sizes.values()))
    spec, surfaces = press_peaks(args.sensor, scenes, first, args.seed)
    with recorded(args, "bench_taxim", device=device, owned=("metrics.json",)) as (_, metrics):
        metrics |= machine()
        began = time.perf_counter()
        settings, baked_at = (BakeSettings.quick(), first) if args.quick else (BakeSettings(), None)
        table = baked_table(spec, device=device, seed=args.seed, settings=settings, resolution=baked_at)
        metrics["table_s"] = time.perf_counter() - began
        metrics |= error(spec, surfaces, table, first, device, args.seed)
        for name, size in sizes.items():
            timed_on = scenes[:3]
            chosen = surfaces if size == first else press_peaks(args.sensor, timed_on, size, args.seed)[1]
            shown = [chosen[Path(scene).stem] for scene in timed_on]
            metrics |= speed(spec, shown, name, size, device, table, args)
        metrics |= peer(shown, name, size, device, args)
        if f"peer.{device}.{name}.ms_per_frame" in metrics:
            for family, other in (("taxim", "peer"), ("taxim_shadow", "peer_shadow")):
                mine = 1e3 / float(metrics[f"{family}.{device}.{name}.fps"])
                metrics[f"{family}.vs_peer_speedup"] = float(metrics[f"{other}.{device}.{name}.ms_per_frame"]) / mine
        metrics["machine.load_at_end"] = os.getloadavg()[0]
    for key, value in metrics.items():
        if not key.startswith(("versions.", "machine.")):
            print(f"{key} = {value:.4g}" if isinstance(value, float) else f"{key} = {value}")


if __name__ == "__main__":
    run(main, Args)
