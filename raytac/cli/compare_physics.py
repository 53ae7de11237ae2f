"""``raytac compare-physics``: the same presses on the rigid pad and on soft ones."""

from __future__ import annotations

import time
from dataclasses import dataclass

from raytac.cli.shared import SolverOptions, print_paths
from raytac.io.options import parse_names, parse_resolution
from raytac.optics.registry import OPTICS
from raytac.report.pads import image_modes, press_pads, write_pads
from raytac.specs import PADS

_NOT_CHOSEN = ("raytrace", "mlp")
"""Optical modes that are the reference, or need a file of the user's."""


@dataclass(frozen=True, kw_only=True)
class ComparePhysicsArgs(SolverOptions):
    """Press the same objects into the rigid pad and into levels of the soft one.

    Writes report.html (one file: force, imprint, bulge, contact, differences of height and image to the finest level, times), sheet.png
    (images, indentations, height differences), error_cost.png (image error against time of pads and image modes) and metrics.json.
    Without --out the folder is runs/compare_physics.
    """

    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    scenes: str = "sphere,coin,pins"
    """Shipped press scenes or scene files, joined by commas."""
    levels: str = "coarse,medium"
    """Levels of the soft pad, joined by commas: coarse, medium, fine.

    The finest is what all others are compared with."""
    modes: str = "taxim,phong"
    """Optical modes to compare too, joined by commas, on the finest pad's surface; "" for none.

    A table is baked at first use: a minute or two."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the images in pixels; the sensor's if not given."""
    quick: bool = False
    """80x60, the first scene, the coarse level, Phong's model: shows that all runs."""

    def run(self) -> int:
        start = time.perf_counter()
        scenes, levels = parse_names(self.scenes, "scenes"), parse_names(self.levels, "levels", PADS)
        resolution = None if self.resolution is None else parse_resolution(self.resolution)
        choices = tuple(name for name in OPTICS.names if name not in _NOT_CHOSEN)
        modes = parse_names(self.modes, "modes", choices) if self.modes else ()
        if self.quick:
            scenes, levels, modes, resolution = scenes[:1], PADS[:1], ("phong",), (80, 60)
        self.prepare_warp(soft=True)
        presses, sensor = press_pads(
            scenes, levels, sensor=self.sensor, resolution=resolution, device=self.device, seed=self.seed
        )
        images = image_modes(presses, sensor, modes)
        return print_paths(write_pads(presses, sensor, self.folder("compare_physics"), time.perf_counter() - start, images))
