"""The exposure that makes a sensor's image at rest mid-grey, and whether that image is saturated."""

from __future__ import annotations

import numpy as np

from raytac.errors import SpecError
from raytac.specs.sensor import SensorSpec

__all__ = ["SATURATED", "mid_grey_exposure", "saturated_share"]

SATURATED = 0.05
"""Share of pixels at full scale above which an image at rest counts as saturated: shipped sensors have none."""
_LIMITS = (1e-9, 1e9)
"""Exposures that are looked at; the upper one is the largest that a file may have."""
_STEPS = 60


def mid_grey_exposure(sensor: SensorSpec, signal: np.ndarray) -> float:
    """Exposure at which the brightest channel's mean over the image at rest is half of full scale, to four digits.

    e solves max_c mean_p clip(e · s_pc + b_c, 0, 1)^(1/γ) = 1/2 over channels c and pixels p, by bisection: the left side rises with e.

    Args:
        sensor: its response gives γ and the black level b, and names the file of an error.
        signal: s, the linear image at rest with vignette, shading and white balance at exposure 1, (H, W, 3).

    Raises:
        SpecError: no exposure makes mid-grey, since half of the image or more is dark, or since the black level alone is brighter.
    """
    black, gamma = np.asarray(sensor.response.black_level), sensor.response.gamma

    def brightness(exposure: float) -> float:
        return float((np.clip(exposure * signal + black, 0, 1) ** (1 / gamma)).mean(axis=(0, 1)).max())

    low, high = np.log(_LIMITS)
    if not brightness(_LIMITS[0]) < 0.5 < brightness(_LIMITS[1]):
        rule = "no exposure makes the image at rest mid-grey: too much of it is dark, or its black level alone is brighter"
        raise SpecError(rule, file=sensor.source, key="response.exposure", value=sensor.response.exposure)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if brightness(np.exp(middle)) < 0.5 else (low, middle)
    return float(f"{np.exp(0.5 * (low + high)):.4g}")


def saturated_share(rgb: np.ndarray) -> float:
    """Share of the pixels of an 8-bit image (…, 3) with a channel at 255."""
    return float((rgb == 255).any(axis=-1).mean())
