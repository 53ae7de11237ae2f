"""A Taxim table from our own ray tracer: the virtual calibration.

A real calibration presses a ball some fifty times and finds its outline by hand. Here the surface is known, so every pixel that a press
moved is a sample: its slope, from the front step that the table mode itself uses, names the bin; its place and its difference from the
image at rest are what the bin's polynomial is fitted to (docs/taxim-table.md, *Baked from the ray tracer*).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.optics.bake_fit import BinFit, BinSums
from raytac.optics.bake_presses import ball_presses, pin_presses
from raytac.optics.bake_settings import BakeSettings
from raytac.optics.bake_shadow import ShadowSums
from raytac.optics.bake_views import Calibration, Views
from raytac.optics.calib_folder import load_calibration
from raytac.optics.table import PolyTable, TaximConstants, slope_bins
from raytac.optics.table_cache import cached, keep, table_folder
from raytac.specs.sensor import SensorSpec

__all__ = ["Baked", "bake", "bake_table", "baked_table"]

MOVED = 5e-6
"""Least displacement [m] of a pixel that counts as a sample: a hundredth of a usual press, which changes an image by less than rounding."""

_PLAIN = TaximConstants(background_share=0.0, background_threshold=1e3, shadow_sigma=0.0, final_sigma=0.0)
"""The background is the image at rest as it is, and nothing is blurred: what comes out is what the ray tracer showed."""


@dataclass(frozen=True)
class Baked:
    """A table and how well its bins were sampled."""

    table: PolyTable
    fit: BinFit
    images: int
    """Images that were rendered for it, those of the shadows included."""
    device: str
    """``cpu`` or ``cuda``: where they were rendered."""


def bake_table(
    sensor: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    resolution: tuple[int, int] | None = None,
    settings: BakeSettings | None = None,
    progress: bool = False,
) -> PolyTable:
    """Calibrate a table on the ray tracer; ``bake`` says how the bins were sampled, ``baked_table`` keeps the result on disk."""
    return bake(sensor, device=device, seed=seed, resolution=resolution, settings=settings, progress=progress).table


def baked_table(
    sensor: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    resolution: tuple[int, int] | None = None,
    settings: BakeSettings | None = None,
    progress: bool = True,
) -> PolyTable:
    """The table of ``bake_table``, baked once and kept on disk under a digest of sensor, lights, settings and code.

    It is kept in ``cache_root()``, as a calibration folder; an entry that is damaged is baked again, with a warning. An interrupt leaves
    nothing there. A cached table may come from the other device, whose images differ by rounding.

    Raises:
        InputError: a value out of its choices, or a cache that cannot be written.
        BackendError: the table is not cached, and the ray tracer cannot run on ``device``.
    """
    settings = BakeSettings() if settings is None else settings
    folder = table_folder(sensor, settings, seed, resolution or sensor.camera.resolution)
    table = cached(folder)
    if table is None:
        keep(bake_table(sensor, device=device, seed=seed, resolution=resolution, settings=settings, progress=progress), folder)
        # What later processes will read, to the last bit.
        table = load_calibration(folder)
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

    The same arguments give the same table on one device.

    Args:
        sensor: geometry, lights and camera.
        device: ``auto``, ``cpu`` or ``cuda``.
        seed: where the sequence of presses starts, and of the fit of the case's light.
        resolution: (width, height) of the calibration images [px]; None is the sensor's own.
        settings: numbers and ranges of presses; None is the default.
        progress: show a progress bar.

    Raises:
        InputError: a value out of its choices.
        BackendError: the ray tracer cannot run on ``device``.
    """
    from tqdm import tqdm

    settings = BakeSettings() if settings is None else settings
    with tqdm(total=settings.images + 4 * settings.pins, desc=f"bake {sensor.name}", unit="image", disable=not progress) as bar:
        lit = Calibration(sensor, device=device, resolution=resolution, seed=seed)
        sums = BinSums(settings.n_bins, lit.tracer.camera.resolution)
        for views in lit.views(ball_presses(sensor.gelpad, lit.grid, lit.tracer.camera, settings, seed)):
            add_samples(sums, views, lit.rest_image)
            bar.update(len(views.rgb))
        fit = sums.solve(neighbours=settings.neighbours, ridge=settings.ridge)
        shadow = None
        if settings.pins:
            constants = TaximConstants()
            dark = Calibration(sensor, device=device, resolution=resolution, seed=seed, shadows=False)
            _, deepest = settings.depth_range(sensor.gelpad.thickness)
            shades = ShadowSums(2 * constants.ring_dilations, deepest, lit.tracer.camera.resolution)
            for on, off in zip(*(each.views(_shadow_presses(sensor, each, settings, seed)) for each in (lit, dark)), strict=True):
                shades.add(on, off.rgb, lit.rest_image, dark.rest_image)
                bar.update(2 * len(on.rgb))
            shadow = shades.table()
    width, height = lit.tracer.camera.resolution
    table = PolyTable(
        gradients=fit.gradients,
        covered=fit.covered,
        background=lit.rest_image.astype(np.float32),
        pixel_pitch=lit.pitch,
        shadow=shadow,
        slopes_of="displacement",
        rest_image=lit.rest_image,
        constants=_PLAIN,
        provenance={
            "source": "baked from the ray tracer",
            "sensor": sensor.name,
            "mode": lit.tracer.label,
            "settings": repr(settings),
            "seed": str(seed),
            "resolution": f"{width}x{height}",
            "fill": "nearest covered magnitude of the same direction, else the nearest direction",
        },
    )
    return Baked(table, fit, settings.images + 4 * settings.pins, lit.tracer.device)


def add_samples(sums: BinSums, views: Views, rest_image: np.ndarray) -> None:
    """Every pixel that moved, of all environments of ``views``."""
    for b in range(len(views.rgb)):
        row, column = np.nonzero(views.moved[b] > MOVED)
        at = b, row, column
        i, j = slope_bins(views.slope_x[at].astype(np.float64), views.slope_y[at].astype(np.float64), sums.n_bins)
        sums.add(i, j, column, row, views.rgb[at].astype(np.float32) - rest_image[row, column])


def _shadow_presses(sensor: SensorSpec, at: Calibration, settings: BakeSettings, seed: int) -> Iterator[GelSurface]:
    """Pins, whose walls are as steep as the surround allows, and as many single balls, whose flanks cast little."""
    pad, grid, camera = sensor.gelpad, at.grid, at.tracer.camera
    single = replace(settings, images=settings.pins, balls=1, bare_share=0.0)
    return chain(pin_presses(pad, grid, camera, settings, seed), ball_presses(pad, grid, camera, single, seed + 1))
