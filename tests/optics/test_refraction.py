"""Gel and plate as a slab: its geometry against finite differences, its light against a formula and against Mitsuba's dielectric."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import SpecError
from raytac.optics import RayTraced
from raytac.optics.camera import Pinhole
from raytac.optics.refraction import Slab
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.fast_tracer import total
from raytac.optics.trace.scene import UNIT
from raytac.specs.sensor import RefractionSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree, psnr_db
from tests.optics.scenes import at_rest, ball, grid_of, led, like_a_mini, sensor, surface

IOR = 1.41
ALBEDO = (0.6, 0.45, 0.3)
POWER = (1.0, 0.5, 0.25)


@pytest.fixture(scope="module")
def mi() -> Any:
    return load_mitsuba("cpu")[0]


def slabbed(spec: SensorSpec, ior: float = IOR, plate: float = 1e-3) -> SensorSpec:
    return replace(spec, refraction=RefractionSpec("slab", ior, plate))


def bisect(rho: np.ndarray, h1: np.ndarray, h2: np.ndarray, ior: float) -> np.ndarray:
    """Angle θ₁ in air of the ray over ``rho``, by halving [0, π/2): slow, and without any formula of the package."""
    low, high = np.zeros_like(rho), np.full_like(rho, np.pi / 2)
    for _ in range(80):
        mid = (low + high) / 2
        short = reach(mid, h1, h2, ior) < rho
        low, high = np.where(short, mid, low), np.where(short, high, mid)
    return (low + high) / 2


def reach(theta: np.ndarray, h1: np.ndarray, h2: np.ndarray, ior: float) -> np.ndarray:
    """Horizontal way of the ray of angle ``theta`` in air."""
    return h1 * np.tan(theta) + h2 * np.tan(np.arcsin(np.sin(theta) / ior))


def fresnel(theta: np.ndarray, ior: float) -> np.ndarray:
    """Transmittance by the sine and tangent laws, mean of both polarisations."""
    t2 = np.arcsin(np.sin(theta) / ior)
    s = np.sin(theta - t2) ** 2 / np.sin(theta + t2) ** 2
    p = np.tan(theta - t2) ** 2 / np.tan(theta + t2) ** 2
    return 1 - (s + p) / 2


def places(n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(ρ, h₁, h₂) [m]: from almost under the LED to grazing, LEDs close under the plate included."""
    rng = np.random.default_rng(0)
    return rng.uniform(1e-5, 25e-3, n), 10 ** rng.uniform(-4.5, -1.5, n), rng.uniform(0.2e-3, 8e-3, n)


# ---------------------------------------------------------------- geometry


@pytest.mark.parametrize("ior", [1.0, 1.1, IOR, 2.0])
def test_the_ray_between_two_points_is_found_at_every_angle(ior: float) -> None:
    rho, h1, h2 = places()
    theta = np.arctan(Slab(0.0, ior).meet(rho, h1, h2))
    np.testing.assert_allclose(theta, bisect(rho, h1, h2, ior), rtol=0, atol=3e-7)


@pytest.mark.parametrize("ior", [1.0, IOR, 2.0])
def test_spread_is_the_derivative_of_a_tube_of_rays(ior: float) -> None:
    rho, h1, h2 = places()
    theta = bisect(rho, h1, h2, ior)
    keep = theta < 1.55
    rho, h1, h2, theta = rho[keep], h1[keep], h2[keep], theta[keep]
    cos1, cos2, slide, gain = Slab(0.0, ior).spread(np.tan(theta), h1, h2)
    step = 1e-6
    derivative = (reach(theta + step, h1, h2, ior) - reach(theta - step, h1, h2, ior)) / (2 * step)
    np.testing.assert_allclose(slide, derivative, rtol=2e-4)
    # Solid angle 2π (1 − cos) between two cones over the ring that they cut out of the plane, seen along the ray.
    cap = np.cos(theta - step) - np.cos(theta + step)
    ring = (reach(theta + step, h1, h2, ior) ** 2 - reach(theta - step, h1, h2, ior) ** 2) / 2
    np.testing.assert_allclose(gain, cap / (ring * cos2), rtol=2e-4)
    np.testing.assert_allclose(cos1, np.cos(theta), rtol=1e-9)
    if ior == 1.0:
        np.testing.assert_allclose(gain, 1 / (rho**2 + (h1 + h2) ** 2), rtol=1e-9)


def test_light_from_the_gel_spreads_into_the_air_by_its_own_tube(mi: Any) -> None:
    rho, h1, h2 = (1e3 * a for a in places())
    theta = bisect(rho, h1, h2, IOR)
    keep = (theta < 1.4) & (h1 > 0.5)
    rho, h1, h2, theta = rho[keep], h1[keep], h2[keep], theta[keep]
    slab, zero = Slab(-5.0, IOR), np.zeros_like(rho)
    air, gel = mi.Point3f(np.stack([rho, zero, -5 - h1])), mi.Point3f(np.stack([zero, zero, -5 + h2]))
    out = slab.link(mi, air, gel)
    inside = np.arcsin(np.sin(theta) / IOR)
    step = 1e-6

    def at(angle: np.ndarray) -> np.ndarray:
        return h2 * np.tan(angle) + h1 * np.tan(np.arcsin(IOR * np.sin(angle)))

    tube = (np.cos(inside - step) - np.cos(inside + step)) / (
        (at(inside + step) ** 2 - at(inside - step) ** 2) / 2 * np.cos(theta)
    )
    np.testing.assert_allclose(np.array(out.gain), tube * fresnel(theta, IOR), rtol=2e-3)
    # Both directions of the link, and the point that it crosses at, are those of one ray.
    np.testing.assert_allclose(np.array(out.w), np.stack([-np.sin(theta), zero, np.cos(theta)]), atol=1e-4)
    np.testing.assert_allclose(np.array(out.out), np.stack([np.sin(inside), zero, -np.cos(inside)]), atol=1e-4)
    np.testing.assert_allclose(np.array(out.via), np.stack([h2 * np.tan(inside), zero, zero - 5]), atol=2e-3)


def test_points_in_one_medium_are_joined_straight(mi: Any) -> None:
    slab = Slab(-5.0, IOR)
    for z in (-2.0, -9.0):
        link = slab.link(mi, mi.Point3f(1, 2, z), mi.Point3f(4, 6, z))
        assert not np.array(link.bent).any()
        assert np.array(link.gain).item() == pytest.approx(1 / 25, rel=1e-6)
        np.testing.assert_allclose(np.array(link.w).ravel(), (0.6, 0.8, 0), atol=1e-6)


def test_the_face_mirrors_as_an_image_behind_it(mi: Any) -> None:
    x, y = np.array((1.0, 2.0, -7.0)), np.array((5.0, -1.0, -9.0))
    link = Slab(-5.0, IOR).mirror(mi, mi.Point3f(x.tolist()), mi.Point3f(y.tolist()))
    via, w, out = (np.array(a).ravel() for a in (link.via, link.w, link.out))
    assert via[2] == pytest.approx(-5.0, abs=1e-5)
    np.testing.assert_allclose(w, (via - x) / np.linalg.norm(via - x), atol=1e-6)
    np.testing.assert_allclose(out, (via - y) / np.linalg.norm(via - y), atol=1e-6)
    length = np.linalg.norm(via - x) + np.linalg.norm(via - y)
    loss = 1 - fresnel(np.arccos(w[2]), IOR)
    assert np.array(link.gain).item() == pytest.approx(loss / length**2, rel=1e-4)


def test_the_penumbra_turns_as_the_light_moves(mi: Any) -> None:
    slab, p = Slab(-5.0, IOR), mi.Point3f(0, 0, -0.5)
    step, light = 0.05, np.array((9.0, 0.0, -11.0))
    link, turn = slab.connect(mi, p, mi.Point3f(light.tolist()))
    out = np.array(link.out).ravel()
    across = np.array((out[2], 0, -out[0]))
    angles = []
    for s in (-step, step):
        w = np.array(slab.connect(mi, p, mi.Point3f((light + s * across).tolist()))[0].w).ravel()
        angles.append(np.arctan2(w[0], -w[2]))
    assert np.array(turn).item() == pytest.approx((angles[1] - angles[0]) / (2 * step), rel=1e-3)


# ---------------------------------------------------------------- camera


def test_pixels_keep_their_size_on_the_gel_plane() -> None:
    spec = slabbed(sensor([led("one", (12e-3, 0.0, -9e-3))]), plate=3e-3)
    camera = Pinhole.from_spec(spec.camera, slab=Slab.from_spec(spec))
    x, y = camera.pixel_centres_on_plane(0.0)
    middle = len(x) // 2, len(y) // 2
    assert x[middle[0]] - x[middle[0] - 1] == pytest.approx(spec.camera.pixel_pitch[0], rel=1e-4)
    assert y[middle[1]] - y[middle[1] - 1] == pytest.approx(spec.camera.pixel_pitch[1], rel=1e-4)
    # Without the slab the same lens would look from closer by: 7 mm of gel and plate appear as 7 / n mm.
    assert camera.focal[0] == pytest.approx((28e-3 - 7e-3 + 7e-3 / IOR) / spec.camera.pixel_pitch[0])


def test_projecting_a_seen_point_gives_its_pixel() -> None:
    spec = slabbed(sensor([led("one", (12e-3, 0.0, -9e-3))]))
    camera = Pinhole.from_spec(spec.camera, slab=Slab.from_spec(spec))
    pixels = np.random.default_rng(1).uniform((0, 0), camera.resolution, (50, 2))
    (x, y, z), (tx, ty) = camera.ray(pixels[:, 0], pixels[:, 1])
    depth = np.linspace(0, 2e-3, 50)
    seen = np.stack([x + tx * (-depth - z), y + ty * (-depth - z), -depth], axis=-1)
    np.testing.assert_allclose(camera.project(seen), pixels, atol=1e-6)
    straight = replace(camera, slab=None)
    assert np.abs(straight.project(seen) - pixels).max() > 1


# ---------------------------------------------------------------- light


def test_index_one_is_no_slab(tracer: Build) -> None:
    spec = like_a_mini()
    coat = surface(grid_of(spec), ball(grid_of(spec))[0])
    plain, slab = (total(tracer(s, bounce=False).render_layers(coat)) for s in (spec, slabbed(spec, ior=1.0)))
    assert np.abs(slab - plain).max() < 1e-4 * plain.max()


def radiance(spec: SensorSpec, resolution: tuple[int, int]) -> np.ndarray:
    """L (H, W, 3) in air of a flat Lambertian pad under small LEDs: angles by bisection, the ray tube by a difference quotient."""
    camera, ior = spec.camera, spec.refraction.ior
    h2 = np.array(spec.gelpad.thickness + spec.refraction.plate_thickness)
    air = -camera.position[2] - h2
    sx, sy = (native / pixels for native, pixels in zip(camera.resolution, resolution, strict=True))
    # Near the axis a pixel is its pitch wide on the plane z = 0, which fixes the slopes in air.
    tx = ((np.arange(resolution[0]) + 0.5) * sx - camera.principal_point[0]) * camera.pixel_pitch[0] / (air + h2 / ior)
    ty = ((np.arange(resolution[1]) + 0.5) * sy - camera.principal_point[1]) * camera.pixel_pitch[1] / (air + h2 / ior)
    tx, ty = np.meshgrid(tx, ty)
    view, azimuth = np.arctan(np.hypot(tx, ty)), np.arctan2(ty, tx)
    far = reach(view, air, h2, ior)
    x, y = camera.position[0] + far * np.cos(azimuth), camera.position[1] + far * np.sin(azimuth)
    image = np.zeros((*resolution[::-1], 3))
    for lamp in spec.lights.leds:
        dx, dy = x - lamp.position[0], y - lamp.position[1]
        rho, h1 = np.hypot(dx, dy), np.array(-h2 - lamp.position[2])
        theta = bisect(rho, h1 + 0 * rho, h2 + 0 * rho, ior)
        step = 1e-6
        rings = reach(theta + step, h1, h2, ior) ** 2 - reach(theta - step, h1, h2, ior) ** 2
        # Irradiance of a horizontal plane: solid angle over the ring's whole area, so no cosine appears.
        gain = (np.cos(theta - step) - np.cos(theta + step)) / (rings / 2)
        leaving = np.stack([dx / rho * np.sin(theta), dy / rho * np.sin(theta), np.cos(theta)], axis=-1)
        lobe = np.maximum(leaving @ np.asarray(lamp.axis), 0) ** lamp.lobe
        image += (gain * lobe * fresnel(theta, ior))[..., None] * np.asarray(lamp.power)
    return image * np.asarray(spec.coat.reflectance) / np.pi * (fresnel(view, ior) / ior**2)[..., None]


PLACES = {"below_the_pad": (4e-3, -3e-3, -9e-3), "beside_the_pad": (-13e-3, 2e-3, -7e-3), "grazing": (-13e-3, 2e-3, -5.1e-3)}


@pytest.mark.parametrize("ior", [1.2, IOR])
@pytest.mark.parametrize("place", PLACES)
def test_fast_equals_the_formula_of_a_small_led_behind_the_slab(tracer: Build, tmp_path: Path, place: str, ior: float) -> None:
    spec = slabbed(sensor([led("one", PLACES[place], lobe=1.5, power=POWER)], albedo=ALBEDO), ior)
    mode = tracer(spec, bounce=False)
    image = total(mode.render_layers(at_rest(grid_of(spec))))[0]
    expected = radiance(spec, mode.camera.resolution)
    assert expected.max() > 0
    assert_images_agree(image, expected, tmp_path, mean=1e-4, maximum=1e-3)


def test_fast_without_bounces_equals_the_reference_at_depth_one(tracer: Build, tmp_path: Path) -> None:
    # Black walls: the reference also sees the case mirrored in the slab's face, which the fast integrator leaves out.
    spec = slabbed(replace(like_a_mini(), case=replace(like_a_mini().case, reflectance=0.0)))
    coat = surface(grid_of(spec), ball(grid_of(spec))[0])
    fine = total(tracer(spec, bounce=False, led_points=2, resolution=(160, 120)).render_layers(coat))[0]
    fast = blocks(fine, 2)
    reference = total(tracer(spec, integrator="reference", max_depth=1, spp=256).render_layers(coat))[0]
    assert fast.mean() == pytest.approx(reference.mean(), rel=2e-3)
    assert_images_agree(fast, reference, tmp_path, mean=5e-3)


def blocks(image: np.ndarray, size: int = 10) -> np.ndarray:
    """Means over squares of ``size`` pixels."""
    h, w, c = image.shape
    return image.reshape(h // size, size, w // size, size, c).mean((1, 3))


@pytest.mark.parametrize("walls", [pytest.param(0.0, id="black"), pytest.param(0.7, id="bright", marks=pytest.mark.slow)])
def test_reference_equals_the_stock_path_through_a_dielectric(tracer: Build, walls: float) -> None:
    # The stock path cannot aim at an LED through the glass: only large ones are met often enough.
    size = (6e-3, 6e-3)
    leds = (
        led("a", (11.5e-3, 3e-3, -12e-3), (0, 0, -2e-3), size=size, lobe=1.5, power=POWER),
        led("b", (-3e-3, -9.5e-3, -11e-3), (0, 0, -3e-3), size=size, power=(0.2, 0.5, 1.0)),
    )
    spec = slabbed(sensor(leds, albedo=ALBEDO, walls=walls, specular=0.1))
    coat = surface(grid_of(spec), ball(grid_of(spec))[0])
    ours = total(tracer(spec, integrator="reference", spp=64, resolution=(40, 30)).render_layers(coat))[0]
    stock = total(tracer(spec, integrator="path", spp=1024, resolution=(40, 30)).render_layers(coat))[0]
    assert ours.mean() == pytest.approx(stock.mean(), rel=0.015)
    assert np.abs(blocks(ours) / blocks(stock) - 1).max() < 0.12


@pytest.mark.slow
def test_error_of_the_bounce_model_behind_the_slab(tracer: Build) -> None:
    spec = slabbed(like_a_mini())
    spec = replace(spec, response=replace(spec.response, exposure=24.0))
    coat = surface(grid_of(spec), ball(grid_of(spec))[0])
    reference = tracer(spec, integrator="reference", spp=1024).render(coat).rgb
    fast = tracer(spec).render(coat).rgb
    without = tracer(spec, bounce=False).render(coat).rgb
    assert reference is not None and fast is not None and without is not None
    assert 60 < reference.mean() < 200
    assert psnr_db(fast, reference) > 40
    # All light but the direct: case, coat to coat, and what the slab's face throws back. Leaving it out must show.
    assert psnr_db(without, reference) < 30


# ---------------------------------------------------------------- bad input


def test_an_led_in_the_plate_is_named() -> None:
    spec = slabbed(sensor([led("fine", (12e-3, 0.0, -9e-3)), led("sunk", (12e-3, 0.0, -6e-3))]), plate=3e-3)
    with pytest.raises(SpecError, match=r"led\[1\]\.position_mm = .*LED 'sunk' reaches up to z = -5\.9.*air face, z < -7 mm"):
        RayTraced().build(spec, device="cpu")


def test_a_camera_in_the_plate_is_refused() -> None:
    spec = slabbed(sensor([led("one", (12e-3, 0.0, -29e-3))]), plate=24.5e-3)
    with pytest.raises(SpecError, match=r"camera\.position_mm = \[0\.0, 0\.0, -28\.0\]: .*behind the gel, z < -28\.5 mm"):
        RayTraced().build(spec, device="cpu")


def test_the_scene_has_the_slab_in_its_own_unit() -> None:
    spec = slabbed(sensor([led("one", (12e-3, 0.0, -9e-3))]))
    slab = Slab.from_spec(spec, UNIT)
    assert slab is not None and slab.z == pytest.approx(-5.0) and slab.ior == IOR
    assert Slab.from_spec(replace(spec, refraction=RefractionSpec("none", IOR, 1e-3))) is None
