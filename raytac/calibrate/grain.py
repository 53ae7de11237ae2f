"""Grain: the noise of a camera's pixels, measured in photographs of presses.

Pixels that no press reaches show the same coat in every photograph, so what differs between photographs is noise. Its variance
depends on the pixel's level: shot noise grows with light, and the camera's curve and filters change it again. It is fitted by a straight
line over the level, given by its ends, dark (0) and bright (255), neither below 0.
"""

from __future__ import annotations

import numpy as np

from raytac.calibrate.drift import Settled
from raytac.calibrate.photographs import FAR
from raytac.specs.sensor import NoiseSpec, SensorSpec

BINS = 12
"""Bins of level, of as many pixels each."""
PIXELS = 100
"""Fewest pixels of a bin."""
FEWEST = 3
"""Fewest photographs that must show a pixel untouched."""
ROUNDING = 1 / 12
"""Variance of rounding to whole levels; the 8-bit image has it anyway."""


def measured_grain(sensor: SensorSpec, steady: Settled) -> NoiseSpec | None:
    """Noise of the photographs beyond ``FAR`` radii, without drift and without rounding.

    The variance in a pixel is that about its mean over photographs, with n − 1 degrees of freedom. None where too few photographs
    show the same pixels untouched.
    """
    samples = grain_samples(sensor, steady)
    if samples is None:
        return None
    level, variance = samples
    ends = np.array([_line(level[:, c], variance[:, c]) for c in range(3)])
    dark, bright = (tuple(map(float, end)) for end in ends.T)
    return NoiseSpec(dark_variance=dark, bright_variance=bright)  # type: ignore[arg-type]


def grain_samples(sensor: SensorSpec, steady: Settled) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean level and variance [levels²] by bin of level and channel, each (``BINS``, 3).

    None with fewer than ``PIXELS`` a bin that ``FEWEST`` photographs show untouched.
    """
    shots = steady.shots
    far = shots.distance(sensor) > FAR
    count = far.sum(0)
    used = count >= FEWEST
    if used.sum() < PIXELS * BINS:
        return None
    own = far[:, used, None]
    seen, times = shots.presses[:, used], count[used][:, None]
    mean = np.where(own, seen, 0).sum(0) / times
    square = np.where(own, (seen - mean) ** 2, 0).sum(0)
    level, variance = np.empty((2, BINS, 3))
    for c in range(3):
        order = np.argsort(mean[:, c], kind="stable")
        for k, part in enumerate(np.array_split(order, BINS)):
            level[k, c] = mean[part, c].mean()
            variance[k, c] = square[part, c].sum() / (times[part, 0] - 1).sum()
    return level, np.maximum(variance - ROUNDING, 0)


def _line(level: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Ends at 0 and 255 of the line through variances, both >= 0; weights as of variances."""
    weight = 1 / np.maximum(variance, 0.1 * max(float(variance.max()), 1e-6))
    basis = np.stack([1 - level / 255, level / 255], axis=1)
    ends, *_ = np.linalg.lstsq(basis * weight[:, None], variance * weight, rcond=None)
    for k in (0, 1):  # an end below 0 is put there, and the other alone is solved for
        if ends[k] < 0:
            other = basis[:, 1 - k] * weight
            ends[k], ends[1 - k] = 0.0, max(float(other @ (variance * weight) / (other @ other)), 0.0)
            break
    return float(ends[0]), float(ends[1])
