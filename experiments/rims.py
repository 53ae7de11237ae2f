"""How clean are the rims of what is pressed into the pad? Waves of two pixels in the height, beside a contact that is solved finer.

    python experiments/rims.py --out runs/rims                      # coarse pad, pins, coin and gear: some minutes on two cores
    python experiments/rims.py --scenes pins --level medium

The nodes are 0.0625 mm apart, about a pixel of 320 x 240. The fourth difference of the height, over 16, is the amplitude of a wave
of two nodes. Sharp flanks and rims of an object have such differences of their own; those of the height *less that of a contact solved on
nodes three times as fine* are of the pad's own contact: ragged rims, and rings around them.

``metrics.json``, 95th percentiles over the pad and both axes: ``<scene>.<pad>.wave_um`` of the height of ``rigid``, of the level, and of
``wide``: the level with contact on nodes 0.1 mm apart and a spline between them; ``<scene>.<pad>.ragged_um`` of the height less that of the
finer contact, and ``…off_um``, root mean square of that difference itself; ``press_s``, with compilation in the first.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.gel import GelSurface
from raytac.io import CommonOptions, parse_names
from raytac.physics import Correction, PressPad, RigidPad, SoftPad
from raytac.specs import PADS, PressScene, SensorSpec, load_press, load_sensor

SCENES = ("pins", "coin", "mesh")
PITCH = 0.0625e-3
"""Divides the pad of the GelSight Mini evenly [m]."""
FINER = 3
WIDE = 0.1e-3
"""Nodes of the contact of ``wide`` [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure waves of two nodes around rims."""

    scenes: str = ",".join(SCENES)
    """Names of shipped press scenes or paths of scene files, joined by commas."""
    level: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "coarse"
    """Level of the soft pad."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""

    def run(self) -> None:
        names = parse_names(self.scenes, "scenes")
        if self.level not in PADS:
            raise InputError("level", value=self.level, rule="must be a known level", choices=PADS)
        spec = load_sensor(self.sensor)
        with recorded(self, "rims", device="cpu", owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
            for name in names:
                began = time.perf_counter()
                shown = surfaces(spec, load_press(name), self.level)
                metrics[f"{name}.press_s"] = time.perf_counter() - began
                truth = sampled_nodes(shown.pop("finer"), shown["rigid"])
                for pad, surface in shown.items():
                    height = 1e6 * surface.height[0].astype(float)
                    metrics[f"{name}.{pad}.wave_um"] = waves(height)
                    if pad != "rigid":
                        metrics[f"{name}.{pad}.ragged_um"] = waves(height - truth)
                        metrics[f"{name}.{pad}.off_um"] = float(np.sqrt(np.square(height - truth).mean()))
                print(f"{name}: done", flush=True)
        for key, value in metrics.items():
            if isinstance(value, float):
                print(f"{key} = {value:.4g}")


def surfaces(spec: SensorSpec, scene: PressScene, level: str) -> dict[str, GelSurface]:
    """The gel at the end of a scene's first stage under ``rigid``, ``wide``, the level, and ``finer``."""
    scene = replace(scene, trajectory=scene.trajectory[:1])
    pads: dict[str, PressPad] = {"rigid": RigidPad(spec, scene, pitch=PITCH)}
    for name, pitch, contact in (("wide", PITCH, WIDE), (level, PITCH, PITCH), ("finer", PITCH / FINER, PITCH / FINER)):
        pads[name] = SoftPad(spec, scene, pitch=pitch, level=level, correction=Correction(pitch=contact))
    return {name: pad.peak(pad.run()).surface for name, pad in pads.items()}


def sampled_nodes(finer: GelSurface, surface: GelSurface) -> np.ndarray:
    """Height [µm] of the ``finer`` surface at the nodes of the other, (Ny, Nx)."""
    for fine, wide in ((finer.grid.x, surface.grid.x), (finer.grid.y, surface.grid.y)):
        if len(fine[::FINER]) != len(wide) or not np.allclose(fine[::FINER], wide, rtol=0.0, atol=1e-9):
            rule = f"must have a pad whose sides are multiples of {1e3 * PITCH:g} mm"
            raise InputError("sensor", value=float(np.ptp(wide)), rule=rule)
    return 1e6 * finer.height[0, ::FINER, ::FINER].astype(float)


def waves(height: np.ndarray) -> float:
    """95th percentile of a field's (Ny, Nx) fourth differences along both axes, over 16."""
    return float(np.percentile(np.concatenate([np.abs(np.diff(height, 4, axis=axis)).ravel() for axis in (0, 1)]), 95)) / 16.0


if __name__ == "__main__":
    run(Args.run, Args)
