"""Normalised force field: penalty forces at the markers themselves, scaled to displacements.

Xu et al. (Efficient tactile simulation with differentiability for robotic manipulation, CoRL 2022) and TacSL (Akinola et al., T-RO
2025): each taxel inside the object feels f_n = k_n δ along the wall's normal and a tangential force up to μ f_n. Both compare their field
with markers after normalising it; here one fitted gain does that, so that it can be given in metres:

    Δd = g (δ n_xy + min(k ‖s‖, μ δ) s / ‖s‖)

with the penetration δ, the object's outward normal n, and s the way of the object's material at the marker since first touch. A marker
outside the contact does not move at all, which is what the model is known for.
"""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples
from raytac.markers.fots import marker_motion_of
from raytac.markers.sampling import height_and_slope, object_way
from raytac.specs.sensor import SensorSpec

__all__ = ["ForceFieldMarkers"]


class ForceFieldMarkers:
    """The model ``force_field``; constants from the sensor's marker motion."""

    name = "force_field"
    needs_contacts = True
    device = "cpu"

    def __init__(self, sensor: SensorSpec) -> None:
        """Raises ``InputError`` if the sensor has no marker motion."""
        motion = marker_motion_of(sensor)
        self.gain, self.shear, self.friction = motion.field_gain, motion.field_shear, motion.field_friction

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert contacts is not None
        height, slope, touched = height_and_slope(surface, rest[..., :2])
        depth = np.where(touched, np.maximum(rest[..., 2] - height, 0.0), 0.0)
        wall = slope / np.sqrt(1.0 + (slope**2).sum(axis=-1, keepdims=True))
        way = object_way(contacts, rest[..., :2])
        length = np.linalg.norm(way, axis=-1)
        held = np.minimum(self.shear * length, self.friction * depth) / np.maximum(length, 1e-12)
        return self.gain * (depth[..., None] * wall + held[..., None] * way)
