"""The ``fast`` integrator: direct light by quadrature over every LED; nothing is random.

For each pixel one camera ray meets the coat, and for each LED the rendering equation's direct term is summed over a small grid of
points on its rectangle (Kajiya 1986, eq. 1 restricted to one bounce; area form of Shirley, Wang and Zimmerman 1996):

    L_o(p) = Σ_led Σ_k w_k · f(p, ω_k, ω_o) · V_k · I(θ_k) · cos θ_p / r_k²

with the LED's intensity I(θ) = power · cosⁿ θ, the coat's reflectance f and visibility V. Everything runs in Dr.Jit, batched over
environments: one thread a pixel, one code for LLVM and CUDA.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from raytac.optics.geometry import CoatField, PixelSample
from raytac.optics.refraction import Slab
from raytac.optics.trace.led import Lamp
from raytac.specs.sensor import CoatSpec


def direct_light(
    mi: Any,
    field: CoatField,
    coat: CoatSpec,
    seen: PixelSample,
    lamp: Lamp,
    points: int,
    shadows: bool,
    specular: bool = True,
    slab: Slab | None = None,
) -> tuple[Any, Any]:
    """(diffuse, specular) transport of one LED to every pixel, by power and reflectance.

    ``points`` × ``points`` quadrature nodes (midpoint rule) over the LED's rectangle, one shadow ray each; through the face of
    ``slab`` if there is one. Radiance is that at the coat.
    """
    diffuse, mirror = mi.Float(0), mi.Float(0)
    for a in range(points):
        for b in range(points):
            light = lamp.sample(mi.Point2f((a + 0.5) / points, (b + 0.5) / points))
            # An LED's extent e across the ray, seen from p, is the tangent e · turn / flat of elevation.
            if slab is None:
                d = light - seen.p
                r2 = dr.squared_norm(d)
                w = d * dr.rsqrt(r2)
                out, target, spread = -w, light, r2
                turn, flat = dr.sqrt(r2), dr.maximum(dr.squared_norm(d.xy), 1e-12)
            else:
                link, turn = slab.connect(mi, seen.p, light)
                w, out, target, spread = link.w, link.out, link.via, 1 / link.gain
                flat = dr.maximum(dr.squared_norm(w.xy), 1e-6)
            cos_p = dr.dot(seen.n, w)
            lobe = lamp.lobe_gain(out)
            lit = (lobe > 0) & (cos_p > 0)
            gain = dr.select(lit, lobe * cos_p / spread, 0) / points**2
            if shadows:
                up = mi.Vector3f(-out.x * out.z, -out.y * out.z, 1 - out.z * out.z) * dr.rsqrt(
                    dr.maximum(1 - out.z * out.z, 1e-12)
                )
                tan_half = dr.maximum(lamp.extent(up) / points * turn / flat, 1e-4)
                gain *= field.visibility(seen.env, seen.p, target, tan_half, lit)
            diffuse += gain
            if specular and coat.specular > 0:
                mirror += gain * ggx(mi, coat.roughness, seen.n, w, seen.wo)
    return diffuse, mirror


def ggx(mi: Any, alpha: float, n: Any, wi: Any, wo: Any) -> Any:
    """GGX reflectance D G / (4 cos θ_i cos θ_o) of a mirror (Walter et al. 2007, eq. 20, 33)."""
    h = dr.normalize(wi + wo)
    ci, co, ch = dr.dot(n, wi), dr.dot(n, wo), dr.dot(n, h)
    a2 = alpha * alpha
    t = ch * ch * (a2 - 1) + 1
    d = a2 / (dr.pi * t * t)

    def g1(c: Any) -> Any:
        return 2 / (1 + dr.sqrt(1 + a2 * (1 / (c * c) - 1)))

    ok = (ci > 1e-4) & (co > 1e-4)
    return dr.select(ok, d * g1(ci) * g1(co) / (4 * dr.maximum(ci, 1e-4) * dr.maximum(co, 1e-4)), 0)
