"""``raytac press``: press an object into the gel, and write what the sensor sees."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.frame import OUTPUTS
from raytac.io.options import CommonOptions, parse_outputs, parse_resolution
from raytac.report.press import run_press
from raytac.sensor import TactileSensor
from raytac.specs import load_press

__all__ = ["PressArgs"]


@dataclass(frozen=True, kw_only=True)
class PressArgs(CommonOptions):
    """Press an object into the gel and write image, layers, height and a preview to a folder.

    Writes rgb.png, frame.exr (linear light, one layer a light, normals, positions, depth), height.npy, preview.png and
    metrics.json; nothing is left half-written if it is interrupted.
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped press scene, such as coin, or path of a scene file."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    physics: str = "rigid"
    """How the gel deforms: rigid."""
    optics: str = "raytrace"
    """How images are made: raytrace."""
    integrator: str = "fast"
    """fast (quadrature over the LEDs, no noise) or reference (path tracing)."""
    spp: int | None = None
    """Samples a pixel of the reference integrator."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the images in pixels, as in 320x240; the sensor's own if not given."""
    outputs: str = ",".join(OUTPUTS)
    """What to compute, joined by commas."""

    def run(self) -> int:
        start = time.perf_counter()
        outputs = parse_outputs(self.outputs, OUTPUTS)
        # Linear R, G, B of frame.exr is the sum of the layers, so an image asks for them too.
        computed = (*outputs, "layers") if "rgb" in outputs else outputs
        sensor = TactileSensor(
            self.sensor,
            physics=self.physics,
            optics=self.optics,
            outputs=computed,
            resolution=parse_resolution(self.resolution) if self.resolution is not None else None,
            integrator=self.integrator,
            spp=self.spp,
            device=self.device,
            seed=self.seed,
        )
        scene = load_press(self.scene)
        out = self.out if self.out is not None else Path("runs") / "press" / scene.name
        for path in run_press(sensor, scene, out, outputs=outputs, start=start):
            print(path)
        return 0
