"""Compliance of a gel layer bonded at its back, wave by wave, in closed form."""

from __future__ import annotations

import numpy as np

from raytac.specs.sensor import GelpadSpec

_DEEP = 20.0
"""Wave number times thickness above which a layer is a half-space to rounding."""
_LONG = 1e-3
"""The same below which it is compressed uniformly."""


def layer_compliance(wave_number: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Normal displacement over pressure [m/Pa] at each ``wave_number`` [rad/m], same shape.

    With α = k h and K = 3 − 4ν it is 2 (1 − ν²)/(E k) · (K sinh 2α − 2α) / (K cosh 2α + 2α² + 5 − 12ν + 8ν²), small strain and
    no friction (K. L. Johnson, Contact Mechanics, 1985, section 5.8 has the layer; tests compare it with finite elements). For short
    waves that is the half-space's 2 (1 − ν²)/(E k). For k → 0 it is h (1 + ν)(1 − 2ν)/(E (1 − ν)), uniaxial compression.
    """
    young, nu = gelpad.youngs_modulus, gelpad.poisson_ratio
    inverse_k, α, _, _ = _layer(wave_number, gelpad)
    return 2.0 * (1.0 - nu**2) / young * relative_compliance(α, nu) * inverse_k


def relative_compliance(ratio: np.ndarray, nu: float) -> np.ndarray:
    """``layer_compliance`` over a half-space's, at each wave number times thickness up to 20."""
    κ = 3.0 - 4.0 * nu
    return (κ * np.sinh(2.0 * ratio) - 2.0 * ratio) / _determinant(ratio, nu)


def layer_spread(wave_number: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Sideways displacement over pressure [m/Pa]: under p cos kx it is this times p sin kx.

    2 (1 + ν)/(E k) · (α² − (1 − 2ν)(3 − 4ν) sinh² α) / (K cosh 2α + 2α² + 5 − 12ν + 8ν²), from the same solution of the layer's plane
    strain as ``layer_compliance``. Long waves squeeze gel out from under the load (> 0). Short ones draw the face towards it:
    −(1 + ν)(1 − 2ν)/(E k), the half-space's.
    """
    young, nu = gelpad.youngs_modulus, gelpad.poisson_ratio
    inverse_k, α, κ, determinant = _layer(wave_number, gelpad)
    return 2.0 * (1.0 + nu) / young * (α**2 - (1.0 - 2.0 * nu) * κ * np.sinh(α) ** 2) / determinant * inverse_k


def layer_shear(wave_number: np.ndarray, gelpad: GelpadSpec) -> tuple[np.ndarray, np.ndarray]:
    """Sideways displacement over traction [m/Pa] along the wave vector, and across it.

    Along: 2 (1 − ν²)/(E k) · (K sinh 2α + 2α) / (K cosh 2α + 2α² + 5 − 12ν + 8ν²), from the same plane strain as
    ``layer_compliance``. Across, where gel is only sheared: 2 (1 + ν)/(E k) · tanh α. Both tend to h/G for long waves.
    """
    young, nu = gelpad.youngs_modulus, gelpad.poisson_ratio
    inverse_k, α, κ, determinant = _layer(wave_number, gelpad)
    along = 2.0 * (1.0 - nu**2) / young * (κ * np.sinh(2.0 * α) + 2.0 * α) / determinant * inverse_k
    return along, 2.0 * (1.0 + nu) / young * np.tanh(α) * inverse_k


def _layer(wave_number: np.ndarray, gelpad: GelpadSpec) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """1/k, α = k h within bounds, K, and the denominator of all three laws."""
    nu, thickness = gelpad.poisson_ratio, gelpad.thickness
    wave_number = np.maximum(np.asarray(wave_number, float), _LONG / thickness)
    α = np.minimum(wave_number * thickness, _DEEP)
    return 1.0 / wave_number, α, 3.0 - 4.0 * nu, _determinant(α, nu)


def _determinant(α: np.ndarray, nu: float) -> np.ndarray:
    return (3.0 - 4.0 * nu) * np.cosh(2.0 * α) + 2.0 * α**2 + 5.0 - 12.0 * nu + 8.0 * nu**2
