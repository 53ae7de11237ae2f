"""``raytac compare-real``: optical modes against photographs of other presses."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from raytac.calibrate.drift import Settled, settled
from raytac.calibrate.grain import measured_grain
from raytac.calibrate.model_fits import ALONE
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.presses import RealPresses, Split, by_half, by_press, shallow_to_deep
from raytac.calibrate.ray_fit import FEWEST
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.io.progress import Progress
from raytac.report.real_drift import drift_metrics, drift_rows, grain_metrics, session_lines
from raytac.report.real_fits import ABLATIONS, RealFits, RealSettings
from raytac.report.real_imprints import imprint_table
from raytac.report.real_scores import noise_floor, press_rows
from raytac.specs import SensorSpec

SHOWN = 3
"""Presses on the image sheet: in true colour, with their noise, more make a large file."""

_LOG = logging.getLogger("raytac")


def compare_real(
    sensor: SensorSpec, presses: RealPresses, shots: Photographs, out: Path, settings: RealSettings, *, began: float | None = None
) -> list[Path]:
    """Fit, test and write ``real.md``, ``real.png``, tables and ``metrics.json`` to ``out``.

    ``shots`` are the ``presses``. Those at the border are fitted with the others, and tested apart: keys ``border.…``.

    Raises:
        InputError: a split that leaves too few presses, or a folder that cannot be written.
        BackendError: the ray tracer cannot run on ``settings.device``.
    """
    resolve_device(settings.device)
    began = time.perf_counter() if began is None else began
    whole = shots.fully_visible
    splits = real_splits(presses, whole, settings)
    for kind, (train, _) in splits:  # now, and not after the fits before it
        _check_count(kind, int(whole[train].sum()), settings)
    ablations = list(ABLATIONS) if settings.ablations else []
    with result_folder(out) as folder:  # before the fits, so that a folder that cannot be written is refused at once
        with Progress(total=len(splits) + len(ablations), desc="fits") as bar:
            fits = RealFits(sensor, presses, shots, settings, bar)
            for kind, split in splits:
                fits.run_split(kind, split)
                bar.update()
            for name in ablations:
                fits.run_ablation(name, splits[0][1])
                bar.update()
        steady = settled(sensor, shots.take(whole), drift=settings.drift)
        metrics = fits.metrics(splits[0][1]) | _session_metrics(sensor, shots.take(whole), steady)
        metrics["outliers"] = ", ".join(fits.outliers)
        for name, reason in fits.outliers.items():
            _LOG.info("press %s is an outlier: %s", name, reason)
        head: dict[str, Metric] = {
            "command": "compare-real",
            "device": fits.device,
            "seed": settings.seed,
            "sensor": sensor.name,
            "presses": int(whole.sum()),
            "presses_at_border": int((~whole).sum()),
            "drift": int(settings.drift),
            "folds": settings.folds,
            "tested_folds": len(fits.priors["press"]),
            "shadows": int(settings.shadows),
            "imprints": ", ".join(settings.imprints),
            "imprint_level": settings.level,
            "starts": settings.starts,
            "rounds": settings.rounds,
            "leds": len(sensor.lights.leds),
            "start_lights": "at walls" if sensor.lights.source is None else sensor.lights.source.stem,
            **versions(),
        }
        (folder / "real.md").write_text(table_text(metrics, ablations), "utf-8")
        rows = drift_rows(tuple(presses.names[k] for k in np.flatnonzero(whole)), steady.drift)
        (folder / "drift.csv").write_text("\n".join(rows) + "\n", "utf-8")
        (folder / "presses.csv").write_text("\n".join(press_rows(fits.tested, fits.scores)) + "\n", "utf-8")
        images = fits.images
        shown = sorted(images)[len(images) // (2 * SHOWN) :: max(1, len(images) // SHOWN)][:SHOWN]
        draw(shots.presses[shown], [images[k] for k in shown], [shots.circles[k] for k in shown], folder / "real.png")
        write_metrics(folder / "metrics.json", head | metrics | {"wall_s": time.perf_counter() - began})
    return [out / name for name in ("real.md", "real.png", "drift.csv", "presses.csv", "metrics.json")]


def _check_count(kind: str, count: int, settings: RealSettings) -> None:
    """Raise ``InputError`` for a split with too few fully visible presses to fit to."""
    least = FEWEST if settings.prior is not None else 2 * FEWEST  # a choice halves them again
    if count < least:
        rule = f"are too few to fit the split {kind!r} to: at least {least}"
        if count >= FEWEST:
            rule += f", or {FEWEST} with a named prior"
        raise InputError("presses", value=count, rule=rule)


def _session_metrics(sensor: SensorSpec, whole: Photographs, steady: Settled) -> dict[str, Metric]:
    """Noise, drift and grain of the fully visible photographs; ``steady``: after their drift."""
    level = float(steady.shots.background.mean())
    metrics: dict[str, Metric] = {
        "noise_floor": noise_floor(sensor, whole),
        "noise_settled": noise_floor(sensor, steady.shots),  # against the image at rest of all modes, drift removed
    }
    metrics |= drift_metrics(steady.drift, steady.background, level)
    return metrics | grain_metrics(measured_grain(sensor, steady), level)


def real_splits(presses: RealPresses, whole: np.ndarray, settings: RealSettings) -> list[tuple[str, Split]]:
    """Splits by name; ``whole`` (N,) marks presses that are fully visible.

    Those and the presses at the border are split apart, so that folds of the former do not depend on the latter. From half to half,
    and from shallow to deep, presses at the border are only fitted.
    """
    inner, edge = np.flatnonzero(whole), np.flatnonzero(~whole)
    splits: list[tuple[str, Split]] = []
    for fold, (train, test) in enumerate(by_press(len(inner), settings.folds)[: settings.tested]):
        held_out = np.arange(len(edge)) % settings.folds == fold
        own = np.concatenate([inner[train], edge[~held_out]]), np.concatenate([inner[test], edge[held_out]])
        splits.append(("press", own))
    if settings.regions:
        visible = presses.take(inner)
        middle, relative = presses.resolution[0] / 2, presses.circles[:, 2] / presses.ball_radius
        is_left = presses.circles[edge, 0] < middle
        deepest = shallow_to_deep(visible)
        for kind, (train, test), also in (
            ("left_right", by_half(visible)[0], is_left),
            ("right_left", by_half(visible)[1], ~is_left),
            ("shallow_deep", deepest, relative[edge] <= relative[inner[deepest[0]]].max()),
        ):
            splits.append((kind, (np.concatenate([inner[train], edge[also]]), inner[test])))
    return splits


def check_folds(presses: RealPresses, folds: int) -> None:
    """Raise ``InputError`` for folds that leave too few fully visible presses to fit to."""
    count = int(presses.fully_visible.sum())
    if count - -(-count // max(folds, 1)) < FEWEST:
        raise InputError("presses", value=count, rule=f"are too few for {folds} folds: {FEWEST} must be left to fit to")


_ROWS = (
    ("raytrace", "ray tracer"),
    (ALONE, "ray tracer, no photograph"),
    ("taxim", "table"),
    ("mlp", "network"),
    ("phong", "Phong"),
    ("background", "background only"),
)
_SPLITS = (("left_right.", "left half → right"), ("right_left.", "right half → left"), ("shallow_deep.", "shallow → deep"))


def table_text(metrics: Mapping[str, Metric], ablations: Sequence[str]) -> str:
    """Markdown tables of the figures; errors in levels of 255."""

    def cell(key: str, digits: str = ".2f") -> str:
        value = metrics.get(key)
        return "–" if value is None else format(value, digits)

    measures = (
        "contact MAE | contact RMSE | ring MAE | box PSNR [dB] | box SSIM | frame MAE | contact, ring MAE, labelled circles"
    )
    lines = [f"| mode | {measures} | ms |", "|" + "---|" * 9]
    for key, name in _ROWS:
        cells = [cell(f"{key}.{m}") for m in ("contact_mae", "contact_rmse", "ring_mae", "box_psnr")]
        cells += [
            cell(f"{key}.box_ssim", ".3f"),
            cell(f"{key}.frame_mae"),
            cell(f"labelled.{key}.contact_mae") + ", " + cell(f"labelled.{key}.ring_mae"),
            cell(f"{key}.ms", ".1f"),
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"Noise floor: {cell('noise_floor')}, against the mean image at rest: {cell('noise_settled')}.", ""]
    shown = [(prefix, name) for prefix, name in _SPLITS if f"{prefix}raytrace.contact_mae" in metrics]
    if shown:
        lines += ["| contact MAE (ring MAE) | " + " | ".join(name for _, name in shown) + " |", "|" + "---|" * (len(shown) + 1)]
        for key, name in _ROWS:
            cells = [f"{cell(f'{prefix}{key}.contact_mae')} ({cell(f'{prefix}{key}.ring_mae')})" for prefix, _ in shown]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        lines.append("")
    if "border.raytrace.contact_mae" in metrics:
        lines += ["| held-out presses at the border | contact MAE | ring MAE |", "|---|---|---|"]
        for key, name in _ROWS:
            lines.append(f"| {name} | {cell(f'border.{key}.contact_mae')} | {cell(f'border.{key}.ring_mae')} |")
        lines.append("")
    lines += session_lines(metrics)
    lines += imprint_table(metrics)
    if ablations:
        lines += ["| ray tracer, first fold | contact MAE | ring MAE |", "|---|---|---|"]
        for name in ("nothing", *ablations):
            row = f"ablation.{name}"
            text = "nothing left out" if name == "nothing" else name.replace("_", " ")
            lines.append(f"| {text} | {cell(f'{row}.contact_mae')} | {cell(f'{row}.ring_mae')} |")
        lines.append("")
    return "\n".join(lines)


def draw(
    real: np.ndarray, images: list[dict[str, np.ndarray]], circles: list[np.ndarray], path: Path, labels: Sequence[str] = ()
) -> None:
    """Draw a row a press, cut to the contact: photograph, modes, signed errors (grey is none).

    ``labels``: text at the left of each row.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    modes = [(key, name) for key, name in _ROWS if key in images[0] and key not in (ALONE, "background")]
    columns = [
        "photograph",
        *(name for _, name in modes),
        *(f"{name}, error × 4" if len(modes) > 1 else "error × 4" for _, name in modes),
    ]
    with rc_context({"font.size": 6.5}):
        figure = Figure(figsize=(1.1 * len(columns), 1.12 * len(real)), layout="constrained")
        axes = figure.subplots(len(real), len(columns), squeeze=False)
        for line, photo, own, (x, y, r) in zip(axes, real, images, circles, strict=True):
            low_x, low_y = (max(0, int(c - 2.2 * r)) for c in (x, y))
            box = np.s_[low_y : int(y + 2.2 * r), low_x : int(x + 2.2 * r)]
            shown = [photo, *(own[key] for key, _ in modes), *(128 + 4 * (own[key].astype(float) - photo) for key, _ in modes)]
            for axis, image in zip(line, shown, strict=True):
                axis.imshow(np.clip(image[box], 0, 255).astype(np.uint8))
                axis.set(xticks=[], yticks=[])
            circle = Circle(
                (x - low_x - 0.5, y - low_y - 0.5), r, fill=False, color="white", linewidth=0.5, linestyle=(0, (4, 4))
            )
            line[0].add_patch(circle)
        for axis, name in zip(axes[0], columns, strict=True):
            axis.set_title(name)
        for axis, label in zip(axes[:, 0], labels, strict=False):
            axis.set_ylabel(label)
        figure.savefig(path, dpi=110)
