"""How stiff a pad's contact can be at most: bounds that keep a coupled simulation stable."""

from __future__ import annotations

import numpy as np

from raytac.specs.sensor import GelpadSpec

__all__ = ["pad_stiffness"]

_SHEAR_MARGIN = 1.2
"""The tangential bound is the tightest, and a coarse mesh has more than the continuum."""


def pad_stiffness(gelpad: GelpadSpec, area: float) -> np.ndarray:
    """Bound (6, 6) of dF/dx of a contact of ``area`` [m²] that moves as one, pad axes, about its centre: [N/m], [N m/rad], diagonal.

    The sum of two limits of a rigid flat punch of the same area, a = √(area/π), on a bonded layer of thickness t: one much wider than the
    layer (all strain confined: modulus M = E (1 − ν) / ((1 + ν)(1 − 2ν)), shear modulus G over the height t) and one much narrower
    (half-space; K. L. Johnson, *Contact Mechanics*, 1985, for normal, tangential and twisting displacement; a rocking punch).

    ======== ====================== ===============
    motion   narrow                 wide
    ======== ====================== ===============
    normal   2 a E / (1 − ν²)       M A / t
    tangent  8 a G / (2 − ν)        G A / t
    rocking  4/3 a³ E / (1 − ν²)    M π a⁴ / (4 t)
    twist    16/3 G a³              G π a⁴ / (2 t)
    ======== ====================== ===============
    """
    e, nu, t = gelpad.youngs_modulus, gelpad.poisson_ratio, gelpad.thickness
    shear, confined, plane = e / (2.0 * (1.0 + nu)), e * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu)), e / (1.0 - nu**2)
    a = float(np.sqrt(area / np.pi))
    normal = 2.0 * a * plane + confined * area / t
    tangent = _SHEAR_MARGIN * (8.0 * a * shear / (2.0 - nu) + shear * area / t)
    rocking = 4.0 / 3.0 * a**3 * plane + confined * np.pi * a**4 / (4.0 * t)
    twist = _SHEAR_MARGIN * (16.0 / 3.0 * shear * a**3 + shear * np.pi * a**4 / (2.0 * t))
    return np.diag([tangent, tangent, normal, rocking, rocking, twist])
