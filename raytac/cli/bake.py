"""``raytac bake``: a Taxim table from the ray tracer of a sensor."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from raytac.cli.shared import ShadowOptions, print_paths
from raytac.io.options import CommonOptions, parse_names, parse_resolution
from raytac.report.bake import run_bake
from raytac.specs import load_sensor


@dataclass(frozen=True, kw_only=True)
class BakeArgs(ShadowOptions, CommonOptions):
    """Bake a Taxim table from the ray tracer of a sensor.

    Presses of balls and pins are rendered and fitted by slope. Writes the table as a calibration folder that the package taxim reads
    too (polycalib.npz, dataPack.npz, gelmap.npy, shadowTable.npz, params.json, raytac.npz), coverage.png, sheet.png and
    metrics.json, and keeps it in the cache, from where optics taxim takes it if it is of the sensor's own resolution and not of
    --quick. Without --out the folder is runs/bake/SENSOR, with --quick runs/bake/SENSOR-quick. An error or Ctrl-C leaves folder and
    cache as they were.
    """

    sensor: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SENSOR")] = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the table's images [px], as in 320x240; the sensor's own if not given."""
    scenes: str = "sphere,coin,pins"
    """Press scenes, names or files joined by commas, to compare table and ray tracer on."""
    quick: bool = False
    """Few presses, coarse bins, in seconds: a poor table, which only --calibration FOLDER uses."""

    def run(self) -> int:
        from raytac.optics.taxim.bake.settings import BakeSettings

        start = time.perf_counter()
        resolution = None if self.resolution is None else parse_resolution(self.resolution)
        chosen = self.chosen_shadows()
        sensor = load_sensor(self.sensor)
        sensor = replace(sensor, optics=replace(sensor.optics, **chosen))
        paths = run_bake(
            sensor,
            self.folder("bake", sensor.name + ("-quick" if self.quick else "")),
            settings=BakeSettings.quick() if self.quick else BakeSettings(),
            scenes=parse_names(self.scenes, "scenes"),
            device=self.device,
            seed=self.seed,
            resolution=resolution,
            start=start,
        )
        return print_paths(paths)
