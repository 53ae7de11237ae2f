"""Gel surfaces that would lie below the bonded face, which is impossible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.specs.sensor import GelpadSpec

_ROUNDING = 1e-8
"""Rounding of a height in float32, and some [m]."""


def without_pierced(surface: GelSurface, gelpad: GelpadSpec) -> GelSurface:
    """The surface, with NaN and no contact where an environment's gel is below its bonded face."""
    pierced = surface.height.min(axis=(1, 2)) < -gelpad.thickness - _ROUNDING
    if not pierced.any():
        return surface
    height, contact, centre = surface.height.copy(), surface.contact.copy(), surface.contact_centre.copy()
    height[pierced], contact[pierced], centre[pierced] = np.nan, False, np.nan
    return replace(surface, height=height, contact=contact, contact_centre=centre)
