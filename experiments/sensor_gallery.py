"""How do the shipped sensors look? The same five objects pressed into each, at one scale.

    python experiments/sensor_gallery.py --out runs/sensor_gallery
    python experiments/sensor_gallery.py --sensors digit,my_sensor.toml --objects coin,pins

Rigid pads, the ray tracer, each sensor's own resolution, each object's own shipped depth. Writes ``sensors.png`` and ``metrics.json``:
``SENSOR.OBJECT.contact_mm2``, area of contact, and ``.change``, mean absolute change of the image in it against the image at rest, in
levels of 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import recorded, run
from raytac import TactileSensor
from raytac.errors import InputError
from raytac.io import CommonOptions, Progress
from raytac.specs import CameraSpec, load_press

SENSORS = {
    "gelsight_mini": "GelSight Mini",
    "gelsight_dome": "domed GelSight",
    "digit": "DIGIT",
    "gelsight_r15": "GelSight R1.5-like",
}
OBJECTS = {"sphere": "sphere", "coin": "coin", "pins": "pins", "cone": "cone", "mesh": "gear"}
REST = "at rest"
DPI = 86


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Press objects into sensors and draw the images."""

    sensors: str = ",".join(SENSORS)
    """Names of shipped sensors or paths of sensor files, joined by commas."""
    objects: str = ",".join(OBJECTS)
    """Names of shipped press scenes or paths of their files, joined by commas."""


@dataclass(frozen=True)
class Row:
    """Images (H, W, 3) of one sensor, at rest first, and its camera."""

    title: str
    images: list[np.ndarray]
    camera: CameraSpec


def main(args: Args) -> None:
    sensors, objects = (tuple(part.strip() for part in text.split(",") if part.strip()) for text in (args.sensors, args.objects))
    for name, given in (("sensors", sensors), ("objects", objects)):
        if not given:
            raise InputError(name, value="", rule="must name at least one")
    scenes = {OBJECTS.get(name, Path(name).stem): load_press(name) for name in objects}
    with recorded(args, "sensor_gallery", owned=("sensors.png", "metrics.json")) as (folder, metrics):
        rows = []
        with Progress(desc="presses", total=len(sensors) * len(scenes), unit="press") as bar:
            for name in sensors:
                sensor = TactileSensor(name, outputs=("rgb", "normals"), device=args.device, seed=args.seed)
                rest = sensor.rest().rgb[0]
                images = [rest]
                for title, scene in scenes.items():
                    frame = sensor.press(scene)
                    touched, contact = frame.contact[0], frame.surface.contact[0]
                    changed = np.abs(frame.rgb[0].astype(float) - rest)
                    metrics[f"{sensor.spec.name}.{title}.contact_mm2"] = 1e6 * float(
                        contact.sum() * np.prod(frame.surface.grid.pitch)
                    )
                    metrics[f"{sensor.spec.name}.{title}.change"] = float(changed[touched].mean()) if touched.any() else 0.0
                    images.append(frame.rgb[0])
                    bar.update()
                rows.append(Row(SENSORS.get(name, sensor.spec.name), images, sensor.spec.camera))
        draw(folder / "sensors.png", rows, [REST, *scenes])


def draw(path: Path, rows: list[Row], titles: list[str]) -> None:
    """Figure of all images at one scale, a row a sensor, with a scale bar of 5 mm."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    views = [tuple(1e3 * n * p for n, p in zip(r.camera.resolution, r.camera.pixel_pitch, strict=True)) for r in rows]
    widest, heights = max(width for width, _ in views), [height for _, height in views]
    inch = 1.55 / widest
    size = (1.62 * len(titles) + 0.5, inch * sum(heights) + 0.16 * len(rows) + 0.35)
    with plt.rc_context({"font.size": 10}):
        figure, axes = plt.subplots(
            len(rows), len(titles), figsize=size, height_ratios=heights, layout="constrained", squeeze=False
        )
        for line, row, (width, height) in zip(axes, rows, views, strict=True):
            for axis, image in zip(line, row.images, strict=True):
                axis.imshow(image, extent=(-width / 2, width / 2, height / 2, -height / 2), interpolation="antialiased")
                axis.set(xlim=(-widest / 2, widest / 2), ylim=(height / 2, -height / 2), xticks=[], yticks=[])
                for spine in axis.spines.values():
                    spine.set_visible(False)
            line[0].set_ylabel(f"{row.title}\n{width:.0f} × {height:.0f} mm", fontsize=9)
            left, bottom = -width / 2 + 0.8, height / 2 - 0.9
            line[0].plot([left, left + 5], [bottom, bottom], color="white", linewidth=2)
            line[0].text(left + 2.5, bottom - 0.4, "5 mm", color="white", ha="center", va="bottom", fontsize=8)
        for axis, title in zip(axes[0], titles, strict=True):
            axis.set_title(title, fontsize=10)
        figure.savefig(path, dpi=DPI)
        plt.close(figure)


if __name__ == "__main__":
    run(main, Args)
