"""From what a sensor sees to what a learner is given: spaces, batched arrays, stacks, randomisation. Gymnasium is not needed."""

from __future__ import annotations

from raytac.observe.observer import TactileObserver
from raytac.observe.randomization import Randomization, randomised_bodies, randomised_sensor
from raytac.observe.settings import MODALITIES, SCALES, ObservationSettings
from raytac.observe.spaces import ArraySpec, gymnasium_space
from raytac.observe.tensors import as_tensors

__all__ = [
    "MODALITIES",
    "SCALES",
    "ArraySpec",
    "ObservationSettings",
    "Randomization",
    "TactileObserver",
    "as_tensors",
    "gymnasium_space",
    "randomised_bodies",
    "randomised_sensor",
]
