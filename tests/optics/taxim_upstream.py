"""Taxim's released simulator from its description, in NumPy and SciPy, float64: what the table mode must agree with.

Written for clarity, one pixel loop where upstream has one, and independent of ``raytac``: its own binning, kernels and shadow march.
Channels here are B, G, R, as upstream's files have them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter

PYRAMID = (201, 101, 51, 21, 11, 5)


@dataclass
class Upstream:
    """One calibration: ``polynomials`` (3, n, n, 6) and ``shadow`` lists [3][n_dir][n_depth], B, G, R."""

    polynomials: np.ndarray
    background: np.ndarray
    pixmm: float
    shadow: list | np.ndarray | None = None
    directions: np.ndarray = field(default_factory=lambda: np.arange(0, 2 * np.pi, 0.1))

    def image(self, z: np.ndarray, mask: np.ndarray, lift: np.ndarray, *, shadow: bool = False) -> np.ndarray:
        """Image of heights ``z`` [px], contact ``mask`` and ``lift`` above the gel at rest [px]; neither rounded nor clipped."""
        magnitude, direction = slopes(z)
        i, j = self.bins(magnitude, direction)
        return self.with_bins(z, mask, lift, i, j, direction, shadow=shadow)

    def bins(self, magnitude: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bin coordinates before rounding down."""
        n = self.polynomials.shape[1]
        return magnitude / (np.pi / 2 / (n - 1)), (direction + np.pi) / (2 * np.pi / (n - 1))

    def with_bins(
        self,
        z: np.ndarray,
        mask: np.ndarray,
        lift: np.ndarray,
        i: np.ndarray,
        j: np.ndarray,
        direction: np.ndarray,
        *,
        shadow: bool,
    ) -> np.ndarray:
        h, w = z.shape
        y, x = np.mgrid[0:h, 0:w].astype(float)
        monomials = np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=-1)
        n = self.polynomials.shape[1] - 1
        coefficients = self.polynomials[:, np.clip(np.floor(i).astype(int), 0, n), np.clip(np.floor(j).astype(int), 0, n)]
        change = np.moveaxis((coefficients * monomials).sum(-1), 0, -1)
        if not shadow:
            return change + self.background
        assert self.shadow is not None
        ring = dilate(mask) & ~mask
        out = np.empty_like(change)
        for c in range(3):
            frame = change[..., c].copy()
            for row, column in zip(*np.nonzero(ring), strict=True):
                self.cast(frame, c, z, lift, direction, int(row), int(column))
            out[..., c] = gaussian_filter(frame, sigma=(2.0, 2.0))
        return opencv_blur(out + self.background, 5)

    def cast(
        self, frame: np.ndarray, c: int, z: np.ndarray, lift: np.ndarray, direction: np.ndarray, row: int, column: int
    ) -> None:
        assert self.shadow is not None
        n = int((direction[row, column] + np.pi) // 0.1)
        depth = int((lift[row, column] * self.pixmm - 0.4) // 0.1) + 6
        if depth < 0 or depth >= len(self.shadow[c][n]):
            return
        levels = self.shadow[c][n][depth]
        h, w = z.shape
        for theta in np.arange(self.directions[n] - 0.1, self.directions[n] + 0.1, 0.05):
            for s in range(1, len(levels)):
                u, v = int(column + 1.25 * s * np.cos(theta)), int(row + 1.25 * s * np.sin(theta))
                if 0 <= u < w and 0 <= v < h and z[row, column] > z[v, u]:
                    frame[v, u] = min(frame[v, u], levels[s])


def slopes(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(magnitude, direction) [rad] by central differences inside, repeated on the rim."""
    down, right = (z[2:, 1:-1] - z[:-2, 1:-1]) / 2, (z[1:-1, 2:] - z[1:-1, :-2]) / 2
    steep = np.sqrt(down**2 + right**2)
    direction = np.where(steep == 0, 0.0, np.arctan2(down, right))
    return np.pad(np.arctan(steep), 1, mode="symmetric"), np.pad(direction, 1, mode="symmetric")


def dilate(mask: np.ndarray) -> np.ndarray:
    """Two dilations by a square of 5 pixels."""
    for _ in range(2):
        padded = np.pad(mask, 2)
        mask = np.any([padded[a : a + mask.shape[0], b : b + mask.shape[1]] for a in range(5) for b in range(5)], axis=0)
    return mask


def opencv_sigma(size: int) -> float:
    """OpenCV's width for a kernel of this size."""
    return 0.3 * ((size - 1) * 0.5 - 1) + 0.8


def opencv_blur(image: np.ndarray, size: int) -> np.ndarray:
    """``cv2.GaussianBlur(image, (size, size), 0)``: sampled weights, border mirrored about the edge pixels."""
    k = np.arange(size) - size // 2
    weights = np.exp(-0.5 * (k / opencv_sigma(size)) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        image = convolve1d(image, weights, axis=axis, mode="mirror")
    return image


def processed_background(f0: np.ndarray) -> np.ndarray:
    """The rest image as upstream adds it: uint8 in, whole levels out."""
    sharp, out = f0.astype(float), f0.copy()
    for c in range(3):
        out[..., c] = gaussian_filter(sharp[..., c], 50)
    below = (out - sharp).mean(axis=2) < 5
    for c in range(3):
        out[..., c][below] = 0.15 * out[..., c][below] + 0.85 * sharp[..., c][below]
    return out.astype(float)


def deform(heights: np.ndarray, gel_map: np.ndarray, press_mm: float, pixmm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z, mask, lift) [px] of an object's ``heights`` [px] pressed ``press_mm`` into the gel: upstream's pyramid."""
    gel = opencv_blur(gel_map.astype(float), 5)
    press = press_mm / pixmm
    gel = gel.max() + heights.max() - press - gel
    contact = heights > gel
    pressed = np.where(contact, heights, gel)
    mask = (pressed - gel > 0.4 * press) & contact
    z = pressed.copy()
    for size in PYRAMID:
        z = opencv_blur(z, size)
        z[mask] = pressed[mask]
    z = opencv_blur(z, 5)
    return z, mask, z - gel
