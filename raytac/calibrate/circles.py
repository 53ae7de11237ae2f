"""Contact circles in images of ball presses: where the colour changes most along a circle.

With D the image minus that of the untouched sensor, the score of a circle is the mean over its angles of the step |D(r − δ) − D(r + δ)|,
Euclidean over the channels [levels]. The shading of a pressed ball is strongest at the rim of its contact and falls off within the
surround, so the score peaks there. A search starts at the centroid of the change and climbs from coarse steps to fine ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.calibrate.presses import RealPresses
from raytac.errors import InputError
from raytac.gel.interpolate import sampled

DOUBTFUL = 5.0
"""Score [levels] below which a circle is a guess: three times the noise of a Mini's pixel."""
_REACH = 0.08
"""δ over the circle's radius."""
_ANGLES = 96
_LEAST_INSIDE = 0.4
"""Share of a circle's angles that must lie in the image."""
_STEPS = (0.2, 0.1, 0.05, 0.02, 0.01)
"""Steps of the search over the radius of the first guess."""


@dataclass(frozen=True)
class FoundCircles:
    """Result of ``find_circles``."""

    circles: np.ndarray
    """x, y, radius [px], (N, 3)."""
    score: np.ndarray
    """Mean colour step across each circle [levels], (N,)."""

    @property
    def doubtful(self) -> np.ndarray:
        """True where a circle's step is below ``DOUBTFUL``, (N,) bool."""
        return self.score < DOUBTFUL


def find_circles(presses: RealPresses, pixel_pitch: float) -> FoundCircles:
    """The contact circle of every press, without labels.

    ``pixel_pitch`` [m]: a contact is not wider than its ball. Raises InputError for a ball whose contact could be wider than the image.
    """
    smallest = min(presses.resolution)
    widest = presses.ball_radius / pixel_pitch
    if (widest > smallest / 2).any():
        large = 2e3 * float(presses.ball_radius[widest > smallest / 2][0])
        rule = f"must be smaller than the view: {1e3 * smallest * pixel_pitch:.4g} mm across, {smallest} px of {pixel_pitch * 1e3:.4g} mm"
        raise InputError("ball_diameter_mm", value=large, rule=rule)
    background = presses.background.astype(np.float32)
    circles, scores = [], []
    for image, limit in zip(presses.images, widest, strict=True):
        change = _smoothed(image.astype(np.float32) - background)
        circle, score = _climb(change, _first_guess(change, limit), limit)
        circles.append(circle)
        scores.append(score)
    return FoundCircles(np.array(circles).reshape(-1, 3), np.array(scores))


def with_found_circles(presses: RealPresses, pixel_pitch: float) -> tuple[RealPresses, np.ndarray]:
    """The presses with a circle each, and a mask of those whose circle is doubtful, (N,) bool."""
    unknown = np.asarray(np.isnan(presses.circles).any(axis=1))
    doubtful = np.zeros(len(presses), bool)
    if not unknown.any():
        return presses, doubtful
    result = find_circles(presses.take(unknown), pixel_pitch)
    circles = presses.circles.copy()
    circles[unknown], doubtful[unknown] = result.circles, result.doubtful
    return presses.with_circles(circles), doubtful


def circle_score(change: np.ndarray, circles: np.ndarray) -> np.ndarray:
    """Mean colour step [levels] across ``circles`` (N, 3) in ``change``; −1 off the image."""
    x, y, r = np.asarray(circles, dtype=float).T[..., None]
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    sides, valid = [], True
    for factor in (1 - _REACH, 1 + _REACH):
        value, inside = _sample(change, x + factor * r * np.cos(angle), y + factor * r * np.sin(angle))
        sides.append(value)
        valid = valid & inside
    step = np.linalg.norm(sides[0] - sides[1], axis=-1)
    count = np.sum(valid, axis=-1)
    mean = np.sum(np.where(valid, step, 0), axis=-1) / np.maximum(count, 1)
    return np.where(count >= _LEAST_INSIDE * _ANGLES, mean, -1.0)


def _first_guess(change: np.ndarray, limit: float) -> np.ndarray:
    """Circle of the pixels that changed by more than a third of the most: centroid and area."""
    size = np.linalg.norm(change, axis=-1)
    strong = size > np.percentile(size, 99.5) / 3
    row, column = np.nonzero(strong)
    radius = float(np.clip(np.sqrt(strong.sum() / np.pi), 3.0, 0.9 * limit))
    return np.array([np.median(column) + 0.5, np.median(row) + 0.5, radius])


def _climb(change: np.ndarray, circle: np.ndarray, limit: float) -> tuple[np.ndarray, float]:
    """Best circle by trying all 26 neighbours a step, ever finer; ``limit`` of the radius [px]."""
    directions = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    best = float(circle_score(change, circle[None])[0])
    scale = circle[2]
    for step in _STEPS:
        for _ in range(40):
            trial = circle + step * scale * directions
            trial[:, 2] = np.clip(trial[:, 2], 2.0, limit)
            score = circle_score(change, trial)
            if score.max() <= best + 1e-9:
                break
            circle, best = trial[score.argmax()], float(score.max())
    return circle, best


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear values at pixel positions (first centre at 0.5); a mask of those in the image."""
    height, width = image.shape[:2]
    x, y = u - 0.5, v - 0.5
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    channels = sampled(np.moveaxis(image, -1, 0), np.arange(width), np.arange(height), x, y)
    return np.moveaxis(channels, 0, -1), inside


def _smoothed(image: np.ndarray) -> np.ndarray:
    """Binomial smoothing, 1 4 6 4 1 along both axes (σ = 1 px), the border repeated."""
    for axis in (0, 1):
        padded = np.pad(image, [(2, 2) if k == axis else (0, 0) for k in range(3)], mode="edge")
        n = image.shape[axis]
        taps = [w / 16 * np.take(padded, np.arange(k, k + n), axis=axis) for k, w in enumerate((1, 4, 6, 4, 1))]
        image = np.sum(taps, axis=0)
    return image
