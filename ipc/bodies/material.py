"""Elastic materials: a user's moduli, and the coefficients of the stored energies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ipc.errors import IpcError

MODEL_CODES = {"stable": 0, "stable_log": 1, "orthogonal": 2}
"""The stored energies that the element kernels know (see ``ipc.solver.elasticity``)."""


@dataclass(frozen=True)
class Material:
    """A soft solid: stable neo-Hookean with the small-strain moduli that are asked for.

    Attributes:
        young: Young's modulus E [Pa], at small strain.
        poisson: Poisson's ratio ν [-], in [0, 0.5). Linear tetrahedra lock as ν nears 0.5, unless a body has ``volume_blocks``.
        density: mass density ρ [kg/m³].
        model: ``"stable"``: Ψ = μ/2 (I_C − 3) − μ (J − 1) + λ/2 (J − 1)²; ``"stable_log"``: the form of Smith et al. 2018, eq. 14,
            Ψ = μ/2 (I_C − 3) + λ/2 (J − a)² − μ/2 ln(I_C + 1), a = 1 + 3μ/(4λ), for which F = 0 is no stable point. Both have a barrier
            against inversion below J = 0.2 (see ``ipc.solver.elasticity``).
        mass_damping: α [1/s]; adds the force −α M v. Zero leaves only the damping of the time integrator.
    """

    young: float
    poisson: float = 0.45
    density: float = 1000.0
    model: Literal["stable", "stable_log"] = "stable"
    mass_damping: float = 0.0

    def __post_init__(self) -> None:
        if not self.young > 0:
            raise IpcError(f"young = {self.young} Pa: Young's modulus must be positive")
        if not 0 <= self.poisson < 0.5:
            raise IpcError(f"poisson = {self.poisson}: Poisson's ratio must lie in [0, 0.5)")
        if not self.density > 0:
            raise IpcError(f"density = {self.density} kg/m³: the density must be positive")
        if self.model not in ("stable", "stable_log"):
            raise IpcError(f"model = {self.model!r}: choose 'stable' or 'stable_log'")
        if not self.mass_damping >= 0:
            raise IpcError(f"mass_damping = {self.mass_damping} 1/s: damping cannot be negative")

    def lame(self) -> tuple[float, float]:
        """Lamé's μ_L and λ_L [Pa] of linear elasticity."""
        return self.young / (2 * (1 + self.poisson)), self.young * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    def coefficients(self) -> tuple[float, float]:
        """μ and λ [Pa] of the stored energy with the Lamé constants of :meth:`lame` at rest.

        ``stable``: μ = μ_L, λ = λ_L + μ_L. ``stable_log``: μ = 4/3 μ_L, λ = λ_L + 5/6 μ_L (Smith, de Goes, Kim 2018,
        "Stable Neo-Hookean Flesh Simulation", section 3.4).
        """
        mu, lam = self.lame()
        return (mu, lam + mu) if self.model == "stable" else (4 * mu / 3, lam + 5 * mu / 6)


@dataclass(frozen=True)
class Stiff:
    """The material of an affine body: Ψ = κ ‖F Fᵀ − 1‖² (Lan et al. 2022, eq. 6).

    Attributes:
        stiffness: κ [Pa]; for small strain it acts like a shear modulus of 4κ.
        density: mass density ρ [kg/m³].
    """

    stiffness: float = 1e8
    density: float = 1000.0

    def __post_init__(self) -> None:
        if not self.stiffness > 0:
            raise IpcError(f"stiffness = {self.stiffness} Pa: the orthogonality stiffness must be positive")
        if not self.density > 0:
            raise IpcError(f"density = {self.density} kg/m³: the density must be positive")
