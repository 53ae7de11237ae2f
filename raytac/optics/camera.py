"""The camera: from pixels to rays and back, the same numbers for every optical mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.specs.lens import Lens
from raytac.specs.sensor import CameraSpec

if TYPE_CHECKING:
    # The ray tracer's side of the slab needs Dr.Jit; a camera without one does not.
    from raytac.optics.refraction import Slab

PLAIN = Lens()
"""That of a pinhole which looks along +z."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole at ``position`` [m], pad frame, that looks along +z, x right, y down (OpenCV).

    ``lens`` distorts its image and turns it from +z.
    Pixel (u, v) counts from the top-left image corner, so the centre of the first pixel is (0.5, 0.5). ``focal`` = (fx, fy) and
    ``principal`` = (cx, cy) are in pixels of ``resolution`` = (width, height).
    """

    position: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    resolution: tuple[int, int]
    slab: Slab | None = None
    """Gel and plate that bend its rays, in metres; None where light goes straight."""
    crop: tuple[int, int, int, int] | None = None
    """Piece of the image that is rendered, (left, top, width, height) [px]; None is all of it."""
    lens: Lens = PLAIN
    """Distortion and tilt."""

    @property
    def piece(self) -> tuple[int, int, int, int]:
        """``crop``, or the whole image."""
        return self.crop or (0, 0, *self.resolution)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of what is rendered [px]."""
        return self.piece[2:]

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The rendered piece of an image (H, W, …)."""
        left, top, width, height = self.piece
        return image[top : top + height, left : left + width]

    def pixel(self, index: Any) -> tuple[Any, Any]:
        """Column and row in the whole image of pixels of the rendered piece, numbered row by row."""
        left, top, width, _ = self.piece
        return index % width + left, index // width + top

    @classmethod
    def from_spec(cls, spec: CameraSpec, resolution: tuple[int, int] | None = None, slab: Slab | None = None) -> Pinhole:
        """Scale the native camera to ``resolution`` (width, height) [px]; the same field of view.

        With the pinhole a distance d below the gel plane, a pixel of pitch p there is the angle p / d: f = d / p. The pitch is what
        a ruler on the gel plane shows, so behind a slab d is the apparent distance: that in air plus the slab's thickness over n.
        This holds about the optical axis; farther out the plane z = 0 appears distorted (docs/refraction.md). Of a tilted camera, which
        has no slab, d is the distance along its optical axis.
        """
        width, height = spec.resolution if resolution is None else resolution
        sx, sy = width / spec.resolution[0], height / spec.resolution[1]
        distance = -spec.position[2]
        if slab is not None:
            distance = (slab.z - spec.position[2]) - slab.z / slab.ior
        distance /= spec.lens.axis[2]
        return cls(
            position=spec.position,
            focal=(sx * distance / spec.pixel_pitch[0], sy * distance / spec.pixel_pitch[1]),
            principal=(sx * spec.principal_point[0], sy * spec.principal_point[1]),
            resolution=(width, height),
            slab=slab,
            lens=spec.lens,
        )

    def slope(self, u, v):
        """(dx/dz, dy/dz) of the ray through pixel (u, v) as it leaves the pinhole."""
        return self.lens.slope((u - self.principal[0]) / self.focal[0], (v - self.principal[1]) / self.focal[1])

    def ray(self, u: Any, v: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any]]:
        """(origin [m], slopes) of the ray of pixel (u, v) at the coat, behind the slab if any."""
        tx, ty = self.slope(u, v)
        if self.slab is None:
            return self.position, (tx, ty)
        x, y, z = self.position
        air = self.slab.z - z
        return (x + air * tx, y + air * ty, self.slab.z), self.slab.bend(tx, ty)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (…, 2) of pad-frame points (…, 3) [m]; with a slab, of points in it."""
        d = np.asarray(points, dtype=np.float64) - np.asarray(self.position)
        if self.slab is None:
            slope = d[..., :2] / d[..., 2:]
        else:
            air = self.slab.z - self.position[2]
            rho = np.linalg.norm(d[..., :2], axis=-1, keepdims=True)
            slope = d[..., :2] * (self.slab.meet(rho, air, d[..., 2:] - air) / np.maximum(rho, 1e-12))
        if not self.lens.is_plain:
            slope = np.stack(self.lens.image(slope[..., 0], slope[..., 1]), axis=-1)
        return slope * np.asarray(self.focal) + np.asarray(self.principal)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance (…) [m] of pad-frame points (…, 3) along the optical axis."""
        if not self.lens.tilts:
            return points[..., 2] - self.position[2]
        return (points - np.asarray(self.position)) @ np.asarray(self.lens.axis)

    def pixel_centres_on_plane(self, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """x (W,) and y (H,) [m] where the pixel centres meet the plane at height ``z`` [m].

        With a slab, distortion or tilt these are the places along the row and the column of the principal point.
        """
        (ox, _, oz), (tx, _) = self.ray(np.arange(self.resolution[0]) + 0.5, self.principal[1])
        (_, oy, _), (_, ty) = self.ray(self.principal[0], np.arange(self.resolution[1]) + 0.5)
        return ox + tx * (z - oz), oy + ty * (z - oz)
