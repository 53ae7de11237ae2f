"""Motion of a ball from the rings that its printed layers leave in the coat of two photographs.

A point of the ball at r from its centre moves by d + ω × r. Seen along z, with s the negative of its height over the ball's lowest point:
u = u₀ + s ρ, where u₀ is the lowest point's motion and ρ = (−ω_y, ω_x) the roll; the centre moves by u₀ − R ρ. These four numbers make the
correlation of both photographs' rings greatest. A turn about the axis of the rings leaves them where they are, so it is taken as none. Dots
are masked: they are on the gel, and the gel may slip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

BAND = 1.2, 3.0
"""Gaussians [px] whose difference keeps the rings."""
DOT = 0.12
"""Darkness, or glare, above which a pixel is none of the coat's; its neighbours within 3 px neither."""
FIRST = np.arange(-16.0, 16.1, 1.0)
"""Displacements that are tried first along either axis [px]."""


@dataclass(frozen=True)
class LayerMotion:
    """Motion between the photographs."""

    lowest: tuple[float, float]
    """Displacement of the ball's lowest point [px]."""
    roll: tuple[float, float]
    """ρ [rad]: by how much farther along x and y the lowest point moves than the centre, over the radius."""
    centre: tuple[float, float]
    """Displacement of its centre [px]."""
    correlation: float
    without_roll: float
    """Correlation of rings with the best motion, and with the best that does not roll."""

    def figures(self, pitch_um: float) -> dict[str, float]:
        """The motion in µm and degrees by name; ``pitch_um``: size of a pixel."""
        values = {"correlation": self.correlation, "without_roll": self.without_roll}
        for k, axis in enumerate("xy"):
            values |= {f"lowest_{axis}_um": pitch_um * self.lowest[k], f"centre_{axis}_um": pitch_um * self.centre[k]}
            values[f"roll_{axis}_deg"] = float(np.degrees(self.roll[k]))
        return values


def layer_motion(before: np.ndarray, after: np.ndarray, circle: np.ndarray, radius: float) -> LayerMotion:
    """Motion of a ball of ``radius`` [px] between photographs (H, W, 3); rings within ``circle`` (3,) [px]."""
    (first, is_coat), (second, is_later) = (_rings(image) for image in (before, after))
    v, u = np.mgrid[: first.shape[0], : first.shape[1]].astype(float)
    x, y = u + 0.5 - circle[0], v + 0.5 - circle[1]
    used = is_coat & (x**2 + y**2 < min(circle[2], 0.95 * radius) ** 2)
    x, y, u, v, rings = x[used], y[used], u[used], v[used], first[used]
    s = np.sqrt(radius**2 - x**2 - y**2) - radius
    later, splines = is_later.astype(float), ndimage.spline_filter(second, order=3, mode="constant")

    def cost(motion: np.ndarray) -> float:
        dx, dy, *roll = motion
        across, along = roll or (0.0, 0.0)
        place = np.stack([v + dy + along * s, u + dx + across * s])
        seen = ndimage.map_coordinates(later, place, order=1) > 0.99
        if seen.sum() < 50:
            return 0.0
        one, two = rings[seen], ndimage.map_coordinates(splines, place[:, seen], order=3, prefilter=False)
        if one.std() == 0.0 or two.std() == 0.0:  # a ball without layers
            return 0.0
        return -float(np.corrcoef(one, two)[0, 1])

    def best(start: np.ndarray, steps: tuple[float, ...]) -> optimize.OptimizeResult:
        simplex = np.vstack([start, start + np.diag(steps)])
        return optimize.minimize(
            cost, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxiter": 2000, "xatol": 1e-4, "fatol": 1e-6}
        )

    coarse = min((cost(np.array([dx, dy])), dx, dy) for dx in FIRST for dy in FIRST)
    shift = best(np.array(coarse[1:]), (0.5, 0.5))
    full = best(np.array([*shift.x, 0.0, 0.0]), (0.5, 0.5, 0.05, 0.05))
    dx, dy, across, along = (float(value) for value in full.x)
    centre = dx - radius * across, dy - radius * along
    return LayerMotion((dx, dy), (across, along), centre, -float(full.fun), -float(shift.fun))


def _rings(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rings in the brightness of a photograph, and the mask of pixels that show the coat, (H, W) each."""
    bright, grey = image[..., :3].max(axis=2).astype(float), image[..., :3].mean(axis=2)
    behind = ndimage.gaussian_filter(ndimage.percentile_filter(bright, 80, size=27), 6.0)
    coat = np.logical_not(ndimage.binary_dilation(np.abs(bright / np.maximum(behind, 1.0) - 1.0) > DOT, iterations=3))
    weight = coat.astype(float)
    fine, wide = (
        ndimage.gaussian_filter(grey * weight, sigma) / np.maximum(ndimage.gaussian_filter(weight, sigma), 1e-3) for sigma in BAND
    )
    return fine - wide, coat
