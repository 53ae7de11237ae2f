"""Which LEDs make the ray tracer's images of ball presses like a real sensor's? Fits a light file to photographs, held-out presses apart.

The forward model is raytac's own: the ball pressed into the rigid pad, the ``fast`` ray tracer with shadows and inter-reflection, the
sensor's response. Light is additive, so one rendering with every LED in a layer of its own gives the derivatives by a parameter of
all LEDs at once, and derivatives by powers are exact. Every third press is left out of the fit and scored.

    python experiments/fit_lights.py --data DIR --out runs/fit_lights                   # about 5 minutes on two cores
    python experiments/fit_lights.py --data DIR --iterations 0 --depth-factor 1.1       # scores the sensor as it is

raytac/calibrate/presses.py says what DIR holds. Written: ``lights.toml``, ``sensor.toml`` (the numbers of the sensor file that
belong to it), ``presses.png`` and ``metrics.json``. A fit that is interrupted leaves what it reached in ``lights.toml``.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from raytac.calibrate.photographs import Photographs, encode, press_balls, read_photographs
from raytac.errors import InputError, RaytacError
from raytac.gel.pad import make_grid
from raytac.gel.surface import GelSurface
from raytac.io.folder import result_folder
from raytac.io.metrics import versions, write_metrics
from raytac.io.options import CommonOptions
from raytac.optics.lamp import Lamp
from raytac.optics.raytrace import RayTracer
from raytac.specs import LedSpec, LightsSpec, SensorSpec, load_sensor, with_lights
from raytac.specs.lights_text import lights_text
from raytac.specs.sensor_check import led_corners

CHANNELS = ("red", "green", "blue")
SIDES = {"red": (0.0, -1.0), "green": (1.0, 0.0), "blue": (0.0, 1.0)}
"""Outward direction (x, y) of the wall that the LEDs of a layer stay at."""
STEPS = np.array([0.15, 0.15, 0.15, 0.03, 0.03, 0.1])
"""Steps of the derivatives: position [mm], azimuth and elevation of the axis [rad], lobe exponent. Wide enough to cross the cells of a
shadow walk."""
VIEW_MARGIN = 0.3
"""How far [mm] the plane through an LED across its axis, its 90-degree cut-off, stays from every point of the visible pad."""
CEILING = -5.1
"""Highest z [mm] of an LED: below gel and a support plate of 1 mm, so that ``refraction.model = "slab"`` stays possible."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Fit the lights of a sensor to photographs of ball presses."""

    data: Path
    """Folder of photographs and labels."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file; its lights are where the fit starts."""
    depth_factor: float = 1.2
    """Depth of a press over that of a ball whose overlap with the resting gel is the labelled circle (docs/rigid-pad.md)."""
    surround_scale: float = 1.0
    """Widths of the elastic surround over Taxim's."""
    iterations: int = 30
    """Steps of the solver at each of the two resolutions."""
    background_weight: float = 0.7
    """Weight of a pixel of the image at rest against one of a press."""
    quick: bool = False
    """Six presses, small images, ten steps at most: shows that all runs."""


# ------------------------------------------------------------------------------------------------------------ parameters


@dataclass(frozen=True)
class Parameters:
    """``leds`` (L, 6): x, y, z [mm], azimuth, elevation [rad], lobe; ``power`` (L, 3): own channel [W/sr], the other two relative to it;
    ``vignette``: a₁ of 1 + a₁r². ``template``: the light file that names, layers and sizes come from."""

    template: LightsSpec
    leds: np.ndarray
    power: np.ndarray
    vignette: float

    @classmethod
    def of(cls, sensor: SensorSpec) -> Parameters:
        """Those of a sensor.

        Raises:
            InputError: a layer that is no camera channel.
        """
        leds, power = [], []
        for led in sensor.lights.leds:
            if led.layer not in CHANNELS:
                raise InputError(
                    "led.layer", value=led.layer, rule="must be a camera channel, the LED's colour", choices=CHANNELS
                )
            x, y, z = led.axis
            leds.append([*(1e3 * c for c in led.position), np.arctan2(y, x), np.arcsin(z), led.lobe])
            own, *others = (led.power[c] for c in channels(led))
            power.append([own, *(other / max(own, 1e-12) for other in others)])
        return cls(sensor.lights, np.array(leds), np.array(power), sensor.response.vignetting[0])

    def flat(self) -> np.ndarray:
        return np.concatenate([self.leds.ravel(), self.power.ravel(), [self.vignette]])

    def at(self, x: np.ndarray) -> Parameters:
        """The parameters of a vector as ``flat`` gives it."""
        cut = self.leds.size
        return Parameters(self.template, x[:cut].reshape(-1, 6), x[cut:-1].reshape(-1, 3), float(x[-1]))

    def moved(self, leds: np.ndarray) -> Parameters:
        return dataclasses.replace(self, leds=leds)

    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """Power by LED and channel (L, 3) [W/sr], and its slope by each of the LED's three parameters (L, 3, 3)."""
        power, slope = np.zeros((len(self.leds), 3)), np.zeros((len(self.leds), 3, 3))
        for k, (led, (main, a, b)) in enumerate(zip(self.template.leds, self.power, strict=True)):
            own, first, second = channels(led)
            power[k, [own, first, second]] = main, main * a, main * b
            slope[k, 0, [own, first, second]] = 1, a, b
            slope[k, 1, first] = slope[k, 2, second] = main
        return power, slope

    def lights(self, powers: np.ndarray | None = None) -> LightsSpec:
        """The light file, with these powers or other ones (L, 3)."""
        leds = []
        for led, row, w in zip(self.template.leds, self.leds, self.powers()[0] if powers is None else powers, strict=True):
            flat, azimuth = np.cos(row[4]), row[3]
            axis = (float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(np.sin(row[4])))
            place, power = (row[0] / 1e3, row[1] / 1e3, row[2] / 1e3), (float(w[0]), float(w[1]), float(w[2]))
            leds.append(dataclasses.replace(led, position=tuple(map(float, place)), axis=axis, lobe=float(row[5]), power=power))
        return LightsSpec(tuple(leds))

    def bounds(self, sensor: SensorSpec) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest parameters: an LED stays at its wall and looks at most 75 degrees aside of straight across."""
        low, high = [], []
        half = 5e2 * np.array(sensor.case.size)
        for led, row in zip(self.template.leds, self.leds, strict=True):
            out = np.array(SIDES[led.layer])
            across = np.arctan2(-out[1], -out[0])
            across += 2 * np.pi * np.round((row[3] - across) / (2 * np.pi))
            low.append([*np.where(out > 0, 0.6 * half, 0.1 - half), -24.0, across - 1.31, -1.2, 1.0])
            high.append([*np.where(out < 0, -0.6 * half, half - 0.1), CEILING, across + 1.31, 1.0, 15.0])
        shares = np.tile([0.0, 0.0, 0.0], len(low)), np.tile([1.0, 0.5, 0.5], len(low))
        return np.r_[np.ravel(low), shares[0], -0.4], np.r_[np.ravel(high), shares[1], 0.0]


def channels(led: LedSpec) -> tuple[int, int, int]:
    """The LED's own channel, then the other two."""
    own = CHANNELS.index(led.layer)
    return own, *(c for c in range(3) if c != own)  # type: ignore[return-value]


# ------------------------------------------------------------------------------------------------------------ the fit


class Problem:
    """Residuals in 8-bit levels: the presses with the real background as flat field (disc and ring up to twice the labelled radius), the
    image at rest, and a penalty [500 levels/mm] where an LED leaves its place or its cut-off comes near the view."""

    def __init__(
        self, sensor: SensorSpec, shots: Photographs, surface: GelSurface, p: Parameters, weight: float, device: str
    ) -> None:
        """``weight`` of a pixel at rest; the light that comes over the case is that of ``p`` and stays."""
        self.sensor, self.shots, self.surface, self.weight = sensor, shots, surface, weight
        height, width = shots.background.shape[:2]
        self.press, self.row, self.column = np.nonzero(shots.distance(sensor) < 2)
        native, (cx, cy) = sensor.camera.resolution, sensor.camera.principal_point
        v, u = (np.mgrid[:height, :width] + 0.5) * native[0] / width
        self.r2 = (((u - cx) ** 2 + (v - cy) ** 2) / (native[0] ** 2 + native[1] ** 2) * 4).reshape(-1, 1)
        lit = dataclasses.replace(sensor, lights=p.lights(np.ones((len(p.leds), 3))))
        self.tracer = RayTracer(lit, resolution=(width, height), outputs=("layers",), layers="led", device=device)

    def light(self, p: Parameters) -> list[np.ndarray]:
        """Exposed light of every LED at power 1: in the pixels of presses, in the same pixels at rest, at rest (L, …)."""
        leds = p.lights(np.ones((len(p.leds), 3))).leds
        self.tracer.lamps = [Lamp.from_spec(self.tracer.mi, led) for led in leds]
        layers = self.tracer.render_layers(self.surface)
        light = self.sensor.response.exposure * np.stack([layer[..., 0] for layer in layers.values()]).astype(float)
        rest = light[:, 0]
        return [light[:, 1 + self.press, self.row, self.column], rest[:, self.row, self.column], rest.reshape(len(light), -1)]

    def penalty(self, p: Parameters) -> np.ndarray:
        camera, half = self.sensor.camera, 5e2 * np.array(self.sensor.case.size)
        x, y = (5e2 * n * pitch for n, pitch in zip(camera.resolution, camera.pixel_pitch, strict=True))
        corners = np.array([(sx * x, sy * y, z) for sx in (-1, 1) for sy in (-1, 1) for z in (-0.3, -1.2)])
        over = []
        for led in p.lights().leds:
            edge = 1e3 * np.array(led_corners(led))
            over += [VIEW_MARGIN - (corners - 1e3 * np.array(led.position)) @ np.array(led.axis), edge[:, 2] - CEILING]
            over += [np.ravel(np.abs(edge[:, :2]) - half + 0.1), 1e3 * self.sensor.case.floor_z + 0.1 - edge[:, 2]]
        return 500 * np.maximum(np.concatenate(over), 0)

    def residuals(self, p: Parameters, light: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([*(part.ravel() for part in self._images(p, light)[0]), self.penalty(p)])

    def _images(self, p: Parameters, light: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Residuals of presses (N, 3) and rest (M, 3); slopes of the first by light pressed and at rest, of the second by that at rest."""
        power, gamma = p.powers()[0], self.sensor.response.gamma
        pressed, flat, rest = (np.maximum(part.T @ power, 1e-7) for part in light)
        image = encode(self.shots.background[self.row, self.column] * pressed / flat, gamma)
        still = encode(rest * (1 + p.vignette * self.r2), gamma)
        apart = [image - encode(self.shots.presses[self.press, self.row, self.column], gamma)]
        apart.append(self.weight * (still - encode(self.shots.background.reshape(-1, 3), gamma)))
        return apart, [image / gamma / pressed, -image / gamma / flat, self.weight * still / gamma / rest]

    def jacobian(self, p: Parameters, light: list[np.ndarray]) -> np.ndarray:
        (power, slope), count, (apart, gains) = p.powers(), len(p.leds), self._images(p, light)
        images, limits = sum(part.size for part in apart), self.penalty(p)
        jac = np.zeros((images + len(limits), 9 * count + 1), np.float32)

        def column(k: int, parts: list[np.ndarray], weights: np.ndarray) -> None:
            pressed, flat, rest = (gain * (part[:, None] * weights) for gain, part in zip(gains, parts, strict=True))
            jac[:images, k] = np.concatenate([(pressed + flat).ravel(), rest.ravel()])

        for k, step in enumerate(STEPS):
            all_moved = p.leds.copy()
            all_moved[:, k] += step
            change = [(new - old) / step for new, old in zip(self.light(p.moved(all_moved)), light, strict=True)]
            for led in range(count):
                column(6 * led + k, [part[led] for part in change], power[led])
                alone = p.leds.copy()
                alone[led, k] += 1e-4
                jac[images:, 6 * led + k] = (self.penalty(p.moved(alone)) - limits) / 1e-4
        for led in range(count):
            for k in range(3):
                column(6 * count + 3 * led + k, [part[led] for part in light], slope[led, k])
        by_vignette = gains[2] * (light[2].T @ power) / (1 + p.vignette * self.r2) * self.r2
        jac[images - by_vignette.size : images, -1] = by_vignette.ravel()
        return jac


def solve(problem: Problem, p: Parameters, iterations: int, label: str) -> Parameters:
    """Levenberg and Marquardt's method with bounds: steps are cut off at the bounds, a parameter that is pushed out of them rests.

    An interrupt ends the fit with what it reached.
    """
    low, high = p.bounds(problem.sensor)
    p, damping = p.at(np.clip(p.flat(), low, high)), 1e-2
    light = problem.light(p)
    residuals = problem.residuals(p, light)
    try:
        for _ in (bar := tqdm(range(iterations), desc=label, leave=False, disable=None)):
            x, jac, before = p.flat(), problem.jacobian(p, light), float(residuals @ residuals)
            normal, slope = (jac.T @ jac).astype(float), (jac.T @ residuals.astype(np.float32)).astype(float)
            free = ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))
            cost = before
            while damping < 1e6 and cost >= before:
                damped, step = normal + np.diag(damping * np.maximum(np.diag(normal), 1e-9)), np.zeros_like(x)
                step[free] = np.linalg.solve(damped[np.ix_(free, free)], -slope[free])
                trial = p.at(np.clip(x + step, low, high))
                seen = problem.light(trial)
                off = problem.residuals(trial, seen)
                cost = float(off @ off)
                damping *= 4
            if cost >= before:
                break
            p, light, residuals, damping = trial, seen, off, max(damping / 12, 1e-6)
            bar.set_postfix(rmse=f"{np.sqrt(cost / len(residuals)):.3f}")
            if before - cost < 1e-4 * before:
                break
    except KeyboardInterrupt:
        print("interrupted: going on with what was reached", file=sys.stderr)
    return p


# ------------------------------------------------------------------------------------------------------------ results


def score(sensor: SensorSpec, surface: GelSurface, shots: Photographs, device: str) -> tuple[dict[str, float], np.ndarray]:
    """Errors in 8-bit levels and the images with the real background as flat field, (N, H, W, 3).

    Mean absolute errors are means over presses, in the labelled disc and in the ring up to twice its radius, with the flat field and
    (``plain``) without; ``rest_rms`` compares the image at rest with the background.
    """
    height, width = shots.background.shape[:2]
    tracer, gamma = RayTracer(sensor, resolution=(width, height), outputs=("layers",), device=device), sensor.response.gamma
    linear = np.sum(list(tracer.render_layers(surface).values()), axis=0) * tracer.response.scale
    real, rho = encode(shots.presses, gamma), shots.distance(sensor)
    flat = encode(shots.background * linear[1:] / linear[:1], gamma)
    rms = np.sqrt(np.mean((encode(linear[0], gamma) - encode(shots.background, gamma)) ** 2, axis=(0, 1)))
    errors = {f"rest_rms.{name}": float(e) for name, e in zip(CHANNELS, rms, strict=True)}
    for kind, images in (("flat_field", flat), ("plain", encode(linear[1:], gamma))):
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


def main(args: Args) -> None:
    began = time.perf_counter()
    sensor = load_sensor(args.sensor)
    shots = read_photographs(args.data, sensor)
    if args.quick:
        shots = shots.take(np.arange(min(6, len(shots.presses))))
    held_out = np.arange(len(shots.presses)) % 3 == 2
    train, test = shots.take(np.nonzero(~held_out)[0]), shots.take(np.nonzero(held_out)[0])
    grid = make_grid(sensor.gelpad, 0.3e-3 if args.quick else 0.12e-3)
    pressed, unseen = (press_balls(sensor, grid, part, args.depth_factor, args.surround_scale) for part in (train, test))

    p, iterations = Parameters.of(sensor), min(args.iterations, 10) if args.quick else args.iterations
    for factor in (8,) if args.quick else (8, 4):  # a new ray tracer each: the light from the case follows the LEDs
        problem = Problem(sensor, train.shrunk(factor), pressed, p, args.background_weight, args.device)
        p = solve(problem, p, iterations, f"at 1/{factor}")

    response = dataclasses.replace(sensor.response, vignetting=(p.vignette, 0.0, 0.0))
    fitted = with_lights(dataclasses.replace(sensor, response=response), p.lights())
    device = RayTracer(sensor, resolution=(8, 6), outputs=("depth",), device=args.device).device
    metrics: dict[str, int | float | str] = {"experiment": "fit_lights", "device": device, "seed": args.seed, **versions()}
    metrics |= {"presses.fitted": len(train.presses), "presses.held_out": len(test.presses), "depth_factor": args.depth_factor}
    touching = unseen.contact[1:].sum((1, 2)) * grid.pitch[0] * grid.pitch[1]
    labelled = test.circles[:, 2] * sensor.camera.pixel_pitch[0]
    metrics["contact_radius_over_label"] = float(np.mean(np.sqrt(touching / np.pi) / labelled))
    small = test.shrunk(4 if args.quick else 1)
    for name, spec in (("start", sensor), ("fitted", fitted)):
        fitted_errors, images = score(spec, unseen, small, args.device)
        metrics |= {f"{name}.{key}": value for key, value in fitted_errors.items()}
    with result_folder(args.out or Path("runs") / "fit_lights") as folder:
        error = " and ".join(f"{fitted_errors[f'flat_field.{part}_mae']:.2f} ({part})" for part in ("contact", "ring"))
        comment = f"Fitted by experiments/fit_lights.py to {len(train.presses)} presses.\nMean absolute error on others: {error} of 255."
        (folder / "lights.toml").write_text(lights_text(fitted.lights, comment), "utf-8")
        numbers = f"[response]\nexposure = {response.exposure}\nvignetting = [{p.vignette:.4f}, 0.0, 0.0]\n"
        (folder / "sensor.toml").write_text("# Numbers of the sensor file that belong to lights.toml.\n" + numbers, "utf-8")
        shown = np.unique(np.linspace(0, len(images) - 1, 5).astype(int))
        draw(255 * small.presses[shown] ** (1 / response.gamma), images[shown], folder / "presses.png")
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - began})
    for key, value in metrics.items():
        if key.startswith(("start.", "fitted.")):
            print(f"{key} = {value:.3f}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except RaytacError as error:
        sys.exit(f"error: {error}")
