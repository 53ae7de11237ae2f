"""How like a real DIGIT is the DIGIT? Its light fitted to photographs of ball presses without labels, and scored on others.

    python experiments/fit_digit.py fots_digit --out runs/fit_digit

The folder holds upright photographs of one sensor (240 x 320 px ``*.png``), each with one ball pressed in; nothing else is known. The image
at rest begins as the median of the fitted photographs, and is then the mean of what lies far from each contact. Contact circles are
searched for in the difference from it. The ball's radius matters little: the slopes of its imprint are fitted too, and scale with it.
Every fifth photograph is held out. LEDs begin as virtual strips on three sides, 120 degrees apart, and not where the shipped file has
them, which was written by this script. Keys of ``metrics.json``, mean absolute errors in levels of 255 on held-out photographs:

- ``background.contact_mae``, ``.ring_mae``, ``.frame_mae``: the image at rest in place of a render.
- ``flat_field.…``: the ray tracer with the image at rest as flat field; ``file.…``: the sensor file as it is written, no photograph in it.
- ``rest.mae``: image at rest of that file against the one of the photographs; ``noise``: standard deviation of the camera's grain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.calibrate import (
    ALONE,
    FitSettings,
    Models,
    Photographs,
    RealPresses,
    fit_models,
    images_of,
    measured_grain,
    photographs_of,
    with_first_response,
    with_found_circles,
)
from raytac.checks import check_number, check_whole
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.gel import GelSurface, make_grid
from raytac.io import CommonOptions, Progress, read_png
from raytac.optics import RayTraced
from raytac.report import press_scores, summary
from raytac.specs import (
    LedSpec,
    LightsSpec,
    NoiseSpec,
    OpticsSpec,
    SensorSpec,
    lights_text,
    load_sensor,
    sensor_files,
    with_lights,
)

FILES = "lights.toml", "sensor.toml", "photographs.png", "metrics.json"
HOLDOUT = 5
SIDES = {"red": (7.7, -4.6), "green": (-7.7, -4.6), "blue": (0.0, 10.9)}
"""x, y [mm] of the middle of each colour's row where a fit begins: beside the view, on the side that photographs show it."""
SPREAD, HEIGHT, LONGEST = 8.0, -2.5, 2.6
"""Length of a row, its z, and the longest of its strips on the sides [mm]."""
WIDEST = 46.0
"""Largest radius of a contact that is searched for [px]: beyond it circles enclose shadows."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Fit the lights of a DIGIT to photographs."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of photographs."""
    sensor: str = "digit"
    """Name of a shipped sensor, or path of a sensor file: geometry, gel and coat."""
    ball_diameter_mm: float = 6.0
    """Diameter of the ball; not known."""
    leds: int = 2
    """Strips a colour."""
    rounds: int = 3
    """Rounds with the ray tracer after direct light."""
    shadows: bool = True
    """Let the ray tracer cast shadows."""
    shown: int = 5
    """Held-out photographs in the figure."""


def read(folder: Path, sensor: SensorSpec, ball_radius: float) -> tuple[RealPresses, np.ndarray]:
    """All photographs with their circles, and a mask of the held-out ones; raises ``InputError``: none, or of other sizes."""
    files = sorted(folder.glob("*.png"))
    if len(files) < 2 * HOLDOUT:
        raise InputError(
            "data", value=str(folder), rule=f"must hold at least {2 * HOLDOUT} photographs, *.png: it has {len(files)}"
        )
    images = [read_png(file) for file in files]
    shape = (*sensor.camera.resolution[::-1], 3)
    for file, image in zip(files, images, strict=True):
        if image.shape != shape:
            raise InputError(
                "data", value=f"{file.name} {image.shape}", rule=f"must have the shape of the sensor's images, {shape}"
            )
    stack = np.stack(images)
    held_out = np.arange(len(files)) % HOLDOUT == HOLDOUT - 1
    rest = np.rint(np.median(stack[~held_out], axis=0)).astype(np.uint8)
    pitch = sensor.camera.pixel_pitch[0]
    unknown = np.full((len(files), 3), np.nan)
    presses = RealPresses(rest, stack, np.full(len(files), WIDEST * pitch), unknown, tuple(file.stem for file in files))
    presses, _ = with_found_circles(presses, pitch)
    return replace(presses, ball_radius=np.full(len(files), ball_radius)), held_out


def first_lights(count: int) -> LightsSpec:
    """Virtual strips of three colours, ``count`` each, where a fit begins."""
    leds = []
    for channel, (name, (x, y)) in enumerate(SIDES.items()):
        axis = np.array([-x, 0.57 * abs(x) if x else -y, 0.0])
        axis /= np.linalg.norm(axis)
        length = SPREAD / count * 0.75
        for k in range(count):
            along = (k - 0.5 * (count - 1)) * SPREAD / count
            place = (x, y + along) if x else (x + along, y)
            power = 2e-4 / count * np.eye(3)[channel]
            leds.append(
                LedSpec(
                    name=f"{name}_{k + 1}",
                    layer=name,
                    position=(place[0] / 1e3, place[1] / 1e3, HEIGHT / 1e3),
                    axis=(float(axis[0]), float(axis[1]), 0.0),
                    size=((min(length, LONGEST) if x else length) / 1e3, 1e-3),
                    lobe=2.5,
                    power=(float(power[0]), float(power[1]), float(power[2])),
                    virtual=True,
                )
            )
    return LightsSpec(tuple(leds))


def main(args: Args) -> None:
    check_whole("leds", args.leds)
    check_whole("rounds", args.rounds, 0)
    check_whole("shown", args.shown)
    radius = check_number("ball_diameter_mm", args.ball_diameter_mm, "(0, 100]") / 2e3
    device = resolve_device(args.device)
    plain = load_sensor(args.sensor)
    presses, held_out = read(args.data, plain, radius)
    sensor = with_first_response(
        with_lights(replace(plain, response=replace(plain.response, exposure=20.0)), first_lights(args.leds))
    )
    whole = presses.fully_visible
    shots = photographs_of(presses.take(whole), sensor)
    fitted, unseen = shots.take(np.flatnonzero(~held_out[whole])), shots.take(np.flatnonzero(held_out[whole]))
    tracing = RayTraced(shadows=args.shadows)
    with recorded(args, "fit_digit", device=device, owned=FILES) as (folder, metrics):
        metrics |= {"photographs": len(whole), "fitted": len(fitted.presses), "held_out": len(unseen.presses), "leds": args.leds}
        metrics |= {"rounds": args.rounds, "shadows": int(args.shadows), "ball_diameter_mm": args.ball_diameter_mm}
        with Progress(desc="fit", unit="step") as bar:
            models = fit_models(
                sensor,
                fitted,
                settings=FitSettings(fixed=("gamma",)),
                modes=("raytrace", ALONE),
                device=device,
                seed=args.seed,
                starts=1,
                rounds=args.rounds,
                prior="tied" if args.leds > 1 else "free",
                tracing=tracing,
                tick=bar.fit_step,
            )
        images = scored(models, unseen, metrics)
        file = models.modes[ALONE].sensor  # type: ignore[attr-defined]
        at_rest = GelSurface.at_rest(make_grid(file.gelpad, file.camera.pixel_pitch[0]))
        rest = tracing.build(file, device=device).render(at_rest).rgb
        assert rest is not None
        metrics["rest.mae"] = float(np.abs(rest[0].astype(float) - models.rest).mean())
        noise = measured_grain(file, models.settled)
        if noise is not None:
            middle = models.rest.mean() / 255
            ends = zip(noise.dark_variance, noise.bright_variance, strict=True)
            metrics["noise"] = float(np.mean([np.sqrt(dark + (bright - dark) * middle) for dark, bright in ends]))
        error = f"{metrics['file.contact_mae']:.2f} in the contact and {metrics['file.ring_mae']:.2f} in the ring from one to two radii"
        comment = (
            f"Fitted by experiments/fit_digit.py to {len(fitted.presses)} photographs, virtual strips, cast shadows included."
        )
        comment += f"\nError on {len(unseen.presses)} held-out photographs: mean absolute error {error}, of 255."
        (folder / "lights.toml").write_text(lights_text(file.lights, comment), "utf-8")
        written = replace(file, optics=OpticsSpec(shadows=args.shadows), noise=noise or NoiseSpec())
        for name, text in sensor_files(written).items():
            (folder / name).write_text(text, "utf-8")
        draw(folder / "photographs.png", unseen.presses[: args.shown], images[: args.shown], models.rest)
        for name in sorted(key for key in metrics if key.endswith("mae")):
            print(f"{name:28s}{metrics[name]:8.2f}")


def scored(models: Models, unseen: Photographs, metrics: dict) -> np.ndarray:
    """Errors on ``unseen``, added to ``metrics``; images (N, H, W, 3) of the sensor file, with each photograph's drift."""
    sensor = models.fitted.sensor
    circles, drift = models.circles(unseen), models.drift(unseen)
    still = drift.applied(np.repeat(models.rest[None], len(unseen.presses), 0))
    drawn = {"background": still}
    for name, mode in (("flat_field", "raytrace"), ("file", ALONE)):
        drawn[name] = drift.applied(images_of(models.modes[mode], sensor, unseen, circles, models.fitted.state.slopes))
    for name, images in drawn.items():
        metrics |= {f"{name}.{key}": value for key, value in summary(press_scores(sensor, images, unseen)).items()}
    return drawn["file"]


def draw(path: Path, photographs: np.ndarray, renders: np.ndarray, rest: np.ndarray) -> None:
    """Figure of photographs over renders over their difference, doubled, and the image at rest's error beside."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = {"photograph": photographs, "ray-traced": renders, "difference × 2": 128.0 + 2.0 * (renders - photographs)}
    rows["without contact × 2"] = 128.0 + 2.0 * (rest - photographs)
    count = len(photographs)
    with plt.rc_context({"font.size": 10}):
        figure, axes = plt.subplots(
            len(rows), count, figsize=(1.5 * count + 0.4, 2.0 * len(rows)), layout="constrained", squeeze=False
        )
        for line, (title, images) in zip(axes, rows.items(), strict=True):
            line[0].set_ylabel(title)
            for axis, image in zip(line, images, strict=True):
                axis.imshow(np.clip(image, 0, 255).astype(np.uint8))
                axis.set(xticks=[], yticks=[])
        figure.savefig(path, dpi=66)
        plt.close(figure)


if __name__ == "__main__":
    run(main, Args)
