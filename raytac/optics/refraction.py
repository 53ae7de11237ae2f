"""Refraction at the flat face between air and gel: bending, loss, and spread of a beam.

Gel and support plate are one medium of index n above the plane z = z_i, air lies below. A ray at the angle θ₁ to the normal in air
and θ₂ in the gel obeys sin θ₁ = n sin θ₂ (Snell), so with slopes t = tan θ:

    t₂ = t₁ / √(n² + (n² − 1) t₁²)

Light that crosses keeps its plane of incidence, so joining a point in the gel to one in air is one equation in one unknown. Radiance
divided by the square of the index is kept but for the loss 1 − T: a camera in air sees T / n² of the radiance in the gel (Walter et al.
2007, section 5.1; Pharr, Jakob and Humphreys, Physically Based Rendering, 4th ed., section 9.5.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_check import check_slab

STEPS = 5
"""Newton steps of ``Slab.meet``: enough for float32 at any angle (by a test)."""


@dataclass(frozen=True)
class Link:
    """The path of light from y to x, possibly over the interface; all Dr.Jit arrays."""

    w: Any
    """Unit direction at x from where the light comes."""
    out: Any
    """Unit direction in which the light leaves y."""
    gain: Any
    """Irradiance at x perpendicular to w for unit intensity at y [1/m² or 1/unit²], with loss."""
    via: Any
    """Point of the interface that the light crosses or is mirrored at."""
    bent: Any
    """True if the path has two legs, x to ``via`` and ``via`` to y; else it is straight."""


@dataclass(frozen=True)
class Slab:
    """Gel and plate of index ``ior`` above height ``z`` (the points' unit), air (1) below."""

    z: float
    ior: float

    @classmethod
    def from_spec(cls, sensor: SensorSpec, unit: float = 1.0) -> Slab | None:
        """The slab, ``unit`` units a metre, or None; SpecError unless camera and LEDs lie below."""
        if sensor.refraction.model == "none":
            return None
        check_slab(sensor)
        return cls(-unit * (sensor.gelpad.thickness + sensor.refraction.plate_thickness), sensor.refraction.ior)

    def inside(self, p: Any) -> Any:
        """True if point ``p`` is in the gel or plate."""
        return p.z > self.z

    def bend(self, tx: Any, ty: Any) -> tuple[Any, Any]:
        """Slopes (dx/dz, dy/dz) in the gel of a ray of these slopes in air; NumPy or Dr.Jit."""
        scale = 1 / _sqrt(self.ior**2 + (self.ior**2 - 1) * (tx * tx + ty * ty))
        return tx * scale, ty * scale

    def transmittance(self, mi: Any, cos_air: Any) -> Any:
        """Fresnel transmittance T, unpolarised, for this cosine (> 0) in air; equal both ways."""
        return 1 - mi.fresnel(cos_air, self.ior)[0]

    def refract(self, mi: Any, d: Any) -> tuple[Any, Any]:
        """(direction behind the plane, Fresnel reflectance) of unit ``d``; 1 for total reflection."""
        # The outer normal is −z, so a positive cosine of the incident side means air.
        reflectance, cos_t, _, eta_ti = mi.fresnel(d.z, self.ior)
        return dr.normalize(mi.Vector3f(d.x * eta_ti, d.y * eta_ti, -cos_t)), reflectance

    def meet(self, rho: Any, h1: Any, h2: Any) -> Any:
        """t = tan θ₁ of the ray that goes ``rho`` across over heights ``h1`` in air, ``h2`` in gel.

        Root of f(t) = h₁ t + h₂ t / √(n² + (n² − 1) t²) − ρ. f increases and is concave, so Newton's iteration climbs to the root
        without overshooting from any start left of it; both bounds of f from above, h₂ t / n and h₂ / √(n² − 1) for the second term,
        give such a start. NumPy or Dr.Jit.
        """
        n2 = self.ior**2
        t = rho / (h1 + h2 / self.ior)
        if self.ior > 1:
            t = _maximum(t, (rho - h2 / np.sqrt(n2 - 1)) / h1)
        for _ in range(STEPS):
            s2 = n2 + (n2 - 1) * t * t
            s = _sqrt(s2)
            t = t - (h1 * t + h2 * t / s - rho) / (h1 + h2 * n2 / (s2 * s))
        return t

    def spread(self, t: Any, h1: Any, h2: Any) -> tuple[Any, Any, Any, Any]:
        """(cos θ₁, cos θ₂, dρ/dθ₁, dΩ_air / dA⊥) of the ray of slope ``t`` in air.

        A tube of rays from a point in air is dΩ = sin θ₁ dθ₁ dφ wide there; at the point in the gel it covers the horizontal area
        ρ dρ dφ, of which the ray sees cos θ₂. With ρ = h₁ tan θ₁ + h₂ tan θ₂:

            dΩ / dA⊥ = 1 / [(h₁ / cos θ₁ + h₂ / (n cos θ₂)) · cos θ₂ · dρ/dθ₁],
            dρ/dθ₁ = h₁ / cos² θ₁ + h₂ cos θ₁ / (n cos³ θ₂).

        For n = 1 it is 1 / r².
        """
        n = self.ior
        cos1 = 1 / _sqrt(1 + t * t)
        cos2 = _sqrt(n * n + (n * n - 1) * t * t) * cos1 / n
        slide = h1 / (cos1 * cos1) + h2 * cos1 / (n * cos2 * cos2 * cos2)
        return cos1, cos2, slide, 1 / ((h1 / cos1 + h2 / (n * cos2)) * cos2 * slide)

    def connect(self, mi: Any, p: Any, light: Any) -> tuple[Link, Any]:
        """The refracted path from ``light`` in air to ``p`` in the gel, and dθ₂/ds at p.

        ds moves the light perpendicular to its ray in the plane of incidence; dρ = ds / cos θ₁ and dθ₂ = cos θ₁ / (n cos θ₂) dθ₁.
        """
        d = light - p
        rho = dr.sqrt(dr.maximum(d.x * d.x + d.y * d.y, 1e-24))
        ux, uy = d.x / rho, d.y / rho
        h1, h2 = self.z - light.z, p.z - self.z
        t = self.meet(rho, h1, h2)
        cos1, cos2, slide, gain = self.spread(t, h1, h2)
        sin1, sin2 = t * cos1, t * cos1 / self.ior
        w = mi.Vector3f(ux * sin2, uy * sin2, -cos2)
        out = mi.Vector3f(-ux * sin1, -uy * sin1, cos1)
        reach = sin2 / cos2 * h2
        via = mi.Point3f(p.x + ux * reach, p.y + uy * reach, self.z)
        link = Link(w, out, gain * self.transmittance(mi, cos1), via, mi.Bool(True))
        return link, 1 / (self.ior * cos2 * slide)

    def link(self, mi: Any, x: Any, y: Any) -> Link:
        """Light from ``y`` to ``x``: straight within one medium, refracted between the two.

        From gel to air the spread follows from étendue, dA₁ dΩ₁ = n² dA₂ dΩ₂: it is that of the other way over n².
        """
        d = y - x
        r2 = dr.maximum(dr.squared_norm(d), 1e-12)
        straight = d * dr.rsqrt(r2)
        inside = self.inside(x)
        bent = inside != self.inside(y)
        # Lanes whose points lie in one medium get a harmless pair, so that no NaN arises in them.
        deep = dr.select(bent, dr.select(inside, x, y), mi.Point3f(0, 0, self.z + 1))
        shallow = dr.select(bent, dr.select(inside, y, x), mi.Point3f(0, 0, self.z - 1))
        over, _ = self.connect(mi, deep, shallow)
        return Link(
            w=dr.select(bent, dr.select(inside, over.w, over.out), straight),
            out=dr.select(bent, dr.select(inside, over.out, over.w), -straight),
            gain=dr.select(bent, over.gain * dr.select(inside, 1, 1 / self.ior**2), 1 / r2),
            via=over.via,
            bent=bent,
        )

    def mirror(self, mi: Any, x: Any, y: Any) -> Link:
        """Light from ``y`` to ``x`` in air by the plane's mirror, times Fresnel's reflectance."""
        d = mi.Point3f(y.x, y.y, 2 * self.z - y.z) - x
        r2 = dr.maximum(dr.squared_norm(d), 1e-12)
        w = d * dr.rsqrt(r2)
        via = x + w * ((self.z - x.z) / dr.maximum(w.z, 1e-9))
        loss = mi.fresnel(dr.maximum(w.z, 1e-9), self.ior)[0]
        return Link(w, mi.Vector3f(-w.x, -w.y, w.z), loss / r2, via, mi.Bool(True))


def _sqrt(x: Any) -> Any:
    return dr.sqrt(x) if dr.is_array_v(x) else np.sqrt(x)


def _maximum(x: Any, y: Any) -> Any:
    return dr.maximum(x, y) if dr.is_array_v(x) or dr.is_array_v(y) else np.maximum(x, y)
