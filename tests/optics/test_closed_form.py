"""Direct light of an LED on a flat Lambertian pad against formulas: E = I cosⁿθ cosθ_p / r², L = ρ E / π."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import LedSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree, errors
from tests.optics.scenes import at_rest, grid_of, led, sensor

ALBEDO = (0.6, 0.45, 0.3)
POWER = (1.0, 0.5, 0.25)


def radiance(spec: SensorSpec, resolution: tuple[int, int], nodes: int = 1) -> np.ndarray:
    """L (H, W, 3) at the pixel centres on the plane z = 0: every LED as ``nodes``² equal point lights (midpoint rule)."""
    camera = spec.camera
    sx, sy = (native / pixels for native, pixels in zip(camera.resolution, resolution, strict=True))
    # A pixel's pitch is measured on the plane z = 0, so no focal length is needed.
    x = camera.position[0] + ((np.arange(resolution[0]) + 0.5) * sx - camera.principal_point[0]) * camera.pixel_pitch[0]
    y = camera.position[1] + ((np.arange(resolution[1]) + 0.5) * sy - camera.principal_point[1]) * camera.pixel_pitch[1]
    p = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1)
    image = np.zeros((len(y), len(x), 3))
    for lamp in spec.lights.leds:
        image += np.asarray(spec.coat.reflectance) / np.pi * irradiance(lamp, p, nodes)[..., None] * np.asarray(lamp.power)
    return image


def irradiance(lamp: LedSpec, p: np.ndarray, nodes: int) -> np.ndarray:
    """E (…) for unit power at points ``p`` (…, 3) of a plane that faces −z."""
    u, v = np.array(lamp.edges)
    offsets = (np.arange(nodes) + 0.5) / nodes - 0.5
    e = np.zeros(p.shape[:-1])
    for a in offsets * lamp.size[0]:
        for b in offsets * lamp.size[1]:
            d = p - (np.asarray(lamp.position) + a * u + b * v)
            r2 = (d**2).sum(-1)
            cos_led = np.maximum(d @ np.asarray(lamp.axis), 0) / np.sqrt(r2)
            e += cos_led**lamp.lobe * d[..., 2] / np.sqrt(r2) / r2 / nodes**2
    return e


PLACES: dict[str, dict[str, Any]] = {
    "over_the_pad": {"position": (4e-3, -3e-3, -9e-3), "aim": (0.0, 0.0, 0.0)},
    "beside_the_pad": {"position": (-13e-3, 2e-3, -7e-3), "aim": (1e-3, 0.0, -2e-3)},
    # The axis misses the pad: only the skirt of the lobe lights it, and a part of the pad is behind the LED.
    "looking_away": {"position": (9e-3, 7e-3, -6e-3), "aim": (-1e-3, 7e-3, -8e-3)},
}


@pytest.mark.parametrize("lobe", [1.0, 2.5])
@pytest.mark.parametrize("place", PLACES)
def test_fast_equals_the_formula_of_a_small_led(tracer: Build, tmp_path: Path, place: str, lobe: float) -> None:
    spec = sensor([led("one", **PLACES[place], lobe=lobe, power=POWER)], albedo=ALBEDO)
    mode = tracer(spec, bounce=False)
    image = total(mode.render_layers(at_rest(grid_of(spec))))[0]
    expected = radiance(spec, mode.camera.resolution)
    assert expected.max() > 0
    assert_images_agree(image, expected, tmp_path, mean=1e-6, maximum=1e-5)
    lit = expected > 1e-3 * expected.max()
    assert np.abs(image[lit] / expected[lit] - 1).max() < 2e-5


@pytest.mark.parametrize("integrator", ["reference", "path"])
@pytest.mark.parametrize("lobe", [1.0, 2.5])
def test_sampled_integrators_equal_it_within_their_noise(tracer: Build, tmp_path: Path, integrator: str, lobe: float) -> None:
    spec = sensor([led("one", **PLACES["beside_the_pad"], lobe=lobe, power=POWER)], albedo=ALBEDO)
    mode = tracer(spec, integrator=integrator, max_depth=1, spp=64)
    image = total(mode.render_layers(at_rest(grid_of(spec))))[0]
    expected = radiance(spec, mode.camera.resolution)
    # What is left is the spread of 64 places in a pixel; it averages out over the image.
    assert_images_agree(image, expected, tmp_path, mean=3e-3, maximum=3e-2)
    assert image.mean() == pytest.approx(expected.mean(), rel=5e-4)


LARGE: dict[str, Any] = {"size": (6e-3, 4e-3), "position": (-11.5e-3, -2e-3, -5e-3), "aim": (0.0, 0.0, 0.0)}
"""An LED larger than its distance from the nearest point in view, and itself out of view."""


def test_points_on_a_large_led_converge_to_its_integral(tracer: Build) -> None:
    spec = sensor([led("large", **LARGE, lobe=1.7, power=POWER)], albedo=ALBEDO)
    rest = at_rest(grid_of(spec))
    expected = radiance(spec, (80, 60), nodes=64)
    mean = {n: errors(total(tracer(spec, bounce=False, led_points=n).render_layers(rest))[0], expected)[0] for n in (1, 2)}
    # Gauss-Legendre: exact but for where a part of the LED shines away from the pad.
    assert mean[1] < 5e-3 and mean[2] < 1e-3, mean


def test_sampling_a_large_led_converges_to_its_integral(tracer: Build, tmp_path: Path) -> None:
    spec = sensor([led("large", **LARGE, lobe=1.7, power=POWER)], albedo=ALBEDO)
    image = total(tracer(spec, integrator="reference", max_depth=1, spp=256).render_layers(at_rest(grid_of(spec))))[0]
    expected = radiance(spec, (80, 60), nodes=64)
    assert_images_agree(image, expected, tmp_path, mean=0.02)
    assert image.mean() == pytest.approx(expected.mean(), rel=1e-3)
