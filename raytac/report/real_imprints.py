"""Imprints of balls by the physics of pads, under a fitted ray tracer, against photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from raytac.calibrate.ball_presses import pressed_balls
from raytac.calibrate.model_fits import GRID_PITCH, Models, images_of
from raytac.calibrate.photographs import Photographs
from raytac.checks import check_names
from raytac.io.metrics import Metric
from raytac.physics.base import PhysicsConfig
from raytac.physics.configs import Ipc, Rigid
from raytac.report.real_scores import press_scores, summary
from raytac.specs import SensorSpec

FITTED = "fitted"
"""The profile of slopes that was fitted with the lights."""
IMPRINTS = (FITTED, "rigid", "ipc")
AT_OVERLAP = "overlap"
"""Prefix of errors at the depth of the geometric overlap."""
_MODE = "raytrace"

Scores = dict[str, list[dict[str, float]]]
"""Errors and depths by press; names are those between ``imprint.`` and the measure."""


def check_imprints(names: Sequence[str]) -> tuple[str, ...]:
    """``names``, each once; raises ``InputError`` for one that is not in ``IMPRINTS``."""
    return tuple(dict.fromkeys(check_names("imprint", names, IMPRINTS)))


def imprint_scores(
    models: Models, pad_models: Models, sensor: SensorSpec, shots: Photographs, names: Sequence[str], *, level: str, device: str
) -> Scores:
    """Errors of the fitted ray tracer by imprint, of presses that were not fitted.

    A circle has its centre as refined by the lights and its radius as labelled. That is all that the imprint is told of a press.

    Args:
        models: lights fitted with a free profile of slopes, for ``FITTED``.
        pad_models: lights fitted under the rigid pad's profile, for the pads: lights fitted with a free one make up for what it takes over.
    """
    out: Scores = {}
    for name in names:
        lit = models if name == FITTED else pad_models
        circles = np.column_stack([lit.circles(shots)[:, :2], shots.circles[:, 2]])
        if name == FITTED:
            drift = models.drift(shots)
            own = models.fitted
            images = drift.applied(images_of(models.modes[_MODE], own.sensor, shots, circles, own.state.slopes))
            out[f"{name}.{_MODE}"] = press_scores(sensor, images, shots)
        else:
            physics: PhysicsConfig = Rigid() if name == "rigid" else Ipc(level=level)
            _press(out, name, pad_models, sensor, shots, circles, physics, device)
    return out


def _press(
    out: Scores,
    name: str,
    models: Models,
    sensor: SensorSpec,
    shots: Photographs,
    circles: np.ndarray,
    physics: PhysicsConfig,
    device: str,
) -> None:
    drift = models.drift(shots)
    keys = name, f"{name}.{_MODE}", f"{name}.{AT_OVERLAP}.{_MODE}"
    own, at_depth, at_overlap = (out.setdefault(key, []) for key in keys)
    balls = pressed_balls(models.fitted.sensor, circles, shots.radius, physics, pitch=GRID_PITCH, device=device)
    for k, ball in enumerate(balls):
        one = shots.take(np.array([k]))
        for scores, surface in ((at_overlap, ball.at_overlap), (at_depth, ball.surface)):
            if surface is not None:
                rgb = models.modes[_MODE].render(surface).rgb
                assert rgb is not None
                scores += press_scores(sensor, drift.take([k]).applied(rgb), one)
        reached = (
            {} if ball.surface is None else {"depth_over_overlap": ball.depth / ball.overlap_depth, "depth_mm": 1e3 * ball.depth}
        )
        own.append({"reached": float(ball.surface is not None), "overlap_depth_mm": 1e3 * ball.overlap_depth} | reached)


def imprint_metrics(scores: Scores) -> dict[str, Metric]:
    """Means over presses, those of depths over presses that reached their circle."""
    out: dict[str, Metric] = {}
    for key, of in scores.items():
        reached = [score for score in of if score.get("reached", 1.0)]
        if of and "reached" in of[0]:
            out[f"imprint.{key}.presses"], out[f"imprint.{key}.unreached"] = len(of), len(of) - len(reached)
            reached = [{k: v for k, v in score.items() if k != "reached"} for score in reached]
        if reached:
            out |= {f"imprint.{key}.{measure}": value for measure, value in summary(reached).items()}
    return out


def imprint_table(metrics: Mapping[str, Metric]) -> list[str]:
    """Markdown lines of the errors by imprint; empty without any."""
    rows = []
    for name, text in ((FITTED, "fitted to other presses"), ("rigid", "rigid pad"), ("ipc", "soft pad")):
        for at, which in (
            (f"{name}.{_MODE}", "edge as wide as the circle"),
            (f"{name}.{AT_OVERLAP}.{_MODE}", "overlap as wide"),
        ):
            errors = [
                metrics.get(f"imprint.{at}.{measure}") for measure in ("contact_mae", "contact_rmse", "ring_mae", "frame_mae")
            ]
            if errors[0] is None:
                continue
            kind = "depth" if which.startswith("edge") else "overlap_depth"
            depth = metrics.get(f"imprint.{name}.{kind}_mm")
            own = [f"{error:.2f}" for error in errors]
            unreached = metrics.get(f"imprint.{name}.unreached") if kind == "depth" else None
            missing = f", {unreached} presses without such a depth" if unreached else ""
            where = "–" if name == FITTED else which + missing
            rows.append(f"| {text} | {where} | {'–' if depth is None else f'{depth:.3f}'} | {' | '.join(own)} |")
    if not rows:
        return []
    head = "imprint, labelled radius | depth where | depth [mm] | contact MAE | contact RMSE | ring MAE | frame MAE"
    return [f"| {head} |", "|" + "---|" * 7, *rows, ""]
