"""How the face of a gel layer gives way to pressure, wave by wave."""

from __future__ import annotations

import numpy as np

from raytac.specs.sensor import GelpadSpec

__all__ = ["CosineSeries", "layer_compliance"]

_DEEP = 20.0
"""Wave number times thickness beyond which a layer is a half-space to rounding."""
_LONG = 1e-3
"""And below which it is squeezed evenly."""


def layer_compliance(wave_number: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Depth over pressure [m/Pa] of a wave of that ``wave_number`` [rad/m] on a layer whose back is bonded, same shape.

    With α = k h and K = 3 − 4ν it is 2 (1 − ν²)/(E k) · (K sinh 2α − 2α) / (K cosh 2α + 2α² + 5 − 12ν + 8ν²), small strain and
    no friction (K. L. Johnson, Contact Mechanics, 1985, section 5.8 has the layer; checked here against finite elements). For short
    waves that is the half-space's 2 (1 − ν²)/(E k); for k → 0 it is h (1 + ν)(1 − 2ν)/(E (1 − ν)), a layer that cannot give way sideways.
    """
    young, nu, thickness = gelpad.youngs_modulus, gelpad.poisson_ratio, gelpad.thickness
    α = np.clip(np.asarray(wave_number, float) * thickness, _LONG, _DEEP)
    κ = 3.0 - 4.0 * nu
    part = (κ * np.sinh(2.0 * α) - 2.0 * α) / (κ * np.cosh(2.0 * α) + 2.0 * α**2 + 5.0 - 12.0 * nu + 8.0 * nu**2)
    reach = np.maximum(np.asarray(wave_number, float), _LONG / thickness)
    return 2.0 * (1.0 - nu**2) / young * part / reach


class CosineSeries:
    """Values at even nodes from edge to edge of the pad as a series of cosines, whose slope across the edges is 0."""

    def __init__(self, nodes: np.ndarray) -> None:
        """``nodes`` [m], shape (n,), evenly spaced from one edge to the other."""
        n = len(nodes)
        self._start, self._length = float(nodes[0]), float(nodes[-1] - nodes[0])
        self.wave_numbers = np.pi * np.arange(n) / self._length
        """[rad/m], shape (n,)."""
        half = np.ones(n)
        half[[0, -1]] = 0.5
        order = np.arange(n)
        self.analysis = 2.0 * half[:, None] * half * np.cos(np.pi * np.outer(order, order) / (n - 1)) / (n - 1)
        """What takes values at the nodes to the amplitudes, shape (n, n)."""
        self.hat = np.sinc(0.5 * order / (n - 1)) ** 2
        """Amplitudes of hat functions on the nodes over those of the cosines that pass through the same values, shape (n,)."""

    def synthesis(self, t: np.ndarray) -> np.ndarray:
        """What takes amplitudes to the values at ``t`` [m]: shape (P, n)."""
        return np.cos(np.outer(np.asarray(t) - self._start, self.wave_numbers))
