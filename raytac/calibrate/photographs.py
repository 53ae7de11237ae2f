"""Photographs of ball presses, and the gel surfaces that belong to their contact circles."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.calibrate.presses import read_presses
from raytac.errors import InputError
from raytac.gel.elastic import PYRAMID_SIGMAS, ElasticSurround
from raytac.gel.object_height import object_height
from raytac.gel.pad import rest_height
from raytac.gel.part import primitive
from raytac.gel.surface import GelSurface, PadGrid
from raytac.specs.sensor import SensorSpec

__all__ = ["Photographs", "decode", "encode", "press_balls", "read_photographs"]


@dataclass(frozen=True)
class Photographs:
    """Images in 8-bit levels, as floats: ``background`` (H, W, 3), ``presses`` (N, H, W, 3); ``circles`` (N, 3): x, y, radius [px] at the
    sensor's resolution; ``radius``: of the ball [m]."""

    background: np.ndarray
    presses: np.ndarray
    circles: np.ndarray
    radius: float

    def take(self, index: np.ndarray) -> Photographs:
        return dataclasses.replace(self, presses=self.presses[index], circles=self.circles[index])

    def shrunk(self, factor: int) -> Photographs:
        """Mean of every ``factor`` × ``factor`` pixels."""

        def mean(image: np.ndarray) -> np.ndarray:
            *batch, height, width, _ = image.shape
            return image.reshape(*batch, height // factor, factor, width // factor, factor, 3).mean((-4, -2))

        return dataclasses.replace(self, background=mean(self.background), presses=mean(self.presses))

    def distance(self, sensor: SensorSpec) -> np.ndarray:
        """Distance of every pixel from the circle's centre over its radius, (N, H, W)."""
        height, width = self.background.shape[:2]
        v, u = (np.mgrid[:height, :width] + 0.5) * sensor.camera.resolution[0] / width
        x, y, r = self.circles.T[:, :, None, None]
        return np.hypot(u - x, v - y) / r


def encode(linear: np.ndarray, gamma: float) -> np.ndarray:
    """8-bit levels, not rounded and not cut at 255; the lower end keeps slopes finite."""
    return 255 * np.maximum(linear, 1e-6) ** (1 / gamma)


def decode(levels: np.ndarray, gamma: float) -> np.ndarray:
    """Linear full scale of 8-bit levels."""
    return (levels / 255) ** gamma


def read_photographs(folder: Path, sensor: SensorSpec) -> Photographs:
    """The fully visible presses of a data set that labels its circles, at the sensor's own resolution.

    Raises:
        InputError: no such data set, images of another size than the sensor's, more than one ball, or no fully visible press.
        CalibrationError: a missing or malformed file.
    """
    presses = read_presses(folder)
    presses = presses.take(presses.fully_visible)
    balls = sorted({f"{2e3 * radius:.4g} mm" for radius in presses.ball_radius})
    if len(balls) != 1:
        raise InputError("data", value=balls, rule="must hold fully visible presses of one ball")
    if presses.resolution != sensor.camera.resolution:
        rule = f"must have images of the sensor's size, {sensor.camera.resolution}"
        raise InputError("data", value=presses.resolution, rule=rule)
    background, images = (image.astype(np.float32) for image in (presses.background, presses.images))
    return Photographs(background, images, presses.circles, float(presses.ball_radius[0]))


def press_balls(
    sensor: SensorSpec, grid: PadGrid, shots: Photographs, depth_factor: float = 1.0, scale: float = 1.0
) -> GelSurface:
    """The pad at rest (first environment) and pressed by the ball at each labelled circle.

    A ball of radius R overlaps a dome of radius R_d in a circle of radius a at depth a² (1/R + 1/R_d) / 2 and higher orders; that depth,
    times ``depth_factor``, is taken along the normal of the dome under the circle's centre. ``scale``: widths of the elastic surround
    over Taxim's.
    """
    camera, pad = sensor.camera, sensor.gelpad
    distance, (px, py) = -camera.position[2], camera.pixel_pitch
    poses = np.tile(np.eye(4), (len(shots.circles) + 1, 1, 1))
    poses[0, 2, 3] = 1.0  # far above: no contact
    for pose, (u, v, r) in zip(poses[1:], shots.circles, strict=True):
        z, eps = 0.0, 1e-5
        for _ in range(5):  # the pixel's ray meets the dome
            x = camera.position[0] + (u - camera.principal_point[0]) * px * (1 + z / distance)
            y = camera.position[1] + (v - camera.principal_point[1]) * py * (1 + z / distance)
            around = rest_height(pad, x + eps * np.array([0, 1, -1, 0, 0]), y + eps * np.array([0, 0, 0, 1, -1]))
            z = float(around[0])
        normal = np.array([around[2] - around[1], around[4] - around[3], 2 * eps])
        a = r * px * (1 + z / distance)
        dome = np.mean([1 / pad.dome_radius[0], 1 / pad.dome_radius[1]])
        depth = depth_factor * (shots.radius - np.sqrt(shots.radius**2 - a * a) + 0.5 * a * a * dome)
        pose[:3, 3] = np.array([x, y, z]) + normal / np.linalg.norm(normal) * (shots.radius - depth)
    surround = ElasticSurround(grid, sigmas=tuple(scale * s for s in PYRAMID_SIGMAS))
    return surround.surface(object_height([primitive("sphere", (shots.radius,))], poses, grid.x, grid.y), poses)
