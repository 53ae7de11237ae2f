"""A Taxim table from real presses of balls: the polynomial of every slope bin, as for a baked table, from photographs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from raytac.calibrate.press_samples import PressSamples
from raytac.optics.taxim.bake.bake import PLAIN, bake_shadow
from raytac.optics.taxim.bake.fit import BinSums
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.bake.views import Calibration
from raytac.optics.taxim.table import PolyTable, slope_bins
from raytac.specs.sensor import SensorSpec

__all__ = ["N_BINS", "fit_table", "with_cast_shadows"]

N_BINS = 60
"""Bins of the slope's magnitude, and of its direction. Upstream has 125; with 20 presses of a Mini half as many leave out fewer places."""
NEIGHBOURS, RIDGE = 1.0, 1e-4
"""As in ``BakeSettings``, but the eight bins around count as much as the bin itself: photographs are few."""


def fit_table(sensor: SensorSpec, background: np.ndarray, samples: PressSamples, *, n_bins: int = N_BINS) -> PolyTable:
    """The table of ``samples`` over the real ``background`` (H, W, 3) [levels]: one sheet for touched pixels, one for those around, and for
    readers that know one alone (``PolyTable.one_sheet``) one of all samples. It has no shadows: photographs of balls alone tell too
    little of them."""
    height, width = background.shape[:2]
    i, j = slope_bins(samples.slope_x, samples.slope_y, n_bins)
    touched, around = (BinSums(n_bins, (width, height)) for _ in range(2))
    for sums, own in ((touched, samples.touched), (around, ~samples.touched)):
        sums.add(i[own], j[own], samples.column[own], samples.row[own], samples.difference[own].astype(np.float32))
    contact, surround, together = (
        sums.solve(neighbours=NEIGHBOURS, ridge=RIDGE) for sums in (touched, around, touched.plus(around))
    )
    return PolyTable(
        gradients=contact.gradients,
        covered=contact.covered,
        surround=surround.gradients,
        one_sheet=together.gradients,
        background=background.astype(np.float32),
        pixel_pitch=sensor.camera.pitch_at((width, height)),
        slopes_of="displacement",
        rest_image=np.clip(np.rint(background), 0, 255).astype(np.uint8),
        constants=PLAIN,
        provenance={"source": "real presses of balls", "sensor": sensor.name, "presses": str(len(np.unique(samples.press)))},
    )


def with_cast_shadows(
    table: PolyTable,
    lit: SensorSpec,
    *,
    device: str = "auto",
    seed: int = 0,
    settings: BakeSettings | None = None,
    tick: Callable[[int], None] | None = None,
) -> PolyTable:
    """``table`` with a shadow table of pins and balls under the fitted lights of ``lit``, which the ray tracer presses and renders.

    Its images have the table's background as flat field, so both tables are differences in levels from the same image by the same
    response. ``tick`` is told how many images are rendered.
    """
    height, width = table.background.shape[:2]
    field = np.clip(np.rint(table.background), 0, 255).astype(np.uint8)
    at, rendered = Calibration(lit, device=device, resolution=(width, height), seed=seed, flat_field=field), 0

    def told(count: int) -> None:
        nonlocal rendered
        rendered += count
        if tick is not None:
            tick(rendered)

    shadow = bake_shadow(at, settings=settings, seed=seed, tick=told)
    return dataclasses.replace(table, shadow=shadow, provenance=table.provenance | {"shadow": "cast by the fitted ray tracer"})
