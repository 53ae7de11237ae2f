"""What two photographs of a drag show: where dots are, and how the ball moved.

Dots are centroids of darkness. The ball's motion is read from the rings that the layers of a printed ball leave in the coat. A point of the
ball moves from P to C + t + R (P − C), C its centre; the camera sees both. Displacement t along x and y and tilt R are those at which the
rings of both photographs correlate best. A turn about the rings' axis leaves them where they are, so it is taken as none. So is a change of
depth. Dots are masked: they are on the gel, and the gel may slip.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage, optimize
from scipy.spatial.transform import Rotation

from raytac.errors import InputError
from raytac.io import read_png
from raytac.markers import camera_of
from raytac.specs import SensorSpec

REACH, DARK, LEAST = 9.0, (0.1, 0.9), 15.0
"""Window of a dot's centroid [px]; darkness that counts not at all and wholly; least dark area of a dot [px]."""
OTHER_DARK = (0.05, 0.5), (0.2, 0.6)
"""Other such thresholds, by which the detection of dots is judged."""
BAND = 1.2, 3.0
"""Gaussians [px] whose difference keeps the rings."""
DOT = 0.12
"""Darkness, or glare, above which a pixel is none of the coat's; its neighbours within 3 px neither."""
FIRST = np.arange(-16.0, 16.1, 1.0)
"""Displacements that are tried first along either axis [px]."""
TILTS = (0.0, 0.0), (0.06, 0.0), (-0.06, 0.0), (0.0, 0.06), (0.0, -0.06)
"""Tilts that the search begins at [rad]."""
ANNULUS, BEYOND = 3.0, 12.0
"""Width of the annuli whose rings are compared alone, and how far beyond the circle they go [px]."""


@dataclass(frozen=True)
class Drag:
    """Dots of both photographs [px], (N, 2) each, and how many were lost."""

    before: np.ndarray
    after: np.ndarray
    lost: int
    size: tuple[int, int]
    """Width and height of the photographs [px]."""
    images: tuple[np.ndarray, ...] = ()
    """Both photographs, (H, W, 3) each."""

    @property
    def motion(self) -> np.ndarray:
        return self.after - self.before

    @classmethod
    def read(cls, folder: Path) -> Drag:
        """Dots that both photographs show; raises ``InputError`` for missing, damaged or unlike files."""
        try:
            images = [read_png(folder / f"{k}.png") for k in (0, 1)]
        except OSError as error:
            raise InputError("data", value=str(folder), rule=f"must hold the photographs 0.png and 1.png: {error}") from error
        near = [_places(folder / f"{k}.csv") for k in (0, 1)]
        if images[0].shape != images[1].shape or near[0].shape != near[1].shape:
            raise InputError(
                "data", value=str(folder), rule="must hold two photographs of one size, with a row for each dot in both"
            )
        (before, area), (after, later) = (dot_centres(image, places) for image, places in zip(images, near, strict=True))
        seen = (area >= LEAST) & (later >= LEAST)
        if seen.sum() < 3:
            raise InputError("data", value=str(folder), rule="must show at least three dots in both photographs")
        height, width = images[0].shape[:2]
        return cls(before[seen], after[seen], int((~seen).sum()), (width, height), tuple(images))


def _places(path: Path) -> np.ndarray:
    """About where the dots are [px], (N, 2)."""
    try:
        rows = list(csv.DictReader(path.read_text("utf-8").splitlines()))
        start, motion = (
            np.array([[float(row[name]) for name in names] for row in rows]) for names in (("Mx", "My"), ("dx", "dy"))
        )
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError("data", value=str(path), rule=f"must hold the columns Mx, My, dx, dy of numbers: {error}") from error
    return (start + motion).reshape(-1, 2)


def dot_centres(image: np.ndarray, near: np.ndarray, dark: tuple[float, float] = DARK) -> tuple[np.ndarray, np.ndarray]:
    """Centroids of dark dots [px], (N, 2), and their dark areas [px], (N,).

    ``image`` (H, W, 3), ``near`` (N, 2): about where dots are [px]; ``dark``: as ``DARK``. Darkness is 1 less the brightest channel over
    what surrounds the dot. The window of the centroid follows it until it stands still.
    """
    bright = image[..., :3].max(axis=2).astype(float)
    behind = ndimage.gaussian_filter(ndimage.percentile_filter(bright, 80, size=int(3 * REACH)), 6.0)
    darkness = np.clip((1.0 - bright / np.maximum(behind, 1.0) - dark[0]) / (dark[1] - dark[0]), 0.0, 1.0)
    v, u = np.mgrid[: bright.shape[0], : bright.shape[1]] + 0.5
    centres, areas = np.array(near, float), np.zeros(len(near))
    for k, centre in enumerate(centres):
        for _ in range(20):
            weight = darkness * (np.hypot(u - centre[0], v - centre[1]) < REACH)
            areas[k] = weight.sum()
            if areas[k] < LEAST:
                break
            moved = np.array([(weight * u).sum(), (weight * v).sum()]) / areas[k]
            done, centre = np.abs(moved - centre).max() < 1e-3, moved
            if done:
                break
        centres[k] = centre
    return centres, areas


def rigid_motion(places: np.ndarray, motion: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, float]:
    """Displacement of ``centre`` and turn [rad] about it that fit the ``motion`` (N, 2) of ``places`` (N, 2) best, small turns."""
    x, y = (places - centre).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate([np.stack([one, none, -y], axis=1), np.stack([none, one, x], axis=1)])
    u, v, turn = np.linalg.lstsq(rows, np.concatenate([motion[:, 0], motion[:, 1]]), rcond=None)[0]
    return np.array([u, v]), float(turn)


def detection_error(drag: Drag) -> float:
    """RMS change of the dots' motion by other thresholds of darkness [px]: glare and uneven ink move a centroid with them."""
    changes = []
    for dark in OTHER_DARK:
        before, after = (
            dot_centres(image, at, dark)[0] for image, at in zip(drag.images, (drag.before, drag.after), strict=True)
        )
        changes.append(((after - before - drag.motion) ** 2).sum(axis=1))
    return float(np.sqrt(np.mean(changes)))


@dataclass(frozen=True)
class BallMotion:
    """Motion of a ball from one photograph to the other, pad frame."""

    shear: np.ndarray
    """Displacement of its centre along x and y [m], (2,)."""
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Rotation vector along x and y [rad], (2,)."""
    turn: float = 0.0
    """Turn about z [rad]."""

    def lowest(self, radius: float) -> np.ndarray:
        """Displacement of the lowest point of a ball of ``radius`` [m], (2,) [m]."""
        return self.shear + radius * np.array([-self.tilt[1], self.tilt[0]])

    def of(self, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Where ``points`` (N, 3) of a ball at ``centre`` (3,) go, without its turn about z [m]."""
        return centre + np.array([*self.shear, 0.0]) + Rotation.from_rotvec([*self.tilt, 0.0]).apply(points - centre)


@dataclass(frozen=True)
class LayerMotion:
    """Motion of a printed ball by its rings."""

    motion: BallMotion
    correlation: float
    without_roll: float
    """Correlation of rings with the best motion, and with the best that does not tilt."""
    annuli: dict[float, float]
    """Correlation by annulus, by its inner radius [px]; where gel and ball part it falls."""

    def figures(self, radius: float) -> dict[str, float]:
        """The motion in µm and degrees by name, and correlations; ``radius`` of the ball [m]."""
        values = {"correlation": self.correlation, "without_roll": self.without_roll}
        for k, axis in enumerate("xy"):
            values |= {f"lowest_{axis}_um": 1e6 * self.motion.lowest(radius)[k], f"centre_{axis}_um": 1e6 * self.motion.shear[k]}
            values[f"tilt_{axis}_deg"] = float(np.degrees(self.motion.tilt[k]))
        return values | {f"correlation_from_{edge:.0f}_px": value for edge, value in self.annuli.items()}


def layer_motion(
    images: tuple[np.ndarray, ...], sensor: SensorSpec, circle: np.ndarray, centre: np.ndarray, radius: float
) -> LayerMotion:
    """Motion of a ball between two photographs (H, W, 3) by the camera of ``sensor``.

    ``circle`` (3,) [px]: contact whose rings are used; ``centre`` (3,) and ``radius`` of the ball before the drag, pad frame [m].
    """
    camera = camera_of(sensor)
    (first, is_coat), (second, is_later) = (_rings(image) for image in images)
    later, spline = is_later.astype(float), ndimage.spline_filter(second)
    v, u = np.mgrid[: first.shape[0], : first.shape[1]] + 0.5
    away = np.hypot(u - circle[0], v - circle[1])
    points = ball_points(sensor, u, v, centre, radius)
    is_ball = is_coat & np.isfinite(points[..., 0])

    def motion_of(lowest: np.ndarray, tilt: np.ndarray) -> BallMotion:
        return BallMotion(lowest - radius * np.array([-tilt[1], tilt[0]]), tilt)

    def correlation(lowest: np.ndarray, tilt: np.ndarray, used: np.ndarray) -> float:
        """Correlation of the rings at ``used`` pixels (H, W) of the first photograph; 0 for too few."""
        place = camera.project(motion_of(lowest, tilt).of(points[used], centre)).T[::-1] - 0.5
        seen = ndimage.map_coordinates(later, place, order=1) > 0.99
        if seen.sum() < 50:
            return 0.0
        one, two = first[used][seen], ndimage.map_coordinates(spline, place[:, seen], prefilter=False)
        if one.std() == 0.0 or two.std() == 0.0:  # a ball without layers
            return 0.0
        return float(np.corrcoef(one, two)[0, 1])

    within = is_ball & (away < circle[2])
    pitch = np.linalg.norm(np.diff(ball_points(sensor, circle[0] + np.array([0.0, 1.0]), circle[1], centre, radius), axis=0))

    def best(start: np.ndarray, steps: tuple[float, ...]) -> optimize.OptimizeResult:
        """Least negative correlation over the lowest point's displacement [px of the lowest point] and, if given, tilt."""
        return optimize.minimize(
            lambda p: -correlation(pitch * p[:2], p[2:] if len(p) > 2 else np.zeros(2), within),
            start,
            method="Nelder-Mead",
            options={
                "initial_simplex": np.vstack([start, start + np.diag(steps)]),
                "maxiter": 2000,
                "xatol": 1e-4,
                "fatol": 1e-6,
            },
        )

    coarse = max((correlation(pitch * np.array([dx, dy]), np.zeros(2), within), dx, dy) for dx in FIRST for dy in FIRST)
    shift = best(np.array(coarse[1:]), (0.5, 0.5))
    full = min((best(np.array([*shift.x, *tilt]), (0.5, 0.5, 0.03, 0.03)) for tilt in TILTS), key=lambda result: result.fun)
    lowest, tilt = pitch * full.x[:2], full.x[2:]
    edges = np.arange(circle[2] - 6 * ANNULUS, circle[2] + BEYOND, ANNULUS)
    annuli = {
        float(edge): correlation(lowest, tilt, is_ball & (away >= edge) & (away < edge + ANNULUS)) for edge in edges if edge > 0.0
    }
    return LayerMotion(motion_of(lowest, tilt), -float(full.fun), -float(shift.fun), annuli)


def ball_points(sensor: SensorSpec, u: np.ndarray, v: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Points (…, 3) [m] of a ball that pixels (u, v) see, pad frame; NaN beside it."""
    origin, (tx, ty) = camera_of(sensor).ray(u, v)
    direction = np.stack(np.broadcast_arrays(tx, ty, np.ones_like(tx)), axis=-1)
    start = np.stack(np.broadcast_arrays(*origin, tx)[:3], axis=-1) - centre
    a, b, c = ((one * two).sum(axis=-1) for one, two in ((direction, direction), (direction, start), (start, start)))
    with np.errstate(invalid="ignore"):
        share = (-b - np.sqrt(b**2 - a * (c - radius**2))) / a
    return centre + start + share[..., None] * direction


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
