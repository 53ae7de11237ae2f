"""Forces and sinks of a frictionless press by routes that share nothing with the solver: closed forms and a small integral equation.

A rigid, axisymmetric tool on an elastic half-space or on a layer bonded to a rigid base, at small strain. Lengths [m], forces [N],
moduli [Pa]; E* = E/(1 − ν²).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Elastic:
    """Young's modulus [Pa] and Poisson's ratio [-]."""

    young: float
    poisson: float

    @property
    def plane_strain(self) -> float:
        """E* [Pa]."""
        return self.young / (1 - self.poisson**2)

    @property
    def shear(self) -> float:
        """G [Pa]."""
        return self.young / (2 * (1 + self.poisson))


def hertz_force(solid: Elastic, radius: float, depth: ArrayLike) -> Floats:
    """F = 4/3 E* √R δ^(3/2) of a paraboloid of that radius on a half-space (Johnson 1985, eq. 4.23)."""
    return 4 / 3 * solid.plane_strain * np.sqrt(radius) * np.asarray(depth, float) ** 1.5


def punch_force(solid: Elastic, radius: float, depth: ArrayLike) -> Floats:
    """F = 2 a E* δ of a flat, round punch on a half-space (Johnson 1985, eq. 3.36)."""
    return 2 * radius * solid.plane_strain * np.asarray(depth, float)


def boussinesq_displacement(solid: Elastic, force: float, points: Floats) -> Floats:
    """Displacement (n, 3) [m] of the half-space z ≤ 0 at ``points`` (n, 3) under a load on its surface at the origin, downwards.

    Johnson 1985, eq. 3.18. Far from a press of any shape it is what the half-space does, to O((a/ρ)²) of itself.
    """
    x, y, z = points.T
    depth, r2 = -z, x**2 + y**2
    rho = np.sqrt(r2 + depth**2)
    scale = force / (4 * np.pi * solid.shear)
    # u_r / r, so that nothing is divided by r on the axis
    radial = scale * (depth / rho**3 - (1 - 2 * solid.poisson) / (rho * (rho + depth)))
    down = scale * (depth**2 / rho**3 + 2 * (1 - solid.poisson) / rho)
    return np.stack([radial * x, radial * y, -down], axis=1)


def layer_compliance(poisson: float, s: ArrayLike) -> Floats:
    """L(s) of a bonded layer: under the pressure p cos(k x) its surface sinks by 2 L(k t) p cos(k x)/(E* k); 1 on a half-space.

    L = (2 κ sinh 2s − 4 s)/(2 κ cosh 2s + 1 + κ² + 4 s²), κ = 3 − 4ν: plane strain in the Fourier domain, no slip at the base (tested
    against a layer cut into slices).
    """
    s = np.asarray(s, float)
    kappa = 3 - 4 * poisson
    e = np.exp(-2 * s)  # numerator and denominator are both divided by exp(2s)
    return np.asarray((kappa * (1 - e**2) - 4 * s * e) / (kappa * (1 + e**2) + (1 + kappa**2 + 4 * s**2) * e), np.float64)


class BondedLayer:
    """Presses of a layer of ``thickness`` [m] on a rigid base it is bonded to, infinite to the sides.

    With the pressure's Hankel transform P(k) = (E*/2) ∫₀ᵃ φ(s) cos(ks) ds the contact condition becomes a Fredholm equation of the second
    kind with a smooth kernel (the route of Lebedev, Ufliand 1958),

        φ(s) + (2/π) ∫₀ᵃ φ(s') K(s, s') ds' = (2/π) g(s),    K = ∫₀^∞ (L(kt) − 1) cos(ks) cos(ks') dk,

    where g = δ for a flat end and δ − s²/R for a paraboloid, and F = π E* ∫₀ᵃ φ ds. Gauss-Legendre nodes solve it to rounding.
    """

    def __init__(self, solid: Elastic, thickness: float, nodes: int = 40) -> None:
        self.solid, self.thickness = solid, thickness
        self._unit, self._weight = np.polynomial.legendre.leggauss(nodes)
        u, w = np.polynomial.legendre.leggauss(10)
        self._wave = (np.arange(96)[:, None] + (u + 1) / 2).ravel() / 4  # k t from 0 to 24, where 1 − L is below 1e-15
        self._spectrum = np.tile(w / 8, 96) * (layer_compliance(solid.poisson, self._wave) - 1)

    def _solve(self, right: Floats, s: Floats, weights: Floats) -> Floats:
        cosines = np.cos(np.outer(s / self.thickness, self._wave))
        kernel = (cosines * self._spectrum) @ cosines.T / self.thickness
        return np.linalg.solve(np.eye(len(s)) + 2 / np.pi * kernel * weights, 2 / np.pi * right).astype(np.float64)

    def _nodes(self, radius: float) -> tuple[Floats, Floats]:
        return radius * (self._unit + 1) / 2, radius * self._weight / 2

    def punch_force(self, radius: float, depth: ArrayLike) -> Floats:
        """Force [N] of a flat, round punch."""
        s, w = self._nodes(radius)
        phi = self._solve(np.ones_like(s), s, w)
        return np.pi * self.solid.plane_strain * (w @ phi) * np.asarray(depth, float)

    def sphere(self, sphere_radius: float, contact_radius: float) -> tuple[float, float]:
        """Depth [m] and force [N] at which a paraboloid of that radius touches over ``contact_radius``: where φ(a) = 0."""
        s, w = self._nodes(contact_radius)
        s, w = np.append(s, contact_radius), np.append(w, 0.0)  # the rim is a node of no weight
        flat = self._solve(np.ones_like(s), s, w)
        bowl = self._solve(s**2 / sphere_radius, s, w)
        depth = bowl[-1] / flat[-1]
        return float(depth), float(np.pi * self.solid.plane_strain * (w @ (depth * flat - bowl)))

    def cone(self, slope: float, contact_radius: float) -> tuple[float, float]:
        """Depth [m] and force [N] at which a cone of that slope against the surface touches over ``contact_radius``: φ(a) = 0 again, with
        g = δ − slope π s/2."""
        s, w = self._nodes(contact_radius)
        s, w = np.append(s, contact_radius), np.append(w, 0.0)
        flat, tip = self._solve(np.ones_like(s), s, w), self._solve(0.5 * np.pi * slope * s, s, w)
        depth = tip[-1] / flat[-1]
        return float(depth), float(np.pi * self.solid.plane_strain * (w @ (depth * flat - tip)))

    def sphere_force(self, sphere_radius: float, depth: float) -> float:
        """Force [N] of a paraboloid at ``depth`` [m]."""
        contact = np.sqrt(sphere_radius * depth)
        for _ in range(60):
            reached, force = self.sphere(sphere_radius, contact)
            if abs(reached - depth) < 1e-12 * depth:
                return force
            contact *= np.sqrt(depth / reached)  # depth grows about as a², on a half-space and on a thin layer
        raise ArithmeticError(f"no contact radius found for a depth of {depth} m")

    def twist_stiffness(self, radius: float) -> float:
        """Torque per angle [N m/rad] of a disc that sticks to the layer and turns about its axis.

        The shear stress τ has the transform ∫ r τ J₁(kr) dr = ∫₀ᵃ φ(s) sin(ks) ds, which moves the surface by tanh(kt)/(G k). So

            φ(s) + (2/π) ∫₀ᵃ φ(s') K(s, s') ds' = (4/π) G θ s,    K = ∫₀^∞ (tanh(kt) − 1) sin(ks) sin(ks') dk,

        and the torque is 4π ∫₀ᵃ φ s ds: 16/3 G a³ θ on a half-space (Reissner and Sagoci 1944).
        """
        s, w = self._nodes(radius)
        sines = np.sin(np.outer(s / self.thickness, self._wave))
        u, weights = np.polynomial.legendre.leggauss(10)
        spectrum = np.tile(weights / 8, len(self._wave) // len(u)) * (np.tanh(self._wave) - 1)
        kernel = (sines * spectrum) @ sines.T / self.thickness
        phi = np.linalg.solve(np.eye(len(s)) + 2 / np.pi * kernel * w, 4 / np.pi * self.solid.shear * s)
        return float(4 * np.pi * (w * s) @ phi)
