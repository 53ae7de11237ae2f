"""Response of a bonded gel layer to round frictionless indenters, by contact radius."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from raytac.physics.bonded_layer import relative_compliance
from raytac.specs.sensor import GelpadSpec

ENTRIES = 129
"""Radii of a table, evenly spaced in their roots: dense where the layer begins to be felt."""
_WIDEST = 1.1
"""Area of the widest contact over the pad's: nodes on the pad's edges count whole."""
_WAVES = 16.0
"""Wave number times thickness beyond which a layer is a half-space to 1e-10."""


class LayerResponse(NamedTuple):
    """Contacts of one layer, radius 0 to that of a disc as large as the pad, (ENTRIES,) each."""

    radius: np.ndarray
    """[m]."""
    stiffening: np.ndarray
    """Stiffness κ of the layer under a flat punch of that radius, over a half-space's 2 E* a."""
    share: np.ndarray
    """Gap at a ball contact's rim at first touch over the depth: a² / (2Rδ), half-space 1/2."""
    moment: np.ndarray
    """Mean of (r/a)² under the flat punch's pressure: 2/3 on a half-space, 1/2 if even."""
    bend: np.ndarray
    """Weight of P₂ = 6x² − 6x + 1, x = (r/a)², in that pressure over its mean.

    The pressure is 1 + (12 moment − 6)(x − 1/2) + bend P₂, so that the mean of r/a is right too."""

    def at(self, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """κ, moment and bend at radii [m], linear between the entries' roots, constant beyond."""
        root, roots = np.sqrt(radius), np.sqrt(self.radius)
        stiffening, moment, bend = (np.interp(root, roots, entries) for entries in (self.stiffening, self.moment, self.bend))
        return stiffening, moment, bend


def reduced_modulus(gelpad: GelpadSpec) -> float:
    """E* = E / (1 − ν²) [Pa] of the gel under a rigid indenter."""
    return gelpad.youngs_modulus / (1.0 - gelpad.poisson_ratio**2)


def layer_response(gelpad: GelpadSpec) -> LayerResponse:
    """Table of a gel by Lebedev and Ufliand's integral equation (J. Appl. Math. Mech. 22, 1958)."""
    widest = math.sqrt(_WIDEST * gelpad.size[0] * gelpad.size[1] / math.pi)
    ratio, *entries = _solve(gelpad.poisson_ratio, widest / gelpad.thickness)
    return LayerResponse(gelpad.thickness * ratio, *entries)


@functools.lru_cache(maxsize=64)
def _solve(nu: float, widest: float) -> tuple[np.ndarray, ...]:
    """Ratios a/h from 0 to ``widest``, κ, s, moment and bend.

    With lengths over the thickness, L the compliance of a wave relative to a half-space's, and g the depth less the gap, a round indenter
    gives

        φ(t) − (2/π) ∫₀ᵃ φ(t') K(t, t') dt' = G(t),   K = ∫₀^∞ (1 − L(k)) cos kt cos kt' dk,   F = 2 E* ∫₀ᵃ φ dt,

    with G = δ for a flat end, δ − t²/R for a ball, whose contact ends where φ(a) = 0, and δ − πt/2 · slope for a cone. Held on a disc of
    radius a, ball and cone take the force of the punch at the depth less the mean of their gaps: so the means of r² and r follow.
    Gauss-Legendre nodes solve it to 1e-8 for contacts of up to five thicknesses, and to 1e-3 for fifty of nearly incompressible gel.
    """
    ratio = widest * np.linspace(0.0, 1.0, ENTRIES) ** 2
    stiffening, share, moment, mean = (np.full(ENTRIES, value) for value in (1.0, 0.5, 2.0 / 3.0, np.pi / 4.0))
    for k, a in enumerate(ratio[1:], start=1):
        unit, weight = np.polynomial.legendre.leggauss(16 + math.ceil(2.5 * a))
        t, w = np.append(0.5 * a * (unit + 1.0), a), np.append(0.5 * a * weight, 0.0)  # the rim is a node of no weight
        wave, spectrum = _spectrum(nu, 4 * math.ceil(max(8.0, _WAVES * a / 2.5) / 4.0))
        cosines = np.cos(np.outer(t, wave))
        kernel = (cosines * spectrum) @ cosines.T
        right = np.stack([np.ones_like(t), t**2, 0.5 * np.pi * t], axis=1)
        flat, bowl, cone = np.linalg.solve(np.eye(len(t)) - 2.0 / np.pi * kernel * w, right).T
        stiffening[k] = w @ flat / a
        share[k] = 0.5 * a**2 * flat[-1] / bowl[-1]
        moment[k] = 2.0 * (w @ bowl) / (w @ flat) / a**2
        mean[k] = (w @ cone) / (w @ flat) / a
    bend = 105.0 / 2.0 * (4.0 / 15.0 + 0.8 * moment - mean)
    for values in (ratio, stiffening, share, moment, bend):
        values.setflags(write=False)
    return ratio, stiffening, share, moment, bend


@functools.lru_cache(maxsize=256)
def _spectrum(nu: float, panels: int) -> tuple[np.ndarray, np.ndarray]:
    """Wave numbers of a Gauss-Legendre rule, ten in each panel, and 1 − L times its weights."""
    unit, weight = np.polynomial.legendre.leggauss(10)
    wave = ((np.arange(panels)[:, None] + 0.5 * (unit + 1.0)) * _WAVES / panels).ravel()
    return wave, np.tile(0.5 * weight * _WAVES / panels, panels) * (1.0 - relative_compliance(wave, nu))
