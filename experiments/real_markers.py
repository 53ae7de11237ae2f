"""How near do marker models come to a real drag? Dots of two photographs, a pressed ball and the same dragged, against every model.

    python experiments/real_markers.py fots_markers --circle-px 139,120,45 --ball-radius-mm 3 --pitch-mm 0.0532 --out runs/real_markers

The folder holds ``0.png`` (pressed), ``1.png`` (pressed and dragged), and ``0.csv`` and ``1.csv``: about where each dot is, columns ``Mx``,
``My`` (a start) and ``dx``, ``dy`` (its motion) [px], a row a dot in the same order. Dots are found again below a pixel as centroids of
darkness; what is compared is the difference of both photographs.

A model is told the circle of the contact in ``0.png``, an option, from which follows the depth, at which the edge of the rigid pad's
imprint is as wide; and the ball's own motion: displacement and turn by the dots within the circle, or with ``--layers`` displacement and
tilt by the rings of a printed ball's layers (``layer_motion``), and only the turn about z by the dots. Nothing else is fitted, unless a
constant: a displacement that is the same for all dots (a gel that slides in its case), by least squares, and taken off the ball's motion.

- ``markers.dots``, ``.lost``, ``.size_um``: dots compared and lost, root mean square of their motion; ``.ball_um``, ``.turn_deg``: of those
  under the ball; ``.detection_um``: change of the dots' motion by other thresholds of darkness, root mean square.
- ``markers.MODEL.under_um``, ``….outside_um``: root mean square distance of dots under the ball, and of the others.
- ``markers.layers.…`` with ``--layers``: displacement of the ball's lowest point and of its centre, its tilt and turn, the correlation of
  rings with the best motion, with the best that does not tilt, and by annulus; how far dots on it, ahead of its middle and behind, lag.
- ``markers.MODEL.constant.smooth_…_um``: what is left of that error when a smooth motion of all dots is fitted to it too, on one half of
  the dots, and is taken off the other: a turn and a scale of the whole image, an affine and a quadratic motion. What a quadratic one
  leaves is local: errors of dots, and of the model near the ball.
- ``markers.MODEL.rms_um``, ``….share``: root mean square distance of model and photographs, and over ``size_um``; ``….along_um`` of its
  component along the ball's motion alone.
- ``markers.MODEL.constant.…``: the same with a constant, ``….x_um`` and ``….y_um`` its value. ``residuals.png`` shows what remains.

``--vary NAME=A,B,…`` gives the gelpad each of some values, one property of ``VARIED``, or the circle a radius, with a constant. The value
that is best on one half of the dots, every other one, is tested on the other half, whose dots had no part in it, nor in the constant:

- ``varied.MODEL.A.rms_um``, ``….first_um``, ``….second_um``: of all dots, and of each half with a constant of its own.
- ``varied.MODEL.tested_first``, ``….tested_first_um``: the value chosen on the second half, and the first half's error with it and with
  the second half's constant; ``….tested_second…``: the other way round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from experiments.drag_photographs import BallMotion, Drag, ball_points, detection_error, layer_motion, rigid_motion
from experiments.running import recorded, run
from raytac.calibrate import PressedBall, pressed_balls
from raytac.checks import check_number
from raytac.device import resolve_device
from raytac.errors import InputError, RaytacError
from raytac.gel import PadGrid, rest_height
from raytac.io import CommonOptions, parse_names
from raytac.markers import MARKERS, ContactCells, ContactTracker, MarkersConfig, camera_of, height_at, markers_config
from raytac.physics import PadReading, Rigid, RigidPad, SoftPad
from raytac.specs import PADS, GelpadSpec, ObjectSpec, PressScene, SensorSpec, StageSpec, load_sensor

PITCH = 0.1e-3
"""Spacing of the pad's nodes [m]."""
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
RADIUS = "radius_px"
"""Radius of the contact's circle, which may be varied too [px]."""
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
    """Read the motion of a printed ball from the rings of its layers, and tell it to the models."""
    vary: str = ""
    """Property of the gelpad, or radius_px, and its values, as friction=0.3,0.5,1; see the module's text. None if empty."""


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

    def readings(self, soft: bool, own: BallMotion) -> tuple[PadGrid, list[PadReading]]:
        """Grid and readings of the press and of the drag; kept."""
        key = float(soft), *own.shear.tolist(), *own.tilt.tolist(), own.turn
        if key not in self._kept:
            stages = *self.scene.trajectory, StageSpec("tilt", tilt=_pair(own.tilt))
            scene = replace(self.scene, trajectory=stages)
            if soft:
                pad = SoftPad(self.sensor, scene, pitch=PITCH, level=self.level, device=self.device)
            else:
                pad = RigidPad(self.sensor, scene, pitch=PITCH)
            states = list(pad.follow(StageSpec("indent", depth=self.depth), steps=STEPS))
            for share in np.arange(1, STEPS + 1) / STEPS:
                states += pad.follow(StageSpec("shear", shear=_pair(share * own.shear)))
                if own.tilt.any():
                    states += pad.follow(StageSpec("tilt", tilt=_pair(share * own.tilt)))
                if own.turn:
                    states += pad.follow(StageSpec("twist", twist=float(share * own.turn)))
            if any(state.failed.any() for state in states):
                raise RaytacError("the drag did not converge")
            self._kept[key] = pad.grid, states
        return self._kept[key]

    def motion(self, config: MarkersConfig, before: np.ndarray, own: BallMotion) -> np.ndarray:
        """Motion [px] of the dots that are at ``before`` [px] (N, 2) once the ball is pressed, (N, 2)."""
        grid, readings = self.readings(config.needs_coat, own)
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


def over_ball(
    sensor: SensorSpec, drag: Drag, circle: np.ndarray, centre: np.ndarray, radius: float, motion: BallMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Dots within the circle [px], (N, 2), and how much farther each went than the ball at ``centre`` (3,) under it [px]."""
    within = np.hypot(*(drag.before - circle[:2]).T) < circle[2]
    u, v = drag.before[within].T
    points = ball_points(sensor, u, v, centre, radius)
    moved = camera_of(sensor).project(motion.of(points, centre)) - drag.before[within]
    return drag.before[within], drag.motion[within] - moved


def compared(
    drag: Drag, dragged: Dragged, config: MarkersConfig, own: BallMotion, with_constant: bool
) -> tuple[np.ndarray, np.ndarray]:
    """What photographs have over a model [px], (N, 2), and the constant [px], (2,); ``own``: motion of the ball."""
    pitch, constant = np.asarray(dragged.sensor.camera.pixel_pitch), np.zeros(2)
    for _ in range(4 if with_constant else 1):
        moved = replace(own, shear=own.shear - constant * pitch)
        difference = drag.motion - dragged.motion(config, drag.before, moved)
        if not with_constant:
            return difference, constant
        before, constant = constant, difference.mean(axis=0)
        if np.abs(constant - before).max() < 0.02:
            break
    return difference - constant, constant


def smooth_parts(places: np.ndarray, difference: np.ndarray) -> dict[str, float]:
    """RMS that smooth motions leave of a ``difference`` (N, 2) at ``places`` (N, 2), each half of the dots with the other's fit."""
    x, y = ((places - places.mean(axis=0)) / np.ptp(places, axis=0).max()).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rigid = [(one, none), (none, one), (-y, x), (x, y)]
    powers = {"affine": (one, x, y), "quadratic": (one, x, y, x * x, x * y, y * y)}
    motions = {"turn_and_scale": rigid} | {
        name: [pair for term in terms for pair in ((term, none), (none, term))] for name, terms in powers.items()
    }
    result = {}
    for name, pairs in motions.items():
        rows, squares = np.array(pairs).transpose(2, 1, 0), 0.0  # (N, 2, number of motions)
        for first in (0, 1):
            fitted, tested = slice(first, None, 2), slice(1 - first, None, 2)
            shares = np.linalg.lstsq(rows[fitted].reshape(-1, len(pairs)), difference[fitted].ravel(), rcond=None)[0]
            squares += float(((difference[tested] - rows[tested] @ shares) ** 2).sum())
        result[name] = float(np.sqrt(squares / len(places)))
    return result


def varied(gelpad: GelpadSpec, circle: np.ndarray, text: str) -> tuple[str, dict[str, tuple[GelpadSpec, np.ndarray]]]:
    """Property of ``NAME=A,B,…``, and the gelpad and the circle with each of its values; errors as of the gelpad's own checks."""
    name, _, values = text.partition("=")
    parse_names(name, "vary", (*VARIED, RADIUS))
    if len(set(values.split(","))) < 2:
        raise InputError("vary", value=text, rule="must name a property and two or more values, as friction=0.3,0.5,1")
    try:
        if name == RADIUS:
            return name, {value: (gelpad, np.array([*circle[:2], float(value)])) for value in values.split(",")}
        return name, {value: (VARIED[name](gelpad, value), circle) for value in values.split(",")}
    except ValueError as error:
        raise InputError("vary", value=text, rule=f"must have values that the property takes: {error}") from error


def chosen_by_halves(
    drag: Drag, pads: dict[str, Dragged], model: str, name: str, own: BallMotion, pitch_um: float
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
    seen, turn = rigid_motion(drag.before[under], drag.motion[under], circle[:2])
    own, layers, lag = BallMotion(seen * np.asarray(sensor.camera.pixel_pitch), turn=turn), None, {}
    if args.layers:
        assert ball.surface is not None
        place = ball.surface.contact_centre[0]
        centre = np.array([*place, radius - ball.depth + float(rest_height(sensor.gelpad, *place))])
        layers = layer_motion(drag.images, sensor, circle, centre, radius)
        places, farther = over_ball(sensor, drag, circle, centre, radius, layers.motion)
        own = replace(layers.motion, turn=rigid_motion(places, farther, circle[:2])[1])
        axis = seen / np.hypot(*seen)
        is_ahead = (places - circle[:2]) @ axis > 0.0
        lag = {
            f"lag_{name}_um": -float((farther[m] @ axis).mean()) * pitch_um
            for name, m in (("ahead", is_ahead), ("behind", ~is_ahead))
        }
    if args.vary:
        name, variants = varied(sensor.gelpad, circle, args.vary)
        pads = {}
        for value, (gelpad, around) in variants.items():
            own_sensor = replace(sensor, gelpad=gelpad)
            pads[value] = Dragged(own_sensor, pressed_ball(own_sensor, around, radius, device), radius, args.level, device)
        with recorded(args, "real_markers", device=device) as (_, metrics):
            for model in models:
                metrics |= chosen_by_halves(drag, pads, model, name, own, pitch_um)
        return
    dragged = Dragged(sensor, ball, radius, args.level, device)
    with recorded(args, "real_markers", device=device) as (folder, metrics):
        size = _rms(drag.motion) * pitch_um
        metrics |= {"markers.dots": len(drag.before), "markers.lost": drag.lost, "markers.size_um": size}
        metrics["markers.detection_um"] = detection_error(drag) * pitch_um
        metrics |= {"markers.ball_um": float(np.hypot(*seen)) * pitch_um, "markers.turn_deg": float(np.degrees(turn))}
        metrics |= {
            "markers.depth_mm": 1e3 * ball.depth,
            "markers.dots_under_ball": int(under.sum()),
            "markers.level": args.level,
        }
        if layers is not None:
            figures = layers.figures(radius) | {"turn_deg": float(np.degrees(own.turn))} | lag
            metrics |= {f"markers.layers.{name}": value for name, value in figures.items()}
            print("layers: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)
        residuals = {}
        axis = seen / np.hypot(*seen)
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
            smooth = smooth_parts(drag.before, difference)
            metrics |= {f"{key}.smooth_{part}_um": rms * pitch_um for part, rms in smooth.items()}
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


def _pair(vector: np.ndarray) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])


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
