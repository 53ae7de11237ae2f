"""``raytac dataset``: press objects many times, and keep what the sensor sees."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from raytac.checks import check_number
from raytac.cli.shared import SolverOptions, kept_if_interrupted, named, print_paths
from raytac.dataset import (
    ENGINES,
    EXPORTS,
    DatasetPlan,
    PressDataset,
    check_export,
    contact_sheet,
    export_presses,
    render_dataset,
    verify_dataset,
)
from raytac.errors import InputError
from raytac.io.images import write_png
from raytac.io.metrics import versions, write_metrics
from raytac.io.options import parse_names, parse_resolution
from raytac.optics import OPTICS
from raytac.physics import PHYSICS, Ipc
from raytac.report.measure import machine
from raytac.specs import SweepSpec, available, load_sweep


@dataclass(frozen=True, kw_only=True)
class DatasetArgs(SolverOptions):
    """Press objects many times and keep what the sensor sees: a sharded data set.

    On this machine or on a Ray cluster. What is given here goes before what the sweep's file says. Without --out the folder is
    runs/dataset. Killed at any time, the same command goes on where it stopped; with a greater --count it adds to a data set. Needs
    raytac[dataset], with --engine ray raytac[ray].
    """

    sweep: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SWEEP")] = None
    """Name of a shipped sweep, such as demo, or path of a sweep file; --verify needs none."""
    seed: int | None = None  # type: ignore[assignment]
    """Seed of all presses; the sweep's if not given."""
    count: int | None = None
    """Number of presses."""
    shard_size: int | None = None
    """Presses in one shard."""
    physics: Annotated[str | None, named(PHYSICS.names)] = None
    """Model of the gel."""
    optics: Annotated[str | None, named(OPTICS.names)] = None
    """Optical mode."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the images in pixels."""
    outputs: str | None = None
    """Arrays that are kept, joined by commas."""
    engine: Annotated[str, named(ENGINES)] = "local"
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
    export: Annotated[str | None, named(EXPORTS)] = None
    """Also write the whole data set as LeRobot (videos alone), HDF5 or Zarr, beside its shards.

    Needs raytac[export]."""
    fps: float | None = None
    """With --export lerobot: frames a second at which a press is shown; 30 if not given."""
    verify: bool = False
    """Render nothing: compare all files of the data set with their checksums."""

    def run(self) -> int:
        start = time.perf_counter()
        out = self.folder("dataset")
        if self.verify:
            return self._verify(out)
        plan = DatasetPlan(self._asked())
        self.prepare_warp(soft=isinstance(plan.physics, Ipc))
        if self.sheet < 0:
            raise InputError("sheet", value=self.sheet, rule="must be a whole number >= 0")
        if self.sheet and not {"rgb", "height"} & set(plan.sweep.outputs):
            raise InputError("sheet", value=self.sheet, rule="shows images and heights: outputs must have 'rgb' or 'height'")
        fps = self._checked_fps()
        if self.export is not None:
            check_export(self.export, out, plan.sweep)
        with kept_if_interrupted(f"shards that are finished are kept in {out}"):
            report = render_dataset(
                plan,
                out,
                engine=self.engine,
                device=self.device,
                batch=self.batch,
                workers=self.workers,
                address=self.ray_address,
                compress=self.compress,
                progress=True,
                say=logging.getLogger("raytac").info,
            )
            if self.sheet:
                write_png(out / "sheet.png", contact_sheet(PressDataset(out), self.sheet))
            exported = [] if self.export is None else export_presses(out, self.export, fps=fps, progress=True)
        metrics = {
            "command": "dataset",
            "sweep": plan.sweep.name,
            "engine": self.engine,
            "device": report.device,
            "batch": self.batch,
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
        why = " (manifest.parquet says why)" if report.failed else ""
        print(f"{plan.sweep.count} presses, {report.failed} failed{why}: {out}")
        return print_paths(exported)

    def _checked_fps(self) -> float:
        """Frames a second of the export. Raises InputError where nothing has such a rate."""
        if self.fps is None:
            return 30.0
        if self.export != "lerobot":
            raise InputError("fps", value=self.fps, rule="belongs to --export lerobot")
        return check_number("fps", self.fps, "(0, inf)", "Hz")

    def _verify(self, out: Path) -> int:
        """Compare the files with their checksums; ``InputError`` for a shard that is not whole."""
        check = verify_dataset(out, progress=True)
        for shard, reason in check.wrong.items():
            print(f"shard {shard}: {reason}")
        if check.wrong:
            rule = f"has {len(check.wrong)} of {check.shards} shards that are not whole: render again"
            raise InputError("out", value=out, rule=rule)
        print(f"{check.shards} shards are whole")
        return 0

    def _asked(self) -> SweepSpec:
        """The sweep with what the command line changes."""
        asked = {
            "seed": self.seed,
            "count": self.count,
            "shard_size": self.shard_size,
            "physics": self.physics,
            "optics": self.optics,
            "resolution": None if self.resolution is None else parse_resolution(self.resolution),
            "outputs": None if self.outputs is None else parse_names(self.outputs, "outputs"),
        }
        if self.sweep is None:
            raise InputError("sweep", rule="must be given: a name, or the path of a file", choices=available("sweep"))
        return replace(load_sweep(self.sweep), **{name: value for name, value in asked.items() if value is not None})
