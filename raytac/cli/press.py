"""``raytac press``: press an object into the gel, and write what the sensor sees."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.cli.shared import ShadowOptions, SolverOptions, chosen_physics, named, print_paths
from raytac.errors import InputError
from raytac.frame import OUTPUTS
from raytac.io.metrics import Metric, read_metrics
from raytac.io.options import parse_outputs, parse_resolution
from raytac.markers import MARKERS
from raytac.optics import INTEGRATORS, OPTICS, OpticalMode, OpticsConfig
from raytac.physics import PHYSICS, Ipc
from raytac.report.press import run_press
from raytac.sensor import TactileSensor, sensor_outputs
from raytac.specs import PADS, press_of


@dataclass(frozen=True, kw_only=True)
class PressArgs(ShadowOptions, SolverOptions):
    """Press an object into the gel and write image, layers, height and a preview to a folder.

    Writes rgb.png, frame.exr (linear light, one layer a light, normals, positions, depth), height.npy, traction.npy, markers.npz,
    preview.png and metrics.json. An error or Ctrl-C leaves the folder as it was; a press that is done replaces an earlier one there as
    a whole.
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped press, path of a scene file, or a mesh: STL, OBJ, PLY, OFF, GLB."""
    depth: float | None = None
    """Depth that the object is pressed in to [mm]; a mesh needs it or --force.

    A scene is then pressed once, to this depth, in place of its own trajectory."""
    force: float | None = None
    """Normal force that the object is pressed with [N], in place of --depth."""
    x: float = 0.0
    """Displacement of the object to the right in the image [mm]."""
    y: float = 0.0
    """Displacement of the object downwards in the image [mm]."""
    yaw: float = 0.0
    """Turn of the object about the pad's normal [degrees], clockwise in the image."""
    tilt: float = 0.0
    """Lean at the start, before that turn [degrees]; the upper side in the image goes deeper."""
    scale: float | None = None
    """Metres per unit of a mesh file; if not given 0.001 (millimetres), of GLB 1."""
    repair: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Close the holes of a mesh, and say which; without it, an open mesh is an error."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    physics: Annotated[str | None, named(PHYSICS.names)] = None
    """Model of the gel: rigid (geometry and Gaussians) or ipc (finite elements with contact).

    If not given, as the scene says, else rigid. Soft objects need raytac[ipc]."""
    level: Annotated[str | None, named(PADS)] = None
    """Resolution of a soft pad's mesh, makes physics ipc; as the scene says, else coarse."""
    optics: Annotated[str, named(OPTICS.names)] = "raytrace"
    """Optical mode: raytrace, taxim (a table, baked at first use), phong, mlp or unet.

    A --calibration replaces the baked table; networks need weights. The options below that a mode has are fields of its configuration."""
    calibration: Path | None = None
    """taxim: calibration folder, as raytac bake writes; the sensor's baked table if not given."""
    weights: Path | None = None
    """mlp: folder of raytac calibrate DATASET --model mlp; unet: of experiments/train_unet.py."""
    markers: Annotated[str | None, named(MARKERS.names)] = None
    """Model that moves the sensor's markers; surface needs physics ipc. None if not given.

    The sensor must have markers, as gelsight_mini_7x9 has. Writes markers.npz, and images show the dots."""
    integrator: Annotated[str | None, named(INTEGRATORS)] = None
    """raytrace: fast (no noise, the default), reference (our path tracer) or path (Mitsuba's)."""
    spp: int | None = None
    """raytrace: rays a pixel (fast: a square number) or samples; 1 and 256 if not given."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the images [px], as in 320x240, up to 8192; the sensor's if not given."""
    pitch: float | None = None
    """Spacing of the gel's height map [mm]; a pixel's, at most 0.1, if not given.

    Sharp edges look smoother with a finer one, as 0.02."""
    noise: bool = False
    """Add the camera's grain to rgb.png, by the [noise] table of the sensor's file."""
    background: Path | None = None
    """Photograph of the untouched sensor, of the image's size, on which rgb.png is shown.

    Or a folder of PNG files, from which --seed draws one. frame.exr stays the simulated light."""
    outputs: Annotated[str | None, named(OUTPUTS)] = None
    """Outputs to compute, joined by commas; all if not given. Only raytrace has layers."""

    def run(self) -> int:
        start = time.perf_counter()
        optics = self._optics()
        every = sensor_outputs(optics)
        outputs = every if self.outputs is None else parse_outputs(self.outputs, OUTPUTS)
        # Linear R, G, B of frame.exr is the sum of the layers, so an image asks for them too.
        computed = (*outputs, "layers") if "rgb" in outputs and "layers" in every else outputs
        scene = press_of(
            self.scene,
            depth=None if self.depth is None else self.depth / 1e3,
            force=self.force,
            offset=(self.x / 1e3, self.y / 1e3),
            yaw=math.radians(self.yaw),
            tilt=math.radians(self.tilt),
            scale=self.scale,
            repair=self.repair,
        )
        physics = chosen_physics(self.physics, self.level, scene)
        self.prepare_warp(soft=isinstance(physics, Ipc))
        sensor = TactileSensor(
            self.sensor,
            physics=physics,
            optics=optics,
            outputs=computed,
            resolution=parse_resolution(self.resolution) if self.resolution is not None else None,
            pitch=None if self.pitch is None else self.pitch / 1e3,
            device=self.device,
            seed=self.seed,
            markers=self.markers,
            noise=self.noise,
        )
        if self.background is not None and self.noise:
            raise InputError(
                "background", value=self.background, rule="cannot be together with noise: a photograph has grain of its own"
            )
        # Presses that differ in physics or optics do not replace each other.
        others = [name for name in (PHYSICS.name_of(physics), self.optics) if name not in ("rigid", "raytrace")]
        out = self.folder("press", "-".join([scene.name, *others]))
        written = run_press(sensor, scene, out, outputs=outputs, start=start, progress=True, background=self.background)
        self._log_result(read_metrics(out / "metrics.json"))
        return print_paths(written)

    def _log_result(self, metrics: Mapping[str, Metric]) -> None:
        """Log the greatest indentation, and the force if it is among the outputs."""
        text = f"indentation up to {metrics['contact.max_indentation_mm']:.3f} mm"
        if "contact.force_z_n" in metrics:
            x, y, z = (round(float(metrics[f"contact.force_{axis}_n"]), 2) + 0.0 for axis in "xyz")  # no -0.00
            text += f"; force on the pad {x:.2f}, {y:.2f}, {z:.2f} N along x, y, z (z points out of the gel)"
        logging.getLogger("raytac").info(text)

    def _optics(self) -> OpticsConfig[OpticalMode]:
        """Configuration of the optical mode, with every option that was given as its field."""
        given = {name: getattr(self, name) for name in ("calibration", "weights", "integrator", "spp")}
        options = {name: value for name, value in given.items() if value is not None} | self.chosen_shadows()
        if "progress" in vars(OPTICS.config_class(self.optics)).get("__dataclass_fields__", ()):
            options["progress"] = True
        return OPTICS.config(self.optics, **options)
