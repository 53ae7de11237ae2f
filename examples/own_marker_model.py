"""Your own marker model: one class that moves markers, one that configures it, and one line that names it.

    python examples/own_marker_model.py

The toy model moves every marker by the mean shear of the contacts, less with distance from their mean centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac import GelSurface, PadGrid, SensorSpec, TactileSensor
from raytac.markers import Contacts, ContactSamples, MarkersConfig, register


class MeanShearModel:
    """Moves markers; follows the protocol ``raytac.markers.MarkerModel``."""

    needs_contacts = True
    device = "cpu"

    def __init__(self, reach: float) -> None:
        self.reach = reach

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3) [m]."""
        assert contacts is not None
        count = np.maximum(contacts.active.sum(axis=1), 1)[:, None]
        shear, centre = contacts.shear.sum(axis=1) / count, contacts.centre.sum(axis=1) / count
        distance = np.linalg.norm(rest[..., :2] - centre[:, None], axis=-1)
        return np.exp(-distance / self.reach)[..., None] * shear[:, None]


@register("mean_shear")
@dataclass(frozen=True)
class MeanShear(MarkersConfig):
    """Configuration of the toy model; its fields are the model's settings."""

    reach: float = 3e-3
    """Distance over which the displacement falls to 1/e [m]."""

    def build(self, sensor: SensorSpec, grid: PadGrid, *, num_envs: int, device: str) -> MeanShearModel:
        return MeanShearModel(self.reach)


if __name__ == "__main__":
    for markers in ("fots", "mean_shear", MeanShear(reach=1e-3)):
        frame = TactileSensor("gelsight_mini_9x11", markers=markers, outputs=("wrench",)).press("cylinder")
        assert frame.markers is not None
        print(f"{markers}: markers move by up to {1e3 * np.abs(frame.markers.displacement).max():.3f} mm")
