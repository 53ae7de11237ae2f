"""Protocol of marker models, and the configuration that names and builds each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.contacts import Contacts, ContactSamples, ContactSettings
from raytac.markers.perturbation import MarkerPerturbation
from raytac.specs.marker_motion import MarkerMotionSpec
from raytac.specs.sensor import SensorSpec


class MarkerModel(Protocol):
    """A model that moves the markers of B pads."""

    needs_contacts: bool
    """True if it reads contacts: samples, and the object's motion at each since first touch."""
    device: str
    """``cpu`` or ``cuda``: the device that it computes on."""

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement of markers at ``rest`` (B, M, 3) [m]: (B, M, 2), or with z (B, M, 3).

        With two components the marker stays on the surface, whose height gives the third. ``samples`` and ``contacts`` are None for a
        model that does not need them.
        """
        ...


@dataclass(frozen=True)
class MarkersConfig(ABC):
    """Configuration of a marker model, which users pass as ``markers=``."""

    perturbation: MarkerPerturbation | None = None
    """Noise, lost markers and shifts of the pattern; None is none."""
    contacts: ContactSettings = field(default_factory=ContactSettings)
    """Sampling and tracking of contacts, for models that need them."""
    needs_coat: ClassVar[bool] = False
    """True if it reads ``GelSurface.coat``, which only a soft pad has."""
    follows_shear: ClassVar[bool] = False
    """True if ``PadReading.shear`` takes the place of the object's motion since first touch."""

    def __post_init__(self) -> None:
        if not isinstance(self.perturbation, (MarkerPerturbation, type(None))):
            raise InputError("perturbation", value=self.perturbation, rule="must be a MarkerPerturbation or None")
        if not isinstance(self.contacts, ContactSettings):
            raise InputError("contacts", value=self.contacts, rule="must be a ContactSettings")

    def slip(self, sensor: SensorSpec) -> float | None:
        """Shear at which a contact slips, over mean indentation · radius [1/m]; None: never."""
        return None

    @abstractmethod
    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MarkerModel:
        """Build the model for surfaces on ``grid`` of ``num_envs`` environments.

        Args:
            device: ``auto``, ``cpu`` or ``cuda``.

        Raises:
            InputError: the sensor lacks what the model needs.
            BackendError: the model's backend does not work here.
        """


def marker_motion_of(sensor: SensorSpec) -> MarkerMotionSpec:
    """Fitted marker motion of a sensor; raises ``InputError`` if it was never fitted."""
    if sensor.marker_motion is None:
        rule = "has no marker motion: `raytac calibrate markers --sensor NAME` fits one and writes marker_motion.toml, "
        rule += "which the sensor's file names as marker_motion"
        raise InputError("sensor", value=sensor.name, rule=rule)
    return sensor.marker_motion
