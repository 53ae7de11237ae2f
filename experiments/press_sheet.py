"""What does the sensor see when a coin, a plate of pins and a mesh are pressed into it? One folder a press and one sheet of all.

This is what ``make demo`` runs: ``python experiments/press_sheet.py --out runs/demo``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.running import recorded, run
from raytac.frame import OUTPUTS
from raytac.io import CommonOptions, read_metrics, write_sheet
from raytac.report import run_press
from raytac.sensor import TactileSensor
from raytac.specs import load_press


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Press several scenes into one sensor and draw one sheet of their previews."""

    scenes: tuple[str, ...] = ("coin", "pins", "mesh")
    """Names of shipped press scenes, or paths of scene files."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    quick: bool = False
    """Small images of the first scene only: enough to see that all works."""


def main(args: Args) -> None:
    out = args.out if args.out is not None else Path("runs") / "press_sheet"
    sensor = TactileSensor(
        args.sensor, outputs=OUTPUTS, device=args.device, seed=args.seed, resolution=(80, 60) if args.quick else None
    )
    scenes = [load_press(name) for name in (args.scenes[:1] if args.quick else args.scenes)]
    for scene in scenes:
        run_press(sensor, scene, out / scene.name, outputs=OUTPUTS)
        print(f"{scene.name}: {out / scene.name}/preview.png, rgb.png, frame.exr, height.npy, metrics.json")
    with recorded(args, "press_sheet", device=sensor.device_used) as (folder, metrics):
        write_sheet([out / scene.name / "preview.png" for scene in scenes], folder / "sheet.png")
        for scene in scenes:
            pressed = read_metrics(out / scene.name / "metrics.json")
            metrics |= {f"{scene.name}.{key}": value for key, value in pressed.items() if key.startswith(("time.", "contact."))}


if __name__ == "__main__":
    run(main, Args)
