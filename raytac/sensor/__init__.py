"""The sensor as one object: pad, optical mode, markers and forces behind ``TactileSensor``."""

from __future__ import annotations

from raytac.optics.base import INTEGRATORS
from raytac.physics.soft.contact_width import NarrowContactWarning
from raytac.sensor.options import LARGEST_SIDE, OPTICS, sensor_outputs
from raytac.sensor.tactile_sensor import TactileSensor
from raytac.specs.press import PADS, PHYSICS

__all__ = ["INTEGRATORS", "LARGEST_SIDE", "OPTICS", "PADS", "PHYSICS", "NarrowContactWarning", "TactileSensor", "sensor_outputs"]
