"""Press objects many times and keep what the sensor sees: a sharded data set, on this machine or on a Ray cluster.

    python experiments/render_dataset.py demo --out runs/demo_presses
    python experiments/render_dataset.py my_sweep.toml --out presses --engine ray --workers 8
    python experiments/render_dataset.py --verify --out presses

Killed at any time, the same command goes on where it stopped. docs/guide/data-sets.md describes sweeps, files and the loader.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from experiments.running import run
from raytac import quiet_warp
from raytac.dataset import ENGINES, DatasetPlan, PressDataset, RunReport, contact_sheet, render_dataset, verify_dataset
from raytac.errors import InputError
from raytac.io import CommonOptions, parse_names, parse_resolution, versions, write_metrics, write_png
from raytac.optics import OPTICS
from raytac.physics import PHYSICS
from raytac.report import machine
from raytac.specs import SweepSpec, load_sweep


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Render a sweep of presses into a data set. What is given here goes before what the sweep's file says."""

    sweep: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP")] = "demo"
    """Name of a shipped sweep, or path of a sweep file."""
    seed: int | None = None  # type: ignore[assignment]
    """Seed of all presses; the sweep's if not given."""
    count: int | None = None
    """Number of presses."""
    shard_size: int | None = None
    """Presses in one shard."""
    physics: Annotated[str | None, tyro.conf.arg(metavar="{" + ",".join(PHYSICS.names) + "}")] = None
    """How the gel deforms."""
    optics: Annotated[str | None, tyro.conf.arg(metavar="{" + ",".join(OPTICS.names) + "}")] = None
    """How images are made."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the images in pixels."""
    outputs: str | None = None
    """Arrays that are kept, joined by commas."""
    engine: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(ENGINES) + "}")] = "local"
    """local: in this process. ray: on a Ray cluster, or on a Ray started for this run."""
    workers: int | None = None
    """ray: number of workers; one a GPU if not given, or one a node where there is none."""
    ray_address: str | None = None
    """ray: address of a cluster, or auto for one on this machine; a Ray of its own if not given."""
    batch: int = 16
    """Presses computed at once: more suit a GPU."""
    compress: bool = False
    """Deflate the arrays: smaller files, slower to read."""
    sheet: int = 0
    """Write sheet.png, a contact sheet of so many presses; 0 is none."""
    verify: bool = False
    """Render nothing: compare all files of the data set with their checksums."""


def main(args: Args) -> RunReport | None:
    """Render, or verify, and write ``metrics.json`` beside the data set's own files."""
    start = time.perf_counter()
    quiet_warp()
    out = args.out if args.out is not None else Path("runs") / "dataset"
    if args.verify:
        check = verify_dataset(out, progress=True)
        for shard, reason in check.wrong.items():
            print(f"shard {shard}: {reason}")
        if check.wrong:
            raise InputError(
                "out", value=out, rule=f"has {len(check.wrong)} of {check.shards} shards that are not whole: render again"
            )
        print(f"{check.shards} shards are whole")
        return None
    plan = DatasetPlan(_asked(args))
    if args.sheet < 0:
        raise InputError("sheet", value=args.sheet, rule="must be a whole number >= 0")
    if args.sheet and not {"rgb", "height"} & set(plan.sweep.outputs):
        raise InputError("sheet", value=args.sheet, rule="shows images and heights: outputs must have 'rgb' or 'height'")
    report = render_dataset(
        plan,
        out,
        engine=args.engine,
        device=args.device,
        batch=args.batch,
        workers=args.workers,
        address=args.ray_address,
        compress=args.compress,
        progress=True,
        say=print,
    )
    if args.sheet:
        write_png(out / "sheet.png", contact_sheet(PressDataset(out), args.sheet))
    metrics = {
        "experiment": "render_dataset",
        "sweep": plan.sweep.name,
        "engine": args.engine,
        "device": report.device,
        "batch": args.batch,
        "presses": plan.sweep.count,
        "failed": report.failed,
        "rendered.presses": report.presses,
        "rendered.shards": report.rendered,
        "render_s": report.render_s,
        **({"presses_per_s": report.presses / report.render_s} if report.presses else {}),
        **({} if report.steady_presses_per_s is None else {"steady.presses_per_s": report.steady_presses_per_s}),
        **machine(),
        **versions(),
    }
    write_metrics(out / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
    print(f"{plan.sweep.count} presses, {report.failed} failed (manifest.parquet says why): {out}")
    return report


def _asked(args: Args) -> SweepSpec:
    """The sweep with what the command line changes."""
    asked = {
        "seed": args.seed,
        "count": args.count,
        "shard_size": args.shard_size,
        "physics": args.physics,
        "optics": args.optics,
        "resolution": None if args.resolution is None else parse_resolution(args.resolution),
        "outputs": None if args.outputs is None else parse_names(args.outputs, "outputs"),
    }
    return replace(load_sweep(args.sweep), **{name: value for name, value in asked.items() if value is not None})


if __name__ == "__main__":
    run(main, Args)
