"""Shadows of a Taxim table: rays from the contact's rim darken the image; then a blur.

Si and Yuan, Taxim, RA-L 2022, section III-C, as their released simulator does it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.optics.image.base import ImageHeights
from raytac.optics.taxim.table import ShadowTable, TaximConstants

_DILATION = 2
"""Pixels by which a 5 × 5 square grows a mask."""
_FINAL_TAPS = 2
"""Half the taps of the last blur [calibration pixels]."""
_NOTHING = np.float32(np.inf)


@dataclass(frozen=True)
class ShadowArrays:
    """Device arrays of a shadow table at one resolution."""

    values: Any
    """``ordered`` levels, 4 a (direction, depth, step), the last unused; +∞ after a list's end."""
    ends: Any
    """End of a pixel's ray by (direction, depth): that of the longest of the three lists."""
    paths: Any
    """Pixels of a direction's rays by place: (column offset, row offset, step, unused)."""


class ShadowCaster:
    """Casts the shadows of a table into difference images of one resolution."""

    def __init__(
        self,
        mi: Any,
        table: ShadowTable,
        constants: TaximConstants,
        resolution: tuple[int, int],
        scale: tuple[float, float],
        pitch: float,
    ) -> None:
        """``scale``: calibration pixels per image pixel (x, y); ``pitch`` [m] of one along x."""
        self.mi, self.table, self.resolution, self.scale, self.pitch = mi, table, resolution, scale, pitch
        # At another resolution every length keeps its size on the pad.
        self.ring = tuple(max(1, round(_DILATION * constants.ring_dilations / s)) for s in scale)
        self._shadow_taps = [gaussian_taps(constants.shadow_sigma / s, int(4 * constants.shadow_sigma / s + 0.5)) for s in scale]
        self._final_taps = [gaussian_taps(constants.final_sigma / s, max(1, round(_FINAL_TAPS / s))) for s in scale]

    def arrays(self) -> ShadowArrays:
        """Upload the table."""
        mi, t = self.mi, self.table
        _, n_dir, n_depth, length = t.values.shape
        beyond = np.arange(length) >= t.lengths[..., None]
        values = np.full((n_dir, n_depth, length, 4), _NOTHING, dtype=np.float32)
        values[..., :3] = np.moveaxis(np.where(beyond, _NOTHING, t.values), 0, -1)
        paths, counts = self._paths()
        lengths = t.lengths.max(axis=0)
        if t.depth_of == "drop":  # a ray may need the list of any depth up to that of its origin
            lengths = np.maximum.accumulate(lengths, axis=1)
        ends = counts[np.arange(n_dir)[:, None], lengths]
        return ShadowArrays(mi.Int32(ordered(values).ravel()), mi.UInt32(ends.astype(np.uint32).ravel()), mi.Int32(paths.ravel()))

    def _paths(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of rays (n_dir, n_places, 4) int32, and how many lie before step s.

        The numbers are (n_dir, max_length + 1), from 1.

        Rays of a fan pass the same pixels near their origin; each (step, pixel) is listed once, in the order of the steps.
        """
        t, length = self.table, self.table.values.shape[3]
        angle, step = t.rays()[:, None, :], t.step * np.arange(length)[None, :, None]
        # Rounding first keeps cos and sin of right angles from moving a whole pixel; float64 elsewhere decides as upstream does.
        x, y = (
            np.floor(np.round(step * turn / s, 9)) for turn, s in zip((np.cos(angle), np.sin(angle)), self.scale, strict=True)
        )
        at = np.broadcast_to(np.arange(length)[None, :, None], x.shape)
        places = np.stack([at, x, y], axis=-1).astype(np.int32)
        pixels = [np.unique(one[1:].reshape(-1, 3), axis=0) for one in places]
        packed = np.zeros((len(pixels), max(1, max(len(one) for one in pixels)), 4), dtype=np.int32)
        for row, one in zip(packed, pixels, strict=True):
            row[: len(one), :3] = one[:, [1, 2, 0]]
        counts = [np.searchsorted(one[:, 0], np.arange(length + 1)) for one in pixels]
        return packed, np.stack(counts)

    def cast(self, seen: ImageHeights, of: Any, direction: Any, change: list[Any], arrays: ShadowArrays) -> list[Any]:
        """``change`` (3 × B·H·W), shadowed and blurred; ``of`` [px], slope's ``direction`` [rad]."""
        mi, t = self.mi, self.table
        width, height = self.resolution
        _, n_dir, n_depth, length = t.values.shape
        i, _, column, row = seen.pixel(mi)
        first = i - row * width - column
        ring = self._dilated(seen) & (seen.contact == 0)
        a = mi.Int32(dr.floor((direction + np.pi) * (1 / t.direction_precision)))
        by_drop = t.depth_of == "drop"

        def depth_bin(pixels: Any) -> Any:
            d = mi.Int32(dr.floor((pixels * self.pitch - t.first_depth) * (1 / t.depth_precision))) + t.depth_offset
            return dr.minimum(d, n_depth - 1) if by_drop else d

        d = depth_bin(seen.displacement)
        casts = ring & (a >= 0) & (a < n_dir) & (d >= 0) & (d < n_depth)
        a, d = mi.UInt32(dr.select(casts, a, 0)), mi.UInt32(dr.select(casts, d, 0))
        # Every pixel is a lane, though few cast: how many do changes from frame to frame, and a recording must not depend on it.
        x0, y0 = mi.Int32(column), mi.Int32(row)
        entry = a * n_depth + d
        end = dr.gather(mi.UInt32, arrays.ends, entry, casts)
        places = dr.width(arrays.paths) // (4 * n_dir)
        # Integers, since not every device has an atomic minimum of floats.
        least = dr.full(mi.Int32, int(ordered(np.array([_NOTHING]))[0]), 3 * dr.width(i))

        def march(k: Any) -> tuple[Any]:
            place = dr.gather(mi.Vector4i, arrays.paths, a * places + k)
            x, y = x0 + place.x, y0 + place.y
            # Upstream truncates towards zero, so what falls just outside the first row or column is in it.
            x, y = dr.select(x == -1, 0, x), dr.select(y == -1, 0, y)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            at = first + mi.UInt32(y) * width + mi.UInt32(x)
            shaded = inside & (of > dr.gather(mi.Float, of, at, inside))
            row_of = entry
            if by_drop:
                drop = depth_bin(seen.displacement - dr.gather(mi.Float, seen.displacement, at, inside))
                shaded &= drop >= 0
                row_of = a * n_depth + mi.UInt32(dr.maximum(drop, 0))
            value = dr.gather(mi.Vector4i, arrays.values, row_of * length + mi.UInt32(place.z), shaded)
            for c in range(3):
                dr.scatter_reduce(dr.ReduceOp.Min, least, value[c], at * 3 + c, shaded, mode=dr.ReduceMode.Direct)
            return (k + 1,)

        dr.while_loop((mi.UInt32(0),), lambda k: k < end, march, label="table shadow")
        dark = [dr.minimum(change[c], unordered(mi, dr.gather(mi.Int32, least, i * 3 + c))) for c in range(3)]
        packed = dr.ravel(mi.Vector4f(*dark, 0))
        for axis, taps in enumerate(self._shadow_taps):
            packed = self._blurred(packed, taps, axis, "reflect")
        for axis, taps in enumerate(self._final_taps):
            packed = self._blurred(packed, taps, axis, "mirror")
        out = dr.gather(mi.Vector4f, packed, i)
        return [out.x, out.y, out.z]

    def blur_background(self, image: np.ndarray) -> np.ndarray:
        """The last blur of ``cast`` on an image (H, W, 3): linear, so done once for the background."""
        out = np.asarray(image, dtype=np.float64)
        for axis, taps in ((1, self._final_taps[0]), (0, self._final_taps[1])):
            radius, n = len(taps) // 2, out.shape[axis]
            places = [_mirrored(np.arange(n) + k - radius, n) for k in range(len(taps))]
            out = np.sum([w * np.take(out, at, axis=axis) for w, at in zip(taps, places, strict=True)], axis=0)
        return out.astype(np.float32)

    def _dilated(self, seen: ImageHeights) -> Any:
        """The contact grown by a square of ``ring`` pixels: rows first, then columns."""
        mi = self.mi
        width, height = self.resolution
        i, _, column, row = seen.pixel(mi)
        first = i - row * width - column
        grown = mi.UInt8(0)
        for k in range(-self.ring[0], self.ring[0] + 1):
            x = mi.UInt32(dr.clip(mi.Int32(column) + k, 0, width - 1))
            grown = grown | dr.gather(mi.UInt8, seen.contact, first + row * width + x)
        dr.eval(grown)
        both = mi.UInt8(0)
        for k in range(-self.ring[1], self.ring[1] + 1):
            y = mi.UInt32(dr.clip(mi.Int32(row) + k, 0, height - 1))
            both = both | dr.gather(mi.UInt8, grown, first + y * width + column)
        return both != 0

    def _blurred(self, packed: Any, taps: np.ndarray, axis: int, border: str) -> Any:
        """One pass of a separable filter along x (axis 0) or y (axis 1) over 4 floats a pixel."""
        mi = self.mi
        width, height = self.resolution
        n, stride = ((width, 1), (height, width))[axis]
        i = dr.arange(mi.UInt32, dr.width(packed) // 4)
        place = (i // stride) % n
        base, at = mi.Int32(i) - mi.Int32(place) * stride, mi.Int32(place)
        radius = len(taps) // 2
        total = mi.Vector4f(0)
        for k, weight in enumerate(taps):
            t = at + (k - radius)
            if border == "mirror":
                t = dr.abs(t)
                t = dr.select(t > n - 1, 2 * (n - 1) - t, t)
            else:
                t = dr.select(t < 0, -1 - t, t)
                t = dr.select(t > n - 1, 2 * n - 1 - t, t)
            # An image narrower than the filter repeats its border.
            total += float(weight) * dr.gather(mi.Vector4f, packed, mi.UInt32(base + dr.clip(t, 0, n - 1) * stride))
        return dr.ravel(total)


def gaussian_taps(sigma: float, radius: int) -> np.ndarray:
    """Weights exp(−k² / 2σ²), k = −radius … radius, that sum to 1; one at k = 0 for σ = 0."""
    k = np.arange(-radius, radius + 1)
    if sigma == 0:
        return (k == 0).astype(np.float64)
    weights = np.exp(-0.5 * (k / sigma) ** 2)
    return weights / weights.sum()


def ordered(values: np.ndarray) -> np.ndarray:
    """float32 as int32 in the same order: of negative ones all bits but the sign are flipped."""
    bits = np.ascontiguousarray(values, dtype=np.float32).view(np.int32)
    return np.where(bits >= 0, bits, bits ^ 0x7FFFFFFF)


def unordered(mi: Any, bits: Any) -> Any:
    """Device inverse of ``ordered``."""
    return dr.reinterpret_array(mi.Float, dr.select(bits >= 0, bits, bits ^ 0x7FFFFFFF))


def _mirrored(index: np.ndarray, n: int) -> np.ndarray:
    index = np.abs(index)
    return np.clip(np.where(index > n - 1, 2 * (n - 1) - index, index), 0, n - 1)
