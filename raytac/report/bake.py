"""Bake a table and write its folder: Taxim's files, coverage, error by scene."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.optics.taxim.config import Taxim
from raytac.optics.trace.config import RayTraced
from raytac.report.image_error import contact_box, mae, psnr, rmse
from raytac.report.measure import machine
from raytac.report.press import press_peaks
from raytac.report.style import STYLE
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.taxim.bake.bake import Baked
    from raytac.optics.taxim.bake.fit import BinFit
    from raytac.optics.taxim.bake.settings import BakeSettings
    from raytac.optics.taxim.table import PolyTable
    from raytac.optics.trace.tracer import Tracer


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
    """Bake, cache the table, and write calibration files, figures and metrics to ``out``.

    ``scenes`` are the presses on which the table is compared; ``start`` is ``time.perf_counter()`` at the beginning of the job. Nothing
    in ``out`` or in the cache changes until everything is computed. A cache that cannot be written is a warning. Returns the files written.

    Raises:
        SpecError: an unknown scene, before anything is baked.
        InputError: a value out of its choices, or a folder that cannot be written.
        BackendError: the ray tracer cannot run on ``device``.
    """
    from raytac.optics.taxim.bake.bake import bake
    from raytac.optics.taxim.cache import keep, table_folder
    from raytac.optics.taxim.folder import CALIBRATION_FILES, save_calibration

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


ERROR_RANGE = 32
"""Levels that the signed error is shown to, in either direction, the same in every sheet."""
_FILLED = "#d9d9d9"
_DEGREES = ("#fdcc8a", "#74a9cf", "#045a8d")


def write_coverage(path: Path, fit: BinFit, sensor: str) -> None:
    """Samples of every bin, and the degree of its polynomial, over the slope."""
    from matplotlib import rc_context
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    counts, degree = fit.counts[:-1, :-1].astype(float), fit.degree[:-1, :-1]
    look: dict[str, Any] = {"origin": "lower", "extent": (-180.0, 180.0, 0.0, 90.0), "aspect": "auto", "interpolation": "nearest"}
    with rc_context(STYLE):
        figure = Figure(figsize=(7.0, 2.7), layout="constrained")
        first, right = figure.subplots(1, 2, sharey=True)
        for axes in (first, right):
            axes.set_facecolor(_FILLED)
            axes.set_xlabel("direction of the slope [°]")
            axes.set_xticks((-180, -90, 0, 90, 180))
            axes.set_yticks((0, 15, 30, 45, 60, 75, 90))
        first.set_ylabel("magnitude of the slope [°]")
        norm = LogNorm(1, max(10.0, float(counts.max())))
        image = first.imshow(np.ma.masked_equal(counts, 0), cmap="viridis", norm=norm, **look)
        first.set_title(f"a  touched samples a bin, {sensor}")
        figure.colorbar(image, ax=first, pad=0.02)
        right.imshow(np.ma.masked_less(degree, 0), cmap=ListedColormap(_DEGREES), vmin=-0.5, vmax=2.5, **look)
        right.set_title("b  degree of the bin's polynomial")
        names = ("mean", "linear", "quadratic")
        keys = [Patch(facecolor=c, label=n) for c, n in zip(_DEGREES, names, strict=True)]
        keys.append(Patch(facecolor=_FILLED, label="no sample (filled)"))
        figure.legend(handles=keys, loc="outside lower right", ncols=4, frameon=False)
        figure.savefig(path, dpi=300)


def write_table_sheet(path: Path, errors: dict[str, dict[str, SceneError]]) -> None:
    """Draw a row a scene: ray tracer, table, table with shadows, signed errors."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    names = {"taxim": "table", "taxim_shadow": "with shadows"}
    scenes = list(errors["taxim"])
    columns = 1 + 2 * len(errors)
    first = errors["taxim"][scenes[0]].traced
    cell = 1.75
    with rc_context(STYLE):
        size = (columns * cell + 0.6, len(scenes) * (cell * first.shape[0] / first.shape[1] + 0.16) + 0.2)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(scenes), columns, squeeze=False)
        shown = None
        for row, scene in enumerate(scenes):
            images = [("ray tracer", errors["taxim"][scene].traced, "")]
            for family, by_scene in errors.items():
                ratio = by_scene[scene].box_psnr
                images.append((names[family], by_scene[scene].table, "equal" if np.isinf(ratio) else f"{ratio:.1f} dB"))
            for axes, (title, image, note) in zip(grid[row], images, strict=False):
                axes.imshow(image, interpolation="nearest")
                axes.set_title(f"{scene}: {title}" if not note else f"{title}, {note}")
            for axes, (family, by_scene) in zip(grid[row, len(images) :], errors.items(), strict=True):
                error = by_scene[scene]
                off = (error.table.astype(float) - error.traced).mean(axis=-1)
                shown = axes.imshow(off, cmap="RdBu_r", vmin=-ERROR_RANGE, vmax=ERROR_RANGE, interpolation="nearest")
                axes.set_title(f"error, {names[family]}")
            for axes in grid[row]:
                axes.set(xticks=(), yticks=())
        assert shown is not None
        figure.colorbar(shown, ax=grid, shrink=0.8, pad=0.01, aspect=40, label="table − ray tracer [levels]")
        figure.savefig(path, dpi=200)


BOX_MARGIN = 15 / 320
"""Margin of the box round the contact as a share of the image's width: 15 px at 320 × 240."""


@dataclass(frozen=True)
class SceneError:
    """One press: the images and how far the table's is from the ray tracer's."""

    traced: np.ndarray
    """(H, W, 3) uint8."""
    table: np.ndarray
    """(H, W, 3) uint8."""
    contact: np.ndarray
    """(H, W) bool; nothing but False if nothing touches."""
    uncovered: float
    """Share of the contact's pixels whose bin no sample reached; NaN without contact."""

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the contact's box with ``BOX_MARGIN`` around it, or of the image."""
        return contact_box(self.contact, round(BOX_MARGIN * self.contact.shape[1]))

    @property
    def contact_mae(self) -> float:
        """Mean absolute error over the contact's pixels [levels], over the image if nothing touches."""
        where = self.contact if self.contact.any() else np.ones_like(self.contact)
        return mae(self.table[where], self.traced[where])

    @property
    def box_psnr(self) -> float:
        """PSNR in the box [dB]."""
        return psnr(rmse(self.table[self.box], self.traced[self.box]))

    @property
    def frame_psnr(self) -> float:
        """PSNR over the image [dB]."""
        return psnr(rmse(self.table, self.traced))


def table_errors(
    sensor: SensorSpec, surfaces: Mapping[str, GelSurface], table: PolyTable, tracer: Tracer
) -> dict[str, dict[str, SceneError]]:
    """Errors of ``taxim`` and ``taxim_shadow`` against the images of ``tracer``, by scene.

    ``surfaces`` (B = 1 each) share one grid, that of the first image of ``tracer`` if it has rendered already.
    """
    setting: dict[str, Any] = {"resolution": tracer.camera.resolution, "device": tracer.device}
    seen = RayTraced().build(sensor, outputs=("depth",), **setting)
    traced = {name: (tracer.render(surface).rgb, seen.render(surface).contact) for name, surface in surfaces.items()}
    errors: dict[str, dict[str, SceneError]] = {}
    for family, shadow in (("taxim", False), ("taxim_shadow", True)):
        if shadow and table.shadow is None:
            continue
        mode = Taxim(table, shadows=shadow).build(sensor, **setting)
        errors[family] = {}
        for name, surface in surfaces.items():
            image, (truth, contact) = mode.render(surface), traced[name]
            assert image.rgb is not None and truth is not None and contact is not None
            uncovered = float("nan") if image.uncovered is None else float(image.uncovered[0])
            errors[family][name] = SceneError(truth[0], image.rgb[0], contact[0], uncovered)
    return errors


def error_metrics(errors: Mapping[str, Mapping[str, SceneError]]) -> dict[str, Metric]:
    """``<family>.<scene>.<figure>`` of finite figures: not the PSNR of equal images, for one."""
    metrics: dict[str, Metric] = {}
    for family, by_scene in errors.items():
        for scene, error in by_scene.items():
            figures = {
                "psnr_box_db": error.box_psnr,
                "contact_mae_levels": error.contact_mae,
                "psnr_frame_db": error.frame_psnr,
                "uncovered_share": error.uncovered,
            }
            metrics |= {f"{family}.{scene}.{name}": value for name, value in figures.items() if np.isfinite(value)}
    return metrics
