"""Photographs of ball presses as floats in 8-bit levels, and their linear light."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.calibrate.presses import RealPresses, in_image, read_presses
from raytac.errors import InputError
from raytac.specs.sensor import SensorSpec
from raytac.specs.tone import STRAIGHT, ToneCurve

DARK = 1e-6
"""Least light [full scales] that is encoded."""
FAR = 3.0
"""Radii from a contact's centre beyond which a press counts as changing nothing."""


@dataclass(frozen=True)
class Photographs:
    """Images in 8-bit levels, as floats."""

    background: np.ndarray
    """(H, W, 3)."""
    presses: np.ndarray
    """(N, H, W, 3)."""
    circles: np.ndarray
    """x, y, radius [px] at the sensor's resolution, (N, 3)."""
    radius: np.ndarray
    """Those of the balls [m], (N,)."""

    @property
    def fully_visible(self) -> np.ndarray:
        """Mask (N,) of the circles that lie in the image."""
        height, width = self.background.shape[:2]
        return in_image(self.circles, (width, height))

    def take(self, index: np.ndarray) -> Photographs:
        return dataclasses.replace(self, presses=self.presses[index], circles=self.circles[index], radius=self.radius[index])

    def shrunk(self, factor: int) -> Photographs:
        """Mean of every ``factor`` × ``factor`` pixels."""
        return dataclasses.replace(self, background=shrunk(self.background, factor), presses=shrunk(self.presses, factor))

    def distance(self, sensor: SensorSpec) -> np.ndarray:
        """Distance of every pixel from the circle's centre over its radius, (N, H, W)."""
        height, width = self.background.shape[:2]
        v, u = (np.mgrid[:height, :width] + 0.5) * sensor.camera.resolution[0] / width
        x, y, r = self.circles.T[:, :, None, None]
        return np.hypot(u - x, v - y) / r


def shrunk(images: np.ndarray, factor: int) -> np.ndarray:
    """Mean of every ``factor`` × ``factor`` pixels of images (..., H, W, 3).

    Raises InputError for a size that is no multiple of ``factor``.
    """
    *batch, height, width, _ = images.shape
    if height % factor or width % factor:
        raise InputError("size of the images", value=(width, height), rule=f"must be a multiple of {factor} on both sides")
    rows = images.reshape(*batch, height // factor, factor, width, 3).sum(-3)
    # Ten times faster than a mean over both axes, which goes through memory pixel by pixel.
    total = rows[..., ::factor, :]
    for k in range(1, factor):
        total = total + rows[..., k::factor, :]
    return total / factor**2


def encode(linear: np.ndarray, gamma: float, curve: ToneCurve = STRAIGHT) -> np.ndarray:
    """8-bit levels, not rounded and not cut at 255; the lower end keeps slopes finite."""
    u = np.maximum(linear, DARK) ** (1 / gamma)
    return 255 * (u if curve.is_plain else curve.extended(u)[0])


def decode(levels: np.ndarray, gamma: float, curve: ToneCurve = STRAIGHT) -> np.ndarray:
    """Linear full scale of 8-bit levels."""
    u = levels / 255
    return (u if curve.is_plain else curve.extended_straight(u)) ** gamma


def level_slope(linear: np.ndarray, gamma: float, curve: ToneCurve = STRAIGHT) -> np.ndarray:
    """Slope of ``encode`` [levels]; what is darker than ``DARK`` has its slope there."""
    light = np.maximum(linear, DARK)
    u = light ** (1 / gamma)
    return 255 * curve.extended(u)[1] * u / (gamma * light)


def photographs_of(presses: RealPresses, sensor: SensorSpec) -> Photographs:
    """Presses at the sensor's resolution, those at the border among them; all have a circle.

    Raises InputError for other sizes, or none that is fully visible.
    """
    if presses.resolution != sensor.camera.resolution:
        rule = f"must have images of the sensor's size, {sensor.camera.resolution}, or say --pixel-mm"
        raise InputError("data", value=presses.resolution, rule=rule)
    if not presses.fully_visible.any():
        raise InputError("data", value="0 presses", rule="must hold a press whose contact circle lies in the image")
    widest = presses.circles[:, 2] * sensor.camera.pixel_pitch[0] / presses.ball_radius
    if (widest >= 1).any():
        k = int(np.argmax(widest))
        across, ball = (2e3 * length for length in (widest[k] * presses.ball_radius[k], presses.ball_radius[k]))
        rule = f"must be smaller than the ball, which has {ball:.4g} mm"
        raise InputError(f"circle of press {presses.names[k]}", value=f"{across:.4g} mm across", rule=rule)
    background, images = (image.astype(np.float32) for image in (presses.background, presses.images))
    return Photographs(background, images, presses.circles, presses.ball_radius)


def read_photographs(data: Path, sensor: SensorSpec) -> Photographs:
    """``photographs_of`` the presses of a data set with labelled circles; as ``read_presses``."""
    return photographs_of(read_presses(data), sensor)
