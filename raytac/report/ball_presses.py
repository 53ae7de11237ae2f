"""Photographs of ball presses with labelled contact circles, and the gel surfaces that belong to them.

A folder holds ``background.png`` (the sensor untouched), ``labels.csv`` (columns ``diameter``, ``index``, ``cx_px``, ``cy_px``, ``r_px``,
``fully_visible``) and ``DIAMETER_INDEX.png``, such as ``6.310mm_07.png``, all at the sensor's own resolution.
"""

from __future__ import annotations

import csv
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.errors import InputError
from raytac.gel.elastic import PYRAMID_SIGMAS, ElasticSurround
from raytac.gel.object_height import object_height
from raytac.gel.pad import rest_height
from raytac.gel.part import primitive
from raytac.gel.surface import GelSurface, PadGrid
from raytac.io.png import read_png
from raytac.specs.sensor import SensorSpec

__all__ = ["Photographs", "encode", "press_balls", "read_photographs"]


@dataclass(frozen=True)
class Photographs:
    """Images in linear full scale: ``background`` (H, W, 3), ``presses`` (N, H, W, 3); ``circles`` (N, 3): x, y, radius [px] at the
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
    """8-bit levels, not rounded; the lower end keeps slopes finite."""
    return 255 * np.clip(linear, 1e-6, 1) ** (1 / gamma)


def read_photographs(folder: Path, sensor: SensorSpec) -> Photographs:
    """The fully visible presses of a folder.

    Raises:
        InputError: no such folder, a missing file, an image of another size, more than one ball, or no fully visible press.
    """
    for needed in (folder, folder / "labels.csv", folder / "background.png"):
        if not needed.exists():
            raise InputError("data", value=str(needed), rule="must exist: background.png, labels.csv and photographs, see --help")
    with (folder / "labels.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["fully_visible"] == "1"]
    balls = {row["diameter"] for row in rows}
    if len(balls) != 1:
        raise InputError("data", value=sorted(balls), rule="must hold fully visible presses of one ball")
    width, height = sensor.camera.resolution

    def image(path: Path) -> np.ndarray:
        pixels = read_png(path)
        if pixels.shape != (height, width, 3):
            raise InputError(
                "data", value=f"{path.name}: {pixels.shape}", rule=f"must have the sensor's shape ({height}, {width}, 3)"
            )
        return (pixels / 255) ** sensor.response.gamma

    ball = balls.pop()
    presses = np.stack([image(folder / f"{ball}_{int(row['index']):02d}.png") for row in rows])
    circles = np.array([[float(row[key]) for key in ("cx_px", "cy_px", "r_px")] for row in rows])
    return Photographs(image(folder / "background.png"), presses, circles, float(ball.removesuffix("mm")) / 2e3)


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
