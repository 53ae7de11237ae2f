"""A Taxim table from our own ray tracer: the virtual calibration.

A real calibration presses a ball some fifty times and finds its outline by hand. Here the surface is known, so every pixel that a press
moved is a sample: its slope, from the front step that the table mode itself uses, names the bin; its place and its difference from the
image at rest are what the bin's polynomial is fitted to, for touched pixels and for those around them apart
(docs/concepts/taxim-table.md, *Baked from the ray tracer*).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from raytac.io.progress import Progress
from raytac.optics.taxim.bake.fit import BinFit, BinSums, two_sheets
from raytac.optics.taxim.bake.presses import ball_presses, punch_presses
from raytac.optics.taxim.bake.settings import PLAIN, BakeSettings
from raytac.optics.taxim.bake.shadow import bake_shadow
from raytac.optics.taxim.bake.views import Calibration, Views
from raytac.optics.taxim.cache import cached, keep, table_folder
from raytac.optics.taxim.table import PolyTable, slope_bins
from raytac.specs.sensor import SensorSpec

MOVED = 5e-6
"""Least displacement [m] of a sample: a hundredth of a usual press, too little to show."""

_LOG = logging.getLogger("raytac")


@dataclass(frozen=True)
class Baked:
    """A table and how well the bins of its sheet for touched pixels were sampled."""

    table: PolyTable
    fit: BinFit
    images: int
    """Images that were rendered for it, those of the shadows included."""
    calibration: Calibration
    """The ray tracer that it was baked from, and its images at rest."""


def baked_table(
    sensor: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    resolution: tuple[int, int] | None = None,
    settings: BakeSettings | None = None,
    progress: bool = True,
) -> PolyTable:
    """The table of ``bake``, with its arguments and errors, baked once and kept in a cache.

    It is a calibration folder under a digest of sensor, lights, settings and code; a damaged one is baked again, with a warning. An
    interrupt leaves nothing there. Where the cache cannot be written the table is used and not kept, with a warning. A cached table may
    come from the other device, whose images differ by rounding.
    """
    settings = BakeSettings() if settings is None else settings
    folder = table_folder(sensor, settings, seed, resolution or sensor.camera.resolution)
    table = cached(folder)
    if table is None:
        if progress:
            where = "" if folder is None else f" and kept in {folder.parent}"
            _LOG.info("no table of %s yet, so it is baked once%s", sensor.name, where)
        table = bake(sensor, device=device, seed=seed, resolution=resolution, settings=settings, progress=progress).table
        if keep(table, folder):
            table = cached(folder) or table  # what later processes will read, to the last bit
    return table


def bake(
    sensor: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    resolution: tuple[int, int] | None = None,
    settings: BakeSettings | None = None,
    progress: bool = False,
) -> Baked:
    """Calibrate a table on the ray tracer ``fast`` with this sensor's own optics.

    The same arguments give the same table on one device. ``resolution`` (width, height) [px] is that of the calibration images, None the
    sensor's own. ``seed``: where the sequence of presses starts, and of the fit of the case's light. Raises InputError: a value out of
    its choices; BackendError: the ray tracer cannot run on ``device``.
    """
    return calibrate(
        Calibration(sensor, device=device, resolution=resolution, seed=seed), settings=settings, seed=seed, progress=progress
    )


def calibrate(at: Calibration, *, settings: BakeSettings | None = None, seed: int = 0, progress: bool = False) -> Baked:
    """``bake`` with a ray tracer that is set up already."""
    settings = BakeSettings() if settings is None else settings
    sensor, grid, camera = at.sensor, at.grid, at.tracer.camera
    pins = settings.pins if sensor.optics.shadows else 0
    images = settings.renders(sensor.optics.shadows)
    with Progress(total=images, desc=f"bake {sensor.name}", unit="image", show=progress) as bar:
        touched, around, steep = (BinSums(settings.n_bins, camera.resolution) for _ in range(3))
        pad = sensor.gelpad, grid, camera, settings, seed
        for presses, inside, outside in (
            (ball_presses(*pad), touched, around),
            (ball_presses(*pad, bare=True), touched, None),  # ends in a crease: the slopes beside it are those of no gel
            (punch_presses(*pad), None, steep),
        ):
            for views in at.views(presses):
                if inside is not None:
                    add_samples(inside, views, at.rest_image, views.contact)
                if outside is not None:
                    add_samples(outside, views, at.rest_image, ~views.contact)
                bar.update(len(views.rgb))
        around = around.with_thin_bins_of(steep)
        fit, sheets = two_sheets(touched, around, neighbours=settings.neighbours, ridge=settings.ridge)
        shadow = bake_shadow(at, settings=settings, seed=seed, tick=bar.update) if pins else None
    width, height = camera.resolution
    table = PolyTable(
        **sheets,
        background=at.rest_image.astype(np.float32),
        pixel_pitch=at.pitch,
        shadow=shadow,
        rest_image=at.rest_image,
        constants=PLAIN,
        provenance={
            "source": "baked from the ray tracer",
            "sensor": sensor.name,
            "mode": at.tracer.label,
            "exposure": f"{at.tracer.sensor.response.gain:g}",
            "settings": repr(settings),
            "seed": str(seed),
            "resolution": f"{width}x{height}",
            "fill": "nearest covered magnitude of the same direction, else the nearest direction",
        },
    )
    return Baked(table, fit, images, at)


def add_samples(sums: BinSums, views: Views, rest_image: np.ndarray, own: np.ndarray) -> None:
    """Every pixel of ``own`` (B, H, W) that moved, of all environments of ``views``."""
    for b in range(len(views.rgb)):
        row, column = np.nonzero((views.moved[b] > MOVED) & own[b])
        at = b, row, column
        i, j = slope_bins(views.slope_x[at].astype(np.float64), views.slope_y[at].astype(np.float64), sums.n_bins)
        sums.add(i, j, column, row, views.rgb[at].astype(np.float32) - rest_image[row, column])
