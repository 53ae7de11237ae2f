"""Calibration of a pad's marker motion: fitted file, errors on held-out presses, metrics."""

from __future__ import annotations

import datetime
import math
import time
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytac.checks import check_known
from raytac.device import resolve_device
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.progress import Progress
from raytac.markers.calibration import ModelError, ProbeData, fit_motion, model_errors, probe_sensor
from raytac.markers.calibration_presses import (
    FIT,
    HELD_OUT,
    LOADS,
    QUICK_FIT,
    QUICK_HELD_OUT,
    Press,
    PressFrame,
    press_frames,
    simulate_press,
)
from raytac.markers.registry import models_without_coat
from raytac.markers.tracker import MarkerFrame, MarkerTracker
from raytac.report.measure import machine
from raytac.report.press_store import PressStore, press_code
from raytac.report.style import STYLE
from raytac.specs import validate_press
from raytac.specs.marker_motion import MarkerMotionSpec, load_marker_motion, marker_motion_text
from raytac.specs.press import PADS
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILES = ("marker_motion.toml", "errors.md", "errors.png", "arrows.png", "metrics.json")
"""Files that a calibration writes."""


@dataclass(frozen=True)
class MotionReport:
    """A fit and its errors."""

    motion: MarkerMotionSpec
    errors: list[ModelError]
    """Errors on held-out presses."""
    fit_errors: list[ModelError]
    """Errors of FOTS, and of FOTS as published, on the presses that both were fitted to."""
    by_press: list[tuple[str, ModelError]]
    """Errors of FOTS by press, in words, and kind of load; those of the fit first."""
    times_ms: dict[str, float]
    """Median time of a frame of every model at the probes [ms]."""
    probes: int
    held_out: list[PressFrame]


def run_calibrate_markers(
    sensor: SensorSpec, out: Path, *, level: str, quick: bool, device: str, seed: int, start: float, progress: bool = True
) -> list[Path]:
    """Press the soft pad, fit, test on held-out presses, and write ``FILES`` to ``out``.

    Returns the files written. Finished presses are kept in ``presses`` of ``out``, also if an error or an interrupt ends the run. A
    later run reuses them.

    Raises:
        RaytacError: a press did not settle.
        SpecError: a press fits nowhere on this sensor.
        InputError: an unknown ``level`` or ``device``, or ``out`` cannot be written.
        BackendError: the solver or Dr.Jit cannot run.
    """
    check_known("level", level, PADS)
    solver = resolve_device(device, ray_tracing=False)
    with result_folder(out, FILES) as folder:
        fit, held_out = (QUICK_FIT, QUICK_HELD_OUT) if quick else (FIT, HELD_OUT)
        began = time.perf_counter()
        store = PressStore(out / "presses", sensor.gelpad, pad=level, device=solver, code=press_code(), say=Progress.write)
        pressed = press_all(sensor, (*fit, *held_out), level, device, progress=progress, store=store)
        press_s = time.perf_counter() - began
        names = {press.name for press in fit}
        report = calibrate_markers(
            sensor,
            [frame for frame in pressed if frame.press.name in names],
            [frame for frame in pressed if frame.press.name not in names],
            level=level,
            device=device,
        )
        (folder / "marker_motion.toml").write_text(marker_motion_text(report.motion), encoding="utf-8")
        load_marker_motion(folder / "marker_motion.toml")  # the written file can be read
        (folder / "errors.md").write_text(error_table(report), encoding="utf-8")
        write_errors(folder / "errors.png", report)
        write_arrows(folder / "arrows.png", replace(sensor, marker_motion=report.motion), report.held_out, device=device)
        metrics = motion_metrics(report) | {"sensor": sensor.name, "pad": level, "seed": seed, "press_s": press_s}
        metrics |= {"presses": len(names) + len(held_out), "presses_reused": store.reused}
        metrics |= {"device": device, **versions((*VERSIONED, "warp-lang")), **machine()}
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
        written = [Path(out) / path.name for path in sorted(folder.iterdir())]
    return written


def press_all(
    sensor: SensorSpec, presses: tuple[Press, ...], level: str, device: str, *, progress: bool, store: PressStore | None = None
) -> list[PressFrame]:
    """States of all presses on the soft pad of a ``level``, in order.

    ``progress``: show a bar. ``store``: finished presses, which are reused; None keeps none.

    Raises:
        SpecError: a press fits nowhere on this sensor; raised before the first press.
        RaytacError: a press did not settle.
        BackendError: the solver cannot run on ``device``.
    """
    for press in presses:
        validate_press(sensor, press.scene())
    solver = resolve_device(device, ray_tracing=False)
    frames: list[PressFrame] = []
    for press in Progress(presses, desc=f"press {sensor.name}", unit="press", show=progress):
        states = None if store is None else store.read(press)
        if states is None:
            states = simulate_press(sensor, press, level=level, device=solver)
            if store is not None:
                store.write(press, states)
        frames += press_frames(sensor, press, states)
    return frames


def calibrate_markers(
    sensor: SensorSpec, fit: list[PressFrame], held_out: list[PressFrame], *, level: str, device: str = "auto"
) -> MotionReport:
    """Fit to ``fit`` and test on ``held_out``: whole presses of the soft pad of a ``level``."""
    data = ProbeData.of(sensor, fit)
    motion = fit_motion(data, device=device)
    fitted = replace(sensor, marker_motion=motion)
    grid = fit[0].surface.grid
    errors, times = model_errors(fitted, held_out, grid, device=device)
    fit_errors, _ = model_errors(fitted, fit, grid, models=("fots", "fots_published"), device=device)
    by_press = []
    for name, group in groupby([*fit, *held_out], key=lambda frame: str(frame.press)):
        rows, _ = model_errors(fitted, list(group), grid, models=("fots",), device=device)
        by_press += [(name, row) for row in rows]
    markers = probe_sensor(sensor).markers
    report = MotionReport(motion, errors, fit_errors, by_press, times, markers.rows * markers.columns, held_out)
    return replace(report, motion=replace(motion, provenance=_provenance(sensor, report, fit, held_out, level, device)))


def _provenance(
    sensor: SensorSpec, report: MotionReport, fit: list[PressFrame], held_out: list[PressFrame], level: str, device: str
) -> str:
    """Presses, versions and errors of a fit, as text of its file."""

    def listed(frames: list[PressFrame]) -> list[str]:
        return [f"  {press}" for press in dict.fromkeys(str(frame.press) for frame in frames)]

    def errors(rows: list[ModelError], model: str) -> str:
        return ", ".join(f"{row.load} {1e6 * row.mean:.1f} um" for row in rows if row.model == model)

    gelpad, used = sensor.gelpad, versions(("raytac", "warp-lang", "drjit", "numpy"))
    made_by = ", ".join(f"{key.split('.', 1)[1]} {value}" for key, value in used.items() if key != "versions.python")
    return "\n".join(
        [
            f"Fitted {datetime.date.today().isoformat()} to surface tracking on the soft pad, level {level}, of {sensor.name}:",
            f"E {1e-3 * gelpad.youngs_modulus:g} kPa, nu {gelpad.poisson_ratio:g}, friction {gelpad.friction:g}, bonded at "
            f"{gelpad.bonded}.",
            f"By {made_by}, simulated on {resolve_device(device, ray_tracing=False)}.",
            "Presses of the fit:",
            *listed(fit),
            "Presses held out:",
            *listed(held_out),
            f"Mean distance of FOTS, {report.probes} probes on a 1 mm grid, on the fit: {errors(report.fit_errors, 'fots')};",
            f"held out: {errors(report.errors, 'fots')}.",
            f"Without [punch], as published, on the fit: {errors(report.fit_errors, 'fots_published')};",
            f"held out: {errors(report.errors, 'fots_published')}.",
        ]
    )


def motion_metrics(report: MotionReport) -> dict[str, Metric]:
    """Constants and errors as flat keys."""
    metrics: dict[str, Metric] = {"command": "calibrate-markers", "markers.probes": report.probes}
    motion = report.motion
    for name in ("dilate_gain", "dilate_lambda", "shear_lambda", "shear_max", "twist_lambda", "twist_max"):
        metrics[f"fots.{name}"] = getattr(motion, name)
    if motion.punch is not None:
        metrics |= {f"punch.{name}": value for name, value in vars(motion.punch).items()}
    for name in ("field_gain", "field_shear", "field_friction"):
        metrics[name.replace("_", ".", 1)] = getattr(motion, name)
    for part, rows in (("held_out", report.errors), ("fit", report.fit_errors)):
        for row in rows:
            metrics |= error_metrics(f"{part}.{row.model}.{row.load}", row)
    return metrics | {f"{model}.ms_per_frame": value for model, value in report.times_ms.items()}


def error_metrics(key: str, row: ModelError) -> dict[str, Metric]:
    """Errors of one model and kind of load as ``<key>.<figure>``."""
    metrics: dict[str, Metric] = {
        f"{key}.mean_um": 1e6 * row.mean,
        f"{key}.p95_um": 1e6 * row.p95,
        f"{key}.mean_px": row.mean_px,
        f"{key}.truth_mean_um": 1e6 * row.size,
        f"{key}.frames": row.frames,
    }
    return metrics | ({f"{key}.moved_um": 1e6 * row.moved} if math.isfinite(row.moved) else {})


def error_table(report: MotionReport) -> str:
    """Errors of every model, and those of FOTS on every press, as Markdown tables."""
    lines = [
        "# Marker models against surface tracking on held-out presses",
        "",
        f"Distance over {report.probes} markers on a 1 mm grid over the view; `moved`: over those that surface tracking moves by more",
        "than 50 µm; `truth`: the mean displacement itself, which is the error of a model that never moves a marker.",
        "",
        "| model | load | frames | mean [µm] | p95 [µm] | moved [µm] | mean [px] | truth [µm] | a frame [ms] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report.errors:
        moved = f"{1e6 * row.moved:.1f}" if math.isfinite(row.moved) else "–"
        lines.append(
            f"| {row.model} | {row.load} | {row.frames} | {1e6 * row.mean:.1f} | {1e6 * row.p95:.1f} | {moved} | {row.mean_px:.2f} | "
            f"{1e6 * row.size:.1f} | {report.times_ms[row.model]:.2f} |"
        )
    held_out = {str(frame.press) for frame in report.held_out}
    lines += ["", "## FOTS by press", "", "| press | | load | mean [µm] | p95 [µm] | truth [µm] |", "|---|---|---|---|---|---|"]
    for press, row in report.by_press:
        part = "held out" if press in held_out else "fit"
        lines.append(f"| {press} | {part} | {row.load} | {1e6 * row.mean:.1f} | {1e6 * row.p95:.1f} | {1e6 * row.size:.1f} |")
    return "\n".join(lines) + "\n"


_LOOK = {
    "surface": ("surface tracking", "#1b1b1b"),
    "fots": ("FOTS", "#0072b2"),
    "fots_published": ("FOTS as published", "#56b4e9"),
    "superposition": ("superposition", "#009e73"),
    "force_field": ("force field", "#d55e00"),
}
"""Label and colour of each model; others have their name and grey."""
_LONGEST = 1.6
"""Length of the longest arrow in a plot, in spacings of the markers."""


def _look(model: str) -> tuple[str, str]:
    """Label and colour of a model."""
    return _LOOK.get(model, (model, "#7f7f7f"))


def draw_arrows(
    axes: Axes,
    markers: MarkerFrame,
    resolution: tuple[int, int],
    *,
    magnified: float | None = None,
    colour: str = "#1b1b1b",
    image: np.ndarray | None = None,
) -> float:
    """Draw displacements as arrows from the markers at rest; returns their magnification.

    Environment 0. ``magnified``: factor on the arrows; None picks 1, 2, 5, 10 … so that the longest is about as long as the spacing of
    the markers. ``image``: shown underneath, (H, W, 3) uint8.
    """
    width, height = resolution
    rest, displacement = markers.rest_px[0], markers.displacement_px[0]
    visible = np.isfinite(displacement).all(axis=1)
    if magnified is None:
        magnified = _magnification(rest, displacement[visible])
    if image is not None:
        axes.imshow(image, extent=(0, width, height, 0), interpolation="nearest")
    axes.plot(*rest.T, ".", color="0.75" if image is None else "white", markersize=1.2, zorder=1)
    axes.quiver(
        *rest[visible].T,
        *(magnified * displacement[visible]).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.0045,
        headwidth=3.6,
        headlength=4.2,
        headaxislength=3.8,
        minlength=0.0,
        zorder=2,
    )
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=(), yticks=())
    return magnified


def _magnification(rest: np.ndarray, displacement: np.ndarray) -> float:
    """Magnification of 1, 2, 5, 10 … for arrows of at most ``_LONGEST`` marker spacings."""
    longest = float(np.linalg.norm(displacement, axis=1).max(initial=0.0))
    distances = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    spacing = float(np.median(np.where(distances > 0, distances, np.inf).min(axis=1)))
    steps = np.array([1, 2, 5, 10, 20, 50, 100], float)
    fits = steps[steps * longest <= _LONGEST * spacing]
    return float(fits.max(initial=1.0))


def write_arrows(path: Path, sensor: SensorSpec, frames: list[PressFrame], *, device: str = "auto") -> None:
    """Draw markers at the end of held-out presses, a row a load and a column a model."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    probed = probe_sensor(sensor)
    order = ("surface", *(name for name in models_without_coat() if name != "fots_published"))
    presses = [list(group) for _, group in groupby(frames, key=lambda frame: frame.press.name)]
    rows = []
    for load in LOADS:
        chosen = next((press for press in presses if press[-1].load == load or load == "normal"), None)
        if chosen is not None:
            last = max(k for k, frame in enumerate(chosen) if frame.load == load)
            rows.append((load, chosen[: last + 1]))
    resolution = probed.camera.resolution
    with rc_context(STYLE):
        size = (1.8 * len(order) + 0.1, len(rows) * (1.8 * resolution[1] / resolution[0] + 0.24))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(rows), len(order), squeeze=False)
        for (load, press), line in zip(rows, grid, strict=True):
            magnified, truth = None, None
            for axes, model in zip(line, order, strict=True):
                label, colour = _look(model)
                tracker = MarkerTracker(probed, model, press[0].surface.grid, device=device)
                markers = [tracker.update(frame.surface) for frame in press][-1]
                magnified = draw_arrows(axes, markers, resolution, magnified=magnified, colour=colour)
                _outline(axes, tracker, press[-1])
                if truth is None:
                    truth = markers.displacement[0]
                    axes.set_title(f"{load}: {label}, × {magnified:g}", fontsize=7)
                else:
                    error = 1e6 * np.linalg.norm(markers.displacement[0] - truth, axis=1).mean()
                    axes.set_title(f"{label}, off by {error:.0f} µm", fontsize=7)
        figure.savefig(path, dpi=250)


def _outline(axes: Axes, tracker: MarkerTracker, frame: PressFrame) -> None:
    """Draw the edge of the contact."""
    surface = frame.surface
    if not surface.contact[0].any():
        return
    x, y = np.meshgrid(surface.grid.x, surface.grid.y)
    pixel = tracker.pattern.camera.project(np.stack([x, y, surface.height[0]], axis=-1))
    axes.contour(pixel[..., 0], pixel[..., 1], surface.contact[0].astype(float), levels=[0.5], colors="#cc79a7", linewidths=0.7)


def write_errors(path: Path, report: MotionReport) -> None:
    """Draw mean error and 95th percentile of every model by load, beside the motion's size."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    models = list(dict.fromkeys(row.model for row in report.errors))
    loads = list(dict.fromkeys(row.load for row in report.errors))
    with rc_context(STYLE):
        figure = Figure(figsize=(3.5, 2.4), layout="constrained")
        axes = figure.subplots()
        width = 0.8 / (len(models) + 1)
        for k, model in enumerate(models):
            label, colour = _look(model)
            rows = {row.load: row for row in report.errors if row.model == model}
            x = np.arange(len(loads)) + (k - 0.5 * len(models)) * width
            mean = [1e6 * rows[load].mean for load in loads]
            axes.bar(x, mean, 0.92 * width, color=colour, label=label)
            axes.plot(x, [1e6 * rows[load].p95 for load in loads], "_", color=colour, markersize=7)
        motion = {row.load: row.size for row in report.errors}
        x = np.arange(len(loads)) + 0.5 * len(models) * width
        axes.bar(x, [1e6 * motion[load] for load in loads], 0.92 * width, color="0.8", label="the motion itself")
        axes.axhline(30, color="0.4", linewidth=0.6, linestyle=(0, (4, 3)))
        axes.set_xticks(range(len(loads)), loads)
        axes.set_ylabel("distance [µm]: mean, 95 % (dash)")
        axes.legend(frameon=False, ncols=2, loc="upper left")
        axes.set_ylim(0, 1.35 * axes.get_ylim()[1])
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(path, dpi=250)
