"""What a sensor returns: one dataclass of arrays, each present only if it was asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from raytac.gel.surface import GelSurface, summary

if TYPE_CHECKING:
    from raytac.markers import MarkerFrame

__all__ = ["OUTPUTS", "TactileFrame"]

OUTPUTS = ("rgb", "layers", "normals", "depth", "height", "wrench", "traction")
"""Names that ``TactileSensor(outputs=…)`` and ``raytac press --outputs`` accept."""


@dataclass(frozen=True, repr=False)
class TactileFrame:
    """Images of B sensors at one instant; an output that was not asked for is None.

    All images have shape (B, H, W, …) at the rendered resolution, row 0 at the top (pad-frame −y).
    """

    surface: GelSurface
    rgb: np.ndarray | None = None
    """8-bit image after the camera response, shape (B, H, W, 3), uint8."""
    layers: dict[str, np.ndarray] | None = None
    """Linear radiance by light layer, each shape (B, H, W, 3), float32; their sum is the linear image."""
    normals: np.ndarray | None = None
    """Unit normal of the coat towards the camera side (n_z < 0), pad frame, shape (B, H, W, 3), float32."""
    position: np.ndarray | None = None
    """Seen point of the coat, pad frame [m], shape (B, H, W, 3), float32 (comes with ``normals``)."""
    depth: np.ndarray | None = None
    """Camera-axis depth z − z_camera [m], shape (B, H, W), float32 (not distance along the ray)."""
    height: np.ndarray | None = None
    """Surface height on the pad grid [m], shape (B, Ny, Nx), float32."""
    contact: np.ndarray | None = None
    """Contact mask as the camera sees it, shape (B, H, W), bool (comes with ``normals`` or ``depth``)."""
    uncovered: np.ndarray | None = None
    """Share of the contact's pixels whose bin of the Taxim table no calibration sample reached, shape (B,), NaN without contact; None
    for other modes, and where the table does not tell its coverage."""
    markers: MarkerFrame | None = None
    """Where the markers have gone, in metres and pixels; None unless the sensor was given a marker model."""
    wrench: np.ndarray | None = None
    """Force of the object on the pad [N] and its torque about the pad frame's origin [N m], pad frame, shape (B, 6)."""
    traction: np.ndarray | None = None
    """Force of the object on the pad per area [Pa], pad frame, on the pad grid, shape (B, Ny, Nx, 3), float32: x, y shear, −z pressure.
    Of a simulated pad at the place that the coat has at rest; of the rigid pad its force shared out over the contact (a model). Its sum
    over the nodes, each times its area (``raytac.gel.traction.cell_areas``: half a cell at the pad's edge), is the wrench's force."""
    contact_area: np.ndarray | None = None
    """Area of ``surface.contact`` [m²], shape (B,) (comes with ``wrench`` or ``traction``)."""
    contact_cells: np.ndarray | None = None
    """Width of the narrowest patch of contact in cells of a simulated pad, shape (B,), NaN without contact (comes with ``wrench`` or
    ``traction``): with fewer than 6 the force at a given depth is too large. None for the rigid pad."""
    force: np.ndarray | None = None
    """Force of the object on the pad, pad frame [N], shape (B, 3); None if the frame was made from a bare surface."""
    force_law_area: np.ndarray | None = None
    """Area of contact in the law that ties force to depth [m²], shape (B,); not that of ``surface.contact``. None as for
    ``force``, and for a simulated pad, which follows no such law."""
    failed: np.ndarray | None = None
    """Environments whose physics broke down, shape (B,), bool; their arrays hold nothing of use. None as for ``force``."""
    unconverged: np.ndarray | None = None
    """Steps of a simulated pad's solver that did not meet its tolerance since the press began, or since the world's environment was reset,
    shape (B,), int. An environment whose last step is one of them has ``failed``. None for the rigid pad, and as for ``force``."""
    time_ms: dict[str, float] = field(default_factory=dict)
    """Wall time of ``physics``, ``surface``, ``markers`` and ``optics`` for the whole batch [ms]."""

    def __repr__(self) -> str:
        return summary(self)
