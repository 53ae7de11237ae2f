"""The ``reference`` integrator: unbiased path tracing over the sensor's Mitsuba scene, one radiance layer per LED colour.

At the first vertex of a path each LED is sampled once, uniformly over its rectangle (next-event estimation, area form of the rendering
equation, Kajiya 1986; Shirley, Wang and Zimmerman 1996), at later ones one LED; the path goes on by sampling the coat's or the wall's
reflectance and ends by Russian roulette on its throughput. LEDs are found by these shadow rays alone, so a path that runs into one ends there unlit: with
the light never counted twice, no multiple importance sampling is needed. Sampling every LED at the first vertex takes the colour noise
out that Mitsuba's own ``path`` has from choosing one LED at random; both converge to one image (a test checks it).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from tqdm import tqdm

from raytac.optics.camera import Pinhole
from raytac.optics.lamp import Lamp, LampTable
from raytac.optics.scene import SensorScene

__all__ = ["ReferenceIntegrator", "StockPathIntegrator", "trace"]

LAUNCH = 1 << 22
"""Most paths in one kernel launch; keeps memory flat and the progress bar alive."""


class ReferenceIntegrator:
    """Path tracer for one sensor scene and camera; ``render`` returns the layers of the scene as it stands."""

    def __init__(self, scene: SensorScene, camera: Pinhole, *, max_depth: int = -1, progress: bool = False) -> None:
        """``max_depth`` counts reflections: 1 is direct light only, −1 has no limit."""
        self.scene, self.camera, self.max_depth, self.progress = scene, camera, max_depth, progress

    def render(self, lamps: list[Lamp], groups: list[int], spp: int, seed: int) -> np.ndarray:
        """Mean radiance (G, H, W, 3), float32; ``groups`` gives for each lamp the layer in 0 … G−1 that it lights.

        Samples are uniform in each pixel's square (box filter); ``spp`` samples a pixel, ``seed`` fixes them.
        """

        def radiance(sampler: Any, ray: Any) -> list[Any]:
            return trace(self.scene.mi, self.scene, sampler, ray, lamps, groups, self.max_depth)

        return accumulate(self.scene.mi, self.camera, radiance, spp, seed, self.progress)


class StockPathIntegrator:
    """Mitsuba's own ``path`` over the same scene: an independent check of ``reference``, and the peer to measure speed against."""

    def __init__(self, scene: SensorScene, camera: Pinhole, *, max_depth: int = -1, progress: bool = False) -> None:
        """``max_depth`` as in ``ReferenceIntegrator`` (Mitsuba itself counts the camera's edge too)."""
        self.scene, self.camera, self.progress = scene, camera, progress
        depth = -1 if max_depth < 0 else max_depth + 1
        self.integrator = scene.mi.load_dict({"type": "path", "max_depth": depth})

    def render(self, lamps: list[Lamp], groups: list[int], spp: int, seed: int) -> np.ndarray:
        """As ``ReferenceIntegrator.render``; one run a layer, with the other layers' LEDs dark."""
        names = [led.name for led in self.scene.sensor.lights.leds]
        layers = []

        def radiance(sampler: Any, ray: Any) -> list[Any]:
            colour, valid, _ = self.integrator.sample(self.scene.scene, sampler, self.scene.mi.RayDifferential3f(ray))
            return [dr.select(valid, c, 0) for c in colour]

        for group in range(max(groups) + 1):
            self.scene.set_layers([name for name, g in zip(names, groups, strict=True) if g == group])
            layers.append(accumulate(self.scene.mi, self.camera, radiance, spp, seed, self.progress)[0])
        return np.stack(layers)


def accumulate(
    mi: Any, camera: Pinhole, radiance: Callable[[Any, Any], list[Any]], spp: int, seed: int, progress: bool
) -> np.ndarray:
    """Mean of ``radiance(sampler, ray)`` (3·G channels) over ``spp`` rays uniform in each pixel's square; (G, H, W, 3), float32."""
    width, height = camera.resolution
    per_launch = max(1, min(spp, LAUNCH // (width * height)))
    template = mi.load_dict({"type": "independent"})
    total: np.ndarray | None = None
    done = 0
    with tqdm(total=spp, unit="spp", desc="path tracing", disable=None if progress else True, leave=False) as bar:
        while done < spp:
            count = min(per_launch, spp - done)
            n = width * height * count
            sampler = template.clone()
            sampler.seed((seed * 0x9E3779B1 + done * 0x85EBCA6B) & 0xFFFFFFFF, n)
            pixel = dr.arange(mi.UInt32, n) // count
            jitter = sampler.next_2d()
            tx, ty = camera.slope(mi.Float(pixel % width) + jitter.x, mi.Float(pixel // width) + jitter.y)
            ray = mi.Ray3f(mi.Point3f(*camera.position), dr.normalize(mi.Vector3f(tx, ty, 1)))
            sums = [dr.block_sum(c, count) for c in radiance(sampler, ray)]
            dr.eval(sums)
            launch = np.stack([np.array(c) for c in sums]).astype(np.float64)
            total = launch if total is None else total + launch
            done += count
            bar.update(count)
    assert total is not None
    image = (total / spp).reshape(-1, 3, height, width)
    return np.ascontiguousarray(image.transpose(0, 2, 3, 1), dtype=np.float32)


def trace(
    mi: Any, scene: SensorScene, sampler: Any, ray: Any, lamps: list[Lamp], groups: list[int], max_depth: int, direct: bool = True
) -> list[Any]:
    """Radiance along ``ray`` [B·3 layers]: a list of 3 · G Floats, R, G, B of each group in turn.

    The first vertex is lit by every LED; later ones by one LED chosen uniformly, since they carry a few per cent of the light.
    ``direct=False`` leaves the first vertex's own light out.
    """
    n = dr.width(ray.o)
    layers = max(groups) + 1
    table = LampTable.of(mi, lamps, groups)

    def lit_by(si: Any, lamp: Lamp, sampler: Any, beta: Any, active: Any) -> Any:
        """beta · f · I cos θ / r² for one point of ``lamp``, 0 in its shadow."""
        light = lamp.sample(sampler.next_2d(active))
        d = light - si.p
        r2 = dr.squared_norm(d)
        w = d * dr.rsqrt(r2)
        wo = si.to_local(w)
        facing = active & (dr.dot(w, lamp.axis) < 0) & (dr.dot(w, si.n) > 0) & (wo.z > 0)
        facing &= ~scene.scene.ray_test(si.spawn_ray_to(light), facing)
        return beta * scene.reflect(si, wo) * lamp.power * dr.select(facing, lamp.lobe_gain(-w) / r2, 0)

    def scatter(si: Any, sampler: Any, beta: Any, active: Any) -> tuple[Any, Any, Any]:
        wo, weight = scene.sample_reflection(si, sampler.next_1d(active), sampler.next_2d(active))
        beta = beta * weight
        d = si.to_world(wo)
        survive = dr.minimum(dr.max(beta), 0.95)
        active = active & (dr.dot(d, si.n) > 0) & (wo.z > 0) & (sampler.next_1d(active) < survive)
        return si.spawn_ray(d), beta / dr.select(active, survive, 1), active

    si = scene.scene.ray_intersect(ray)
    active = si.is_valid()
    beta = mi.Color3f(1)
    radiance = [mi.Float(0) for _ in range(3 * layers)]
    if direct:
        for lamp, group in zip(lamps, groups, strict=True):
            gain = lit_by(si, lamp, sampler, beta, active)
            for c in range(3):
                radiance[3 * group + c] += gain[c]
    radiance = [r + dr.zeros(mi.Float, n) for r in radiance]
    if max_depth == 1:
        return radiance
    ray, beta, active = scatter(si, sampler, beta, active)

    def alive(sampler: Any, ray: Any, beta: Any, radiance: list[Any], depth: Any, active: Any) -> Any:
        return active

    def bounce(sampler: Any, ray: Any, beta: Any, radiance: list[Any], depth: Any, active: Any) -> tuple[Any, ...]:
        si = scene.scene.ray_intersect(ray, active)
        active = active & si.is_valid()
        index = dr.minimum(mi.UInt32(sampler.next_1d(active) * len(lamps)), len(lamps) - 1)
        lamp, group = table.pick(mi, index, active)
        gain = lit_by(si, lamp, sampler, beta, active) * len(lamps)
        radiance = [r + dr.select(group == k // 3, gain[k % 3], 0) for k, r in enumerate(radiance)]
        depth = depth + 1
        if max_depth > 0:
            active &= depth < max_depth
        ray, beta, active = scatter(si, sampler, beta, active)
        return sampler, ray, beta, radiance, depth, active

    # The sampler is part of the state: its random numbers must differ from turn to turn.
    state = (sampler, ray, beta + dr.zeros(mi.Color3f, n), radiance, mi.UInt32(1) + dr.zeros(mi.UInt32, n), active)
    return dr.while_loop(state, alive, bounce, label="path")[3]
