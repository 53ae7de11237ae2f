"""How wide is a ball's contact at a depth? Overlap with the gel at rest, rigid pad, levels of the soft pad, Taxim's rule of contact.

    python experiments/contact_depth.py --out runs/contact_depth
    python experiments/contact_depth.py --levels coarse,medium --depths-mm 0.4,0.8

Depth is the same in all of them: how far the ball is moved from first touch. ``contact_depth.DEPTH.WHAT`` is the radius of the disc as
large as the contact [mm]. The table also has the depth at which a contact has the radius of the overlap, in units of the overlap's depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.running import recorded, run
from raytac.calibrate import contact_radius
from raytac.device import resolve_device
from raytac.gel import ElasticSurround, GelSurface
from raytac.io import CommonOptions, parse_names
from raytac.physics import PressPad, RigidPad, SoftPad
from raytac.specs import PADS, ObjectSpec, PressScene, StageSpec, load_sensor

PITCH = 0.06e-3
"""Spacing of the nodes [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure the contact of a ball at depths."""

    sensor: str = "gelsight_mini"
    radius_mm: float = 3.155
    depths_mm: str = "0.2,0.4,0.6,0.8,1.0,1.2"
    levels: str = "coarse"
    """Levels of the soft pad, joined by commas; empty for none."""


def main(args: Args) -> None:
    levels = parse_names(args.levels, "levels", PADS) if args.levels else ()
    depths, radius, sensor = [float(d) for d in args.depths_mm.split(",")], args.radius_mm / 1e3, load_sensor(args.sensor)
    device = resolve_device(args.device, ray_tracing=False)
    ball = ObjectSpec("sphere", {"radius": radius}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    scene = PressScene("ball", ball, (StageSpec("indent", depth=max(depths) / 1e3),))
    pads: dict[str, PressPad] = {"rigid": RigidPad(sensor, scene, pitch=PITCH)}
    pads |= {level: SoftPad(sensor, scene, level=level, pitch=PITCH, device=device) for level in levels}
    with recorded(args, "contact_depth") as (_, metrics):
        table: dict[str, list[float]] = {name: [] for name in ("overlap", *pads, "taxim")}
        threshold = ElasticSurround(pads["rigid"].grid, thickness=sensor.gelpad.thickness, contact_rule="threshold")
        for depth in depths:
            for name, pad in pads.items():
                (reading,) = pad.follow(StageSpec("indent", depth=depth / 1e3))
                table[name].append(1e3 * contact_radius(reading.surface))
                if name == "rigid":
                    under = pad.object_height(reading.surface)
                    assert under is not None
                    table["taxim"].append(1e3 * contact_radius(threshold.surface(under)))
                    table["overlap"].append(1e3 * contact_radius(overlapping(reading.surface, under)))
        print("| depth [mm] | " + " | ".join(table) + " |\n|" + "---|" * (1 + len(table)))
        for k, depth in enumerate(depths):
            print(f"| {depth:g} | " + " | ".join(f"{radii[k]:.2f}" for radii in table.values()) + " |")
            metrics |= {f"contact_depth.{depth:g}.{name}": radii[k] for name, radii in table.items()}


def overlapping(surface: GelSurface, under: np.ndarray) -> GelSurface:
    """The same surface, in contact where the object lies below the gel at rest."""
    return GelSurface(surface.grid, surface.height, under < surface.grid.rest, surface.contact_centre)


if __name__ == "__main__":
    run(main, Args)
