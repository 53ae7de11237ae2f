"""Which LEDs make the ray tracer's images of ball presses like a real sensor's? Fits a light file to photographs, held-out presses apart.

The forward model is raytac's own: the ball pressed into the rigid pad, the ``fast`` ray tracer with shadows and inter-reflection, the
sensor's response. Light is additive, so one rendering with every LED in a layer of its own gives the derivatives by a parameter of
all LEDs at once, and derivatives by powers are exact. Fitted with the LEDs: gamma, the stray light that no gel changes (``black_level``)
and the vignette; in turn with them, the contact circle of every press. Some presses are left out of the fit and scored.

    python experiments/fit_lights.py --data DIR --out runs/fit_lights                   # the sensor's own LEDs, from where they are
    python experiments/fit_lights.py --data DIR --sides 3,2,3 --out runs/fit_lights     # red, green, blue LEDs at the walls, from scratch
    python experiments/fit_lights.py --data DIR --split left     # fitted to the left half of the pad, tested on the right
    python experiments/fit_lights.py --data DIR --iterations 0 --depth-factor 1.1       # scores the sensor as it is

raytac/calibrate/presses.py says what DIR holds. Written: ``lights.toml``, ``sensor.toml`` (the numbers of the sensor file that
belong to it), ``presses.png`` and ``metrics.json``. A fit that is interrupted leaves what it reached in ``lights.toml``.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from raytac.calibrate.light_fit import LightFit, solve
from raytac.calibrate.light_parameters import CHANNELS, LightParameters, darkest, leds_at_walls
from raytac.calibrate.photographs import Photographs, decode, encode, press_balls, read_photographs
from raytac.errors import InputError, RaytacError
from raytac.gel.pad import make_grid
from raytac.gel.surface import GelSurface
from raytac.io.folder import result_folder
from raytac.io.metrics import versions, write_metrics
from raytac.io.options import CommonOptions
from raytac.optics.raytrace import RayTracer
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.lights_text import lights_text

ROUNDS = 4
"""Times that LEDs and circles are fitted in turn at each resolution."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Fit the lights of a sensor to photographs of ball presses."""

    data: Path
    """Folder of photographs and labels."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file; its lights are where the fit starts."""
    depth_factor: float = 1.2
    """Depth of a press over that of a ball whose overlap with the resting gel is the labelled circle (docs/rigid-pad.md)."""
    split: Literal["press", "left", "right", "shallow", "none"] = "press"
    """What is fitted: all but every third press, those on one half of the pad, the shallower half, or all (none held out)."""
    sides: str | None = None
    """Numbers of red, green and blue LEDs, joined by commas: such LEDs at their walls replace the sensor's as the start."""
    gamma: float | None = None
    """Where the fit of gamma starts; None is the sensor's own."""
    refine: bool = True
    """Fit the contact circles too; those of held-out presses with the finished lights."""
    surround_scale: float = 1.0
    """Widths of the elastic surround over Taxim's."""
    iterations: int = 30
    """Steps of the solver at each of the two resolutions, in rounds with the circles between them."""
    background_weight: float = 0.7
    """Weight of a pixel of the image at rest against one of a press."""
    quick: bool = False
    """Six presses, small images, ten steps at most: shows that all runs."""


# ------------------------------------------------------------------------------------------------------------ results


def score(
    sensor: SensorSpec, surface: GelSurface, shots: Photographs, labels: np.ndarray, device: str
) -> tuple[dict[str, float], np.ndarray]:
    """Errors in 8-bit levels and the images with the real background as flat field, (N, H, W, 3).

    Mean absolute errors are means over presses, in the labelled disc and in the ring up to twice its radius, with the flat field and
    (``plain``) without; ``labels`` (N, 3) are the circles of disc and ring; ``rest_rms`` compares the image at rest with the background.
    """
    height, width = shots.background.shape[:2]
    tracer, gamma = RayTracer(sensor, resolution=(width, height), outputs=("layers",), device=device), sensor.response.gamma
    black = np.array(sensor.response.black_level)
    linear = np.sum(list(tracer.render_layers(surface).values()), axis=0) * tracer.response.scale
    real, rho = shots.presses, dataclasses.replace(shots, circles=labels).distance(sensor)
    flat = encode((decode(shots.background, gamma) - black) * linear[1:] / linear[:1] + black, gamma).clip(0, 255)
    plain = encode(linear + black, gamma).clip(0, 255)
    rms = np.sqrt(np.mean((plain[0] - shots.background) ** 2, axis=(0, 1)))
    errors = {f"rest_rms.{name}": float(e) for name, e in zip(CHANNELS, rms, strict=True)}
    for kind, images in (("flat_field", flat), ("plain", plain[1:])):
        for part, inside in {"contact": rho < 1, "ring": (rho >= 1) & (rho < 2)}.items():
            each = [np.abs(image - truth)[where].mean() for image, truth, where in zip(images, real, inside, strict=True)]
            errors[f"{kind}.{part}_mae"] = float(np.mean(each))
    return errors, flat


def draw(real: np.ndarray, simulated: np.ndarray, path: Path) -> None:
    """Photographs, simulated images and their difference, a press a column; images (N, H, W, 3) in levels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = (("real", real), ("simulated", simulated), ("4 × difference", 128 + 4 * (simulated - real)))
    with plt.rc_context({"font.size": 8}):
        height, width = real.shape[1:3]
        figure, axes = plt.subplots(
            3, len(real), figsize=(7.0, 3 * 7.0 / len(real) * height / width + 0.1), squeeze=False, layout="constrained"
        )
        for line, (label, images) in zip(axes, rows, strict=True):
            line[0].set_ylabel(label)
            for axis, image in zip(line, images, strict=True):
                axis.imshow(np.clip(image, 0, 255).astype(np.uint8))
                axis.set(xticks=[], yticks=[])
        figure.savefig(path, dpi=200)
        plt.close(figure)


def split_presses(shots: Photographs, split: str) -> tuple[Photographs, Photographs]:
    """The photographs to fit to and those to test on; both are all of them if none are held out."""
    index, (x, _, r) = np.arange(len(shots.circles)), shots.circles.T
    middle = shots.background.shape[1] / 2
    fitted = {
        "press": index % 3 != 2,
        "left": x < middle,
        "right": x >= middle,
        "shallow": np.argsort(np.argsort(r, kind="stable")) < len(r) / 2,
        "none": index >= 0,
    }[split]
    if not fitted.any() or (fitted.all() and split != "none"):
        raise InputError("split", value=split, rule=f"leaves no press to fit to or to test on, of {len(r)}")
    return shots.take(index[fitted]), shots.take(index[~fitted] if split != "none" else index)


def main(args: Args) -> None:
    began = time.perf_counter()
    start = load_sensor(args.sensor)
    if args.gamma is not None:
        if not 1 <= args.gamma <= 2.4:
            raise InputError("gamma", value=args.gamma, rule="must be in [1, 2.4]")
        start = dataclasses.replace(start, response=dataclasses.replace(start.response, gamma=args.gamma))
    if args.sides is not None:
        start = with_lights(start, leds_at_walls(start, args.sides))
    shots = read_photographs(args.data, start)
    if args.quick:
        shots = shots.take(np.arange(min(6, len(shots.presses))))
    train, test = split_presses(shots, args.split)
    grid = make_grid(start.gelpad, 0.3e-3 if args.quick else 0.12e-3)

    def pressed(part: Photographs, circles: np.ndarray) -> GelSurface:
        return press_balls(start, grid, dataclasses.replace(part, circles=circles), args.depth_factor, args.surround_scale)

    p, iterations = LightParameters.of(start, shots.background), min(args.iterations, 10) if args.quick else args.iterations
    if args.sides is not None:
        p = brightened(p, start, lambda c: pressed(train, c), train, args.device)
    circles, rounds = train.circles, ROUNDS if args.refine and iterations else 1
    for factor in (8,) if args.quick else (8, 4):
        for _ in range(rounds):  # a new ray tracer each: the light from the case follows the LEDs
            part = dataclasses.replace(train, circles=circles).shrunk(factor)
            problem = LightFit(start, part, lambda c: pressed(train, c), p, args.background_weight, args.device)
            p = solve(problem, p, -(-iterations // rounds), f"at 1/{factor}")
            if args.refine and iterations:
                problem.refine_circles(p, train.circles)
                circles = problem.circles

    gamma, *stray, a1, a2 = map(float, p.response)
    black = np.array(stray) * darkest(shots.background, gamma)
    response = dataclasses.replace(start.response, gamma=gamma, black_level=tuple(map(float, black)), vignetting=(a1, a2, 0.0))
    fitted = with_lights(dataclasses.replace(start, response=response), p.lights())
    device = RayTracer(start, resolution=(8, 6), outputs=("depth",), device=args.device).device
    metrics: dict[str, int | float | str] = {"experiment": "fit_lights", "device": device, "seed": args.seed, **versions()}
    metrics |= {"split": args.split, "presses.fitted": len(train.presses), "presses.scored": len(test.presses)}
    metrics |= {"depth_factor": args.depth_factor, "surround_scale": args.surround_scale, "leds": len(p.leds)}
    unseen = pressed(test, test.circles)
    touching = unseen.contact[1:].sum((1, 2)) * grid.pitch[0] * grid.pitch[1]
    labelled = test.circles[:, 2] * start.camera.pixel_pitch[0]
    metrics["contact_radius_over_label"] = float(np.mean(np.sqrt(touching / np.pi) / labelled))
    small = test.shrunk(4 if args.quick else 1)
    candidates = [("start", start, unseen), ("fitted", fitted, unseen)]
    if args.refine and iterations:  # the light knows nothing of these presses; three numbers a press are found by it
        problem = LightFit(start, test.shrunk(8), lambda c: pressed(test, c), p, args.background_weight, args.device)
        for _ in range(ROUNDS):
            problem.refine_circles(p, test.circles)
        candidates.append(("refined", fitted, problem.surface))
        metrics["circles.moved_px"] = float(np.abs(problem.circles - test.circles).mean())
    for name, spec, surface in candidates:
        errors, images = score(spec, surface, small, test.circles, args.device)
        metrics |= {f"{name}.{key}": value for key, value in errors.items()}
    with result_folder(args.out or Path("runs") / "fit_lights") as folder:
        contact, ring = (metrics[f"fitted.flat_field.{part}_mae"] for part in ("contact", "ring"))
        error = f"{contact:.2f} (contact) and {ring:.2f} (ring) of 255"
        comment = f"Fitted by experiments/fit_lights.py to {len(train.presses)} presses.\nMean absolute error, split {args.split}: {error}."
        (folder / "lights.toml").write_text(lights_text(fitted.lights, comment), "utf-8")
        levels = ", ".join(f"{level:.5f}" for level in response.black_level)
        numbers = f"exposure = {response.exposure}\ngamma = {gamma:.4f}\nblack_level = [{levels}]\nvignetting = [{a1:.4f}, {a2:.4f}, 0.0]\n"
        heading = "# Numbers of the sensor file that belong to lights.toml.\n[response]\n"
        (folder / "sensor.toml").write_text(heading + numbers, "utf-8")
        shown = np.unique(np.linspace(0, len(images) - 1, 5).astype(int))
        draw(small.presses[shown], images[shown], folder / "presses.png")
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - began})
    for key, value in metrics.items():
        if key.startswith(("start.", "fitted.", "refined.")):
            print(f"{key} = {value:.3f}")


def brightened(
    p: LightParameters, sensor: SensorSpec, press: Callable[[np.ndarray], GelSurface], shots: Photographs, device: str
) -> LightParameters:
    """The same LEDs with powers that give the image at rest its mean, colour by colour."""
    problem = LightFit(sensor, shots.shrunk(8), press, p, 1.0, device)
    rest = (problem.light(p)[2].T @ p.powers()[0]).mean(0)
    gamma = float(p.response[0])
    gain = decode(shots.background, gamma).reshape(-1, 3).mean(0) / np.maximum(rest, 1e-12)
    own = np.array([gain[CHANNELS.index(led.layer)] for led in p.template.leds])
    return dataclasses.replace(p, power=p.power * np.column_stack([own, np.ones_like(own), np.ones_like(own)]))


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except RaytacError as error:
        sys.exit(f"error: {error}")
