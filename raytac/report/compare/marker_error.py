"""Error and time of cheap marker models against surface tracking, on held-out presses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from raytac.io.metrics import Metric
from raytac.report.markers import error_metrics
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.markers.calibration import ModelError
    from raytac.markers.calibration_presses import PressFrame

PAD = "medium"
"""Level of the soft pad by default: the one that shipped marker motion was fitted to."""


@dataclass(frozen=True)
class MarkerErrors:
    """Every model that needs no coat against surface tracking."""

    pad: str
    """Mesh level of the soft pad whose surface is the reference."""
    probes: int
    """Markers that errors are averaged over, on a 1 mm grid over the view."""
    presses: tuple[str, ...]
    """The presses in words."""
    errors: tuple[ModelError, ...]
    """By model and kind of load; the model ``surface`` has no row, since it is the truth."""
    times_ms: dict[str, float]
    """Median time of a frame by model at the probes [ms]; of ``surface`` without the physics."""

    @property
    def loads(self) -> tuple[str, ...]:
        """Kinds of load that were pressed."""
        return tuple(dict.fromkeys(row.load for row in self.errors))

    @property
    def truth(self) -> dict[str, float]:
        """Mean displacement by surface tracking [m], by load: the error of unmoved markers."""
        return {row.load: row.size for row in self.errors}

    def by_model(self) -> list[tuple[str, list[ModelError], float]]:
        """(model, its errors in the order of ``loads``, its time [ms]) of every model."""
        models = dict.fromkeys(row.model for row in self.errors)
        return [(name, [row for row in self.errors if row.model == name], self.times_ms[name]) for name in models]


def marker_errors(sensor: SensorSpec, frames: list[PressFrame], *, pad: str, device: str) -> MarkerErrors:
    """Errors of the models with the marker motion that ``sensor`` has.

    Args:
        sensor: with a marker motion; its own pattern does not matter.
        frames: whole presses, in order.
        pad: level of the soft pad that they come from.
        device: ``auto``, ``cpu`` or ``cuda``.

    Raises:
        InputError: the sensor has no marker motion.
        BackendError: a model's backend does not work here.
    """
    from raytac.markers.calibration import model_errors, probe_sensor

    errors, times = model_errors(sensor, frames, frames[0].surface.grid, device=device)
    probes = probe_sensor(sensor).markers
    presses = tuple(dict.fromkeys(str(frame.press) for frame in frames))
    return MarkerErrors(pad, probes.rows * probes.columns, presses, tuple(errors), times)


def marker_error_metrics(errors: MarkerErrors | None) -> dict[str, Metric]:
    """Keys ``markers.<pad>.<model>.<load>.<figure>`` and ``.ms_per_frame``; none for None."""
    if errors is None:
        return {}
    key = f"markers.{errors.pad}"
    metrics: dict[str, Metric] = {f"{key}.probes": errors.probes, f"{key}.presses": len(errors.presses)}
    for row in errors.errors:
        metrics |= error_metrics(f"{key}.{row.model}.{row.load}", row)
    return metrics | {f"{key}.{model}.ms_per_frame": ms for model, ms in errors.times_ms.items() if math.isfinite(ms)}
