"""Normalised force field: penalty forces at the markers themselves, scaled to displacements.

Xu et al. (Efficient tactile simulation with differentiability for robotic manipulation, CoRL 2022) and TacSL (Akinola et al., T-RO
2025): each taxel inside the object feels f_n = k_n δ along the wall's normal and a tangential force up to μ f_n. Both compare their field
with markers after normalising it; here one fitted gain does that, so that it can be given in metres:

    Δd = g (δ n_xy + min(k ‖s‖, μ δ) s / ‖s‖)

with the penetration δ, the object's outward normal n, and s the displacement of the object's material at the marker since first touch. A
marker outside the contact does not move at all, which is what the model is known for.
"""

from __future__ import annotations

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import Contacts, ContactSamples
from raytac.markers.sampling import height_and_slope, object_displacement
from raytac.specs.marker_motion import MarkerMotionSpec


def contact_at(rest: np.ndarray, surface: GelSurface, contacts: Contacts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Penetration δ (B, M), n_xy and object's displacement (B, M, 2) [m] at ``rest`` (B, M, 3)."""
    height, slope, touched = height_and_slope(surface, rest[..., :2])
    depth = np.where(touched, np.maximum(rest[..., 2] - height, 0.0), 0.0)
    normal = slope / np.sqrt(1.0 + (slope**2).sum(axis=-1, keepdims=True))
    return depth, normal, object_displacement(contacts, rest[..., :2])


class ForceFieldModel:
    """Model of ``ForceField``."""

    needs_contacts = True
    device = "cpu"

    def __init__(self, motion: MarkerMotionSpec) -> None:
        self.gain, self.shear, self.friction = motion.field_gain, motion.field_shear, motion.field_friction

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert contacts is not None
        depth, normal, shear = contact_at(rest, surface, contacts)
        length = np.linalg.norm(shear, axis=-1)
        share = np.minimum(self.shear * length, self.friction * depth) / np.maximum(length, 1e-12)
        return self.gain * (depth[..., None] * normal + share[..., None] * shear)
