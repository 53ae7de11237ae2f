"""Dots on the coat in an image: the ink's share of the skin, and its effect on light."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.optics.geometry import CoatLayout, bilinear
from raytac.specs.sensor import SensorSpec

SPECULAR = 0.57
"""q of ``darkened``, from the reference integrator on the untouched Mini with 7 x 9 dots.
With 64 samples a pixel a dot of albedo 0.05 on a coat of 0.5 with s = 0.15 returns 0.25 of the coat's light (mean of channels and
dots; 0.20 to 0.38 across the pad; 2026-11-21). Where s = 0, as in the shipped sensors, q does not matter."""


def checked_ink(surface: GelSurface) -> np.ndarray | None:
    """The surface's ink (B, Ny, Nx), or None. InputError: another shape, or beyond [0, 1]."""
    if surface.ink is None:
        return None
    ink = np.ascontiguousarray(surface.ink, dtype=np.float32)
    if ink.shape != surface.height.shape:
        raise InputError("surface.ink", value=ink.shape, rule=f"must have the shape of the heights, {surface.height.shape}")
    if not (ink.min() >= 0 and ink.max() <= 1):
        raise InputError("surface.ink", value=(float(ink.min()), float(ink.max())), rule="must be a share in [0, 1]")
    return ink


def ink_at(mi: Any, layout: CoatLayout, ink: Any, env: Any, x: Any, y: Any) -> Any:
    """Share of ink at points (x, y) [m] of environments ``env``, bilinear in ``ink`` (B·Ny·Nx)."""
    i, wx, wy = layout.cell(mi, env, x, y)
    return bilinear(layout.corners(mi.Float, ink, i), wx, wy)


def inked_albedo(sensor: SensorSpec, ink: Any) -> list[Any]:
    """Diffuse albedo of the channels where this share is ink; the specular lobe is the coat's."""
    return [r + (sensor.markers.reflectance - r) * ink for r in sensor.coat.reflectance]


def darkened(sensor: SensorSpec, levels: list[Any], ink: Any) -> list[Any]:
    """Levels (0-255, three channels) of a plain coat with dots, for modes that know no light.

    In linear light x = S⁻¹(level / 255)^γ less the black level, a dot returns the share ((1 − s) ρ_dot + s q) / ((1 − s) ρ + s q) of what
    the coat does; q is what the specular lobe, of weight s, sends to the camera beside a white diffuse coat. Channels are not unmixed
    first, so that with a colour matrix this is exact only where all channels have the same share, as with grey coats.
    """
    coat, response, s, curve = sensor.coat, sensor.response, sensor.coat.specular, sensor.response.curve

    def inked(*levels: Any) -> tuple[Any, ...]:
        result = []
        for c, dotted in enumerate(inked_albedo(sensor, ink)):
            level, albedo, black = levels[c], coat.reflectance[c], response.black_level[c]
            share = ((1 - s) * dotted + s * SPECULAR) / ((1 - s) * albedo + s * SPECULAR)
            power: Any = dr.power  # typed as an object in Dr.Jit's stubs
            level = dr.maximum(level, 0)
            if black == 0 and curve.is_plain:  # the two powers of the level are one another's inverse
                result.append(power(share, 1 / response.gamma) * level)
                continue
            u = level / 255
            linear = power(dr.select(u < 1, curve.straight(u), u), response.gamma) - black
            u = power(dr.maximum(black + linear * share, 0), 1 / response.gamma)
            result.append(dr.select(u < 1, curve.bent(u), u) * 255)  # the curve is for levels up to white
        return tuple(result)

    # A branch, since powers are dear and dots are few.
    return list(dr.if_stmt(tuple(levels), ink > 0, inked, lambda *levels: levels, label="ink"))
