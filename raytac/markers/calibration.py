"""Fit of FOTS and of the force field to simulated presses, and the error of every model."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from raytac.gel.surface import PadGrid, rest_height
from raytac.markers.calibration_presses import LOADS, PressFrame
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import TWIST_SLIP, ContactCells, Contacts
from raytac.markers.force_field import contact_at
from raytac.markers.pattern import marker_centres
from raytac.markers.registry import models_without_coat
from raytac.markers.surface import SurfaceModel
from raytac.markers.tracker import MarkerTracker
from raytac.specs.marker_motion import MarkerMotionSpec, PunchSpec
from raytac.specs.sensor import MarkerSpec, SensorSpec

PROBE_PITCH = 1e-3
"""Spacing of the markers that errors are averaged over [m]: a grid over the view."""
_MARGIN = 0.4e-3
"""Least distance [m] of the outermost probe from the edge of the view: none leaves it."""
_GAIN = 1e9
"""First guess of FOTS' gain [1/m³]; the search works on its logarithm."""
_LAMBDA = 2.5e5
"""First guess of every λ of FOTS [1/m²]: a Gaussian that falls to 1/e within 2 mm."""
_REACH = 5e-3
"""First guess of the punch's ℓ [m], of the order of the pad's thickness."""


def probe_sensor(sensor: SensorSpec) -> SensorSpec:
    """The sensor with a dense, regular pattern, so that a fit does not depend on its own."""
    camera = sensor.camera
    sizes, centre = [], []
    for axis in range(2):
        pitch, count, principal = camera.pixel_pitch[axis], camera.resolution[axis], camera.principal_point[axis]
        sizes.append(1 + int((pitch * count - 2 * _MARGIN) / PROBE_PITCH))
        centre.append(camera.centre[axis] + (count / 2 - principal) * pitch)
    spec = MarkerSpec(sizes[1], sizes[0], (PROBE_PITCH, PROBE_PITCH), (centre[0], centre[1]), 0.2e-3, 0.0)
    return replace(sensor, markers=spec)


@dataclass(frozen=True)
class ProbeData:
    """Frames of many presses under the probes: N frames under load, P probes.

    ``markers`` [m], (P, 2); ``truth`` [m], (N, P, 2): by surface tracking; ``loads``: kind of each frame; ``depth`` [m], (N, ny, nx), and
    ``boxes`` (N, 4): as in ``ContactSamples``; ``contacts``: of all frames, as if they were N environments; ``force``: penetration (N, P),
    normal (N, P, 2) and shear (N, P, 2) that the force field reads.
    """

    cells: ContactCells
    markers: np.ndarray
    truth: np.ndarray
    loads: np.ndarray
    depth: np.ndarray
    boxes: np.ndarray
    contacts: Contacts
    force: tuple[np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def of(cls, sensor: SensorSpec, frames: Sequence[PressFrame]) -> ProbeData:
        """Follow every press from its start; ``frames`` hold whole presses, in order."""
        xy = marker_centres(probe_sensor(sensor).markers)
        rest = np.concatenate([xy, rest_height(sensor.gelpad, xy[:, 0], xy[:, 1])[:, None]], axis=1)[None]
        cells = ContactCells.over(frames[0].surface.grid)
        tracking = SurfaceModel()
        loads: list[str] = []
        tables: list[np.ndarray] = []
        rows: list[tuple[np.ndarray, ...]] = []
        for _, group in groupby(frames, key=lambda frame: frame.press.name):
            tracker = ContactTracker(1)
            for frame in group:
                samples = cells.sample(frame.surface)
                contacts = tracker.update(frame.surface, samples)
                if frame.load not in LOADS:
                    continue
                truth = tracking.displacement(rest, frame.surface, None, None)[..., :2]
                rows.append(
                    (truth[0], samples.depth[0], samples.boxes[0], *(a[0] for a in contact_at(rest, frame.surface, contacts)))
                )
                loads.append(frame.load)
                tables.append(contacts.table[0])
        most = max(len(table) for table in tables)
        padded = [np.pad(table, ((0, most - len(table)), (0, 0))) for table in tables]
        truth, depth, boxes, *force = (np.stack(column) for column in zip(*rows, strict=True))
        return cls(cells, xy, truth, np.array(loads), depth, boxes, Contacts(np.stack(padded)), (force[0], force[1], force[2]))


def pattern_search(
    cost: Callable[[np.ndarray], float], start: np.ndarray, step: float = 0.4, end: float = 2e-3
) -> tuple[np.ndarray, float]:
    """Minimise by trying one coordinate at a time and halving the step.

    No derivatives, no dependence on scale (Hooke and Jeeves 1961).
    Returns the point and its cost. ``step`` and ``end`` are the first and last step along every coordinate.
    """
    point, best = np.array(start, float), cost(np.asarray(start, float))
    while step > end:
        improved = False
        for k in range(len(point)):
            for sign in (1.0, -1.0):
                trial = point.copy()
                trial[k] += sign * step
                value = cost(trial)
                if value < best:
                    point, best, improved = trial, value, True
                    break
        if not improved:
            step *= 0.5
    return point, best


def fit_motion(data: ProbeData, *, device: str = "auto") -> MarkerMotionSpec:
    """Constants that bring FOTS and the force field closest to surface tracking.

    They give the least mean distance, each kind of load weighted alike.

    FOTS is fitted in stages, as its authors do: dilation on normal presses, then shear and twist with the dilation fixed. All are fitted
    once as published and once as a punch (``PunchSpec``), of which shear and twist share three constants. A cap is no more than the
    largest motion in the data, since no larger one was measured.
    """
    from raytac.markers.fots import FotsKernel

    kernel = FotsKernel(data.cells.x, data.cells.y, device=device)

    def error(motion: MarkerMotionSpec, rows: np.ndarray) -> float:
        markers = np.broadcast_to(data.markers, (len(rows), *data.markers.shape))
        moved = kernel.displacement(markers, data.depth[rows], data.boxes[rows], data.contacts.table[rows], motion)
        return float(np.linalg.norm(moved - data.truth[rows], axis=-1).mean())

    normal, sheared, twisted = (np.flatnonzero(data.loads == load) for load in ("normal", "shear", "twist"))
    contacts = data.contacts
    shear_most = float(np.linalg.norm(contacts.shear, axis=-1).max())
    twist_most = float(np.abs(contacts.twist).max())
    gain, stiffness, friction = _fit_force_field(data)
    caps = max(shear_most, 1e-6), max(twist_most, 1e-6)
    motion = MarkerMotionSpec(_GAIN, _LAMBDA, _LAMBDA, caps[0], _LAMBDA, caps[1], gain, stiffness, friction, provenance="")

    def dilated(gain: float, decay: float) -> MarkerMotionSpec:
        return replace(motion, dilate_gain=gain, dilate_lambda=decay)

    motion = dilated(*_fit_dilation(lambda gain, decay: error(dilated(gain, decay), normal)))
    for name, rows, most in (("shear", sheared, shear_most), ("twist", twisted, twist_most)):
        if len(rows) == 0:
            continue

        def dragged(x: np.ndarray, name: str = name, most: float = most, base: MarkerMotionSpec = motion) -> MarkerMotionSpec:
            return replace(base, **{f"{name}_lambda": _LAMBDA * math.exp(x[0]), f"{name}_max": most * _logistic(x[1])})

        x, _ = pattern_search(lambda x, rows=rows, dragged=dragged: error(dragged(x), rows), np.array([0.0, 2.0]))
        motion = dragged(x)
    edge = contacts.radius
    at_edge = np.maximum(np.linalg.norm(contacts.shear, axis=-1), edge * np.abs(contacts.twist) / TWIST_SLIP)
    slip_most = float((at_edge[contacts.active] / (contacts.depth * edge)[contacts.active]).max())
    dragged_rows = [rows for rows in (sheared, twisted) if len(rows)]
    if not dragged_rows:
        return motion

    def punched(gain: float, decay: float, x: np.ndarray) -> MarkerMotionSpec:
        punch = PunchSpec(_logistic(x[0]), _REACH * math.exp(x[1]), slip_most * _logistic(x[2]), gain, decay)
        return replace(motion, punch=punch)

    dilation = _fit_dilation(lambda gain, decay: error(punched(gain, decay, np.zeros(3)), normal))

    def cost(x: np.ndarray) -> float:
        return sum(error(punched(*dilation, x), rows) for rows in dragged_rows)

    # The cost does not depend on slip where nothing slips. A coarse search selects where it begins to.
    begin = min(np.linspace(-5.0, 3.0, 9), key=lambda at: cost(np.array([0.0, 0.0, at])))
    x, _ = pattern_search(cost, np.array([0.0, 0.0, begin]))
    return punched(*dilation, x)


def _fit_dilation(error: Callable[[float, float], float]) -> tuple[float, float]:
    """Gain [1/m³] and λ [1/m²] of the least error."""

    def constants(x: np.ndarray) -> tuple[float, float]:
        return _GAIN * math.exp(x[0]), _LAMBDA * math.exp(x[1])

    # Gain and λ trade off along a valley. A coarse search over λ selects where the fine one starts.
    starts = (-1.0, 0.0, 1.0)
    gains = [pattern_search(lambda x, at=at: error(*constants(np.array([x[0], at]))), np.zeros(1)) for at in starts]
    best = min(range(3), key=lambda k: gains[k][1])
    x, _ = pattern_search(lambda x: error(*constants(x)), np.array([gains[best][0][0], starts[best]]))
    return constants(x)


def _logistic(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


def _fit_force_field(data: ProbeData) -> tuple[float, float, float]:
    """(gain, k_t / k_n, friction) of the force field."""
    depth, normal, shear = data.force
    length = np.linalg.norm(shear, axis=-1)
    direction = shear / np.maximum(length, 1e-12)[..., None]
    weight = np.array([1.0 / np.sum(data.loads == load) for load in data.loads])
    weight /= weight.sum()

    def cost(x: np.ndarray) -> float:
        gain, stiffness, friction = np.exp(x)
        tangential = np.minimum(stiffness * length, friction * depth)
        moved = gain * (depth[..., None] * normal + tangential[..., None] * direction)
        return float(weight @ np.linalg.norm(moved - data.truth, axis=-1).mean(axis=-1))

    x, _ = pattern_search(cost, np.zeros(3))
    gain, stiffness, friction = (float(v) for v in np.exp(np.clip(x, -20, 2.3)))
    return gain, stiffness, friction


@dataclass(frozen=True)
class ModelError:
    """Errors of one model against surface tracking on one kind of load."""

    model: str
    load: str
    frames: int
    mean: float
    """Mean distance over all probes in view [m]."""
    p95: float
    """95th percentile of that distance [m]."""
    moved: float
    """Mean distance [m] over probes that surface tracking moves by more than 50 µm, or NaN."""
    mean_px: float
    """Mean distance in the image [px]."""
    size: float
    """Mean displacement by surface tracking over all probes [m], to compare with."""


def model_errors(
    sensor: SensorSpec, frames: Sequence[PressFrame], grid: PadGrid, *, models: Sequence[str] | None = None, device: str = "auto"
) -> tuple[list[ModelError], dict[str, float]]:
    """Errors of every model by kind of load, and its median time a frame [ms] at the probes.

    Args:
        sensor: with the marker motion that is tested.
        frames: whole presses, in order.
        models: names of ``MARKERS``; None is all that need no coat.
    """
    models = models_without_coat() if models is None else models
    probed = probe_sensor(sensor)
    moved, pixels, times = (defaultdict(list) for _ in range(3))
    loads = [frame.load for frame in frames if frame.load in LOADS]
    for model in dict.fromkeys(("surface", *models)):
        tracker = MarkerTracker(probed, model, grid, device=device)
        for _, group in groupby(frames, key=lambda frame: frame.press.name):
            tracker.reset()
            for frame in group:
                start = time.perf_counter()
                markers = tracker.update(frame.surface)
                times[model].append(1e3 * (time.perf_counter() - start))
                if frame.load in LOADS:
                    moved[model].append(markers.displacement[0])
                    pixels[model].append(markers.displacement_px[0])
    truth, truth_px = np.stack(moved["surface"]), np.stack(pixels["surface"])
    size = np.linalg.norm(truth, axis=-1)
    errors = []
    for model in models:
        error = np.linalg.norm(np.stack(moved[model]) - truth, axis=-1)
        error_px = np.linalg.norm(np.stack(pixels[model]) - truth_px, axis=-1)
        for load in LOADS:
            rows = np.array([one == load for one in loads])
            if not rows.any():
                continue
            far = size[rows] > 50e-6
            by_load = {
                "mean": error[rows].mean(),
                "p95": np.percentile(error[rows], 95),
                "moved": error[rows][far].mean() if far.any() else float("nan"),
                "mean_px": error_px[rows].mean(),
                "size": size[rows].mean(),
            }
            errors.append(ModelError(model, load, int(rows.sum()), **{name: float(value) for name, value in by_load.items()}))
    return errors, {model: float(np.median(values)) for model, values in times.items()}
