"""Session drift: gains and offsets of photographs against the image at rest.

A camera's gains wander from day to day and while it warms up. Pixels far from a contact see the coat at rest, so that they tell how
a photograph I of one press differs from the image at rest B, a gain g and an offset o a channel:

    I = g B + o.

The same gain and offset hold in the contact, where the image is the model's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from raytac.calibrate.photographs import FAR, Photographs
from raytac.specs.sensor import SensorSpec

BLOCK = 8
"""Side [px] of the squares whose means are compared: noise in B would else bias the gain."""
FEWEST_BLOCKS = 30
"""Fewest squares that tell gain and offset; a photograph with fewer counts as steady."""
CLIP = 3.0
"""Squares so many standard deviations off are left out once: dust, or a long shadow."""
GAIN_SIGMA = 0.1
"""Standard deviation of gains about 1 before the data, which matters where B is nearly even."""
ROUNDS = 3
"""Times that image at rest and drift are computed in turn."""


@dataclass(frozen=True)
class Drift:
    """Gain and offset [levels] of N photographs by channel, each (N, 3)."""

    gain: np.ndarray
    offset: np.ndarray

    def take(self, index: np.ndarray | Sequence[int]) -> Drift:
        return Drift(self.gain[index], self.offset[index])

    def applied(self, images: np.ndarray) -> np.ndarray:
        """Images (N, H, W, 3) [levels] as these photographs would show them, as floats."""
        return self.gain[:, None, None] * images + self.offset[:, None, None]

    def removed(self, photographs: np.ndarray) -> np.ndarray:
        """Photographs (N, H, W, 3) [levels] as without drift, as floats."""
        return ((photographs - self.offset[:, None, None]) / self.gain[:, None, None]).astype(np.float32)

    def at(self, level: float) -> np.ndarray:
        """Change of a pixel of this level [levels], (N, 3)."""
        return (self.gain - 1) * level + self.offset


def no_drift(count: int) -> Drift:
    """Drift of ``count`` photographs that have none."""
    return Drift(np.ones((count, 3)), np.zeros((count, 3)))


def measured_drift(sensor: SensorSpec, shots: Photographs, rest: np.ndarray) -> Drift:
    """Drift of the presses of ``shots`` against the image at rest ``rest`` (H, W, 3) [levels].

    Least squares over squares of pixels beyond ``FAR`` radii of each press. A press with fewer than ``FEWEST_BLOCKS`` of these has none.
    """
    near = shots.distance(sensor) <= FAR
    return _drift(shots.presses, near, rest)


@dataclass(frozen=True)
class Settled:
    """Photographs of one reference session, and what was taken from them."""

    shots: Photographs
    """Presses without drift; ``background`` is the image at rest, a mean not rounded."""
    drift: Drift
    """Drift of every press, (N, 3): over all presses its mean gain is 1, its mean offset 0."""
    background: Drift
    """Drift of the one photograph at rest, (1, 3)."""


def settled(sensor: SensorSpec, shots: Photographs, *, drift: bool = True) -> Settled:
    """The presses of ``shots`` with a common image at rest, and their session drift.

    The image at rest is the mean of its photograph and of the presses' pixels beyond ``FAR`` radii. One photograph of the sensor at
    rest holds that photograph's noise, and was taken at another time than the presses were. With ``drift`` the mean is that of
    photographs whose drift is removed; the mean of the presses' drift is the reference.
    """
    near = shots.distance(sensor) <= FAR
    far, count = ~near[..., None], len(shots.presses)
    own, of_background, presses, background = no_drift(count), no_drift(1), shots.presses, shots.background
    rest = _mean(background, presses, far)
    for _ in range(ROUNDS if drift else 0):
        own = _drift(shots.presses, near, rest)
        mean = Drift(own.gain.mean(0, keepdims=True), own.offset.mean(0, keepdims=True))
        own = Drift(own.gain / mean.gain, own.offset - mean.offset * own.gain / mean.gain)
        of_background = _drift(shots.background[None], np.zeros((1, *near.shape[1:]), bool), rest)
        of_background = Drift(of_background.gain / mean.gain, of_background.offset - mean.offset * of_background.gain / mean.gain)
        presses, background = own.removed(shots.presses), of_background.removed(shots.background[None])[0]
        rest = _mean(background, presses, far)
    return Settled(replace(shots, presses=presses, background=np.clip(rest, 0, 255).astype(np.float32)), own, of_background)


def _mean(background: np.ndarray, presses: np.ndarray, far: np.ndarray) -> np.ndarray:
    return (background + np.where(far, presses, 0).sum(0)) / (1 + far.sum(0))


def _drift(photographs: np.ndarray, near: np.ndarray, rest: np.ndarray) -> Drift:
    """Drift of photographs (N, H, W, 3); ``near`` (N, H, W): pixels that do not count."""
    count = len(photographs)
    result = no_drift(count)
    still = _blocks(rest)
    for k in range(count):
        free = _blocks((~near[k]).astype(float)[..., None])[:, 0] == 1  # whole squares alone
        if free.sum() < FEWEST_BLOCKS:
            continue
        seen = _blocks(photographs[k])
        for c in range(3):
            result.gain[k, c], result.offset[k, c] = _line(still[free, c], seen[free, c])
    return result


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset of y = g x + o, with what is far off left out once."""
    keep, gain, offset = np.ones(len(x), bool), 1.0, 0.0
    for _ in range(2):
        middle, at = x[keep].mean(), (y - x)[keep].mean()
        away = x[keep] - middle
        noise = max(float((y - x)[keep].var()), 1e-9)
        slope = float(away @ ((y - x)[keep] - at) / (away @ away + noise / GAIN_SIGMA**2))
        gain, offset = 1 + slope, float(at - slope * middle)
        off = y - gain * x - offset
        keep = np.abs(off) <= CLIP * max(float(off[keep].std()), 1e-9)
    return gain, offset


def _blocks(image: np.ndarray) -> np.ndarray:
    """Means (K, C) over the whole squares of an image (H, W, C)."""
    height, width, channels = image.shape
    rows, columns = height // BLOCK, width // BLOCK
    cut = image[: rows * BLOCK, : columns * BLOCK].astype(float)
    return cut.reshape(rows, BLOCK, columns, BLOCK, channels).mean((1, 3)).reshape(-1, channels)
