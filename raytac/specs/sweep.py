"""Sweeps: objects, sensors, ranges of presses and their number. SI units, pad frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from raytac.errors import SpecError
from raytac.specs.press import PADS, PressScene
from raytac.specs.sensor import SensorSpec
from raytac.specs.toml import ANY, REQUIRED, Integer, Number, Schema, Text, check_fields, split_unit

Range = tuple[float, float]
"""Least and greatest value; draws are uniform between them."""

SWEEP_SCHEMA: Final[Schema] = {
    "sensors": Text(length=ANY, default=("gelsight_mini",)),
    "objects": Text(length=ANY),
    "count": Integer("[1, 1000000000]"),
    "shard_size": Integer("[1, 100000]", default=256),
    "seed": Integer("[0, 4294967295]", default=0),
    "physics": Text(default="rigid"),
    "pad": Text(choices=PADS, default=None),
    "optics": Text(default="taxim"),
    "outputs": Text(length=ANY, default=("rgb", "height", "wrench")),
    "markers": Text(default=None),
    "resolution": Integer("[1, 8192]", length=2, default=None),
    "pitch_mm": Number("[0.01, 5]", default=None),
    "variants": Integer("[1, 10000]", default=1),
    "frames_per_stage": Integer("[1, 1000]", default=None),
}
"""Keys at the top of a sweep."""

RANGE_SCHEMA: Final[Schema] = {
    "depth_mm": Number("(0, 50]", length=2),
    "x_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
    "y_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
    "yaw_deg": Number("[-360, 360]", length=2, default=(0.0, 0.0)),
    "tilt_deg": Number("[0, 180]", length=2, default=(0.0, 0.0)),
    "shear_mm": Number("[0, 50]", length=2, default=(0.0, 0.0)),
    "twist_deg": Number("[-180, 180]", length=2, default=(0.0, 0.0)),
}
"""Keys of ``[press]``: least and greatest value."""

_WIDTH = Number("[0, 1)", default=None)
RANDOMIZATION_SCHEMA: Final[Mapping[str, Number]] = {
    "led_power": _WIDTH,
    "led_colour": _WIDTH,
    "reflectance": _WIDTH,
    "youngs_modulus": _WIDTH,
    "friction": _WIDTH,
    "exposure": _WIDTH,
    "white_balance": _WIDTH,
    "gamma": _WIDTH,
    "noise": Number("[0, 255]", default=None),
}
"""Keys of ``[randomization]``: those of ``raytac.observe.Randomization``."""

MARKER_NOISE_SCHEMA: Final[Mapping[str, Number]] = {
    "noise_px": Number("[0, 100]", default=None),
    "dropout": Number("[0, 1)", default=None),
    "shift_mm": Number("[0, 20]", default=None),
    "turn_deg": Number("[0, 180]", default=None),
}
"""Keys of ``[randomization.markers]``: those of ``raytac.markers.MarkerPerturbation``."""


@dataclass(frozen=True)
class PressRanges:
    """Ranges that presses are drawn from; equal ends fix a value."""

    depth: Range
    """Travel below first touch [m]."""
    x: Range = (0.0, 0.0)
    """Of the object's origin at the start, added to the scene's [m]."""
    y: Range = (0.0, 0.0)
    yaw: Range = (0.0, 0.0)
    """Turn of the object about the pad's normal, +z [rad]."""
    tilt: Range = (0.0, 0.0)
    """Lean of the object, turned by yaw, from +z [rad]; its direction is uniform."""
    shear: Range = (0.0, 0.0)
    """Length of the sideways displacement after the indent [m]; its direction is uniform."""
    twist: Range = (0.0, 0.0)
    """Turn about +z after that, in contact [rad]."""

    def __post_init__(self) -> None:
        check_fields(vars(self), RANGE_SCHEMA, "press")
        for key in RANGE_SCHEMA:
            name, unit = split_unit(key)
            low, high = getattr(self, name)
            if low > high:
                rule = "must be the least and the greatest value, in this order"
                raise SpecError(rule, key=f"press.{key}", value=unit.shown((low, high)))


@dataclass(frozen=True)
class SweepSpec:
    """A data set to be: ``count`` presses in shards of ``shard_size``."""

    name: str
    sensors: tuple[SensorSpec, ...]
    objects: tuple[PressScene, ...]
    """Press scenes, or meshes, whose objects are pressed; trajectories are not used."""
    count: int
    ranges: PressRanges
    shard_size: int = 256
    seed: int = 0
    physics: str = "rigid"
    """Name of the physics; checked when the sweep is planned."""
    pad: str | None = None
    """One of ``PADS``, of a soft pad; None is coarse."""
    optics: str = "taxim"
    outputs: tuple[str, ...] = ("rgb", "height", "wrench")
    """Arrays that are kept, besides parameters, poses and markers."""
    markers: str | None = None
    """Marker model; None is no markers."""
    resolution: tuple[int, int] | None = None
    """(width, height) of the images [px]; None is the sensor's own."""
    pitch: float | None = None
    """Spacing of the maps over the pad [m]; None is that of a pixel, at most 0.1 mm."""
    variants: int = 1
    """Drawn copies of every sensor, where the randomisation changes sensors."""
    frames_per_stage: int | None = None
    """Frames of a video through each stage, after one above the gel; None: the peak alone."""
    randomization: Mapping[str, float] = field(default_factory=dict)
    """Fields of ``raytac.observe.Randomization`` that ``RANDOMIZATION_SCHEMA`` has."""
    marker_perturbation: Mapping[str, float] = field(default_factory=dict)
    """Fields of ``raytac.markers.MarkerPerturbation`` by name."""
    source: Path | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise SpecError("must be a text", file=self.source, key="name", value=self.name)
        own = {key: rule for key, rule in SWEEP_SCHEMA.items() if key not in ("sensors", "objects")}
        check_fields(vars(self), own, file=self.source)
        if self.pad is not None and self.physics != "ipc":
            rule = 'is how finely a soft pad is cut, so physics must be "ipc"'
            raise SpecError(rule, file=self.source, key="pad", value=self.pad)
        self._check_pressed("sensors", SensorSpec)
        self._check_pressed("objects", PressScene)
        for scene in self.objects:
            if scene.object.kind == "none":
                raise SpecError("must be press scenes with an object", file=self.source, key="objects", value=scene.name)
        if not isinstance(self.ranges, PressRanges):
            raise SpecError("must be a PressRanges", file=self.source, key="ranges", value=self.ranges)
        markers = {split_unit(key)[0] if key != "noise_px" else key: (key, rule) for key, rule in MARKER_NOISE_SCHEMA.items()}
        self._check_widths("randomization", self.randomization, {key: (key, rule) for key, rule in RANDOMIZATION_SCHEMA.items()})
        self._check_widths("randomization.markers", self.marker_perturbation, markers)

    def _check_pressed(self, key: str, kind: type[SensorSpec] | type[PressScene]) -> None:
        """Refuse what is no tuple of specifications of this kind, each with a name of its own."""
        specs = getattr(self, key)
        if not isinstance(specs, tuple) or not specs or not all(isinstance(spec, kind) for spec in specs):
            raise SpecError(f"must be a tuple of one or more {kind.__name__}", file=self.source, key=key, value=specs)
        names = [spec.name for spec in specs]
        if len(set(names)) != len(names):
            rule = "must have names of their own: the data set tells them apart by the stems of their files"
            raise SpecError(rule, file=self.source, key=key, value=names)

    def _check_widths(self, prefix: str, widths: object, known: Mapping[str, tuple[str, Number]]) -> None:
        """Refuse an unknown name, or a value that no file could give; ``known``: (key, rule)."""
        if not isinstance(widths, Mapping):
            raise SpecError("must be a mapping of names to numbers", file=self.source, key=prefix, value=widths)
        for name, value in widths.items():
            if name not in known:
                raise SpecError("must have known names", file=self.source, key=prefix, value=name, choices=tuple(known))
            key, rule = known[name]
            check_fields({split_unit(key)[0]: value}, {key: replace(rule, default=REQUIRED)}, prefix, self.source)
