"""Fit the constants of FOTS and of the force field to surface tracking on simulated presses, and tell every model's error."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from raytac.gel.surface import PadGrid
from raytac.markers.calibration_presses import LOADS, PressFrame
from raytac.markers.contacts import ContactCells, Contacts, ContactTracker
from raytac.markers.pattern import marker_centres
from raytac.markers.surface import SurfaceMarkers
from raytac.markers.tracker import MARKER_MODELS, MarkerTracker
from raytac.specs.marker_motion import MarkerMotionSpec, PunchSpec
from raytac.specs.sensor import MarkerSpec, SensorSpec

if TYPE_CHECKING:
    from raytac.markers.fots_kernel import FotsConstants

__all__ = ["PUBLISHED", "ModelError", "ProbeData", "fit_motion", "model_errors", "pattern_search", "probe_sensor"]

PUBLISHED = "fots_published"
"""Name in tables of errors of ``fots`` without the sensor's ``punch``: Gaussians with one λ for all contacts, as published."""
PROBE_PITCH = 1e-3
"""Spacing of the markers that errors are averaged over [m]: a grid over the view, whatever the sensor's own pattern."""
_MARGIN = 0.4e-3
"""Distance of the outermost probe from the edge of the view, at least [m]."""


def probe_sensor(sensor: SensorSpec) -> SensorSpec:
    """The sensor with a dense, regular pattern over its view, so that a fit does not depend on where dots happen to be."""
    camera = sensor.camera
    sizes, centre = [], []
    for axis in range(2):
        pitch, count, principal = camera.pixel_pitch[axis], camera.resolution[axis], camera.principal_point[axis]
        sizes.append(1 + int((pitch * count - 2 * _MARGIN) / PROBE_PITCH))
        centre.append(camera.position[axis] + (count / 2 - principal) * pitch)
    spec = MarkerSpec(sizes[1], sizes[0], (PROBE_PITCH, PROBE_PITCH), (centre[0], centre[1]), 0.2e-3, 0.0)
    return replace(sensor, markers=spec)


@dataclass(frozen=True)
class ProbeData:
    """Frames of many presses under the probes: N frames under load, P probes.

    ``markers`` [m], (P, 2); ``truth`` [m], (N, P, 2): by surface tracking; ``loads``: kind of each frame; ``depth`` [m], (N, ny, nx), and
    ``boxes`` (N, 4): as in ``ContactSamples``; ``contacts``: of all frames, as if they were N environments;
    ``force``: (penetration (N, P), wall (N, P, 2), way (N, P, 2)) that the force field reads.
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
        from raytac.gel.surface import rest_height
        from raytac.markers.sampling import height_and_slope, object_way

        xy = marker_centres(probe_sensor(sensor).markers)
        rest = np.concatenate([xy, rest_height(sensor.gelpad, xy[:, 0], xy[:, 1])[:, None]], axis=1)[None]
        cells = ContactCells.over(frames[0].surface.grid)
        tracking = SurfaceMarkers()
        rows: list[tuple] = []
        for _, group in groupby(frames, key=lambda frame: frame.press.name):
            tracker = ContactTracker(1)
            for frame in group:
                samples = cells.sample(frame.surface)
                contacts = tracker.update(frame.surface, samples)
                if frame.load not in LOADS:
                    continue
                truth = tracking.displacement(rest, frame.surface, None, None)[..., :2]
                height, slope, touched = height_and_slope(frame.surface, rest[..., :2])
                penetration = np.where(touched, np.maximum(rest[..., 2] - height, 0), 0)
                wall = slope / np.sqrt(1 + (slope**2).sum(axis=-1, keepdims=True))
                way = object_way(contacts, rest[..., :2])
                rows.append((truth[0], frame.load, samples.depth[0], samples.boxes[0], contacts, penetration[0], wall[0], way[0]))
        most = max(row[4].table.shape[1] for row in rows)
        tables = [np.pad(row[4].table[0], ((0, most - row[4].table.shape[1]), (0, 0))) for row in rows]
        return cls(
            cells=cells,
            markers=xy,
            truth=np.stack([row[0] for row in rows]),
            loads=np.array([row[1] for row in rows]),
            depth=np.stack([row[2] for row in rows]),
            boxes=np.stack([row[3] for row in rows]),
            contacts=Contacts(np.stack(tables)),
            force=(np.stack([r[5] for r in rows]), np.stack([r[6] for r in rows]), np.stack([r[7] for r in rows])),
        )


def pattern_search(
    cost: Callable[[np.ndarray], float], start: np.ndarray, step: float = 0.4, end: float = 2e-3
) -> tuple[np.ndarray, float]:
    """Minimise by trying one coordinate at a time and halving the step (Hooke and Jeeves 1961); no derivatives, no dependence on scale.

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
    """Constants that make FOTS and the force field closest to surface tracking: least mean distance, each kind of load weighing alike.

    FOTS is fitted in stages, as its authors do: dilation on normal presses, then shear and twist with the dilation kept; these once as
    published and once as a punch (``PunchSpec``), whose three constants shear and twist share. A cap is no more than the largest motion
    in the data: beyond it nobody knows.
    """
    from raytac.markers.fots_kernel import TWIST_SLIP, FotsConstants, FotsKernel

    kernel = FotsKernel(data.cells.x, data.cells.y, device=device)

    def error(constants: FotsConstants, rows: np.ndarray) -> float:
        markers = np.broadcast_to(data.markers, (len(rows), *data.markers.shape))
        moved = kernel.displacement(markers, data.depth[rows], data.boxes[rows], data.contacts.table[rows], constants)
        return float(np.linalg.norm(moved - data.truth[rows], axis=-1).mean())

    def rows_of(load: str) -> np.ndarray:
        return np.flatnonzero(data.loads == load)

    contacts = data.contacts
    shear_most = float(np.linalg.norm(contacts.shear, axis=-1).max())
    twist_most = float(np.abs(contacts.twist).max())
    found = FotsConstants(1e9, 2.5e5, 2.5e5, max(shear_most, 1e-6), 2.5e5, max(twist_most, 1e-6))
    starts = (found.dilate_gain, found.dilate_lambda)

    def dilation(x: np.ndarray) -> FotsConstants:
        return replace(found, dilate_gain=starts[0] * math.exp(x[0]), dilate_lambda=starts[1] * math.exp(x[1]))

    normal = rows_of("normal")
    # Gain and λ trade off along a valley; a coarse look over λ finds its deepest place first.
    tries = [
        pattern_search(lambda x, at=at: error(dilation(np.array([x[0], at])), normal), np.zeros(1)) for at in (-1.0, 0.0, 1.0)
    ]
    best = min(range(3), key=lambda k: tries[k][1])
    x, _ = pattern_search(lambda x: error(dilation(x), normal), np.array([tries[best][0][0], (-1.0, 0.0, 1.0)[best]]))
    found = dilation(x)
    for load, name, most in (("shear", "shear", shear_most), ("twist", "twist", twist_most)):
        rows = rows_of(load)
        if len(rows) == 0:
            continue

        def dragged(x: np.ndarray, name: str = name, most: float = most, kept: FotsConstants = found) -> FotsConstants:
            return replace(kept, **{f"{name}_lambda": 2.5e5 * math.exp(x[0]), f"{name}_max": most * _share(x[1])})

        x, _ = pattern_search(lambda x, rows=rows, dragged=dragged: error(dragged(x), rows), np.array([0.0, 2.0]))
        found = dragged(x)
    edge = contacts.radius
    way = np.maximum(np.linalg.norm(contacts.shear, axis=-1), edge * np.abs(contacts.twist) / TWIST_SLIP)
    slip_most = float((way[contacts.active] / (contacts.depth * edge)[contacts.active]).max())
    dragged_rows = [rows for rows in (rows_of("shear"), rows_of("twist")) if len(rows)]

    def as_punch(x: np.ndarray) -> FotsConstants:
        return replace(found, punch=PunchSpec(_share(x[0]), 5e-3 * math.exp(x[1]), slip_most * _share(x[2])))

    if dragged_rows:

        def cost(x: np.ndarray) -> float:
            return sum(error(as_punch(x), rows) for rows in dragged_rows)

        # Where nothing slips, slip does not matter: a coarse look finds where it begins to.
        slips = np.linspace(-5.0, 3.0, 9)
        begin = min(slips, key=lambda at: cost(np.array([0.0, 0.0, at])))
        x, _ = pattern_search(cost, np.array([0.0, 0.0, begin]))
        found = as_punch(x)
    gain, stiffness, friction = _fit_force_field(data)
    return MarkerMotionSpec(
        dilate_gain=found.dilate_gain,
        dilate_lambda=found.dilate_lambda,
        shear_lambda=found.shear_lambda,
        shear_max=found.shear_max,
        twist_lambda=found.twist_lambda,
        twist_max=found.twist_max,
        field_gain=gain,
        field_shear=stiffness,
        field_friction=friction,
        punch=found.punch,
        provenance="",
    )


def _share(x: float) -> float:
    """A number in (0, 1) for any x."""
    return 1.0 / (1.0 + math.exp(-x))


def _fit_force_field(data: ProbeData) -> tuple[float, float, float]:
    """(gain, k_t / k_n, friction) of the force field."""
    depth, wall, way = data.force
    length = np.linalg.norm(way, axis=-1)
    along = way / np.maximum(length, 1e-12)[..., None]
    weight = np.array([1.0 / np.sum(data.loads == load) for load in data.loads])
    weight /= weight.sum()

    def cost(x: np.ndarray) -> float:
        gain, stiffness, friction = np.exp(x)
        held = np.minimum(stiffness * length, friction * depth)
        moved = gain * (depth[..., None] * wall + held[..., None] * along)
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
    """Mean distance over the probes that surface tracking moves by more than 50 µm [m]; NaN if there is none."""
    mean_px: float
    """Mean distance in the image [px]."""
    size: float
    """Mean displacement by surface tracking over all probes [m], to compare with."""


def model_errors(
    sensor: SensorSpec,
    frames: Sequence[PressFrame],
    grid: PadGrid,
    *,
    models: Sequence[str] = MARKER_MODELS,
    device: str = "auto",
) -> tuple[list[ModelError], dict[str, float]]:
    """Errors of every model by kind of load, and the median time of a frame of every model [ms] at the probes.

    ``frames`` hold whole presses, in order; ``sensor`` has the marker motion that is tested. ``models``: of ``MARKER_MODELS`` or
    ``PUBLISHED``.
    """
    probed = probe_sensor(sensor)
    motion = sensor.marker_motion
    published = probed if motion is None else replace(probed, marker_motion=replace(motion, punch=None))
    moved: dict[str, list[np.ndarray]] = {}
    pixels: dict[str, list[np.ndarray]] = {}
    times: dict[str, list[float]] = {}
    loads = [frame.load for frame in frames if frame.load in LOADS]
    for model in dict.fromkeys(("surface", *models)):
        as_published = model == PUBLISHED
        tracker = MarkerTracker(published if as_published else probed, "fots" if as_published else model, grid, device=device)
        for _, group in groupby(frames, key=lambda frame: frame.press.name):
            tracker.reset()
            for frame in group:
                begun = time.perf_counter()
                markers = tracker.update(frame.surface)
                times.setdefault(model, []).append(1e3 * (time.perf_counter() - begun))
                if frame.load in LOADS:
                    moved.setdefault(model, []).append(markers.displacement[0])
                    pixels.setdefault(model, []).append(markers.displacement_px[0])
    truth, truth_px = np.stack(moved["surface"]), np.stack(pixels["surface"])
    size = np.linalg.norm(truth, axis=-1)
    errors = []
    for model in models:
        off = np.linalg.norm(np.stack(moved[model]) - truth, axis=-1)
        off_px = np.linalg.norm(np.stack(pixels[model]) - truth_px, axis=-1)
        for load in LOADS:
            rows = np.array([one == load for one in loads])
            if not rows.any():
                continue
            far = size[rows] > 50e-6
            errors.append(
                ModelError(
                    model=model,
                    load=load,
                    frames=int(rows.sum()),
                    mean=float(off[rows].mean()),
                    p95=float(np.percentile(off[rows], 95)),
                    moved=float(off[rows][far].mean()) if far.any() else float("nan"),
                    mean_px=float(off_px[rows].mean()),
                    size=float(size[rows].mean()),
                )
            )
    return errors, {model: float(np.median(values)) for model, values in times.items()}
