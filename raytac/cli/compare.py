"""``raytac compare``: time of each optical mode, and its error against the reference."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from raytac.cli.shared import SolverOptions, kept_if_interrupted, named, print_paths
from raytac.io.options import parse_names, parse_resolution
from raytac.report.compare.page import write_comparison
from raytac.report.compare.run import Comparison, run_comparison
from raytac.report.compare.settings import CompareSettings
from raytac.specs import PADS


@dataclass(frozen=True, kw_only=True)
class CompareArgs(SolverOptions):
    """Render the same gel surfaces with several optical modes, and report error beside time.

    Minutes on two cores. Tells at the start how long it will take. After each scene it writes report.html (one file), pareto.png, a
    sheet of images a scene, results.parquet and metrics.json. Interrupted, it keeps what is finished in the folder's rows/ and
    references/: the same command continues from there.
    """

    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    scenes: str = "sphere,coin,pins"
    """Shipped press scenes or scene files, joined by commas."""
    resolutions: str = "320x240"
    """WIDTHxHEIGHT in pixels, joined by commas, as in 320x240,640x480."""
    modes: str | None = None
    """Modes or families, joined by commas, or all.

    If not given: fast, the tables, phong and both path tracers."""
    full: bool = False
    """Every mode, more samples and longer timings: half an hour in place of minutes."""
    spp: int | None = None
    """Samples a pixel of the reference; 512, with --full 1024. Two halves give its noise."""
    frames: int | None = None
    """Timed frames a figure, 30 or with --full 60; fewer, at least three, for slow modes."""
    batch: int | None = None
    """Environments of the batched timing; 8 on the CPU and 64 on CUDA if not given."""
    level: Annotated[str | None, named(PADS)] = None
    """With --markers: level of the soft pad, medium if not given.

    raytac compare-physics compares pads."""
    markers: bool = False
    """Also compare marker models with surface tracking on the soft pad.

    Under normal load, shear and twist; needs a sensor with marker motion."""
    quick: bool = False
    """80x60, one scene, few samples and modes: shows that all runs; its figures mean nothing."""

    def run(self) -> int:
        start = time.perf_counter()
        out = self.folder("compare")
        settings = self.settings()
        settings.check()
        self.prepare_warp(soft=settings.markers)
        with kept_if_interrupted(f"rows that are finished are kept in {out}"):
            so_far = partial(self._write, out=out, start=start)
            written = so_far(run_comparison(settings, out, report=so_far))
        return print_paths(written)

    def _write(self, comparison: Comparison, out: Path, start: float) -> list[Path]:
        """Write the report of what is measured so far; returns the files."""
        written = write_comparison(comparison, out, time.perf_counter() - start)
        if comparison.pending:
            logging.getLogger("raytac").info("%s is there; still to come: %s", out / "report.html", "; ".join(comparison.pending))
        return written

    def settings(self) -> CompareSettings:
        """Settings of the options. Raises InputError for names or numbers that cannot be read."""
        sizes = tuple(dict.fromkeys(parse_resolution(text) for text in parse_names(self.resolutions, "resolutions")))
        chosen: dict[str, Any] = {
            "sensor": self.sensor,
            "scenes": parse_names(self.scenes, "scenes"),
            "resolutions": sizes,
            "device": self.device,
            "seed": self.seed,
            "batch": self.batch,
            "pad": self.level,
            "markers": self.markers,
        }
        given = {"reference_spp": self.spp, "frames": self.frames}
        chosen |= {name: value for name, value in given.items() if value is not None}
        if self.modes is not None:
            names = parse_names(self.modes, "modes")
            chosen["modes"] = None if names == ("all",) else names
        elif self.quick:
            chosen["modes"] = None
        settings = CompareSettings.full(**chosen) if self.full else CompareSettings(**chosen)
        return settings.quickened() if self.quick else settings
