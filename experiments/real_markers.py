"""How near do marker models come to a real drag? Dots of two photographs, a pressed ball and the same dragged, against every model.

    python experiments/real_markers.py fots_markers --circle-px 139,120,45 --ball-radius-mm 3 --pitch-mm 0.0532 --out runs/real_markers

The folder holds ``0.png`` (pressed), ``1.png`` (pressed and dragged), and ``0.csv`` and ``1.csv``: about where each dot is, columns ``Mx``,
``My`` (a start) and ``dx``, ``dy`` (its motion) [px], a row a dot in the same order. Dots are found again below a pixel as centroids of
darkness; what is compared is the difference of both photographs.

A model is told the circle of the contact in ``0.png``, an option, from which follows the depth, at which the edge of the rigid pad's
imprint is as wide; and the ball's own motion, a displacement and a turn, by the dots within the circle. Nothing else is fitted, unless a
constant: a displacement that is the same for all dots (a gel that slides in its case), by least squares, and taken off the ball's motion.

- ``markers.dots``, ``.lost``, ``.size_um``: dots compared and lost, root mean square of their motion; ``.ball_um``, ``.turn_deg``.
- ``markers.MODEL.under_um``, ``….outside_um``: root mean square distance of dots under the ball, and of the others.
- ``markers.layers.…`` with ``--layers``: the ball's motion from the rings of its printed layers (``layer_motion``): of its lowest point
  and its centre, roll, and the rings' correlation with and without a roll. No model is told these.
- ``markers.MODEL.rms_um``, ``….share``: root mean square distance of model and photographs, and over ``size_um``; ``….along_um`` of its
  component along the ball's motion alone.
- ``markers.MODEL.constant.…``: the same with a constant, ``….x_um`` and ``….y_um`` its value. ``residuals.png`` shows what remains.

``--vary NAME=A,B,…`` gives the gelpad each of some values, one property of ``VARIED``, with a constant. The value that is best on one half
of the dots, every other one, is tested on the other half, whose dots had no part in it, nor in the constant:

- ``varied.MODEL.A.rms_um``, ``….first_um``, ``….second_um``: of all dots, and of each half with a constant of its own.
- ``varied.MODEL.tested_first``, ``….tested_first_um``: the value chosen on the second half, and the first half's error with it and with
  the second half's constant; ``….tested_second…``: the other way round.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy import ndimage

from experiments.layer_motion import layer_motion
from experiments.running import recorded, run
from raytac.calibrate import PressedBall, pressed_balls
from raytac.checks import check_number
from raytac.device import resolve_device
from raytac.errors import InputError, RaytacError
from raytac.gel import PadGrid, rest_height
from raytac.io import CommonOptions, parse_names, read_png
from raytac.markers import MARKERS, ContactCells, ContactTracker, MarkersConfig, camera_of, height_at, markers_config
from raytac.physics import PadReading, Rigid, RigidPad, SoftPad
from raytac.specs import PADS, GelpadSpec, ObjectSpec, PressScene, SensorSpec, StageSpec, load_sensor

PITCH = 0.1e-3
"""Spacing of the pad's nodes [m]."""
REACH, DARK, LEAST = 9.0, (0.1, 0.9), 15.0
"""Window of a dot's centroid [px]; darkness that counts not at all and wholly; least dark area of a dot [px]."""
STEPS = 4
"""States of each of press and drag."""
VARIED: dict[str, Callable[[GelpadSpec, str], GelpadSpec]] = {
    "friction": lambda gel, value: replace(gel, friction=float(value)),
    "poisson_ratio": lambda gel, value: replace(gel, poisson_ratio=float(value)),
    "thickness_mm": lambda gel, value: replace(gel, thickness=1e-3 * float(value)),
    "size": lambda gel, value: replace(gel, size=(float(value) * gel.size[0], float(value) * gel.size[1])),
    "bonded": lambda gel, value: replace(gel, bonded=value),
}
"""Properties of the gelpad that may be varied; ``size`` is over the sensor's own."""
UNDER = 0.9
"""Dots within so many radii of the circle's centre move with the ball."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Compare marker models with a drag that was photographed."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of both photographs."""
    circle_px: str
    """Contact in 0.png: x, y, radius [px], joined by commas."""
    ball_radius_mm: float
    """Radius of the ball [mm]."""
    pitch_mm: float
    """Size of a pixel on the gel [mm]."""
    models: str = ""
    """Models to compare, joined by commas; all of the registry if empty."""
    level: str = "medium"
    """Level of the soft pad that surface tracking needs."""
    sensor: str = "gelsight_mini"
    """Sensor whose gelpad and marker motion are used."""
    layers: bool = False
    """Also read the motion of a printed ball from the rings of its layers."""
    vary: str = ""
    """Property of the gelpad and its values, as friction=0.3,0.5,1; see the module's text. None if empty."""


@dataclass(frozen=True)
class Drag:
    """Dots of both photographs [px], (N, 2) each, and how many were lost."""

    before: np.ndarray
    after: np.ndarray
    lost: int
    size: tuple[int, int]
    """Width and height of the photographs [px]."""
    images: tuple[np.ndarray, ...] = ()
    """Both photographs, (H, W, 3) each."""

    @property
    def motion(self) -> np.ndarray:
        return self.after - self.before

    @classmethod
    def read(cls, folder: Path) -> Drag:
        """Dots that both photographs show; raises ``InputError`` for missing, damaged or unlike files."""
        try:
            images = [read_png(folder / f"{k}.png") for k in (0, 1)]
        except OSError as error:
            raise InputError("data", value=str(folder), rule=f"must hold the photographs 0.png and 1.png: {error}") from error
        near = [_places(folder / f"{k}.csv") for k in (0, 1)]
        if images[0].shape != images[1].shape or near[0].shape != near[1].shape:
            raise InputError(
                "data", value=str(folder), rule="must hold two photographs of one size, with a row for each dot in both"
            )
        (before, area), (after, later) = (dot_centres(image, places) for image, places in zip(images, near, strict=True))
        seen = (area >= LEAST) & (later >= LEAST)
        if seen.sum() < 3:
            raise InputError("data", value=str(folder), rule="must show at least three dots in both photographs")
        height, width = images[0].shape[:2]
        return cls(before[seen], after[seen], int((~seen).sum()), (width, height), tuple(images))


def _places(path: Path) -> np.ndarray:
    """About where the dots are [px], (N, 2)."""
    try:
        rows = list(csv.DictReader(path.read_text("utf-8").splitlines()))
        start, motion = (
            np.array([[float(row[name]) for name in names] for row in rows]) for names in (("Mx", "My"), ("dx", "dy"))
        )
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError("data", value=str(path), rule=f"must hold the columns Mx, My, dx, dy of numbers: {error}") from error
    return (start + motion).reshape(-1, 2)


def dot_centres(image: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids of dark dots [px], (N, 2), and their dark areas [px], (N,).

    ``image`` (H, W, 3), ``near`` (N, 2): about where dots are [px]. Darkness is 1 less the brightest channel over what surrounds
    the dot. The window of the centroid follows it until it stands still.
    """
    bright = image[..., :3].max(axis=2).astype(float)
    behind = ndimage.gaussian_filter(ndimage.percentile_filter(bright, 80, size=int(3 * REACH)), 6.0)
    dark = np.clip((1.0 - bright / np.maximum(behind, 1.0) - DARK[0]) / (DARK[1] - DARK[0]), 0.0, 1.0)
    v, u = np.mgrid[: bright.shape[0], : bright.shape[1]] + 0.5
    centres, areas = np.array(near, float), np.zeros(len(near))
    for k, centre in enumerate(centres):
        for _ in range(20):
            weight = dark * (np.hypot(u - centre[0], v - centre[1]) < REACH)
            areas[k] = weight.sum()
            if areas[k] < LEAST:
                break
            moved = np.array([(weight * u).sum(), (weight * v).sum()]) / areas[k]
            done, centre = np.abs(moved - centre).max() < 1e-3, moved
            if done:
                break
        centres[k] = centre
    return centres, areas


def rigid_motion(places: np.ndarray, motion: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, float]:
    """Displacement of ``centre`` and turn [rad] about it that fit the ``motion`` (N, 2) of ``places`` (N, 2) best, small turns."""
    x, y = (places - centre).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate([np.stack([one, none, -y], axis=1), np.stack([none, one, x], axis=1)])
    u, v, turn = np.linalg.lstsq(rows, np.concatenate([motion[:, 0], motion[:, 1]]), rcond=None)[0]
    return np.array([u, v]), float(turn)


class Dragged:
    """A ball pressed and dragged on a pad of ``sensor``, and where the dots of the photographs go in every model."""

    def __init__(self, sensor: SensorSpec, pressed: PressedBall, radius: float, level: str, device: str) -> None:
        """``pressed``: as of ``pressed_ball``; ``radius`` of the ball [m]; ``level`` of the soft pad."""
        assert pressed.surface is not None
        place, depth = pressed.surface.contact_centre[0], pressed.depth
        self.sensor, self.level, self.device, self.camera = sensor, level, device, camera_of(sensor)
        self.depth, ball = (
            depth,
            ObjectSpec("sphere", {"radius": radius}, (float(place[0]), float(place[1]), 0.0), (1.0, 0.0, 0.0, 0.0), 0.1),
        )
        self.scene = PressScene("ball", ball, (StageSpec("indent", depth=depth),))
        self._kept: dict[tuple[float, ...], tuple[PadGrid, list[PadReading]]] = {}

    def readings(self, soft: bool, drag: np.ndarray, turn: float) -> tuple[PadGrid, list[PadReading]]:
        """Grid and readings of the press and of the drag [m] with its turn [rad]; kept."""
        key = float(soft), *map(float, drag), turn
        if key not in self._kept:
            if soft:
                pad = SoftPad(self.sensor, self.scene, pitch=PITCH, level=self.level, device=self.device)
            else:
                pad = RigidPad(self.sensor, self.scene, pitch=PITCH)
            states = list(pad.follow(StageSpec("indent", depth=self.depth), steps=STEPS))
            for share in np.arange(1, STEPS + 1) / STEPS:
                states += pad.follow(StageSpec("shear", shear=tuple((share * drag).tolist())))
                if turn:
                    states += pad.follow(StageSpec("twist", twist=float(share * turn)))
            if any(state.failed.any() for state in states):
                raise RaytacError("the drag did not converge")
            self._kept[key] = pad.grid, states
        return self._kept[key]

    def motion(self, config: MarkersConfig, before: np.ndarray, drag: np.ndarray, turn: float) -> np.ndarray:
        """Motion [px] of the dots that are at ``before`` [px] (N, 2) once the ball is pressed, (N, 2)."""
        grid, readings = self.readings(config.needs_coat, drag, turn)
        model = config.build(self.sensor, grid, num_envs=1, device=self.device)
        cells = ContactCells.over(grid, config.contacts) if model.needs_contacts else None
        tracker, asked = ContactTracker(1, config.contacts, slip=config.slip(self.sensor)), []
        for reading in readings:
            surface, shear = reading.surface, reading.shear if config.follows_shear else None
            samples = None if cells is None else cells.sample(surface)
            asked.append((surface, samples, None if samples is None else tracker.update(surface, samples, None, shear)))

        def seen(rest: np.ndarray, state: int) -> np.ndarray:
            surface = asked[state][0]
            moved = np.asarray(model.displacement(rest[None], *asked[state]), float)[0]
            place = rest[:, :2] + moved[:, :2]
            z = rest[:, 2] + moved[:, 2] if moved.shape[1] == 3 else height_at(surface, place[None])[0]
            return self.camera.project(np.column_stack([place, z]))

        rest = at_rest(self.sensor, before, lambda rest: seen(rest, STEPS - 1))
        return seen(rest, -1) - seen(rest, STEPS - 1)


def at_rest(sensor: SensorSpec, pixels: np.ndarray, seen: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Places on the pad at rest (N, 3) [m] of dots that are ``seen`` at ``pixels`` (N, 2), by fixed-point iteration."""
    pitch = np.asarray(sensor.camera.pixel_pitch)
    xy = (pixels - np.asarray(sensor.camera.principal_point)) * pitch + np.asarray(sensor.camera.position[:2])
    for _ in range(12):
        rest = np.column_stack([xy, rest_height(sensor.gelpad, *xy.T)])
        xy = xy + (pixels - seen(rest)) * pitch
    return np.column_stack([xy, rest_height(sensor.gelpad, *xy.T)])


def compared(
    drag: Drag, dragged: Dragged, config: MarkersConfig, own: tuple[np.ndarray, float], with_constant: bool
) -> tuple[np.ndarray, np.ndarray]:
    """What photographs have over a model [px], (N, 2), and the constant [px], (2,); ``own``: motion of the ball [px], [rad]."""
    pitch, constant = np.asarray(dragged.sensor.camera.pixel_pitch), np.zeros(2)
    for _ in range(4 if with_constant else 1):
        difference = drag.motion - dragged.motion(config, drag.before, (own[0] - constant) * pitch, own[1])
        if not with_constant:
            return difference, constant
        before, constant = constant, difference.mean(axis=0)
        if np.abs(constant - before).max() < 0.02:
            break
    return difference - constant, constant


def varied(gelpad: GelpadSpec, text: str) -> tuple[str, dict[str, GelpadSpec]]:
    """Property of ``NAME=A,B,…``, and the gelpad with each of its values; errors as of the gelpad's own checks."""
    name, _, values = text.partition("=")
    parse_names(name, "vary", tuple(VARIED))
    if len(set(values.split(","))) < 2:
        raise InputError("vary", value=text, rule="must name a property and two or more values, as friction=0.3,0.5,1")
    try:
        return name, {value: VARIED[name](gelpad, value) for value in values.split(",")}
    except ValueError as error:
        raise InputError("vary", value=text, rule=f"must have values that the property takes: {error}") from error


def chosen_by_halves(
    drag: Drag, pads: dict[str, Dragged], model: str, name: str, own: tuple[np.ndarray, float], pitch_um: float
) -> dict[str, float | str]:
    """Metrics of pads by value: each half of the dots tested with the value and the constant that are best on the other."""
    print(f"| {model}: {name} | RMS [µm] | first half alone | second half alone |\n|---|---|---|---|", flush=True)
    differences, metrics = {}, {}
    halves = {"first": slice(0, None, 2), "second": slice(1, None, 2)}
    for value, dragged in pads.items():
        difference, _ = compared(drag, dragged, markers_config(model), own, True)
        differences[value] = pitch_um * difference
        alone = [_rms(d - d.mean(axis=0)) for d in (differences[value][half] for half in halves.values())]
        rms = metrics[f"varied.{model}.{value}.rms_um"] = _rms(differences[value])
        metrics |= {f"varied.{model}.{value}.{half}_um": own_rms for half, own_rms in zip(halves, alone, strict=True)}
        print(f"| {value} | {' | '.join(f'{one:.1f}' for one in (rms, *alone))} |", flush=True)
    for tested, other in (("first", "second"), ("second", "first")):
        best = min(differences, key=lambda value: metrics[f"varied.{model}.{value}.{other}_um"])
        difference = differences[best]
        rms = _rms(difference[halves[tested]] - difference[halves[other]].mean(axis=0))
        metrics |= {f"varied.{model}.tested_{tested}": best, f"varied.{model}.tested_{tested}_um": rms}
        print(f"{tested} half, with what the other chose ({name} {best}): {rms:.1f} µm", flush=True)
    return metrics


def main(args: Args) -> None:
    for name in ("ball_radius_mm", "pitch_mm"):
        check_number(name, getattr(args, name), "(0, 100]", "mm")
    models = parse_names(args.models, "models", tuple(MARKERS.names)) if args.models else tuple(MARKERS.names)
    parse_names(args.level, "level", PADS)
    circle = _circle(args.circle_px)
    drag = Drag.read(args.data)
    device = resolve_device(args.device, ray_tracing=False)
    sensor = photographed(load_sensor(args.sensor), drag.size, args.pitch_mm / 1e3)
    radius, pitch_um = args.ball_radius_mm / 1e3, 1e3 * args.pitch_mm
    ball = pressed_ball(sensor, circle, radius, device)
    under = np.hypot(*(drag.before - circle[:2]).T) < UNDER * circle[2]
    if under.sum() < 2:
        raise InputError("circle_px", value=args.circle_px, rule="must have at least two dots inside")
    own = rigid_motion(drag.before[under], drag.motion[under], circle[:2])
    if args.vary:
        name, gelpads = varied(sensor.gelpad, args.vary)
        pads = {}
        for value, gelpad in gelpads.items():
            own_sensor = replace(sensor, gelpad=gelpad)
            pads[value] = Dragged(own_sensor, pressed_ball(own_sensor, circle, radius, device), radius, args.level, device)
        with recorded(args, "real_markers", device=device) as (_, metrics):
            for model in models:
                metrics |= chosen_by_halves(drag, pads, model, name, own, pitch_um)
        return
    dragged = Dragged(sensor, ball, radius, args.level, device)
    with recorded(args, "real_markers", device=device) as (folder, metrics):
        size = _rms(drag.motion) * pitch_um
        metrics |= {"markers.dots": len(drag.before), "markers.lost": drag.lost, "markers.size_um": size}
        metrics |= {"markers.ball_um": float(np.hypot(*own[0])) * pitch_um, "markers.turn_deg": float(np.degrees(own[1]))}
        metrics |= {
            "markers.depth_mm": 1e3 * ball.depth,
            "markers.dots_under_ball": int(under.sum()),
            "markers.level": args.level,
        }
        if args.layers:
            figures = layer_motion(drag.images[0], drag.images[1], circle, args.ball_radius_mm / args.pitch_mm).figures(pitch_um)
            metrics |= {f"markers.layers.{name}": value for name, value in figures.items()}
            print("layers: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)
        residuals = {}
        axis = own[0] / np.hypot(*own[0])
        print(
            "| model | RMS [µm] | along the drag | share | with a constant: RMS [µm] | along the drag | share | constant [µm] |"
        )
        print("|" + "---|" * 8, flush=True)
        for name in models:
            cells = []
            for key, with_constant in ((f"markers.{name}", False), (f"markers.{name}.constant", True)):
                difference, constant = compared(drag, dragged, markers_config(name), own, with_constant)
                rms, along = _rms(difference) * pitch_um, _rms((difference @ axis)[:, None]) * pitch_um
                metrics |= {f"{key}.rms_um": rms, f"{key}.along_um": along, f"{key}.share": rms / size}
                metrics |= {
                    f"{key}.{part}_um": _rms(difference[m]) * pitch_um for part, m in (("under", under), ("outside", ~under))
                }
                cells += [f"{rms:.1f}", f"{along:.1f}", f"{rms / size:.3f}"]
            metrics |= {f"{key}.{name_of}_um": float(c) * pitch_um for name_of, c in zip("xy", constant, strict=True)}
            residuals[name] = difference * pitch_um
            cells.append(", ".join(f"{c * pitch_um:.0f}" for c in constant))
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
        draw_residuals(folder / "residuals.png", drag, circle, residuals)


def draw_residuals(path: Path, drag: Drag, circle: np.ndarray, residuals: dict[str, np.ndarray]) -> None:
    """Arrows of what photographs have over each model with its constant [µm], at the dots of the first photograph."""
    from matplotlib.figure import Figure

    columns = min(len(residuals), 3)
    rows = -(-len(residuals) // columns)
    figure = Figure(figsize=(5.2 * columns, 4.2 * rows), layout="constrained")
    for k, (name, residual) in enumerate(residuals.items()):
        axes = figure.add_subplot(rows, columns, k + 1)
        arrows = axes.quiver(*drag.before.T, *residual.T, angles="xy", scale_units="xy", scale=3.0, width=0.004)
        axes.quiverkey(arrows, 0.85, 1.04, 60.0, "60 µm", labelpos="E")
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        axes.plot(circle[0] + circle[2] * np.cos(angle), circle[1] + circle[2] * np.sin(angle), lw=0.8, color="tab:red")
        axes.set(xlim=(0, drag.size[0]), ylim=(drag.size[1], 0), aspect="equal", title=f"{name}: {_rms(residual):.1f} µm")
    figure.savefig(path, dpi=110)


def pressed_ball(sensor: SensorSpec, circle: np.ndarray, radius: float, device: str) -> PressedBall:
    """The rigid pad under a ball whose imprint has a ``circle`` (3,) [px]; raises ``InputError`` for one that no depth gives."""
    (ball,) = pressed_balls(sensor, circle[None], np.array([radius]), Rigid(), pitch=PITCH, device=device)
    if ball.surface is None:
        raise InputError("circle_px", value=circle.tolist(), rule="must be a contact that the ball can have")
    return ball


def photographed(sensor: SensorSpec, size: tuple[int, int], pitch: float) -> SensorSpec:
    """The sensor with a camera of photographs of ``size`` [px] whose pixels have ``pitch`` [m] on the gel."""
    camera = replace(sensor.camera, resolution=size, pixel_pitch=(pitch, pitch), principal_point=(size[0] / 2, size[1] / 2))
    return replace(sensor, camera=camera)


def _circle(text: str) -> np.ndarray:
    try:
        circle = np.array([float(number) for number in text.split(",")])
    except ValueError:
        circle = np.zeros(0)
    if circle.shape != (3,) or not np.isfinite(circle).all() or circle[2] <= 0.0:
        raise InputError("circle_px", value=text, rule="must be x, y and a radius above 0, joined by commas")
    return circle


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


if __name__ == "__main__":
    run(main, Args)
