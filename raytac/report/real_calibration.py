"""``raytac calibrate DATASET``: fit one optical mode to real presses, with errors on others."""

from __future__ import annotations

import dataclasses
import datetime
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from raytac.calibrate.direct_fit import FitSettings
from raytac.calibrate.drift import no_drift
from raytac.calibrate.grain import measured_grain
from raytac.calibrate.model_fits import ALONE, SHADOW_TABLES, check_fit, fit_models, images_of
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.prior_choice import INNER
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.io.progress import Progress
from raytac.optics.image.mlp import MlpMode
from raytac.optics.image.mlp_weights import save_mlp
from raytac.optics.taxim.folder import CALIBRATION_FILES, save_calibration
from raytac.optics.taxim.mode import TaximMode
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.tracer import Tracer
from raytac.report.real import draw
from raytac.report.real_drift import drift_metrics, drift_rows, grain_metrics
from raytac.report.real_scores import outliers, press_scores, summary
from raytac.specs import SensorSpec
from raytac.specs.sensor import NoiseSpec, OpticsSpec
from raytac.specs.sensor_file import lights_text, sensor_files

FITTED = ("raytrace", "taxim", "mlp")
"""Models that photographs are fitted by; Phong's has nothing to fit."""
FILES = (
    *CALIBRATION_FILES,
    "fit.png",
    "mlp.npz",
    "lights.toml",
    "sensor.toml",
    "marker_motion.toml",
    "circles.csv",
    "drift.csv",
    "metrics.json",
)

_LOG = logging.getLogger("raytac")
_SHOWN = 4
"""Presses in ``fit.png``."""


def run_calibrate_optics(
    sensor: SensorSpec,
    shots: Photographs,
    names: tuple[str, ...],
    out: Path,
    *,
    model: str,
    data: str,
    holdout: int,
    starts: int,
    rounds: int,
    prior: str | None,
    shadows: bool,
    device: str,
    seed: int,
    start: float,
    shadow_table: str = SHADOW_TABLES[0],
    drift: bool = True,
) -> list[Path]:
    """Fit ``model`` to all but every ``holdout``-th of ``shots`` and write it to ``out``.

    Of fully visible presses and of those at the border every ``holdout``-th is held out; the latter have scores of their own. ``drift``:
    session drift is part of the model. An error leaves nothing there.

    Raises:
        InputError: an unknown model, device or strength of priors, ``holdout`` of 1 or less than 0, too few presses, fewer than
            ``holdout`` too, or a folder that cannot be written.
        BackendError: the ray tracer cannot run on ``device``.
    """
    if model not in FITTED:
        raise InputError("model", value=model, rule="must be one that can be fitted", choices=FITTED)
    if shadow_table != SHADOW_TABLES[0] and model != "taxim":
        raise InputError("shadow_table", value=shadow_table, rule=f"belongs to the model 'taxim', not to {model!r}: leave it out")
    check_fit(prior=prior, shadow_table=shadow_table, device=device, starts=starts, rounds=rounds)
    resolve_device(device)
    if int(holdout) != holdout or holdout < 0 or holdout == 1:
        raise InputError("holdout", value=holdout, rule="must be 0 or a whole number >= 2")
    whole = shots.fully_visible
    if holdout > whole.sum():
        rule = f"are too few to hold out every {holdout}th: name a smaller holdout, or 0 for none"
        raise InputError("presses", value=int(whole.sum()), rule=rule)
    index = np.arange(len(whole))
    rank = np.where(whole, np.cumsum(whole), np.cumsum(~whole)) - 1
    is_test = rank % holdout == holdout - 1 if holdout else np.zeros(len(index), bool)
    train, test = shots.take(index[~is_test]), shots.take(index[is_test])
    with result_folder(out, FILES) as folder:  # before the fit, so that a folder that cannot be written is refused at once
        with Progress(desc=f"calibrate {model}", unit="step") as bar:
            models = fit_models(
                sensor,
                train,
                settings=FitSettings(fixed=("gamma",)),
                modes=(model, ALONE) if model == "raytrace" else (model,),
                device=device,
                seed=seed,
                starts=starts,
                rounds=rounds,
                prior=prior,
                shadow_table=shadow_table,
                drift=drift,
                tracing=RayTraced(shadows=shadows),
                tick=bar.fit_step,
            )
        mode, fitted = models.modes[model], models.fitted
        metrics: dict[str, Metric] = {
            "command": "calibrate",
            "model": model,
            "device": mode.device,
            "seed": seed,
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "data": data,
            "sensor": sensor.name,
            "holdout": holdout,
            "shadows": int(shadows),
            "shadow_table": shadow_table,
            "starts": starts,
            "rounds": rounds,
            "prior": models.prior,
            "prior_asked": INNER if prior is None else prior,
            "leds": len(sensor.lights.leds),
            "start_lights": "at walls" if sensor.lights.source is None else sensor.lights.source.stem,
            "presses.fitted": int((~is_test).sum()),
            "presses.held_out": int(is_test.sum()),
            "presses.at_border": int((~whole).sum()),
            "drift": int(drift),
            **versions(),
        }
        circles = shots.circles.copy()
        circles[~is_test] = fitted.state.circles
        if is_test.any():
            circles[is_test] = models.circles(test)
        drifts = no_drift(len(index))
        for chosen, own in ((~is_test, models.settled.drift), (is_test, models.drift(test))):
            drifts.gain[chosen], drifts.offset[chosen] = own.gain, own.offset
        fitted_errors, shown = np.empty(0), None
        for name, one in models.modes.items():
            for part, chosen, some in (("fitted", ~is_test, train), ("held_out", is_test, test)):
                if not chosen.any():
                    continue
                images = drifts.take(chosen).applied(
                    images_of(one, models.sensor_of(name), some, circles[chosen], fitted.state.slopes)
                )
                scores = press_scores(sensor, images, some)
                key = part if name == model else f"{part}.alone"
                for prefix, of in ((key, whole[chosen]), (f"border.{key}", ~whole[chosen])):
                    if of.any():
                        mean = summary([score for score, is_of in zip(scores, of, strict=True) if is_of])
                        metrics |= {f"{prefix}.{measure}": value for measure, value in mean.items()}
                if key == "fitted":
                    fitted_errors = np.array([score["contact_mae"] for score in scores])
                if name == model:  # the held-out ones, where there are some
                    errors = np.array([score["contact_mae"] for score in scores])
                    shown = some, images, circles[chosen], errors, [names[k] for k in index[chosen]]
        metrics |= {f"cost.round_{k}": cost for k, cost in enumerate(fitted.costs)}
        bad = outliers([names[k] for k in index[~is_test]], fitted_errors, fitted.state.circles, train)
        metrics["outliers"] = ", ".join(bad)
        for name, reason in bad.items():
            _LOG.info("press %s is an outlier: %s", name, reason)
        metrics |= drift_metrics(drifts, models.settled.background, float(models.rest.mean()))
        grain = measured_grain(sensor, models.settled)
        metrics |= grain_metrics(grain, float(models.rest.mean()))
        if model == "raytrace":
            error = f"{metrics.get('held_out.contact_mae', metrics['fitted.contact_mae']):.2f}"
            what = "on held-out presses" if is_test.any() else "on the fitted presses"
            comment = f"Fitted to {(~is_test).sum()} presses of {data}: mean absolute error in the contact {error} of 255 {what}."
            (folder / "lights.toml").write_text(lights_text(fitted.sensor.lights, comment), "utf-8")
            alone = models.modes[ALONE]
            assert isinstance(alone, Tracer)
            written = dataclasses.replace(alone.sensor, optics=OpticsSpec(shadows=shadows), noise=grain or NoiseSpec())
            for name, text in sensor_files(written).items():
                (folder / name).write_text(text, "utf-8")
        elif isinstance(mode, TaximMode):
            save_calibration(mode.table, folder)
        elif isinstance(mode, MlpMode):
            save_mlp(mode.weights, folder / "mlp.npz")
        assert shown is not None
        _draw_fit(model, *shown, folder / "fit.png")
        rows = ["press,held_out,cx_px,cy_px,r_px"]
        rows += [f"{name},{int(h)},{x:.3f},{y:.3f},{r:.3f}" for name, h, (x, y, r) in zip(names, is_test, circles, strict=True)]
        (folder / "circles.csv").write_text("\n".join(rows) + "\n", "utf-8")
        (folder / "drift.csv").write_text("\n".join(drift_rows(names, drifts)) + "\n", "utf-8")
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
        written = sorted(path.name for path in folder.iterdir())
    return [out / name for name in written]


def _draw_fit(
    model: str,
    shots: Photographs,
    images: np.ndarray,
    circles: np.ndarray,
    errors: np.ndarray,
    names: Sequence[str],
    path: Path,
) -> None:
    """Draw presses from the best to the worst: photograph with its circle, fit, error."""
    order = np.argsort(errors)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(_SHOWN, len(order))).round().astype(int))]
    labels = [f"{names[k]}\nerror {errors[k]:.1f}" for k in chosen]
    draw(shots.presses[chosen], [{model: images[k]} for k in chosen], list(circles[chosen]), path, labels)


def calibration_table(metrics: Mapping[str, Metric]) -> str:
    """Markdown of a fit's errors, from what ``run_calibrate_optics`` wrote."""
    head = "| MAE in levels of 255 | contact MAE | ring MAE | whole image MAE | PSNR around the contact [dB] |"
    lines = [head, "|---|---|---|---|---|"]
    for key, text in (
        ("fitted", "fitted"),
        ("held_out", "held out"),
        ("border.fitted", "at the border, fitted"),
        ("border.held_out", "at the border, held out"),
    ):
        if f"{key}.contact_mae" in metrics:
            names = ("contact_mae", "ring_mae", "frame_mae", "box_psnr")
            lines.append(f"| {text} | " + " | ".join(f"{metrics[f'{key}.{name}']:.2f}" for name in names) + " |")
    return "\n".join(lines)
