"""The Taxim table as an optical mode: a polynomial by slope bin, shadows, the image at rest.

Si and Yuan, Taxim, RA-L 2022, sections III-B and III-C; semantics of their released simulator, oddities included
(docs/concepts/taxim-table.md lists what differs). Deformation is not in here: the physics gives the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.optics.base import casts_shadows
from raytac.optics.device_mode import DeviceFrame, Float, UInt8
from raytac.optics.image.base import ImageHeights, ImageMode
from raytac.optics.response import SATURATED, saturated_share
from raytac.optics.taxim.config import Taxim
from raytac.optics.taxim.shadow import ShadowArrays, ShadowCaster
from raytac.optics.taxim.table import PolyTable
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.sampled_tracer import ray_tracer
from raytac.specs.sensor import SensorSpec

_ASPECT_TOLERANCE = 0.01
_UNCOVERED = 2
"""Flag of a pixel in contact whose bin no calibration sample reached."""
FULL_DISPLACEMENT = 20e-6
"""Displacement [m] up to which the change from the image at rest grows in proportion."""


@dataclass(frozen=True)
class TableArrays:
    """Device arrays of a table: what a recorded frame reads besides the surface."""

    bins: Any
    """20 floats a bin: 6 coefficients a channel, covered, one unused; ``surround`` follows."""
    background: Any
    """4 floats a pixel, the last unused."""
    shadow: ShadowArrays | None


class TableShader:
    """Shades height images by a table at one resolution; knows no camera and no pad."""

    def __init__(self, mi: Any, table: PolyTable, resolution: tuple[int, int], pitch: float, *, shadow: bool) -> None:
        """``resolution`` [px] may differ from the table's; ``pitch`` of an image pixel along x [m]."""
        self.mi, self.table, self.resolution = mi, table, resolution
        self.pitch = pitch
        self.scale = (table.resolution[0] / resolution[0], table.resolution[1] / resolution[1])
        """Calibration pixels per image pixel along x and y."""
        background = resized(table.background, resolution)
        self._caster = None
        arrays = None
        if shadow:
            if table.shadow is None:
                raise InputError("shadows", value=True, rule="this table has no shadows", choices=(False,))
            self._caster = ShadowCaster(mi, table.shadow, table.constants, resolution, self.scale, pitch)
            arrays = self._caster.arrays()
            background = self._caster.blur_background(background)
        self.inputs = TableArrays(mi.Float(_packed_bins(table)), mi.Float(padded(background)), arrays)

    def levels(self, seen: ImageHeights, inputs: TableArrays) -> tuple[list[Float], UInt8]:
        """Three channels of B·H·W levels, and flags of every pixel (UInt8).

        A flag is 1 in contact, ``_UNCOVERED`` more in an uncovered bin; one unused value where coverage is not known.
        """
        mi, table = self.mi, self.table
        displaced = table.slopes_of == "displacement"
        of = seen.displacement if displaced else seen.height
        sx, sy, near = seen.slopes(mi, of)
        here, contact = seen.here(mi, of), seen.here(mi, seen.contact)
        _, p, column, row = seen.pixel(mi)
        n = table.n_bins
        # A flat place has direction 0; atan2(0, 0) says so on every device that Dr.Jit knows, but is not promised to.
        flat = (sx == 0) & (sy == 0)
        direction = dr.select(flat, 0, dr.atan2(sy, dr.select(flat, 1, sx)))
        magnitude = dr.atan(dr.sqrt(sx * sx + sy * sy))
        i = dr.minimum(mi.UInt32(magnitude * ((n - 1) / (0.5 * np.pi))), n - 1)
        j = dr.minimum(mi.UInt32(dr.maximum(direction + np.pi, 0) * ((n - 1) / (2 * np.pi))), n - 1)
        which = i * n + j
        if table.surround is not None:
            which += dr.select(contact == 0, mi.UInt32(n * n), 0)
        x = (mi.Float(column) + 0.5) * self.scale[0] - 0.5
        y = (mi.Float(row) + 0.5) * self.scale[1] - 0.5

        def binned() -> tuple[Any, ...]:
            packet = [dr.gather(mi.Vector4f, inputs.bins, which * 5 + k) for k in range(5)]
            c = [packet[k][m] for k in range(5) for m in range(4)]
            basis = (x * x, y * y, x * y, x, y, mi.Float(1))
            return *(sum((c[6 * k + m] * basis[m] for m in range(6)), mi.Float(0)) for k in range(3)), c[18]

        if displaced:
            still = (here == 0) & (near[0] == 0) & (near[1] == 0) & (near[2] == 0) & (near[3] == 0)
            looked_up = ~still if contact is None else ~still | (contact != 0)
            # A branch: packets are dear, and most pads are at rest in most places.
            *change, covered = dr.if_stmt((), looked_up, binned, lambda: (mi.Float(0),) * 4, label="bins")
            # A table says nothing of a touch so light: its flat bins are the apex and the far skirt of deep presses.
            share = dr.minimum(1, dr.abs(here) * (self.pitch / FULL_DISPLACEMENT))
            change = [dr.select(still, 0, share * d) for d in change]
        else:
            *change, covered = binned()
        flags = mi.UInt8(0)
        if table.covered is not None and contact is not None:
            flags = contact | dr.select((contact != 0) & (covered == 0), mi.UInt8(_UNCOVERED), 0)
        if self._caster is not None and inputs.shadow is not None:
            change = self._caster.cast(seen, of, direction, change, inputs.shadow)
        packed = dr.gather(mi.Vector4f, inputs.background, p)
        return [d + packed[k] for k, d in enumerate(change)], flags


class TaximMode(ImageMode):
    """The optical mode ``taxim``: one sensor, one table, one resolution.

    The table is loaded or baked by the constructor, which refuses a resolution of another shape than the table's image.
    """

    config: Taxim

    def _set_up(self) -> None:
        super()._set_up()
        sensor, calibration, shadows = self.sensor, self.config.calibration, self.config.shadows
        # Unless asked for, shadows are only those of a calibration folder: those of a baked table are ragged under strips of light. A table
        # that is asked to is baked with them, whatever the sensor says.
        casts = bool(shadows) if calibration is None else casts_shadows(sensor, shadows)
        baked_of = replace(sensor, optics=replace(sensor.optics, shadows=sensor.optics.shadows or casts))
        self.table, self._is_own = _table(calibration, baked_of, self.device), calibration is None
        self.shadows = casts and (shadows is not None or self.table.shadow is not None)
        self.label = "taxim-shadow" if self.shadows else "taxim"
        width, height = self.camera.resolution
        columns, rows = self.table.resolution
        ratio = (columns / rows) / (width / height)
        if abs(ratio - 1) > _ASPECT_TOLERANCE:
            rule = f"must have the aspect ratio of the table's image, {columns}x{rows}, within {100 * _ASPECT_TOLERANCE:.0f} %"
            raise InputError("resolution", value=f"{width}x{height}", rule=rule)
        self.needs_contact = self.shadows or self.table.covered is not None or self.table.surround is not None
        self._shader = TableShader(self.mi, self.table, self.camera.resolution, self.pitch[0], shadow=self.shadows)

    @property
    def _crops(self) -> bool:
        return not self.shadows  # which come from anywhere in the image

    @property
    def view_ratio(self) -> tuple[float, float]:
        """Width and height in the sensor's view over those in the table's image."""
        sizes = zip(self.pitch, self.camera.resolution, self.table.pixel_pitch, self.table.resolution, strict=True)
        x, y = (p * n / (q * m) for p, n, q, m in sizes)
        return x, y

    def _build(self, grid: PadGrid) -> TableArrays:
        if self._is_own and saturated_share(self.table.background.round().clip(0, 255)) > SATURATED:
            ray_tracer(self.sensor, RayTraced(), device=self.device).prepare(grid)  # which warns of it
        return self._shader.inputs

    def _levels(self, seen: ImageHeights, arrays: TableArrays) -> tuple[list[Float], UInt8]:
        return self._shader.levels(seen, arrays)

    def _floats_per_pixel(self) -> float:
        # With shadows: least values (3), the packed image before and after each of four blurs (20), the contact grown by rows (1/4).
        return 23.25 if self.shadows else 0

    def _other_images(self, frame: DeviceFrame, failed: np.ndarray) -> dict[str, Any]:
        """Share of the contact pixels with an uncovered bin, where the table knows its coverage."""
        if self.table.covered is None:
            return {}
        # Image by image: counting along an axis takes ten times as long.
        flags = np.array(frame.flags).reshape(len(failed), -1)
        touched = np.array([np.count_nonzero(one) for one in flags != 0], float)
        uncovered = np.array([np.count_nonzero(one) for one in flags >= _UNCOVERED])
        share = np.divide(uncovered, touched, out=np.full(len(touched), np.nan), where=(touched > 0) & ~failed)
        return {"uncovered": share}


def resized(image: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) float32 resampled to ``resolution`` (width, height), pixel areas aligned.

    Linear where it grows, a triangle over the covered pixels where it shrinks; the image itself if it has that size.
    """
    if (image.shape[1], image.shape[0]) == resolution:
        return np.asarray(image, dtype=np.float32)
    from PIL import Image

    channels = [Image.fromarray(np.ascontiguousarray(image[..., c], dtype=np.float32)) for c in range(3)]
    return np.stack([np.asarray(one.resize(resolution, Image.Resampling.BILINEAR)) for one in channels], axis=-1)


def _table(calibration: object, sensor: SensorSpec, device: str) -> PolyTable:
    if isinstance(calibration, PolyTable):
        return calibration
    if isinstance(calibration, (str, Path)):
        from raytac.optics.taxim.folder import load_calibration

        return load_calibration(calibration)
    from raytac.optics.taxim.bake.bake import baked_table

    return baked_table(sensor, device=device)


def _packed_bins(table: PolyTable) -> np.ndarray:
    n = table.n_bins
    sheets = [table.gradients] if table.surround is None else [table.gradients, table.surround]
    packed = np.zeros((len(sheets), n, n, 20), dtype=np.float32)
    for own, sheet in zip(packed, sheets, strict=True):
        own[..., :18] = np.moveaxis(sheet, 0, 2).reshape(n, n, 18)
        own[..., 18] = 1 if table.covered is None else table.covered
    return packed.ravel()


def padded(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) as 4 floats a pixel, flat, the last 0: a packet that one gather brings."""
    return np.pad(np.asarray(image, dtype=np.float32), ((0, 0), (0, 0), (0, 1))).ravel()
