"""View of a camera in a fit: parameters, the sensor that has it, what a sensor accepts.

A view is (2,): distance of the pinhole from z = 0 [mm], and radial distortion k1 r² half an image from the middle along its longer side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from raytac.errors import InputError, SpecError
from raytac.specs import LightsSpec, SensorSpec
from raytac.specs.sensor import CameraSpec
from raytac.specs.sensor_check import validate_sensor, view_edges

CLOSER = 0.6, 2.5
"""Range of a fitted distance from pinhole to pad, over that of the start (a guess)."""
MOST_DISTORTED, MOST_K1 = 0.1, 1.9
"""Most of the size of a fitted distortion (a guess), and of its k1."""
VIEW = "distance", "distortion"
"""Blocks of a fit's parameters that are its view."""
SPREAD = 0.2
"""Least distance of presses from the optical axis (a guess).

It is a root mean square, over half the image's longer side."""
ROUNDED = 1e-3
"""Most that a start may lie beyond a bound: numbers of a file are rounded."""
_MARGIN = 1e-4
"""Distortion that a fitted view could still widen by: files round what they take."""
_HALVINGS = 20
"""Halvings of the interval that holds a bound."""


def _half_view(camera: CameraSpec) -> float:
    """Slope that half the image's longer side is in units of the focal length."""
    return 0.5 * max(n / f for n, f in zip(camera.resolution, camera.focal, strict=True))


def view_of(sensor: SensorSpec) -> np.ndarray:
    """View of a sensor's camera, (2,)."""
    return np.array(_view(sensor.camera))


def _view(camera: CameraSpec) -> tuple[float, float]:
    return -1e3 * camera.position[2], camera.distortion[0] * _half_view(camera) ** 2


def tells_view(sensor: SensorSpec, circles: np.ndarray) -> bool:
    """True if presses at ``circles`` (N, 3) [px] lie far enough from the optical axis.

    Parallax and distortion, which tell a view, grow with the distance from the axis. Near it other errors of the imprint pass for them.
    """
    camera = sensor.camera
    away = np.asarray(circles)[:, :2] - camera.principal_point
    return bool(np.sqrt((away**2).sum(1).mean()) >= SPREAD * 0.5 * max(camera.resolution))


def with_view(sensor: SensorSpec, view: np.ndarray) -> SensorSpec:
    """The sensor whose camera has this view: the same pixel pitch at another distance.

    The sensor itself where that is its view, so that a camera which was not fitted keeps its numbers to the last digit.
    """
    camera = camera_with_view(sensor.camera, *map(float, view))
    # Not ``is``: the cache may answer with an equal camera of another sensor.
    return sensor if camera == sensor.camera else dataclasses.replace(sensor, camera=camera)


@lru_cache(1024)
def camera_with_view(camera: CameraSpec, distance: float, distortion: float) -> CameraSpec:
    """The camera of ``with_view``; one equal to that which is given if it has this view."""
    own = _view(camera)
    if (distance, distortion) == own:
        return camera
    z = camera.position[2] if distance == own[0] else -1e-3 * distance
    moved = dataclasses.replace(camera, position=(*camera.position[:2], z))
    k1 = distortion / _half_view(moved) ** 2
    return dataclasses.replace(moved, distortion=(k1, *camera.distortion[1:]))


def most_distorted(sensor: SensorSpec, distance: float) -> float:
    """Most of the size of a fitted distortion at this distance [mm]."""
    half = _half_view(sensor.camera) * -1e3 * sensor.camera.position[2] / distance
    return min(MOST_DISTORTED, MOST_K1 * half**2)


def check_view(sensor: SensorSpec, view: np.ndarray) -> None:
    """InputError for a start whose distortion lies outside the bounds of a fit of it."""
    distance, distortion = map(float, view)
    most = most_distorted(sensor, distance)
    if abs(distortion) > most * (1 + ROUNDED):
        square = _half_view(with_view(sensor, view).camera) ** 2
        rule = f'k1 must be within ±{most / square:.4g} where a fit of it begins: fix "distortion", or begin with less'
        raise InputError("camera.distortion", value=float(f"{distortion / square:.4g}"), rule=rule)


class ViewBounds:
    """Views that a sensor accepts in a fit which begins at ``start`` (2,).

    The outermost pixels see the pad, the distortion has an inverse, the pinhole lies behind the gel, and virtual sources have room
    between the view and the walls.
    """

    def __init__(self, sensor: SensorSpec, start: np.ndarray) -> None:
        self.sensor = dataclasses.replace(sensor, lights=LightsSpec(()))
        self.distance, self.distortion = map(float, start)
        self.most_k1 = max(MOST_K1, abs(with_view(sensor, start).camera.distortion[0]))
        self._is_valid = lru_cache(4096)(self._is_valid)
        self.distances = lru_cache(2)(self.distances)
        self._last_distortion = lru_cache(4096)(self._last_distortion)

    def inside(self, view: np.ndarray, fixed: tuple[str, ...], room: tuple[float, float, float, float]) -> np.ndarray:
        """``view`` (2,) moved to what a sensor accepts; ``fixed`` parameters stay.

        ``room`` [mm]: width that virtual sources need between the view and the walls at low x, high x, low y, high y; 0 for none.
        """
        distance, distortion = map(float, view)
        if "distance" not in fixed:
            low, high = self.distances("distortion" in fixed)
            distance = min(max(distance, low), high)
        if "distortion" not in fixed:
            most = most_distorted(self.sensor, distance)
            distortion = min(max(distortion, -most), most)
            if not self._is_valid(distance, distortion - _MARGIN, room):
                sign = 1 if distortion > self._begin(distance) else -1
                distortion = self._last_distortion(distance, sign * most, room)
        return np.array([distance, distortion])

    def _begin(self, distance: float) -> float:
        """The distortion of the start, as far as it may be at this distance [mm]."""
        most = most_distorted(self.sensor, distance)
        return min(max(self.distortion, -most), most)

    def _is_valid(self, distance: float, distortion: float, room: tuple[float, ...]) -> bool:
        try:
            sensor = with_view(self.sensor, np.array([distance, distortion]))
            validate_sensor(sensor)
        except SpecError:
            return False
        if abs(sensor.camera.distortion[0]) > self.most_k1:
            return False
        sides = zip(self.sensor.case.size, view_edges(sensor), strict=True)
        beside = [5e2 * size + 1e3 * out for size, (low, high) in sides for out in (low, -high)]
        return all(width >= need for width, need in zip(beside, room, strict=True) if need)

    def distances(self, keeps_distortion: bool) -> tuple[float, float]:
        """Range of a fitted distance [mm], with the start's distortion kept or fitted too."""

        def is_valid(distance: float) -> bool:
            return self._is_valid(distance, self.distortion if keeps_distortion else self._begin(distance), (0.0,) * 4)

        low, high = (_last(is_valid, self.distance, factor * self.distance) for factor in CLOSER)
        return low, high

    def _last_distortion(self, distance: float, end: float, room: tuple[float, ...]) -> float:
        """The distortion nearest to ``end`` that is valid; that of the start where none is."""
        return _last(lambda one: self._is_valid(distance, one - _MARGIN, room), self._begin(distance), end)


def _last(is_valid: Callable[[float], bool], begin: float, end: float) -> float:
    """The last valid number on the path from ``begin`` to ``end``, by halving."""
    if is_valid(end):
        return end
    for _ in range(_HALVINGS if is_valid(begin) else 0):
        middle = 0.5 * (begin + end)
        begin, end = (middle, end) if is_valid(middle) else (begin, middle)
    return begin
