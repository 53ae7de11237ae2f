"""Configurations of the marker models that come with raytac."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from raytac.checks import check_known, check_whole
from raytac.gel.surface import PadGrid
from raytac.markers.base import MarkerModel, MarkersConfig, marker_motion_of
from raytac.markers.contacts import ContactCells
from raytac.specs.marker_motion import MarkerMotionSpec
from raytac.specs.press import PADS
from raytac.specs.sensor import SensorSpec


@dataclass(frozen=True)
class Fots(MarkersConfig):
    """FOTS in closed forms, around a disc that sticks where the marker motion has a ``punch``."""

    takes_punch: ClassVar[bool] = True
    follows_shear: ClassVar[bool] = True

    def slip(self, sensor: SensorSpec) -> float | None:
        """As of the sensor's marker motion."""
        punch = self.motion(sensor).punch
        return punch.slip if punch else None

    def motion(self, sensor: SensorSpec) -> MarkerMotionSpec:
        """The sensor's marker motion as far as this model takes it."""
        motion = marker_motion_of(sensor)
        return motion if self.takes_punch else replace(motion, punch=None)

    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MarkerModel:
        from raytac.markers.fots import FotsModel

        return FotsModel(self.motion(sensor), ContactCells.over(grid, self.contacts), device=device)


@dataclass(frozen=True)
class FotsPublished(Fots):
    """FOTS as published: Gaussians with one λ for all contacts; a ``punch`` is ignored."""

    takes_punch: ClassVar[bool] = False
    follows_shear: ClassVar[bool] = False


@dataclass(frozen=True)
class SurfaceMarkers(MarkersConfig):
    """Surface tracking: each marker is a point of the soft pad's coat."""

    needs_coat: ClassVar[bool] = True

    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MarkerModel:
        from raytac.markers.surface import SurfaceModel

        return SurfaceModel()


@dataclass(frozen=True)
class Superposition(MarkersConfig):
    """Superposition of the pad's unit-load fields; no fit."""

    follows_shear: ClassVar[bool] = True
    level: str = "coarse"
    """Level of the soft pad whose unit loads are used; memory grows with its vertices squared."""
    rounds: int = 8
    """Most solutions a frame; after each, vertices lose contact or slide."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_known("level", self.level, PADS)
        check_whole("rounds", self.rounds)

    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MarkerModel:
        from raytac.markers.superposition import SuperpositionModel

        return SuperpositionModel(sensor, self.level, self.rounds)


@dataclass(frozen=True)
class ForceField(MarkersConfig):
    """Penalty forces at the markers, scaled to displacements by the sensor's marker motion."""

    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MarkerModel:
        from raytac.markers.force_field import ForceFieldModel

        return ForceFieldModel(marker_motion_of(sensor))
