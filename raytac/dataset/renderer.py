"""From the presses of a shard to its arrays: the work of one worker."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from raytac.dataset.arrays import ARRAYS
from raytac.dataset.plan import DatasetPlan, Presses, press_scene_of
from raytac.errors import AssetError, BackendError, RaytacError
from raytac.frame import TactileFrame
from raytac.io.code_digest import git_state
from raytac.io.metrics import versions
from raytac.observe.randomization import CameraDrift
from raytac.physics import NarrowContactWarning
from raytac.sensor import TactileSensor
from raytac.specs import PressScene, SensorSpec

_KEPT = 4
"""Sensors that a worker keeps built; each holds a renderer's scene."""
_UNSETTLED = "the press did not settle, or its state is not finite"
Row = dict[str, str | int | float | None]


@dataclass(frozen=True)
class RenderJob:
    """Work order for every worker of a run."""

    plan: DatasetPlan
    device: str = "auto"
    batch: int = 16
    """Presses that are computed at once."""


@dataclass(frozen=True)
class ShardResult:
    """Result of one shard."""

    shard: int
    arrays: dict[str, np.ndarray]
    """Arrays of presses that went well, in order, and of ``SHARED``; empty if there are none."""
    rows: list[Row]
    """One a press, failed or not: all columns of the manifest but those of the file."""
    made_by: dict[str, str | int | float]
    """Device, physics and optics, versions and state of the code."""
    worker: str = ""
    """Name of the worker that rendered it; goes into no file."""


@dataclass
class _Built:
    """A sensor with all that its shards share."""

    sensor: TactileSensor
    drift: CameraDrift | None
    shared: dict[str, np.ndarray]


@dataclass(frozen=True)
class _Taken:
    """Frame of B environments, and the travel below first touch when it was taken [m], (B,)."""

    frame: TactileFrame
    travel: np.ndarray


class ShardRenderer:
    """Renders shards of one plan, in any order; a shard does not depend on those before.

    .. code-block:: python

        result = ShardRenderer(RenderJob(plan, device="cpu")).render(3)
        result.arrays["rgb"]  # (N, H, W, 3)
    """

    def __init__(self, job: RenderJob) -> None:
        self.job, self.plan = job, job.plan
        self._scenes = [press_scene_of(scene, self.plan.sweep.ranges) for scene in self.plan.sweep.objects]
        self._built: dict[tuple[int, int], _Built] = {}

    def prepare(self, shard: int = 0) -> None:
        """Build what a shard needs; ``BackendError`` if a renderer, solver or device does not work."""
        self._for(shard)

    def render(self, shard: int) -> ShardResult:
        """Press and image all presses of a shard; failed ones are in ``rows``. Raises BackendError."""
        presses, built = self.plan.presses(shard), self._for(shard)
        arrays: dict[int, dict[str, np.ndarray]] = {}
        notes: dict[int, Row] = {}
        for which, scene in enumerate(self._scenes):
            places = np.flatnonzero(presses.scene == which)
            for start in range(0, len(places), self.job.batch):
                chosen = places[start : start + self.job.batch]
                frames, reasons = self._press(built, scene, presses[chosen])
                made = self._arrays(built, frames, presses[chosen])
                for b, place in enumerate(chosen.tolist()):
                    own = {name: values[b] for name, values in made.items()}
                    reason = reasons[b] or _not_finite(own)
                    notes[place] = {"status": "failed" if reason else "ok", "reason": reason}
                    if not reason:
                        arrays[place] = own
                        notes[place] |= _figures(frames[-1].frame, b)
        order = sorted(arrays)
        joined = {name: np.stack([arrays[place][name] for place in order]) for name in arrays[order[0]]} if order else {}
        rows = [self._row(shard, presses, place, notes[place]) for place in range(len(presses))]
        made_by = {"device": built.sensor.device_used, "mode": built.sensor.label, **versions(), **git_state()}
        return ShardResult(shard, joined | built.shared if order else {}, rows, made_by)

    def _for(self, shard: int) -> _Built:
        key = self.plan.variant(shard)
        if key in self._built:
            self._built[key] = self._built.pop(key)  # the last used comes last
        else:
            while len(self._built) >= _KEPT:
                self._built.pop(next(iter(self._built)))
            self._built[key] = self._build(self.plan.sensor(shard))
        return self._built[key]

    def _build(self, spec: SensorSpec) -> _Built:
        plan, batch = self.plan, self.job.batch
        sensor = TactileSensor(spec, **plan.sensor_options(batch), device=self.job.device)
        rest = sensor.rest()  # before any press, whose placement of the pattern it would show
        shared = {"grid_x": sensor.grid.x, "grid_y": sensor.grid.y, "rest_height": rest.surface.height[0]}
        if "rgb" in rest.outputs:
            shared["rest_rgb"] = rest.rgb[0]
        drift = CameraDrift(spec, plan.randomization, batch, 0) if plan.randomization.changes_images else None
        return _Built(sensor, drift, shared)

    def _press(self, built: _Built, scene: PressScene, presses: Presses) -> tuple[list[_Taken], list[str]]:
        """Frames of B environments, the first of which are the presses, and why each failed (or "").

        They are those of a video, or the peak's alone.
        """
        reasons = [""] * len(presses)
        own = self._own(presses)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NarrowContactWarning)  # every press tells its contact_cells
            try:
                taken = self._taken(built.sensor, scene, own)
            except (BackendError, AssetError):
                raise
            except RaytacError:
                # One press that cannot be stops its batch: find it by itself, and let the others go on without.
                for b in range(len(presses)):
                    reasons[b] = self._reason(built.sensor, scene, presses[b : b + 1])
                if not any(reasons):
                    raise
                refused = np.flatnonzero([bool(reason) for reason in reasons])
                own["offsets"][refused] = np.nan
                taken = self._taken(built.sensor, scene, own)
        for b in range(len(presses)):
            if any(one.frame.failed[b] for one in taken) and not reasons[b]:
                reasons[b] = _UNSETTLED
        return taken, reasons

    def _taken(self, sensor: TactileSensor, scene: PressScene, own: dict[str, Any]) -> list[_Taken]:
        each = self.plan.sweep.frames_per_stage
        if each is None:
            return [_Taken(sensor.press(scene, **own), np.full(self.job.batch, np.nan))]
        return [_Taken(sensor.update(reading), reading.depth) for reading in sensor.load(scene, **own).run(each)]

    def _own(self, presses: Presses, batch: int | None = None) -> dict[str, Any]:
        """Arguments of ``TactileSensor.press``; environments without a press fail from the start."""
        batch = self.job.batch if batch is None else batch

        def filled(values: np.ndarray, rest: float = 0.0) -> np.ndarray:
            out = np.full((batch, *values.shape[1:]), rest)
            out[: len(values)] = values
            return out

        return {
            "offsets": filled(np.stack([presses.x, presses.y], axis=1), np.nan),
            "depths": filled(presses.press_depth, self.plan.sweep.ranges.depth[1]),
            "rotations": filled(presses.rotations, 1.0),
            "shears": filled(np.stack([presses.shear_x, presses.shear_y], axis=1)),
            "twists": filled(presses.twist),
            "seeds": [*presses.seed.tolist(), *[0] * (batch - len(presses))],
        }

    def _reason(self, sensor: TactileSensor, scene: PressScene, press: Presses) -> str:
        """Why a press cannot be, found by trying it alone; empty if it can."""
        own = self._own(press, 1)
        del own["seeds"]
        try:
            pad = self.plan.physics.build(sensor.spec, scene, pitch=sensor.pitch, num_envs=1, device=self.job.device, **own)
            for _ in pad.run():
                pass
        except (BackendError, AssetError):
            raise
        except RaytacError as error:
            return str(error)
        return ""

    def _arrays(self, built: _Built, taken: list[_Taken], presses: Presses) -> dict[str, np.ndarray]:
        """Arrays (N, …), or (N, T, …) of a video, of the presses."""
        self._begin_drift(built, presses)
        frames = [self._arrays_of(built, one, presses) for one in taken]
        if self.plan.sweep.frames_per_stage is None:
            return frames[0]
        return {
            name: np.stack([frame[name] for frame in frames], axis=1) if ARRAYS[name].changes else first
            for name, first in frames[0].items()
        }

    def _arrays_of(self, built: _Built, taken: _Taken, presses: Presses) -> dict[str, np.ndarray]:
        """Arrays (N, …) of one frame."""
        frame = taken.frame
        outputs, surface = self.plan.sweep.outputs, frame.surface
        arrays: dict[str, Any] = {name: getattr(frame, name) for name in outputs if name not in ("rgb", "contact")}
        arrays |= {"index": presses.index, "pad_from_object": surface.pad_from_object}
        if "travel" in self.plan.arrays:
            arrays["travel"] = taken.travel
        if "contact" in outputs:
            arrays["contact"] = surface.contact
        if "rgb" in frame.outputs:
            arrays["rgb"] = frame.rgb if built.drift is None else built.drift.apply(frame.rgb)
        if "markers" in frame.outputs:
            m = frame.markers
            arrays |= {"markers": m.displacement, "markers_px": m.displacement_px, "markers_rest": m.rest}
            arrays |= {"markers_rest_px": m.rest_px, "marker_visible": m.visible}
        return {name: np.asarray(values[: len(presses)], ARRAYS[name].dtype) for name, values in arrays.items()}

    def _begin_drift(self, built: _Built, presses: Presses) -> None:
        """Draw the camera of every press; noise is drawn of every frame."""
        if built.drift is not None:
            which = range(len(presses))
            built.drift.reseed(which, presses.seed.tolist())
            built.drift.reset(which)

    def _row(self, shard: int, presses: Presses, place: int, note: Mapping[str, Any]) -> Row:
        which, copy = self.plan.variant(shard)
        row: Row = {f.name: getattr(presses, f.name)[place].item() for f in fields(presses) if f.name != "scene"}
        row |= {"sensor": self.plan.sweep.sensors[which].name, "variant": copy}
        return row | {"object": self._scenes[presses.scene[place]].name} | dict(note)


def _figures(frame: TactileFrame, b: int) -> Row:
    """Figures of one press for the manifest."""
    row: Row = {"indentation_max": float(frame.surface.indentation[b].max())}
    if "wrench" in frame.outputs:
        names = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
        row |= dict(zip(names, frame.wrench[b].tolist(), strict=True))
    for name in ("contact_area", "contact_cells"):
        values = getattr(frame, name, None)
        if values is not None and np.isfinite(values[b]):
            row[name] = float(values[b])
    return row


def _not_finite(arrays: Mapping[str, np.ndarray]) -> str:
    """Name of an array of a press with a number that should be finite and is not; or empty."""
    lost = arrays.get("marker_visible")
    for name, values in arrays.items():
        if values.dtype.kind != "f":
            continue
        if name in ("markers", "markers_px") and lost is not None:
            values = values[lost]
        if not np.isfinite(values).all():
            return f"{name} holds a number that is not finite"
    return ""
