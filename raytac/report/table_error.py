"""How far a Taxim table is from the ray tracer it was baked from, press scene by press scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.io.metrics import Metric
from raytac.optics.taxim.config import Taxim
from raytac.optics.trace.config import RayTraced
from raytac.report.image_error import contact_box, mae, psnr, rmse
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.taxim.table import PolyTable
    from raytac.optics.trace.tracer import Tracer

__all__ = ["BOX_MARGIN", "SceneError", "error_metrics", "table_errors"]

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
        """Rows and columns of the contact's bounding box with ``BOX_MARGIN`` on each side; the whole image if nothing touches."""
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
    sensor: SensorSpec,
    surfaces: Mapping[str, GelSurface],
    table: PolyTable,
    tracer: Tracer,
) -> dict[str, dict[str, SceneError]]:
    """Errors of ``taxim`` and ``taxim_shadow`` (if the table has shadows) against the images of ``tracer`` by scene.

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
    """Keys ``<family>.<scene>.psnr_box_db``, ``.contact_mae_levels``, ``.psnr_frame_db`` and ``.uncovered_share``.

    A PSNR of equal images, which is infinite, and a share without contact are left out.
    """
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
