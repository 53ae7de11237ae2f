"""The pinhole camera: from pixels to rays and back, the same numbers for every integrator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.specs.sensor import CameraSpec

__all__ = ["Pinhole"]


@dataclass(frozen=True)
class Pinhole:
    """A pinhole at ``position`` [m] looking along +z of the pad frame, x right, y down (OpenCV convention).

    Pixel (u, v) counts from the top-left image corner, so the centre of the first pixel is (0.5, 0.5). ``focal`` = (fx, fy) and
    ``principal`` = (cx, cy) are in pixels of ``resolution`` = (width, height).
    """

    position: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    resolution: tuple[int, int]

    @classmethod
    def from_spec(cls, spec: CameraSpec, resolution: tuple[int, int] | None = None) -> Pinhole:
        """Scale the native camera to ``resolution`` (width, height) [px]; the field of view stays that of the native image.

        With the pinhole a distance d below the gel plane, a pixel of pitch p there is the angle p / d: f = d / p.
        """
        width, height = spec.resolution if resolution is None else resolution
        sx, sy = width / spec.resolution[0], height / spec.resolution[1]
        distance = -spec.position[2]
        return cls(
            position=spec.position,
            focal=(sx * distance / spec.pixel_pitch[0], sy * distance / spec.pixel_pitch[1]),
            principal=(sx * spec.principal_point[0], sy * spec.principal_point[1]),
            resolution=(width, height),
        )

    def slope(self, u, v):
        """(dx/dz, dy/dz) of the ray through pixel (u, v)."""
        return (u - self.principal[0]) / self.focal[0], (v - self.principal[1]) / self.focal[1]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of pad-frame points (…, 3) [m]."""
        d = np.asarray(points, dtype=np.float64) - np.asarray(self.position)
        return d[..., :2] / d[..., 2:] * np.asarray(self.focal) + np.asarray(self.principal)

    def pixel_centres_on_plane(self, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """x (W,) and y (H,) [m] where the pixel centres meet the plane at height ``z`` [m]."""
        tx, ty = self.slope(np.arange(self.resolution[0]) + 0.5, np.arange(self.resolution[1]) + 0.5)
        depth = z - self.position[2]
        return self.position[0] + tx * depth, self.position[1] + ty * depth
