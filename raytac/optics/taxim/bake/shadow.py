"""Shadow table of the virtual calibration, read off pins and balls of rising depth.

Upstream looks at one pin an image and takes for its shadow what is darker than rest by 10 levels along rays from the rim (Si and Yuan, RA-L
2022, section III-C). Rendering a press with and without cast shadows tells what *is* shadow, so nothing is guessed from darkness, and
lists are read from every ring pixel that casts in the forward model. They are kept by how far the shaded pixel lies below the one that
casts (``ShadowTable.depth_of`` = ``"drop"``): a shadow reaches as far as drop and distance let a light graze the rim.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np

from raytac.optics.taxim.bake.presses import ball_presses, pin_presses
from raytac.optics.taxim.bake.settings import PLAIN, BakeSettings
from raytac.optics.taxim.bake.views import Calibration, Views
from raytac.optics.taxim.table import ShadowTable

DIRECTION_PRECISION, STEP = 0.1, 1.25
"""Width of a direction bin [rad], distance between the values of a list [px] (upstream's)."""
DEPTH_PRECISION = 0.05e-3
"""Width of a depth bin [m], half of upstream's."""
NOTHING = 255.0
"""Value where there is no shadow: no difference is larger, so the image stays as it is."""
_SHADED = 2.0
"""Least levels by which a shaded pixel is darkened: above rounding."""
_SHARE = 0.9
"""Share of the samples that must be shaded.

A table does not know the place, and of many rays the darkest counts, so that a shadow which falls elsewhere does harm: with 0.7 balls
off the centre lost 2 dB, with 0.9 no press lost more than 0.1 dB."""
_FEWEST = 3
"""Samples below which a value is not trusted."""


class ShadowSums:
    """Levels along the rays from all ring pixels, summed by direction, drop and step."""

    def __init__(self, ring: int, deepest: float, resolution: tuple[int, int]) -> None:
        """``ring`` [px]: width of the ring that casts; ``deepest`` [m]: largest drop with a bin."""
        self._ring = ring
        self.directions = np.arange(0.0, 2 * np.pi, DIRECTION_PRECISION)
        # A list never leaves the image; half its diagonal is beyond any shadow of a press seen so far.
        steps = int(np.hypot(*resolution) / (2 * STEP)) + 2
        self.shape = (len(self.directions), int(np.ceil(deepest / DEPTH_PRECISION)), steps)
        self._samples = np.zeros(self.shape)
        self._shaded = np.zeros((3, *self.shape))
        self._levels = np.zeros((3, *self.shape))

    def add(self, views: Views, cast: np.ndarray, rest: np.ndarray) -> None:
        """Add presses; ``cast`` [levels], (B, H, W, 3): what shadows add; ``rest``: image at rest."""
        for b in range(len(views.rgb)):
            self._add_one(views, b, views.rgb[b].astype(np.float32) - rest, cast[b])

    def _add_one(self, views: Views, b: int, change: np.ndarray, cast: np.ndarray) -> None:
        contact, moved = views.contact[b], views.moved[b]
        height, width = contact.shape
        n_dir, n_depth, steps = self.shape
        row, column = np.nonzero(dilated(contact, self._ring) & ~contact)
        slope_x, slope_y = views.slope_x[b, row, column], views.slope_y[b, row, column]
        a = np.floor((np.arctan2(slope_y, slope_x) + np.pi) / DIRECTION_PRECISION).astype(int)
        a = np.minimum(a, n_dir - 1)
        distance = STEP * np.arange(steps)
        x = np.floor(column[:, None] + distance * np.cos(self.directions[a])[:, None]).astype(int)
        y = np.floor(row[:, None] + distance * np.sin(self.directions[a])[:, None]).astype(int)
        n, s = np.nonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
        x, y = x[n, s], y[n, s]
        drop = moved[row, column][n] - moved[y, x]
        d = np.floor(drop / DEPTH_PRECISION).astype(int)
        known = (drop > 0) & (d < n_depth)
        n, s, x, y, d = n[known], s[known], x[known], y[known], d[known]
        key = (a[n] * n_depth + d) * steps + s
        self._samples += self._sum(key, np.ones(len(key)))
        for c in range(3):
            shaded = cast[y, x, c] < -_SHADED
            self._shaded[c] += self._sum(key, shaded)
            self._levels[c] += self._sum(key, np.where(shaded, change[y, x, c], 0))

    def _sum(self, key: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.bincount(key, weights, self._samples.size).reshape(self.shape)

    def table(self) -> ShadowTable:
        """The table: mean of the shaded samples where most are shaded, ``NOTHING`` elsewhere."""
        shaded = (self._shaded >= _SHARE * self._samples) & (self._samples >= _FEWEST)
        values = np.where(shaded, self._levels / np.maximum(self._shaded, 1), NOTHING).astype(np.float32)
        lengths = np.where(shaded, np.arange(self.shape[2]) + 1, 0).max(axis=-1).astype(np.int32)
        values = values[..., : max(2, int(lengths.max()))]
        values[np.arange(values.shape[-1]) >= lengths[..., None]] = 0
        bins = {"first_depth": 0.0, "depth_precision": DEPTH_PRECISION, "depth_offset": 0, "depth_of": "drop"}
        return ShadowTable(self.directions, values, lengths, direction_precision=DIRECTION_PRECISION, step=STEP, **bins)


def bake_shadow(
    at: Calibration,
    *,
    settings: BakeSettings | None = None,
    seed: int = 0,
    tick: Callable[[int], object] = lambda count: None,
) -> ShadowTable:
    """The shadow table alone, in levels of ``at``; ``tick`` is called with numbers of images."""
    settings = BakeSettings() if settings is None else settings
    pad, grid, camera = at.sensor.gelpad, at.grid, at.tracer.camera
    shades = ShadowSums(2 * PLAIN.ring_dilations, settings.depth_range(pad.thickness)[1], camera.resolution)
    # Pins, whose walls are as steep as the surround allows, and as many single balls, whose flanks cast little.
    single = replace(settings, images=settings.pins, balls=1, bare_share=0.0)
    presses = chain(pin_presses(pad, grid, camera, settings, seed), ball_presses(pad, grid, camera, single, seed + 1))
    for views, cast in at.shadow_views(presses):
        shades.add(views, cast, at.rest_image)
        tick(3 * len(views.rgb))
    return shades.table()


def dilated(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The mask (H, W) grown by a square that reaches ``pixels`` to each side."""
    grown = mask
    for axis in (0, 1):
        padded = np.pad(grown, [(pixels, pixels) if k == axis else (0, 0) for k in (0, 1)])
        grown = np.any([np.take(padded, np.arange(mask.shape[axis]) + k, axis=axis) for k in range(2 * pixels + 1)], axis=0)
    return grown
