"""``raytac compare``: time of each optical mode, and its error against the reference."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Annotated

from raytac.cli.shared import SolverOptions, named, print_paths
from raytac.io.options import parse_names, parse_resolution
from raytac.report.compare.page import write_comparison
from raytac.report.compare.run import run_comparison
from raytac.report.compare.settings import CompareSettings
from raytac.specs import PADS


@dataclass(frozen=True, kw_only=True)
class CompareArgs(SolverOptions):
    """Render the same gel surfaces with every optical mode, and report error beside time.

    Writes report.html (one file), pareto.png, a sheet of images a scene, results.parquet and metrics.json. Interrupted, it keeps what
    is finished in the folder's rows/ and references/: the same command continues from there.
    """

    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    scenes: str = "sphere,coin,pins"
    """Shipped press scenes or scene files, joined by commas."""
    resolutions: str = "320x240"
    """WIDTHxHEIGHT in pixels, joined by commas, as in 320x240,640x480."""
    spp: int = 1024
    """Samples a pixel of the reference; two independent halves give its noise."""
    frames: int = 60
    """Timed frames a figure; fewer, at least three, for modes slower than 10 s together."""
    batch: int | None = None
    """Environments of the batched timing; 8 on the CPU and 64 on CUDA if not given."""
    level: Annotated[str | None, named(PADS)] = None
    """Also press into the soft pad of this level, and report what the rigid pad misses."""
    markers: bool = False
    """Also compare marker models with surface tracking on the soft pad (--level, else medium).

    Under normal load, shear and twist; needs a sensor with marker motion."""
    quick: bool = False
    """80x60, one scene, few samples and modes: shows that all runs; its figures mean nothing."""

    def run(self) -> int:
        start = time.perf_counter()
        out = self.folder("compare")
        settings = self.settings()
        settings.check()
        self.prepare_warp()
        try:
            comparison = run_comparison(settings, out)
            written = write_comparison(comparison, out, time.perf_counter() - start)
        except KeyboardInterrupt:
            print(f"raytac: interrupted; finished rows are kept in {out}, the same command continues from there", file=sys.stderr)
            return 130
        return print_paths(written)

    def settings(self) -> CompareSettings:
        """Settings of the options. Raises InputError for names or numbers that cannot be read."""
        sizes = tuple(dict.fromkeys(parse_resolution(text) for text in parse_names(self.resolutions, "resolutions")))
        chosen = CompareSettings(
            sensor=self.sensor,
            scenes=parse_names(self.scenes, "scenes"),
            resolutions=sizes,
            device=self.device,
            seed=self.seed,
            reference_spp=self.spp,
            frames=self.frames,
            batch=self.batch,
            pad=self.level,
            markers=self.markers,
        )
        return chosen.quickened() if self.quick else chosen
