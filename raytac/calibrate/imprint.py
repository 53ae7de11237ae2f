"""Imprint of a ball: one radial profile of slopes about each contact circle.

All presses of a calibration share it. Photographs show where a ball touched, but not how the gel around it deformed. So the slope of
the coat is a free function of the distance ρ = t a from the ball's axis over the contact radius a, fitted with the lights:

    sin θ(t) = s(t) · a / R,  s linear between ``KNOTS``,

with R the ball's radius. A gel that wraps a rigid ball has s = t up to the rim, t = 1; beyond it s falls to 0. Heights are those slopes
integrated inwards from where the gel is at rest, h(ρ) = a ∫ tan θ dt, added to the pad's dome.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid, rest_height
from raytac.specs.sensor import CameraSpec, SensorSpec

KNOTS = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.4, 3.0])
"""Distances over the contact radius between which the slope is linear; 0 at both ends."""
RIGID_PAD = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.7, 0.8, 0.9, 0.86, 0.49, 0.39, 0.26, 0.16, 0.05, 0.01, 0.0])
"""s at the inner knots where a fit starts.

They are about the rigid pad's at the depth where its contact is as wide as the circle (docs/concepts/rigid-pad.md)."""
WIDEST = 0.95
"""Largest sine of a slope."""
_TABLE = np.linspace(0, KNOTS[-1], 751)
_STEPS = 6
"""Iterations of where a ray meets the coat."""


@dataclass(frozen=True)
class PixelGeometry:
    """Coat in pixels, pad frame: points ``p`` [m], normals ``n`` to the camera, each (3, M)."""

    p: np.ndarray
    n: np.ndarray


def _slope(slopes: np.ndarray, t: np.ndarray, share: np.ndarray) -> np.ndarray:
    """tan θ at ``t`` for a/R = ``share``; shapes broadcast."""
    sine = np.clip(np.interp(t, KNOTS, np.concatenate([[0], slopes, [0]])) * share, -WIDEST, WIDEST)
    return sine / np.sqrt(1 - sine * sine)


def _heights(slopes: np.ndarray, share: np.ndarray) -> np.ndarray:
    """h over a at the places of ``_TABLE`` for every a/R, (N, T)."""
    tan = _slope(slopes, _TABLE[None, :], share[:, None])
    steps = 0.5 * (tan[:, 1:] + tan[:, :-1]) * (_TABLE[1] - _TABLE[0])
    total = np.concatenate([np.zeros((len(share), 1)), np.cumsum(steps, axis=1)], axis=1)
    return total[:, -1:] - total


def on_plane(camera: CameraSpec, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y [m], from the pinhole's, where pixels of the sensor's resolution see z = 0."""
    (cx, cy), (fx, fy) = camera.principal_point, camera.focal
    tx, ty = camera.lens.slope((u - cx) / fx, (v - cy) / fy)
    return -camera.position[2] * tx, -camera.position[2] * ty


def _pitch(camera: CameraSpec, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Side [m] of a square on the plane z = 0 as large as what a pixel shows of it."""
    ends = [on_plane(camera, u + 0.5 * du, v + 0.5 * dv) for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    (a, b), (c, d) = ([e - f for e, f in zip(ends[k], ends[k + 1], strict=True)] for k in (0, 2))
    return np.sqrt(a * d - b * c)


def circles_on_pad(sensor: SensorSpec, circles: np.ndarray, ball_radius: np.ndarray) -> np.ndarray:
    """x, y and radius [m] in the pad frame of circles (N, 3) [px of the sensor's resolution].

    A circle in the image is that of the rim, which lies about a² / 2R nearer to the camera than the pad at rest.
    """
    camera = sensor.camera
    distance = -camera.position[2]
    u, v, r = np.asarray(circles, dtype=float).T
    (flat_x, flat_y), flat_r = on_plane(camera, u, v), r * _pitch(camera, u, v)
    deep = 0.5 * flat_r**2 / ball_radius
    z = -deep
    x, y = z, z
    for _ in range(5):  # the pixel's ray meets the dome, moved by that depth
        x = camera.position[0] + flat_x * (1 + z / distance)
        y = camera.position[1] + flat_y * (1 + z / distance)
        z = -sensor.gelpad.sag(x, y) - deep
    return np.stack([x, y, flat_r * (1 + z / distance)], axis=1)


def rims_on_pad(sensor: SensorSpec, circles: np.ndarray, ball_radius: np.ndarray) -> np.ndarray:
    """``circles_on_pad`` of balls that touch; InputError: a circle as wide as its ball."""
    on_pad = circles_on_pad(sensor, circles, ball_radius)
    share = on_pad[:, 2] / ball_radius
    if (share >= 1).any():
        k = int(np.argmax(share))
        rule = f"must be smaller than the ball, which has {2e3 * ball_radius[k]:.4g} mm"
        raise InputError("circle", value=f"{2e3 * on_pad[k, 2]:.4g} mm across", rule=rule)
    return on_pad


def pixel_geometry(
    sensor: SensorSpec,
    places: tuple[np.ndarray, np.ndarray],
    press: np.ndarray,
    on_pad: np.ndarray,
    ball_radius: np.ndarray,
    slopes: np.ndarray,
) -> PixelGeometry:
    """Coat seen by pixels of the presses ``press`` (M,).

    ``places``: where they see z = 0 (``on_plane``); ``on_pad`` (N, 3) [m]: ``circles_on_pad``, ``ball_radius`` (N,) [m]; ``slopes``: s
    at the inner ``KNOTS``. The ray is met by iterating its height; slopes of the view are below 0.4, so that six steps leave less than a
    micrometre.
    """
    share = on_pad[:, 2] / ball_radius
    heights, at, a = _heights(slopes, share), on_pad[press, :2], on_pad[press, 2]
    z = np.zeros(len(press))
    x, y, dx, dy, rho, t = z, z, z, z, z, z
    for _ in range(_STEPS):
        x, y = _along_rays(sensor.camera, places, z)
        dx, dy = x - at[:, 0], y - at[:, 1]
        rho = np.hypot(dx, dy)
        t = rho / a
        place = np.minimum(t / (_TABLE[1] - _TABLE[0]), len(_TABLE) - 1.001)
        k = place.astype(int)
        part = place - k
        height = heights[press, k] * (1 - part) + heights[press, k + 1] * part
        z = -sensor.gelpad.sag(x, y) - a * height
    tan = _slope(slopes, t, share[press])
    rho = np.maximum(rho, 1e-9)
    zx, zy = sensor.gelpad.slope(x, y)
    return _facing(x, y, z, zx + tan * dx / rho, zy + tan * dy / rho)


def rest_geometry(sensor: SensorSpec, places: tuple[np.ndarray, np.ndarray]) -> PixelGeometry:
    """Coat at rest, seen by the pixels of ``places``, as of ``pixel_geometry``."""
    z = np.zeros(len(places[0]))
    x, y = z, z
    for _ in range(_STEPS):
        x, y = _along_rays(sensor.camera, places, z)
        z = -sensor.gelpad.sag(x, y)
    return _facing(x, y, z, *sensor.gelpad.slope(x, y))


def _along_rays(camera: CameraSpec, places: tuple[np.ndarray, np.ndarray], z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y [m] at the height ``z`` of the rays through ``places`` on z = 0."""
    nearer = 1 - z / camera.position[2]
    return camera.position[0] + places[0] * nearer, camera.position[1] + places[1] * nearer


def _facing(x: np.ndarray, y: np.ndarray, z: np.ndarray, zx: np.ndarray, zy: np.ndarray) -> PixelGeometry:
    """Points whose normals, by the slopes ``zx`` and ``zy``, look to the camera."""
    n = np.stack([zx, zy, -np.ones_like(x)])
    return PixelGeometry(np.stack([x, y, z]), n / np.sqrt(zx * zx + zy * zy + 1))


@dataclass(frozen=True)
class PressedCoat:
    """Coat under the ball of each of M pixels.

    ``x`` and ``y`` of the ball's axis, ``radius`` of the contact [m], (M,) each.
    """

    sensor: SensorSpec
    x: np.ndarray
    y: np.ndarray
    radius: np.ndarray
    _press: np.ndarray
    _profiles: np.ndarray

    @classmethod
    def of(
        cls, sensor: SensorSpec, press: np.ndarray, circles: np.ndarray, ball_radius: np.ndarray, slopes: np.ndarray
    ) -> PressedCoat:
        """That of the presses ``press`` (M,), as ``pixel_geometry``."""
        on_pad = circles_on_pad(sensor, circles, ball_radius)
        x, y, radius = on_pad[press].T
        return cls(sensor, x, y, radius, press, _heights(slopes, on_pad[:, 2] / ball_radius))

    def from_axis(self, p: np.ndarray, ux: np.ndarray, uy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance along (ux, uy) from ``p`` (3, M) to where its line is nearest to the axis.

        And the square of the distance between line and axis; (M,) each.
        """
        dx, dy = self.x - p[0], self.y - p[1]
        ahead = dx * ux + dy * uy
        return ahead, dx * dx + dy * dy - ahead * ahead

    def height(self, x: np.ndarray, y: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        """z [m] of the coats of K pixels, ``pixel`` (K,), at x and y (K, S)."""
        a = self.radius[pixel, None]
        t = np.hypot(x - self.x[pixel, None], y - self.y[pixel, None]) / a
        place = np.minimum(t / (_TABLE[1] - _TABLE[0]), len(_TABLE) - 1.001)
        k = place.astype(int)
        part, flat = place - k, self._profiles.ravel()
        k += self._press[pixel, None] * len(_TABLE)
        return -self.sensor.gelpad.sag(x, y) - a * (flat[k] * (1 - part) + flat[k + 1] * part)


def press_surface(
    sensor: SensorSpec, grid: PadGrid, circles: np.ndarray, ball_radius: np.ndarray, slopes: np.ndarray
) -> GelSurface:
    """The pad under every ball, a batch on ``grid``; InputError as of ``rims_on_pad``."""
    on_pad = rims_on_pad(sensor, circles, ball_radius)
    share = on_pad[:, 2] / ball_radius
    heights, contact = [], []
    rest = rest_height(sensor.gelpad, *np.meshgrid(grid.x, grid.y))
    for (x, y, a), profile in zip(on_pad, _heights(slopes, share), strict=True):
        rho = np.hypot(grid.x[None, :] - x, grid.y[:, None] - y)
        heights.append(rest - a * np.interp(rho / a, _TABLE, profile))
        contact.append(rho < a)
    return GelSurface(grid, np.array(heights, dtype=np.float32), np.array(contact), on_pad[:, :2])
