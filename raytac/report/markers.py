"""Calibrate a pad's marker motion and write its folder: the fitted file, errors on held-out presses as table and figures, metrics."""

from __future__ import annotations

import datetime
import math
import time
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io.folder import result_folder
from raytac.io.metrics import VERSIONED, Metric, versions, write_metrics
from raytac.io.progress import Progress
from raytac.markers.calibration import PUBLISHED
from raytac.report.measure import machine
from raytac.specs.marker_motion import MarkerMotionSpec, load_marker_motion, marker_motion_text
from raytac.specs.press import PADS
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.markers.calibration import ModelError
    from raytac.markers.calibration_presses import Press, PressFrame
    from raytac.report.press_store import PressStore
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.markers.tracker import MARKER_MODELS, MarkerFrame, MarkerTracker

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from raytac.markers.calibration_presses import PressFrame
    from raytac.report.markers import MotionReport

__all__ = [
    "FILES",
    "TESTED",
    "MotionReport",
    "calibrate_markers",
    "draw_arrows",
    "error_metrics",
    "error_table",
    "motion_metrics",
    "press_all",
    "run_calibrate_markers",
    "write_arrows",
    "write_errors",
]


FILES = ("marker_motion.toml", "errors.md", "errors.png", "arrows.png", "metrics.json")
"""Every file that a calibration writes."""
TESTED = ("fots", PUBLISHED, "superposition", "force_field")
"""Models that are compared with surface tracking."""


@dataclass(frozen=True)
class MotionReport:
    """A fit and what it is worth."""

    motion: MarkerMotionSpec
    errors: list[ModelError]
    """On held-out presses."""
    fit_errors: list[ModelError]
    """Of FOTS, and of FOTS as published, on the presses that both were fitted to."""
    by_press: list[tuple[str, ModelError]]
    """Of FOTS on every press, in words, under its last kind of load; those of the fit first."""
    times_ms: dict[str, float]
    """Median time of a frame of every model, at the probes."""
    probes: int
    held_out: list[PressFrame]


def run_calibrate_markers(
    sensor: SensorSpec, out: Path, *, pad: str, quick: bool, device: str, seed: int, start: float, progress: bool = True
) -> list[Path]:
    """Press the simulated pad, fit, test on held-out presses, and write ``FILES`` to ``out``; returns the files written.

    Finished presses are kept in ``presses`` of ``out``, also where an error or an interrupt ends the run; a later one does not press them
    again.

    Raises:
        RaytacError: a press did not settle.
        SpecError: a press fits nowhere on this sensor.
        InputError: an unknown ``pad`` or ``device``, or ``out`` cannot be written.
        BackendError: the solver or Dr.Jit cannot run.
    """
    if pad not in PADS:
        raise InputError("pad", value=pad, rule="must be a known level", choices=PADS)
    solver = resolve_device(device, ray_tracing=False)
    from raytac.markers.calibration_presses import FIT, HELD_OUT, QUICK_FIT, QUICK_HELD_OUT
    from raytac.report.markers import write_arrows, write_errors
    from raytac.report.press_store import PressStore, press_code

    with result_folder(out, FILES) as folder:
        fit, held_out = (QUICK_FIT, QUICK_HELD_OUT) if quick else (FIT, HELD_OUT)
        began = time.perf_counter()
        store = PressStore(out / "presses", sensor.gelpad, pad=pad, device=solver, code=press_code(), say=Progress.write)
        pressed = press_all(sensor, (*fit, *held_out), pad, device, progress=progress, store=store)
        press_s = time.perf_counter() - began
        names = {press.name for press in fit}
        report = calibrate_markers(
            sensor,
            [frame for frame in pressed if frame.press.name in names],
            [frame for frame in pressed if frame.press.name not in names],
            pad=pad,
            device=device,
        )
        (folder / "marker_motion.toml").write_text(marker_motion_text(report.motion), encoding="utf-8")
        load_marker_motion(folder / "marker_motion.toml")  # what is written can be read
        (folder / "errors.md").write_text(error_table(report), encoding="utf-8")
        write_errors(folder / "errors.png", report)
        write_arrows(folder / "arrows.png", replace(sensor, marker_motion=report.motion), report.held_out, device=device)
        metrics = motion_metrics(report) | {"sensor": sensor.name, "pad": pad, "seed": seed, "press_s": press_s}
        metrics |= {"presses": len(names) + len(held_out), "presses_reused": store.reused}
        metrics |= {"device": device, **versions((*VERSIONED, "warp-lang")), **machine()}
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
        found = sorted(path.name for path in folder.iterdir())
    return [Path(out) / name for name in found]


def press_all(
    sensor: SensorSpec, presses: tuple[Press, ...], pad: str, device: str, *, progress: bool, store: PressStore | None = None
) -> list[PressFrame]:
    """States of all presses on the simulated pad of level ``pad``, in order.

    ``progress``: show a bar. ``store``: finished presses, which are not pressed again; None keeps none.

    Raises:
        SpecError: a press fits nowhere on this sensor; said before any is pressed.
        RaytacError: a press did not settle.
        BackendError: the solver cannot run on ``device``.
    """
    from raytac.markers.calibration_presses import press_frames, simulate_press
    from raytac.specs import validate_press

    for press in presses:
        validate_press(sensor, press.scene())
    solver = resolve_device(device, ray_tracing=False)
    frames: list[PressFrame] = []
    for press in Progress(presses, desc=f"press {sensor.name}", unit="press", show=progress):
        states = None if store is None else store.read(press)
        if states is None:
            states = simulate_press(sensor, press, pad=pad, device=solver)
            if store is not None:
                store.write(press, states)
        frames += press_frames(sensor, press, states)
    return frames


def calibrate_markers(
    sensor: SensorSpec, fit: list[PressFrame], held_out: list[PressFrame], *, pad: str, device: str = "auto"
) -> MotionReport:
    """Fit to ``fit`` and test on ``held_out``: whole presses, in order, of the simulated pad of level ``pad``."""
    from raytac.markers.calibration import ProbeData, fit_motion, model_errors, probe_sensor

    data = ProbeData.of(sensor, fit)
    motion = fit_motion(data, device=device)
    fitted = replace(sensor, marker_motion=motion)
    grid = fit[0].surface.grid
    errors, times = model_errors(fitted, held_out, grid, models=TESTED, device=device)
    fit_errors, _ = model_errors(fitted, fit, grid, models=("fots", PUBLISHED), device=device)
    by_press = []
    for name, group in groupby([*fit, *held_out], key=lambda frame: str(frame.press)):
        rows, _ = model_errors(fitted, list(group), grid, models=("fots",), device=device)
        by_press.append((name, rows[-1]))
    markers = probe_sensor(sensor).markers
    report = MotionReport(motion, errors, fit_errors, by_press, times, markers.rows * markers.columns, held_out)
    return replace(report, motion=replace(motion, provenance=_provenance(sensor, report, fit, held_out, pad, device)))


def _provenance(
    sensor: SensorSpec, report: MotionReport, fit: list[PressFrame], held_out: list[PressFrame], pad: str, device: str
) -> str:
    def listed(frames: list[PressFrame]) -> list[str]:
        return [f"  {press}" for press in dict.fromkeys(str(frame.press) for frame in frames)]

    def errors(rows: list[ModelError], model: str) -> str:
        return ", ".join(f"{row.load} {1e6 * row.mean:.1f} um" for row in rows if row.model == model)

    gelpad = sensor.gelpad
    return "\n".join(
        [
            f"Fitted {datetime.date.today().isoformat()} to surface tracking on the simulated pad, level {pad}, of {sensor.name}:",
            f"E {1e-3 * gelpad.youngs_modulus:g} kPa, nu {gelpad.poisson_ratio:g}, friction {gelpad.friction:g}, held at "
            f"{gelpad.bonded}.",
            f"By {', '.join(_made_by(device))}.",
            "Presses of the fit:",
            *listed(fit),
            "Presses held out:",
            *listed(held_out),
            f"Mean distance of FOTS, {report.probes} probes on a 1 mm grid, on the fit: {errors(report.fit_errors, 'fots')};",
            f"held out: {errors(report.errors, 'fots')}.",
            f"Without [punch], as published, on the fit: {errors(report.fit_errors, PUBLISHED)};",
            f"held out: {errors(report.errors, PUBLISHED)}.",
        ]
    )


def _made_by(device: str) -> list[str]:
    """Versions of what the fit depends on, and where the pad was simulated."""
    found = versions(("raytac", "warp-lang", "drjit", "numpy"))
    names = [f"{key.split('.', 1)[1]} {value}" for key, value in found.items() if key != "versions.python"]
    return [*names, f"simulated on {resolve_device(device, ray_tracing=False)}"]


def motion_metrics(report: MotionReport) -> dict[str, Metric]:
    """Constants and errors as flat keys."""
    metrics: dict[str, Metric] = {"command": "calibrate-markers", "markers.probes": report.probes}
    motion = report.motion
    for name in ("dilate_gain", "dilate_lambda", "shear_lambda", "shear_max", "twist_lambda", "twist_max"):
        metrics[f"fots.{name}"] = getattr(motion, name)
    if motion.punch is not None:
        metrics |= {f"punch.{name}": getattr(motion.punch, name) for name in ("anisotropy", "reach", "slip")}
    for name in ("field_gain", "field_shear", "field_friction"):
        metrics[name.replace("_", ".", 1)] = getattr(motion, name)
    for part, rows in (("held_out", report.errors), ("fit", report.fit_errors)):
        for row in rows:
            metrics |= error_metrics(f"{part}.{row.model}.{row.load}", row)
    return metrics | {f"{model}.ms_per_frame": value for model, value in report.times_ms.items()}


def error_metrics(key: str, row: ModelError) -> dict[str, Metric]:
    """Figures of one model and kind of load as ``<key>.<figure>``."""
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


_STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7,
}
_LABELS = {
    "surface": "surface tracking",
    "fots": "FOTS",
    "fots_published": "FOTS as published",
    "superposition": "superposition",
    "force_field": "force field",
}
_COLOURS = {
    "surface": "#1b1b1b",
    "fots": "#0072b2",
    "fots_published": "#56b4e9",
    "superposition": "#009e73",
    "force_field": "#d55e00",
}
_LONGEST = 1.6
"""Length of the longest arrow in a plot, in spacings of the markers."""


def draw_arrows(
    axes: Axes,
    markers: MarkerFrame,
    resolution: tuple[int, int],
    *,
    magnified: float | None = None,
    colour: str = "#1b1b1b",
    image: np.ndarray | None = None,
) -> float:
    """Displacement in the image as arrows from the markers' places at rest, environment 0; returns how much they are magnified.

    ``magnified``: by what factor; None picks 1, 2, 5, 10 … so that the longest is about as long as markers are apart. ``image``: shown
    underneath, (H, W, 3) uint8.
    """
    width, height = resolution
    rest, way = markers.rest_px[0], markers.displacement_px[0]
    seen = np.isfinite(way).all(axis=1)
    if magnified is None:
        magnified = _magnification(rest, way[seen])
    if image is not None:
        axes.imshow(image, extent=(0, width, height, 0), interpolation="nearest")
    axes.plot(*rest.T, ".", color="0.75" if image is None else "white", markersize=1.2, zorder=1)
    axes.quiver(
        *rest[seen].T,
        *(magnified * way[seen]).T,
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
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    axes.set_xticks(())
    axes.set_yticks(())
    return magnified


def _magnification(rest: np.ndarray, way: np.ndarray) -> float:
    """1, 2, 5, 10 … at which the longest arrow is not much longer than neighbouring markers are apart."""
    longest = float(np.linalg.norm(way, axis=1).max(initial=0.0))
    apart = np.linalg.norm(rest[:, None] - rest[None], axis=-1)
    spacing = float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))
    steps = np.array([1, 2, 5, 10, 20, 50, 100], float)
    fits = steps[steps * longest <= _LONGEST * spacing]
    return float(fits.max(initial=1.0))


def write_arrows(path: Path, sensor: SensorSpec, frames: list[PressFrame], *, device: str = "auto") -> None:
    """One row a kind of load, at the end of a held-out press; one column a model. ``sensor`` has the marker motion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from raytac.markers.calibration import probe_sensor
    from raytac.markers.calibration_presses import LOADS

    probed = probe_sensor(sensor)
    order = ("surface", *(name for name in MARKER_MODELS if name != "surface"))
    presses = [list(group) for _, group in groupby(frames, key=lambda frame: frame.press.name)]
    rows = []
    for load in LOADS:
        chosen = next((press for press in presses if press[-1].load == load or load == "normal"), None)
        if chosen is not None:
            last = max(k for k, frame in enumerate(chosen) if frame.load == load)
            rows.append((load, chosen[: last + 1]))
    resolution = probed.camera.resolution
    with plt.rc_context(_STYLE):
        size = (1.8 * len(order) + 0.1, len(rows) * (1.8 * resolution[1] / resolution[0] + 0.24))
        figure, grid = plt.subplots(len(rows), len(order), figsize=size, squeeze=False, layout="constrained")
        for (load, press), line in zip(rows, grid, strict=True):
            magnified, truth = None, None
            for axes, model in zip(line, order, strict=True):
                tracker = MarkerTracker(probed, model, press[0].surface.grid, device=device)
                markers = [tracker.update(frame.surface) for frame in press][-1]
                magnified = draw_arrows(axes, markers, resolution, magnified=magnified, colour=_COLOURS[model])
                _outline(axes, tracker, press[-1])
                if truth is None:
                    truth = markers.displacement[0]
                    axes.set_title(f"{load}: {_LABELS[model]}, × {magnified:g}", fontsize=7)
                else:
                    off = 1e6 * np.linalg.norm(markers.displacement[0] - truth, axis=1).mean()
                    axes.set_title(f"{_LABELS[model]}, off by {off:.0f} µm", fontsize=7)
        figure.savefig(path, dpi=250)
        plt.close(figure)


def _outline(axes: Axes, tracker: MarkerTracker, frame: PressFrame) -> None:
    """The contact's edge in the image."""
    surface = frame.surface
    if not surface.contact[0].any():
        return
    x, y = np.meshgrid(surface.grid.x, surface.grid.y)
    pixel = tracker.pattern.camera.project(np.stack([x, y, surface.height[0]], axis=-1))
    axes.contour(pixel[..., 0], pixel[..., 1], surface.contact[0].astype(float), levels=[0.5], colors="#cc79a7", linewidths=0.7)


def write_errors(path: Path, report: MotionReport) -> None:
    """Mean error of every model by kind of load, with the 95th percentile, beside the size of the motion itself."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    models = [name for name in _LABELS if name in {row.model for row in report.errors}]
    loads = list(dict.fromkeys(row.load for row in report.errors))
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(figsize=(3.5, 2.4), layout="constrained")
        wide = 0.8 / (len(models) + 1)
        for k, model in enumerate(models):
            rows = {row.load: row for row in report.errors if row.model == model}
            x = np.arange(len(loads)) + (k - 0.5 * len(models)) * wide
            mean = [1e6 * rows[load].mean for load in loads]
            axes.bar(x, mean, 0.92 * wide, color=_COLOURS[model], label=_LABELS[model])
            axes.plot(x, [1e6 * rows[load].p95 for load in loads], "_", color=_COLOURS[model], markersize=7)
        still = {row.load: row.size for row in report.errors}
        x = np.arange(len(loads)) + 0.5 * len(models) * wide
        axes.bar(x, [1e6 * still[load] for load in loads], 0.92 * wide, color="0.8", label="the motion itself")
        axes.axhline(30, color="0.4", linewidth=0.6, linestyle=(0, (4, 3)))
        axes.set_xticks(range(len(loads)), loads)
        axes.set_ylabel("distance [µm]: mean, 95 % (dash)")
        axes.legend(frameon=False, ncols=2, loc="upper left")
        axes.set_ylim(0, 1.35 * axes.get_ylim()[1])
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        figure.savefig(path, dpi=250)
        plt.close(figure)
