"""What a sweep is: which objects are pressed how into which sensors, how often, and what is kept of it. SI units, pad frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from raytac.specs.press import PressScene
from raytac.specs.sensor import SensorSpec

__all__ = ["PressRanges", "Range", "SweepSpec"]

Range = tuple[float, float]
"""Least and greatest value; draws are uniform between them."""


@dataclass(frozen=True)
class PressRanges:
    """Where presses are drawn from; equal ends fix a value."""

    depth: Range
    """Travel below first touch [m]."""
    x: Range = (0.0, 0.0)
    """Of the object's origin at the start, added to the scene's [m]."""
    y: Range = (0.0, 0.0)
    yaw: Range = (0.0, 0.0)
    """Turn of the object about the pad's normal, +z [rad]."""
    tilt: Range = (0.0, 0.0)
    """Lean of the object, turned by yaw, away from +z [rad]; the direction of the lean is uniform over the circle."""
    shear: Range = (0.0, 0.0)
    """Length of the way sideways after the indent [m]; its direction is uniform over the circle."""
    twist: Range = (0.0, 0.0)
    """Turn about +z after that, in contact [rad]."""


@dataclass(frozen=True)
class SweepSpec:
    """A data set to be: ``count`` presses in shards of ``shard_size``."""

    name: str
    sensors: tuple[SensorSpec, ...]
    objects: tuple[PressScene, ...]
    """Press scenes whose objects are pressed; their own trajectories are not used."""
    count: int
    ranges: PressRanges
    shard_size: int = 256
    seed: int = 0
    physics: str = "rigid"
    """One of ``PHYSICS``."""
    pad: str | None = None
    """One of ``PADS``, of a simulated pad; None is coarse."""
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
    randomization: Mapping[str, float] = field(default_factory=dict)
    """Fields of ``raytac.observe.Randomization`` by name, without ``markers``."""
    marker_perturbation: Mapping[str, float] = field(default_factory=dict)
    """Fields of ``raytac.markers.MarkerPerturbation`` by name."""
    source: Path | None = None
