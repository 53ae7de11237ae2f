"""Direct light of one LED at the coat: quadrature over its rectangle, without cast shadows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from raytac.optics.geometry import PixelSample
from raytac.optics.refraction import Slab
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.quadrature import EdgePoints, gauss
from raytac.specs.sensor import CoatSpec


@dataclass(frozen=True)
class Arrival:
    """Light of one point of an LED at points of the coat; all Dr.Jit arrays."""

    w: Any
    """Unit direction from where it comes."""
    gain: Any
    """cosⁿ θ_led cos θ / r² of it [1/m²], refracted if there is a slab; 0 behind either surface."""
    target: Any
    """End of its last straight stretch: the LED's point, or that of the slab's face."""
    up: Any
    """Unit direction at the LED across the ray, in the vertical plane."""
    turn: Any
    """Tangent of elevation at the coat over extent along ``up`` [1/m]."""

    def tangent(self, lamp: Lamp, share: Any) -> Any:
        """Tangent of half the elevation that the shorter edge and ``share`` of the longer one span."""
        half = share * dr.abs(dr.dot(self.up, lamp.half_u)) + dr.abs(dr.dot(self.up, lamp.half_v))
        return dr.maximum(half * self.turn, 1e-4)


def arrival(mi: Any, seen: PixelSample, lamp: Lamp, light: Any, slab: Slab | None) -> Arrival:
    """Light of a point of ``lamp``, ``light`` [m], at ``seen``, through ``slab`` if any."""
    if slab is None:
        d = light - seen.p
        r2 = dr.squared_norm(d)
        w = d * dr.rsqrt(r2)
        out, target, spread = -w, light, 1 / r2
        turn = dr.sqrt(r2) / dr.maximum(dr.squared_norm(d.xy), 1e-12)
    else:
        link, turn = slab.connect(mi, seen.p, light)
        w, out, target, spread = link.w, link.out, link.via, link.gain
        turn = turn / dr.maximum(dr.squared_norm(w.xy), 1e-6)
    cosine, lobe = dr.dot(seen.n, w), lamp.lobe_gain(out)
    gain = dr.select((lobe > 0) & (cosine > 0), lobe * cosine * spread, 0)
    up = mi.Vector3f(-out.x * out.z, -out.y * out.z, 1 - out.z * out.z)
    return Arrival(w, gain, target, up * dr.rsqrt(dr.maximum(1 - out.z * out.z, 1e-12)), turn)


def direct_light(
    mi: Any,
    coat: CoatSpec,
    seen: PixelSample,
    lamp: Lamp,
    points: EdgePoints,
    specular: bool = True,
    slab: Slab | None = None,
) -> tuple[Any, Any]:
    """(diffuse, specular) transport of one LED to every pixel, by power and reflectance.

    ``points``: nodes of Gauss-Legendre rules, over the angle that the longer edge spans and over the shorter edge (``Lamp.sight``). One
    point is the LED's middle. Radiance is that at the coat, without cast shadows.
    """
    diffuse, mirror = mi.Float(0), mi.Float(0)
    is_line = slab is None and points.across == 1 and points.along > 1
    for w, gain in _of_line(seen, lamp, points.along) if is_line else _of_points(mi, seen, lamp, points, slab):
        diffuse += gain
        if specular and coat.specular > 0:
            mirror += gain * ggx(coat.roughness, seen.n, w, seen.wo)
    return diffuse, mirror


def _of_points(mi: Any, seen: PixelSample, lamp: Lamp, points: EdgePoints, slab: Slab | None) -> Iterator[tuple[Any, Any]]:
    """(direction, weighted gain) of all points of an LED."""
    for u, weight in _along(mi, lamp, seen, points.along):
        for place, share in gauss(points.across):
            light = arrival(mi, seen, lamp, lamp.point(u, 2 * place - 1), slab)
            yield light.w, light.gain * weight * share


def _of_line(seen: PixelSample, lamp: Lamp, points: int) -> Iterator[tuple[Any, Any]]:
    """The same of points on the middle line, without a slab: by angles alone."""
    fan = lamp.fan(seen.p)
    facing, emitted = ([dr.dot(v, to) for to in (fan.middle, fan.beside)] for v in (seen.n, -lamp.axis))
    for place, weight in gauss(points):
        sine, cosine = dr.sincos(abs(place - 0.5) * fan.span) if place != 0.5 else (0, 1)
        sine = sine if place > 0.5 else -sine
        cos_p, cos_led = (cosine * m + sine * b for m, b in (facing, emitted))
        lobe = lamp.lobe_at(cos_led)
        gain = dr.select((lobe > 0) & (cos_p > 0), lobe * cos_p * (weight * fan.span * fan.density), 0)
        yield cosine * fan.middle + sine * fan.beside, gain


def _along(mi: Any, lamp: Lamp, seen: PixelSample, points: int) -> Sequence[tuple[Any, Any]]:
    """Places in [−1, 1] on the longer edge, and their weights."""
    if points == 1:
        return [(0.0, 1.0)]
    sight = lamp.sight(mi, seen.p)
    return [(u, weight * density) for place, weight in gauss(points) for u, density in (sight.at(place),)]


def ggx(alpha: float, n: Any, wi: Any, wo: Any) -> Any:
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
