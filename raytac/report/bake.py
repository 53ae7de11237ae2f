"""Bake a table and write its folder: calibration files as Taxim has them, what was covered, and how far it is from the ray tracer."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.report.machine import machine
from raytac.report.surfaces import press_peaks
from raytac.report.table_error import SceneError, error_metrics, table_errors
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.bake import Baked
    from raytac.optics.bake_settings import BakeSettings

__all__ = ["bake_metrics", "run_bake"]


def run_bake(
    sensor: SensorSpec,
    out: Path,
    *,
    settings: BakeSettings,
    scenes: tuple[str, ...],
    device: str,
    seed: int,
    resolution: tuple[int, int] | None,
    start: float,
) -> list[Path]:
    """Bake, keep the table in the cache, and write calibration files, coverage.png, sheet.png and metrics.json to ``out``.

    ``scenes`` are the presses on which the table is compared; ``start`` is ``time.perf_counter()`` at the beginning of the job. Nothing
    in ``out`` or in the cache changes until everything is computed. A cache that cannot be written is a warning. Returns the files written.

    Raises:
        SpecError: an unknown scene, before anything is baked.
        InputError: a value out of its choices, or a folder that cannot be written.
        BackendError: the ray tracer cannot run on ``device``.
    """
    from raytac.optics.bake import bake
    from raytac.optics.calib_folder import CALIBRATION_FILES, save_calibration
    from raytac.optics.table_cache import keep, table_folder
    from raytac.report.bake_figure import write_coverage, write_table_sheet

    with result_folder(out, (*CALIBRATION_FILES, "coverage.png", "sheet.png", "metrics.json")) as folder:
        size = sensor.camera.resolution if resolution is None else resolution
        _, surfaces = press_peaks(sensor, scenes, size, seed)
        began = time.perf_counter()
        baked = bake(sensor, device=device, seed=seed, resolution=resolution, settings=settings, progress=True)
        bake_s = time.perf_counter() - began
        errors = table_errors(sensor, surfaces, baked.table, baked.calibration.tracer)
        save_calibration(baked.table, folder)
        write_coverage(folder / "coverage.png", baked.fit, sensor.name)
        write_table_sheet(folder / "sheet.png", errors)
        metrics = bake_metrics(baked, errors, bake_s) | {
            "device": baked.calibration.tracer.device,
            "seed": seed,
            "sensor": sensor.name,
        }
        write_metrics(folder / "metrics.json", metrics | versions() | machine() | {"wall_s": time.perf_counter() - start})
        keep(baked.table, table_folder(sensor, settings, seed, size))
        names = sorted(path.name for path in folder.iterdir())
    return [Path(out) / name for name in names]


def bake_metrics(baked: Baked, errors: dict[str, dict[str, SceneError]], bake_s: float) -> dict[str, Metric]:
    """Time, coverage and error by scene."""
    fit, table = baked.fit, baked.table
    width, height = table.resolution
    steepest = np.flatnonzero(fit.covered.any(axis=1))
    metrics: dict[str, Metric] = {
        "command": "bake",
        "image.width_px": width,
        "image.height_px": height,
        "bake.wall_s": bake_s,
        "bake.images": baked.images,
        "bake.samples": int(fit.counts[:, :-1].sum()),
        "bake.n_bins": table.n_bins,
        "bake.steepest_covered_deg": 90.0 * (int(steepest[-1]) + 1) / (table.n_bins - 1) if len(steepest) else 0.0,
        "bake.covered_share": float(fit.covered[:-1, :-1].mean()),
    }
    for degree in (0, 1, 2):
        metrics[f"bake.degree{degree}_share"] = float((fit.degree[:-1, :-1] == degree).mean())
    return metrics | error_metrics(errors)
