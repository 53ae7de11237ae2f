"""Presses of a data set, each drawn from the seed and its own number alone."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from raytac.dataset.arrays import DATASET_OUTPUTS, SHARED, ArrayKind, press_arrays
from raytac.errors import InputError, RaytacError, SpecError
from raytac.gel.surface import PadGrid, grid_pitch, make_grid
from raytac.markers import MARKERS, MarkerPerturbation
from raytac.markers.pattern import MarkerPattern
from raytac.observe import Randomization, randomised_sensor
from raytac.physics.registry import scene_physics
from raytac.sensor import TactileSensor
from raytac.specs import HeightMap, PressRanges, PressScene, SensorSpec, StageSpec, SweepSpec
from raytac.specs.toml import in_mm

_DRAWS = 10
"""Uniform numbers that every press draws, used or not, so that ranges are independent."""


@dataclass(frozen=True)
class Presses:
    """Parameters of N presses; SI units, pad frame."""

    index: np.ndarray
    """Number in the data set, (N,)."""
    scene: np.ndarray
    """Number of the object among the sweep's, (N,)."""
    seed: np.ndarray
    """Of noise in images and markers, (N,)."""
    press_depth: np.ndarray
    """Travel below first touch [m], (N,)."""
    x: np.ndarray
    y: np.ndarray
    """Added to the place of the scene's object [m], (N,)."""
    yaw: np.ndarray
    """[rad], (N,)."""
    tilt: np.ndarray
    tilt_direction: np.ndarray
    """The object leans by ``tilt`` towards this direction, measured from +x to +y [rad], (N,)."""
    shear_x: np.ndarray
    shear_y: np.ndarray
    """Displacement along x and y after the indent [m], (N,)."""
    twist: np.ndarray
    """Turn about +z after that [rad], (N,)."""

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, which: np.ndarray | slice) -> Presses:
        return Presses(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    @property
    def rotations(self) -> np.ndarray:
        """Turn of the object: yaw about +z, then the lean; wxyz, (N, 4)."""
        half, lean, azimuth = 0.5 * self.yaw, 0.5 * self.tilt, self.tilt_direction
        # The axis of the lean is +z × direction.
        axis = np.stack([np.zeros_like(azimuth), -np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=1)
        a = np.cos(lean)[:, None] * np.array([1.0, 0.0, 0.0, 0.0]) + np.sin(lean)[:, None] * axis
        w, z = np.cos(half), np.sin(half)
        return np.stack([a[:, 0] * w, a[:, 1] * w + a[:, 2] * z, a[:, 2] * w - a[:, 1] * z, a[:, 0] * z], axis=1)


class DatasetPlan:
    """A sweep, checked, cut into shards of one sensor each.

    .. code-block:: python

        plan = DatasetPlan(load_sweep("demo"))
        plan.presses(3)  # parameters of the presses of shard 3
        plan.sensor(3)  # and the sensor that they are pressed into
    """

    def __init__(self, sweep: SweepSpec) -> None:
        """Check all that can be checked before anything is rendered.

        Raises:
            InputError: an output that no data set has, a model that the sensor lacks, or randomisation of markers that are not
                asked for.
            SpecError: a range that no press into one of the sensors can follow; names the file and key.
        """
        self.sweep, self.physics = sweep, scene_physics(None, sweep)
        for name in sweep.outputs:
            if name not in DATASET_OUTPUTS:
                raise InputError("outputs", value=name, rule="must be known names", choices=DATASET_OUTPUTS)
        if sweep.marker_perturbation and sweep.markers is None:
            rule = "perturbs markers, which the sweep does not ask for: markers = …"
            raise InputError("randomization.markers", value=dict(sweep.marker_perturbation), rule=rule)
        self.randomization = Randomization(**sweep.randomization, markers=MarkerPerturbation(**sweep.marker_perturbation))
        if sweep.variants > 1 and not self.randomization.changes_sensor:
            rule = "copies of a sensor differ only where the randomisation changes sensors (led_power, friction, …)"
            raise InputError("variants", value=sweep.variants, rule=rule)
        if self.randomization.changes_images and "rgb" not in sweep.outputs:
            raise InputError("randomization", value=dict(sweep.randomization), rule="changes images: outputs must have 'rgb'")
        for scene in sweep.objects:
            self._check_object(scene)
        for sensor in sweep.sensors:
            self._check_reach(sensor)
            TactileSensor(sensor, **self.sensor_options(1), device="cpu")
            self._check_markers(sensor)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.sweep.count // self.sweep.shard_size)

    def variant(self, shard: int) -> tuple[int, int]:
        """Number of the sensor of a shard, and of its drawn copy: shards take turns."""
        copy, sensor = divmod(shard % (len(self.sweep.sensors) * self.sweep.variants), len(self.sweep.sensors))
        return sensor, copy

    def sensor(self, shard: int) -> SensorSpec:
        """Sensor of a shard, as drawn."""
        sensor, copy = self.variant(shard)
        seed = int(np.random.SeedSequence((self.sweep.seed, 0x5E, copy)).generate_state(1)[0])
        return randomised_sensor(self.sweep.sensors[sensor], self.randomization, seed)

    def presses(self, shard: int) -> Presses:
        """Presses of a shard; press i depends on the sweep's seed, ranges and objects, and on i."""
        first = shard * self.sweep.shard_size
        if not 0 <= shard < self.shards:
            raise InputError("shard", value=shard, rule=f"must be in [0, {self.shards})")
        return self.draw(np.arange(first, first + self.shard_presses(shard)))

    def shard_presses(self, shard: int) -> int:
        """Number of presses of a shard; the last one may have fewer."""
        return min(self.sweep.shard_size, self.sweep.count - shard * self.sweep.shard_size)

    def draw(self, index: np.ndarray) -> Presses:
        """Presses by their numbers."""
        streams = [np.random.default_rng((self.sweep.seed, int(i))) for i in index]
        u = np.array([stream.random(_DRAWS) for stream in streams]).reshape(len(index), _DRAWS).T
        seed = np.array([stream.integers(2**32) for stream in streams], np.int64)
        ranges = self.sweep.ranges

        def between(ends: tuple[float, float], share: np.ndarray) -> np.ndarray:
            return ends[0] + (ends[1] - ends[0]) * share

        shear, shear_direction = between(ranges.shear, u[6]), 2.0 * np.pi * u[7]
        return Presses(
            index=np.asarray(index, np.int64),
            scene=np.minimum((u[0] * len(self.sweep.objects)).astype(np.int64), len(self.sweep.objects) - 1),
            seed=seed,
            press_depth=between(ranges.depth, u[1]),
            x=between(ranges.x, u[2]),
            y=between(ranges.y, u[3]),
            yaw=between(ranges.yaw, u[4]),
            tilt=between(ranges.tilt, u[5]),
            tilt_direction=2.0 * np.pi * u[9],
            shear_x=shear * np.cos(shear_direction),
            shear_y=shear * np.sin(shear_direction),
            twist=between(ranges.twist, u[8]),
        )

    def sensor_options(self, num_envs: int) -> dict[str, Any]:
        """Keyword arguments of the ``TactileSensor`` of a sweep, but for sensor and device."""
        sweep = self.sweep
        return {
            "physics": self.physics,
            "optics": sweep.optics,
            "outputs": tuple(name for name in sweep.outputs if name != "contact"),
            "markers": None if sweep.markers is None else MARKERS.config(sweep.markers, perturbation=self.randomization.markers),
            "resolution": sweep.resolution,
            "pitch": sweep.pitch,
            "num_envs": num_envs,
            "seed": sweep.seed,
        }

    def resolution(self, sensor: SensorSpec) -> tuple[int, int]:
        """(width, height) of the images [px]."""
        return self.sweep.resolution or sensor.camera.resolution

    def grid(self, sensor: SensorSpec) -> PadGrid:
        """Nodes of the maps over the pad."""
        pitch = self.sweep.pitch or grid_pitch(sensor.camera.pitch_at(self.resolution(sensor)))
        return make_grid(sensor.gelpad, pitch)

    @cached_property
    def arrays(self) -> dict[str, ArrayKind]:
        """Arrays of one press that shards keep."""
        sweep = self.sweep
        return press_arrays(sweep.outputs, markers=sweep.markers is not None, video=sweep.frames_per_stage is not None)

    @cached_property
    def shared(self) -> dict[str, ArrayKind]:
        """Arrays that shards keep once."""
        return {name: array for name, array in SHARED.items() if array.is_kept(self.sweep.outputs)}

    @property
    def frames(self) -> int:
        """Frames of a press: 1, or those of a video."""
        per_stage = self.sweep.frames_per_stage
        return 1 if per_stage is None else 1 + per_stage * len(press_stages(self.sweep.ranges))

    def array_shapes(self, sensor: SensorSpec, kinds: Mapping[str, ArrayKind] | None = None) -> dict[str, tuple[int, ...]]:
        """Shape of every array of one press, by name; with ``shared``, of those once a shard."""
        width, height = self.resolution(sensor)
        rows, columns = self.grid(sensor).shape
        count = sensor.markers.rows * sensor.markers.columns
        sizes = {"H": height, "W": width, "Ny": rows, "Nx": columns, "M": count, "T": self.frames}
        kinds = self.arrays if kinds is None else kinds
        return {name: tuple(sizes[n] if isinstance(n, str) else n for n in array.shape) for name, array in kinds.items()}

    def press_bytes(self, sensor: SensorSpec) -> int:
        """Bytes on disk of one press, not compressed, without the arrays once a shard."""
        return _bytes(self.array_shapes(sensor), self.arrays)

    def shard_bytes(self, shard: int) -> int:
        """Bytes on disk of a shard, not compressed, but for some kilobytes of headers and rows."""
        sensor = self.sweep.sensors[self.variant(shard)[0]]
        return self.shard_presses(shard) * self.press_bytes(sensor) + self._shared_bytes(sensor)

    def total_bytes(self, without: Collection[int] = ()) -> int:
        """Bytes on disk of all shards but those ``without``, not compressed.

        The time that it takes does not grow with the number of shards.
        """
        kinds, last = len(self.sweep.sensors), self.shards - 1
        done = Counter(shard % kinds for shard in without)  # shards take turns over the sensors
        total = 0
        for k, sensor in enumerate(self.sweep.sensors):
            full = self.sweep.shard_size * self.press_bytes(sensor) + self._shared_bytes(sensor)
            total += full * (len(range(k, self.shards, kinds)) - done[k])
        if last not in without:
            absent = self.shards * self.sweep.shard_size - self.sweep.count
            total -= absent * self.press_bytes(self.sweep.sensors[last % kinds])
        return total

    def _shared_bytes(self, sensor: SensorSpec) -> int:
        return _bytes(self.array_shapes(sensor, self.shared), self.shared)

    @cached_property
    def description(self) -> dict[str, Any]:
        """All that the presses depend on but code and device, as plain values without any path."""
        sweep = self.sweep
        own = {n: v for n, v in vars(sweep).items() if n not in ("sensors", "objects", "source", "ranges", "name")}
        if sweep.frames_per_stage is None:
            del own["frames_per_stage"]  # data sets from before there were videos go on
        facts = {
            **own,
            "press": {name: list(ends) for name, ends in vars(sweep.ranges).items()},
            "sensors": {s.name: _sensor_digest(s) for s in sweep.sensors},
            "objects": {scene.name: _object_of(scene) for scene in sweep.objects},
        }
        return json.loads(json.dumps(facts, default=dict))

    @cached_property
    def digest(self) -> str:
        """64 hex digits that change with anything in ``description``."""
        return hashlib.sha256(json.dumps(self.description, sort_keys=True).encode()).hexdigest()

    def _check_object(self, scene: PressScene) -> None:
        dynamics, key = scene.object.dynamics, "object.dynamics"
        if dynamics == "affine":
            raise SpecError("a free body cannot be pressed to a depth", file=scene.source, key=key, value=dynamics)
        if dynamics == "soft" and (not self.physics.is_simulated or self.sweep.ranges.tilt != (0.0, 0.0)):
            rule = 'a soft object needs physics = "ipc" and tilt_deg = [0, 0]: it is held at its top'
            raise SpecError(rule, file=scene.source, key=key, value=dynamics)

    def _check_reach(self, sensor: SensorSpec) -> None:
        ranges, pad = self.sweep.ranges, sensor.gelpad
        if not ranges.depth[1] < pad.thickness:
            rule = f"must be less deep than the pad of {sensor.name} is thick, {pad.thickness * 1e3:.4g} mm"
            raise self._error("depth_mm", ranges.depth, rule)
        for axis, size in zip("xy", pad.size, strict=True):
            ends: tuple[float, float] = getattr(ranges, axis)
            if max(-ends[0], ends[1]) > 0.5 * size:
                rule = f"must lie on the pad of {sensor.name}: {axis} in ±{0.5e3 * size:.4g} mm"
                raise self._error(f"{axis}_mm", ends, rule)

    def _check_markers(self, sensor: SensorSpec) -> None:
        """Refuse shifts and turns of the pattern that take a marker out of the view."""
        largest = self.randomization.markers
        if self.sweep.markers is not None and largest.moves_pattern:
            ends = np.array([(x, y, turn) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for turn in (-1.0, 0.0, 1.0)])
            shift, turn = largest.shift * ends[:, :2], largest.turn * ends[:, 2]
            MarkerPattern.of(sensor, self.resolution(sensor), shift=shift, turn=turn)

    def _error(self, key: str, ends: tuple[float, float], rule: str) -> RaytacError:
        """Error of a range of the sweep's ``[press]`` table; ``ends`` [m]."""
        return SpecError(rule, file=self.sweep.source, key=f"press.{key}", value=in_mm(ends))


def press_stages(ranges: PressRanges) -> tuple[StageSpec, ...]:
    """Trajectory of a sweep's presses: indent, then shear and twist, if any."""
    stages = [StageSpec("indent", depth=ranges.depth[1])]
    if ranges.shear != (0.0, 0.0):
        stages.append(StageSpec("shear"))
    if ranges.twist != (0.0, 0.0):
        stages.append(StageSpec("twist"))
    return tuple(stages)


def press_scene_of(scene: PressScene, ranges: PressRanges) -> PressScene:
    """A scene's object with the trajectory of a sweep."""
    return replace(scene, trajectory=press_stages(ranges), source=None, physics=None, pad=None)


def _bytes(shapes: Mapping[str, tuple[int, ...]], kinds: Mapping[str, ArrayKind]) -> int:
    return sum(int(np.prod(shape, dtype=np.int64)) * np.dtype(kinds[name].dtype).itemsize for name, shape in shapes.items())


def _sensor_digest(sensor: SensorSpec) -> str:
    plain = replace(sensor, source=None, lights=replace(sensor.lights, source=None))
    if plain.marker_motion is not None and hasattr(plain.marker_motion, "source"):
        plain = replace(plain, marker_motion=replace(plain.marker_motion, source=None))
    return hashlib.sha256(_sensor_text(plain).encode()).hexdigest()


_FIRST_DEFAULTS = {
    "SensorSpec": ("optics", "noise", "marker_motion", "source"),
    "GelpadSpec": ("bonded", "hysteresis", "relaxation_time", "surface"),
    "CaseSpec": ("wall", "density"),
    "CameraSpec": ("distortion", "tilt", "monochrome"),
    "ResponseSpec": ("shading_red", "shading_green", "shading_blue"),
    "OpticsSpec": ("shadows",),
    "NoiseSpec": ("dark_variance", "bright_variance"),
    "LedSpec": ("glow", "virtual"),
    "LightsSpec": ("source",),
    "MarkerMotionSpec": ("punch", "source"),
}
"""Optional fields that the digest of a sensor has at their defaults too, by class.

Never add to it: a later field counts only where it is not at its default, so that data sets from before it go on.
"""


def _sensor_text(value: Any) -> str:
    """``repr`` of a sensor or a part of it, without later fields at their defaults."""
    if isinstance(value, tuple):
        return f"({', '.join(map(_sensor_text, value))}{',' if len(value) == 1 else ''})"
    if not is_dataclass(value) or isinstance(value, HeightMap):
        return repr(value)
    name, given = type(value).__name__, [(f, getattr(value, f.name)) for f in fields(value)]
    first = _FIRST_DEFAULTS.get(name, ())
    items = [f"{f.name}={_sensor_text(own)}" for f, own in given if f.name in first or own != f.default]
    return f"{name}({', '.join(items)})"


def _object_of(scene: PressScene) -> dict[str, Any]:
    """Object and moving side without paths: a file goes in by its name and contents."""
    params: Mapping[str, Any] = dict(scene.object.params)
    if "path" in params:
        file = Path(str(params["path"]))
        params = {**params, "path": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    spec = scene.object
    if spec.heights:
        params = {**params, "sha256": hashlib.sha256(repr(spec.heights).encode()).hexdigest()}
    if spec.triangles is not None:
        params = {**params, "sha256": spec.triangles.digest}
    return {
        "kind": spec.kind,
        "params": params,
        "position": list(spec.position),
        "quaternion": list(spec.quaternion),
        "dynamics": spec.dynamics,
        "youngs_modulus": spec.youngs_modulus,
        "poisson_ratio": spec.poisson_ratio,
        "moves": scene.moves,
    }
