"""The ``reference`` integrator: unbiased path tracing, one radiance layer per LED colour.

Paths start at the camera. At the coat point that it sees each LED is sampled once, uniformly over its rectangle (next-event estimation,
area form of the rendering equation, Kajiya 1986; Shirley, Wang and Zimmerman 1996). Light that comes over the case is found from the
LED instead: one ray leaves it by its lobe, and the point of the case that it meets is joined to the path (a light subpath of one edge, as
in bidirectional path tracing, Lafortune and Willems 1993). The two never count one light path twice: a vertex on the coat is lit
straight, a vertex on the case only by joining. The path goes on by sampling the reflectance of coat or case and ends by Russian roulette.

With refraction, gel and plate are a plane that rays cross in formulas (``advance``): each stretch is mirrored with the probability of
Fresnel's reflectance, else refracted, and both ways of lighting a vertex go through ``Slab.link``. A join does not know the plane's mirror
image, so a case vertex that the path reached over a mirroring is lit straight, and from the mirror image of the LED as well.

Against Mitsuba's own ``path``, which picks one LED at random and meets bright spots on near walls by chance, this takes most of the
noise away; both converge to one image (a test checks it).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.io.progress import Progress
from raytac.optics.camera import Pinhole
from raytac.optics.refraction import Link, Slab
from raytac.optics.trace.led import Lamp, LampTable
from raytac.optics.trace.scene import UNIT, SensorScene

OFFSET = 1e-3
"""Start of a ray off a surface [scene units]."""
GHOST = 0.1
"""Share of camera paths that go on with what the slab's face mirrors."""
LAUNCH = 1 << 22
"""Most paths in one kernel launch; keeps memory flat and the progress bar alive."""


@dataclass(frozen=True)
class ReferenceIntegrator:
    """Path tracer for one sensor scene and camera."""

    scene: SensorScene
    camera: Pinhole
    max_depth: int = -1
    """Most reflections by coat or case, not by the slab's face: 1 is direct light, −1 no limit."""
    progress: bool = False

    def render(self, lamps: list[Lamp], groups: list[int], spp: int, seed: int) -> np.ndarray:
        """Mean radiance (G, H, W, 3) of the scene; ``groups``: layer 0 … G−1 that each lamp lights.

        Samples are uniform in each pixel's square (box filter); ``spp`` samples a pixel, ``seed`` fixes them.
        """

        def radiance(sampler: Any, ray: Any) -> list[Any]:
            return trace(self.scene.mi, self.scene, sampler, ray, lamps, groups, self.max_depth)

        return accumulate(self.scene, self.camera, radiance, spp, seed, self.progress)


class StockPathIntegrator(ReferenceIntegrator):
    """Mitsuba's own ``path`` over the same scene: a check of ``reference``, and a peer in speed."""

    def render(self, lamps: list[Lamp], groups: list[int], spp: int, seed: int) -> np.ndarray:
        """As ``ReferenceIntegrator.render``; one run a layer, with the other layers' LEDs dark."""
        names = [led.name for led in self.scene.sensor.lights.leds]
        depth = -1 if self.max_depth < 0 else self.max_depth + 1  # Mitsuba counts the camera's edge too
        integrator = self.scene.mi.load_dict({"type": "path", "max_depth": depth})
        layers = []

        def radiance(sampler: Any, ray: Any) -> list[Any]:
            colour, valid, _ = integrator.sample(self.scene.scene, sampler, self.scene.mi.RayDifferential3f(ray))
            return [dr.select(valid, c, 0) for c in colour]

        for group in range(max(groups) + 1):
            self.scene.set_layers([name for name, g in zip(names, groups, strict=True) if g == group])
            layers.append(accumulate(self.scene, self.camera, radiance, spp, seed, self.progress)[0])
        return np.stack(layers)


def accumulate(
    scene: SensorScene, camera: Pinhole, radiance: Callable[[Any, Any], list[Any]], spp: int, seed: int, progress: bool
) -> np.ndarray:
    """Mean of ``radiance(sampler, ray)`` over ``spp`` rays a pixel; (G, H, W, 3), float32.

    Rays begin at the pinhole, or at the case's floor if that lies before it.
    """
    mi, (width, height) = scene.mi, camera.resolution
    behind = scene.sensor.case.floor_z - camera.position[2]
    start = UNIT * behind + OFFSET if behind > 0 else 0.0
    per_launch = max(1, min(spp, LAUNCH // (width * height)))
    template = mi.load_dict({"type": "independent"})
    total, done = np.zeros(()), 0
    with Progress(total=spp, unit="sample", desc="path tracing", show=progress, leave=False) as bar:
        while done < spp:
            count = min(per_launch, spp - done)
            n = width * height * count
            sampler = template.clone()
            sampler.seed((seed * 0x9E3779B1 + done * 0x85EBCA6B) & 0xFFFFFFFF, n)
            pixel = dr.arange(mi.UInt32, n) // count
            jitter = sampler.next_2d()
            tx, ty = camera.slope(mi.Float(pixel % width) + jitter.x, mi.Float(pixel // width) + jitter.y)
            d = mi.Vector3f(tx, ty, 1)
            ray = mi.Ray3f(mi.Point3f([UNIT * c for c in camera.position]) + start * d, dr.normalize(d))
            channels = radiance(sampler, ray)
            # All in one kernel: each sum would otherwise evaluate its own channel, and with it trace every path again.
            dr.eval(channels)
            sums = [dr.block_sum(c, count) for c in channels]
            dr.eval(sums)
            total = total + np.stack([np.array(c) for c in sums]).astype(np.float64)
            done += count
            bar.update(count)
    image = (total / spp).reshape(-1, 3, height, width)
    return np.ascontiguousarray(image.transpose(0, 2, 3, 1), dtype=np.float32)


def trace(
    mi: Any, scene: SensorScene, sampler: Any, ray: Any, lamps: list[Lamp], groups: list[int], max_depth: int, seen: bool = True
) -> list[Any]:
    """Radiance along ``ray``: a list of 3 · G Floats, R, G, B of each group in turn.

    ``seen=False`` treats the first vertex like a later one, for light that arrives at the ray's origin from the case or the coat; the
    case's own direct light is then for ``connect`` at the origin.
    """
    n = dr.width(ray.o)
    layers = max(groups) + 1
    table = LampTable.of(mi, lamps, groups)

    def add(radiance: list[Any], gain: Any, group: Any) -> list[Any]:
        return [r + dr.select(group == k // 3, gain[k % 3], 0) for k, r in enumerate(radiance)]

    def vertex(
        sampler: Any, si: Any, beta: Any, radiance: list[Any], deeper: Any, active: Any, mirrored: Any = None
    ) -> list[Any]:
        """Light at a vertex from a random LED: straight on the coat or if ``mirrored``; by the case."""
        lamp, group = table.pick(mi, sampler.next_1d(active))
        weight = beta * len(lamps)
        direct = scene.on_coat(si) if mirrored is None else scene.on_coat(si) | mirrored
        straight = lit_by(mi, scene, sampler, si, lamp, weight, active & direct)
        radiance = add(radiance, straight, group)
        if mirrored is not None and scene.slab is not None:
            image = lit_by(mi, scene, sampler, si, lamp, weight, active & mirrored & ~scene.slab.inside(si.p), mirror=True)
            radiance = add(radiance, image, group)
        lamp, group = table.pick(mi, sampler.next_1d(active))
        w, arriving = connect(mi, scene, sampler, si.p, si.n, lamp, active & deeper)
        return add(radiance, weight * scene.reflect(si, si.to_local(w)) * arriving, group)

    glow = [(k, lamp.glow) for lamp, k in zip(lamps, groups, strict=True) if lamp.glow is not None]

    def shine(si: Any, beta: Any, radiance: list[Any], active: Any) -> list[Any]:
        """The case's even glow where the path meets it."""
        if not glow:
            return radiance
        radiance, met = list(radiance), active & scene.on_case(si)
        for group, even in glow:
            for c in range(3):
                radiance[3 * group + c] = radiance[3 * group + c] + dr.select(met, beta[c] * even[c], 0)
        return radiance

    def scatter(sampler: Any, si: Any, beta: Any, active: Any) -> tuple[Any, Any, Any]:
        wo, weight = scene.sample_reflection(si, sampler.next_1d(active), sampler.next_2d(active))
        beta = beta * weight
        d = si.to_world(wo)
        survive = dr.minimum(dr.max(beta), 0.95)
        if scene.slab is not None:
            # In the gel a path of the camera carries 1 / n² without being worth less.
            survive = dr.minimum(dr.max(beta) * dr.select(scene.slab.inside(si.p), scene.slab.ior**2, 1), 0.95)
        active = active & (dr.dot(d, si.n) > 0) & (wo.z > 0) & (sampler.next_1d(active) < survive)
        return si.spawn_ray(d), beta / dr.select(active, survive, 1), active

    radiance = [dr.zeros(mi.Float, n) for _ in range(3 * layers)]
    beta, active, depth = dr.full(mi.Color3f, 1, n), dr.full(mi.Bool, True, n), 0
    if seen:
        # The camera's vertex is on the coat and carries most of the light: every LED lights it.
        first = ray
        if scene.slab is not None:
            first, inner, mirror = enter(mi, scene.slab, ray)
            beta = beta * inner
        si = scene.scene.ray_intersect(first)
        active = si.is_valid()
        for lamp, group in zip(lamps, groups, strict=True):
            radiance = add(radiance, lit_by(mi, scene, sampler, si, lamp, beta, active), mi.UInt32(group))
        if max_depth == 1 and scene.slab is None:
            return radiance
        if max_depth != 1:
            lamp, group = table.pick(mi, sampler.next_1d(active))
            w, arriving = connect(mi, scene, sampler, si.p, si.n, lamp, active)
            radiance = add(radiance, beta * scene.reflect(si, si.to_local(w)) * arriving * len(lamps), group)
        ray, beta, active = scatter(sampler, si, beta, active)
        if scene.slab is not None:
            # A few paths follow the image of case and LEDs in the slab's face instead.
            ghost = sampler.next_1d() < GHOST
            gray, share = mirror
            gsi = scene.scene.ray_intersect(gray, ghost)
            gactive, gbeta = ghost & gsi.is_valid(), mi.Color3f(share / GHOST)
            for k, (lamp, group) in enumerate(zip(lamps, groups, strict=True)):
                radiance = add(radiance, dr.select(gactive, gbeta * scene.led_radiance(gsi, k, lamp), 0), mi.UInt32(group))
            radiance = shine(gsi, gbeta, radiance, gactive)
            radiance = vertex(sampler, gsi, gbeta, radiance, mi.Bool(max_depth != 1), gactive, mi.Bool(True))
            if max_depth == 1:
                return radiance
            gray, gbeta, gactive = scatter(sampler, gsi, gbeta, gactive)
            ray = mi.Ray3f(dr.select(ghost, gray.o, ray.o), dr.select(ghost, gray.d, ray.d))
            beta, active = dr.select(ghost, gbeta, beta / (1 - GHOST)), dr.select(ghost, gactive, active)
        depth = 1

    def bounce(sampler: Any, ray: Any, beta: Any, radiance: list[Any], depth: Any, active: Any) -> tuple[Any, ...]:
        si, scale, mirrored = advance(mi, scene, sampler, ray, active)
        if scale is not None:
            beta = beta * scale
        active = active & si.is_valid()
        depth = depth + 1
        deeper = mi.Bool(True) if max_depth < 0 else depth < max_depth
        radiance = shine(si, beta, radiance, active)
        radiance = vertex(sampler, si, beta, radiance, deeper, active, mirrored)
        ray, beta, active = scatter(sampler, si, beta, active & deeper)
        return sampler, ray, beta, radiance, depth, active

    # The sampler is part of the state: its random numbers must differ from turn to turn.
    state = (sampler, ray, beta, radiance, dr.full(mi.UInt32, depth, n), active)
    return dr.while_loop(state, lambda *state: state[-1], bounce, label="path")[3]


def enter(mi: Any, slab: Slab, ray: Any) -> tuple[Any, Any, tuple[Any, Any]]:
    """Split a camera ray at the slab's face: (ray in gel, weight T / n², (mirrored ray, 1 − T))."""
    o = ray.o + ray.d * ((slab.z - ray.o.z) / ray.d.z)
    o.z = mi.Float(slab.z)
    d, loss = slab.refract(mi, ray.d)
    return mi.Ray3f(o, d), (1 - loss) / slab.ior**2, (mi.Ray3f(o, mi.Vector3f(ray.d.x, ray.d.y, -ray.d.z)), loss)


def advance(mi: Any, scene: SensorScene, sampler: Any, ray: Any, active: Any) -> tuple[Any, Any, Any]:
    """Follow ``ray`` to its next interaction, over the slab's face if that comes first.

    Returns the interaction, the factor on radiance, and a mask of the rays that the face mirrored. The last two are None without a
    slab. The factor is n² for a path that leaves the gel and 1 / n² for one that enters; light carried from an LED needs none. The
    face is flat, so that a stretch meets it once at most.
    """
    si = scene.scene.ray_intersect(ray, active)
    slab = scene.slab
    if slab is None:
        return si, None, None
    at = (slab.z - ray.o.z) / ray.d.z
    meets = active & (at > 0) & (at < dr.select(si.is_valid(), si.t, dr.inf))
    o = ray.o + ray.d * at
    o.z = mi.Float(slab.z)
    d, loss = slab.refract(mi, ray.d)
    mirrored = meets & (sampler.next_1d(active) < loss)
    d = dr.select(mirrored, mi.Vector3f(ray.d.x, ray.d.y, -ray.d.z), d)
    beyond = scene.scene.ray_intersect(mi.Ray3f(o, d), meets)
    eta2 = slab.ior**2
    factor = dr.select(meets & ~mirrored, dr.select(ray.d.z < 0, eta2, 1 / eta2), 1)
    return dr.select(meets, beyond, si), factor, mirrored


def hidden(mi: Any, scene: SensorScene, start: Any, end: Any, link: Link, active: Any) -> Any:
    """True if something blocks a leg of ``link`` between interaction ``start`` and ``end``."""
    active = mi.Bool(active)
    blocked = scene.scene.ray_test(start.spawn_ray_to(dr.select(link.bent, link.via, end)), active)
    leg = end - link.via
    length = dr.norm(leg)
    second = mi.Ray3f(link.via, leg / dr.maximum(length, 1e-9))
    second.maxt = length * (1 - 1e-4)
    return blocked | scene.scene.ray_test(second, active & link.bent & ~blocked)


def lit_by(mi: Any, scene: SensorScene, sampler: Any, si: Any, lamp: Lamp, beta: Any, active: Any, mirror: bool = False) -> Any:
    """beta · f · I cosⁿ θ_led / r² (RGB) at ``si`` for a random point of ``lamp``; 0 in shadow.

    f includes the cosine. With a slab 1 / r² becomes the link's gain, refracted where si is in the gel; ``mirror`` takes the LED's image in
    the slab's face.
    """
    light = lamp.sample(sampler.next_2d(active))
    if scene.slab is None:
        d = light - si.p
        r2 = dr.squared_norm(d)
        w = d * dr.rsqrt(r2)
        wo = si.to_local(w)
        facing = active & (dr.dot(w, lamp.axis) < 0) & (dr.dot(w, si.n) > 0) & (wo.z > 0)
        facing &= ~scene.scene.ray_test(si.spawn_ray_to(light), facing)
        return beta * scene.reflect(si, wo) * lamp.power * dr.select(facing, lamp.lobe_gain(-w) / r2, 0)
    link = scene.slab.mirror(mi, si.p, light) if mirror else scene.slab.link(mi, si.p, light)
    wo = si.to_local(link.w)
    facing = active & (dr.dot(link.out, lamp.axis) > 0) & (dr.dot(link.w, si.n) > 0) & (wo.z > 0)
    facing &= ~hidden(mi, scene, si, light, link, facing)
    return beta * scene.reflect(si, wo) * lamp.power * dr.select(facing, lamp.lobe_gain(link.out) * link.gain, 0)


def connect(mi: Any, scene: SensorScene, sampler: Any, p: Any, n: Any, lamp: Lamp, active: Any) -> tuple[Any, Any]:
    """Light of ``lamp`` at ``p`` over a random point y of the case: direction, strength (RGB).

    A ray leaves the LED by its own lobe (pdf (n + 1) / 2π cosⁿ θ, so it carries the flux Φ = 2π I / (n + 1)) and meets the case at y,
    which is joined to p: the strength is Φ · ρ / π · cos θ_y · V / r², to be multiplied by the receiver's cosine and reflectance. Bright
    spots that LEDs cast on a near wall are found from the LED, where a path from the camera would hit them by chance.
    """
    start = lamp.sample(sampler.next_2d(active))
    square = sampler.next_2d(active)
    cos_theta: Any = dr.power(dr.maximum(square.x, 1e-9), 1 / (lamp.lobe + 1))
    sin_theta = dr.safe_sqrt(1 - cos_theta * cos_theta)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * square.y)
    out = mi.Frame3f(lamp.axis).to_world(mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta))
    y, _, _ = advance(mi, scene, sampler, mi.Ray3f(start + OFFSET * lamp.axis, out), active)
    albedo = scene.case_albedo(y)
    flux = lamp.power * (2 * dr.pi / (lamp.lobe + 1))
    if scene.slab is None:
        d = p - y.p
        r2 = dr.maximum(dr.squared_norm(d), 1e-12)
        w = -d * dr.rsqrt(r2)
        cos_y = -dr.dot(w, y.n)
        joined = active & y.is_valid() & (albedo > 0) & (y.wi.z > 0) & (cos_y > 0) & (dr.dot(w, n) > 0)
        joined &= ~scene.scene.ray_test(y.spawn_ray_to(p + OFFSET * n), joined)
        return w, flux * dr.select(joined, albedo / dr.pi * cos_y / r2, 0)
    link = scene.slab.link(mi, p, y.p)
    cos_y = dr.dot(link.out, y.n)
    joined = active & y.is_valid() & (albedo > 0) & (y.wi.z > 0) & (cos_y > 0) & (dr.dot(link.w, n) > 0)
    joined &= ~hidden(mi, scene, y, p + OFFSET * n, link, joined)
    return link.w, flux * dr.select(joined, albedo / dr.pi * cos_y * link.gain, 0)
