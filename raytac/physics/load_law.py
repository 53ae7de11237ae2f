"""Force against depth for any indenter on the bonded gel layer: the law that MuJoCo's contact is made to follow."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.specs.sensor import GelpadSpec

__all__ = ["LoadLaw", "layer_stiffening", "reduced_modulus"]

_TABLE = 512
_DEPTHS = np.linspace(0.0, 1.0, _TABLE) ** 2
"""Depths of the table over the pad's thickness."""


def reduced_modulus(gelpad: GelpadSpec) -> float:
    """E* = E / (1 − ν²) [Pa] of the gel under a rigid indenter."""
    return gelpad.youngs_modulus / (1.0 - gelpad.poisson_ratio**2)


def layer_stiffening(radius: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """How many times stiffer the bonded layer is than a half-space under a contact of ``radius`` [m].

    From the sphere on a bonded layer, F = F_Hertz Σ c_n χⁿ with χ = √(Rδ) / h (Dimitriadis et al., Biophysical Journal 82, 2002,
    2798): c₁ = −2α/π, c₂ = 4α²/π², c₃ = −(8/π³)(α³ + 4π²β/15), c₄ = (16α/π⁴)(α³ + 3π²β/5), α and β as below. Its incremental
    stiffness is 2E*a Σ (1 + n/3) c_n (a/h)ⁿ at a = √(Rδ), and that sum is returned. The series holds for contacts up to about the
    layer's thickness; beyond, it is held below the stiffness of a layer squeezed without lateral motion, 1 + (π/2)(M/E*)(a/h)
    with M = E(1 − ν)/((1 + ν)(1 − 2ν)).
    """
    nu, ratio = gelpad.poisson_ratio, np.asarray(radius, float) / gelpad.thickness
    α = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1.0 - nu)
    β = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1.0 - nu)
    series = (
        1.0,
        -2.0 * α / np.pi,
        4.0 * α**2 / np.pi**2,
        -8.0 / np.pi**3 * (α**3 + 4.0 * np.pi**2 / 15.0 * β),
        16.0 * α / np.pi**4 * (α**3 + 3.0 * np.pi**2 / 5.0 * β),
    )
    stiffening = np.zeros_like(ratio)
    for n in range(len(series) - 1, -1, -1):  # Horner's scheme: powers are dear
        stiffening = stiffening * ratio + series[n] * (1.0 + n / 3.0)
    confined = gelpad.youngs_modulus * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    return np.minimum(stiffening, 1.0 + 0.5 * np.pi * confined / reduced_modulus(gelpad) * ratio)


class LoadLaw:
    """Normal force, contact radius and tangential stiffness against depth, from the gap between object and resting gel.

    The incremental stiffness of a contact of area A is dF/dδ = 2 E* √(A/π), exact for every axisymmetric indenter on a half-space
    (Pharr, Oliver & Brotzen, J. Mater. Res. 7, 1992, 613) and within a few percent for other compact ones; here it is multiplied
    by ``layer_stiffening``. The area at depth δ is taken as that where the gap is below δ/2. This is exact for a paraboloid
    (πRδ, so Hertz's law on a half-space) and for a flat punch; a cone comes out with π/4 of Sneddon's force. Separate contacts
    count as one of the same area. F is strictly increasing in δ and 0 at δ <= 0.
    """

    def __init__(self, gap: np.ndarray, cell_area: float, gelpad: GelpadSpec, deepest: float = np.inf) -> None:
        """``gap`` [m]: distance along z from the resting gel to the object at first touch, any shape, >= 0, ``inf`` where there
        is none; ``cell_area`` [m²] of one node; ``deepest`` [m]: where there is gel for, at most the pad's thickness."""
        self._gelpad = gelpad
        self.deepest = min(deepest, gelpad.thickness)
        """Greatest depth that a press may have [m]."""
        self.depth = gelpad.thickness * _DEPTHS
        """Depths of the table [m], 0 to the pad's thickness, denser at the start."""
        near = np.sort(gap[gap < 0.5 * gelpad.thickness], axis=None)
        # Count half a node where the gap reaches the limit, so that the area grows continuously from 0 instead of in steps.
        counts = np.interp(0.5 * self.depth, near, np.arange(len(near)) + 0.5) if len(near) else np.zeros(_TABLE)
        self.radius = np.sqrt(np.maximum(counts, 0.5) * cell_area / np.pi)
        """Contact radius of the table [m]: that of a disc of the contact's area."""
        stiffness = 2.0 * reduced_modulus(gelpad) * self.radius * layer_stiffening(self.radius, gelpad)
        steps = 0.5 * (stiffness[1:] + stiffness[:-1]) * np.diff(self.depth)
        self.table = np.concatenate([[0.0], np.cumsum(steps)])
        """Normal force of the table [N]."""

    @property
    def greatest(self) -> float:
        """Force at the greatest depth [N]."""
        return self.force(self.deepest)

    def force(self, depth: float) -> float:
        """Normal force [N] at ``depth`` [m]; 0 out of contact."""
        return float(np.interp(depth, self.depth, self.table))

    def depth_at(self, force: float) -> float:
        """Depth [m] at which the law reaches ``force`` [N]; raises ``InputError`` if that is deeper than ``deepest``."""
        if force > self.greatest:
            rule = f"would press deeper than the pad is there: at most {self.greatest:.4g} N, {self.deepest * 1e3:.4g} mm deep"
            raise InputError("force", value=force, rule=rule)
        return float(np.interp(force, self.table, self.depth))

    @property
    def thickness(self) -> float:
        return self._gelpad.thickness

    def secant_stiffness(self, depth: float) -> float:
        """F / δ [N/m]; at δ <= 0 that of the first entry of the table."""
        if depth <= self.depth[1]:
            return float(self.table[1] / self.depth[1])
        return self.force(depth) / depth

    def contact_radius(self, depth: float) -> float:
        """Radius [m] of the disc of the contact's area at ``depth`` [m]; 0 out of contact."""
        return float(np.interp(depth, self.depth, self.radius)) if depth > 0.0 else 0.0

    def shear_stiffness(self, depth: float) -> float:
        """Tangential force per displacement [N/m]: 8Ga/(2 − ν) of a half-space (Mindlin) plus GA/h of a sheared layer."""
        a, shear = self.contact_radius(depth), self._shear_modulus
        return 8.0 * shear * a / (2.0 - self._gelpad.poisson_ratio) + shear * np.pi * a**2 / self.thickness

    def twist_stiffness(self, depth: float) -> float:
        """Torque per angle [N m/rad]: 16Ga³/3 of a half-space (Reissner and Sagoci) plus GJ/h of a twisted layer."""
        a, shear = self.contact_radius(depth), self._shear_modulus
        return 16.0 / 3.0 * shear * a**3 + shear * 0.5 * np.pi * a**4 / self.thickness

    @property
    def _shear_modulus(self) -> float:
        return 0.5 * self._gelpad.youngs_modulus / (1.0 + self._gelpad.poisson_ratio)
