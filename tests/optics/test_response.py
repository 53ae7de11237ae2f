"""The camera's response: the stated formula, one result on device and host, and a real background as flat field."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from raytac.optics import RayTraced
from raytac.optics.ink import darkened
from raytac.optics.response import Response
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import ResponseSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import RESOLUTION, at_rest, ball, built, grid_of, like_a_mini, surface

CURVE = ResponseSpec(
    exposure=3.0,
    white_balance=(1.1, 0.9, 0.8),
    gamma=1.8,
    black_level=(0.01, 0.02, 0.0),
    vignetting=(-0.3, 0.1, -0.05),
    colour_mix=(-0.02, 0.03, 0.1, -0.1, 0.05, -0.2),
    tone=(0.3, -0.1, 0.4),
)


def toned(u: float) -> float:
    w = 2 * u - 1
    return u + u * (1 - u) * (0.3 - 0.1 * w + 0.4 * (1.5 * w * w - 0.5))


def linear_image(shape: tuple[int, ...] = (60, 80, 3)) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 0.45, shape).astype(np.float32)


def test_the_formula(tracer: Build) -> None:
    camera = replace(tracer(like_a_mini()).camera, principal=(35.0, 33.0))
    image = linear_image()
    mixed = image @ np.array([[1, -0.02, 0.03], [0.1, 1, -0.1], [0.05, -0.2, 1]], np.float32).T
    encoded = Response(CURVE, camera).encode_numpy(image)
    for row, column in ((0, 0), (33, 35), (59, 79), (10, 60)):
        r = np.hypot(column + 0.5 - 35.0, row + 0.5 - 33.0) / (0.5 * np.hypot(80, 60))
        vignette = 1 - 0.3 * r**2 + 0.1 * r**4 - 0.05 * r**6
        for c in range(3):
            value = CURVE.white_balance[c] * CURVE.gain * vignette * mixed[row, column, c] + CURVE.black_level[c]
            expected = 255 * toned(min(max(value, 0), 1) ** (1 / 1.8))
            assert abs(float(encoded[row, column, c]) - expected) <= 0.51, (row, column, c)
    assert (encoded == 255).any()  # clipped, not wrapped around
    assert Response(CURVE, camera).encode_numpy(np.full_like(image, -0.3)).max() <= 255 * toned(0.02 ** (1 / 1.8)) + 1


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_device_and_host_encode_alike(tracer: Build, device: str) -> None:
    mi, _ = load_mitsuba(device)
    response = Response(CURVE, tracer(like_a_mini(), device=device).camera)
    batch = linear_image((2, 60, 80, 3))
    channels = [mi.Float(np.ascontiguousarray(batch[..., c]).ravel()) for c in range(3)]
    u8 = response.encode(mi, channels, response.device_scale(mi))
    dr.eval(u8)
    on_device = np.array(u8).reshape(batch.shape)
    assert np.abs(on_device.astype(int) - response.encode_numpy(batch)).max() <= 1


@pytest.mark.parametrize("black", [0.0, 0.02])
def test_a_dot_darkens_light_and_not_levels(black: float) -> None:
    """Of light x a coat of albedo 0.5 returns with a dot of albedo 0.1 a fifth, whatever gamma and tone curve make of it."""
    mi, _ = load_mitsuba("cpu")
    spec = like_a_mini()
    spec = replace(
        spec,
        response=replace(CURVE, black_level=(black,) * 3),
        coat=replace(spec.coat, reflectance=(0.5,) * 3, specular=0.0),
        markers=replace(spec.markers, reflectance=0.1),
    )

    def levels(light: np.ndarray) -> np.ndarray:
        return np.array([255 * toned(float(x) ** (1 / 1.8)) for x in light + black])

    light = np.linspace(0.05, 0.9, 20)
    dotted = darkened(spec, [mi.Float(levels(light))] * 3, mi.Float(1.0))
    for channel in dotted:
        np.testing.assert_allclose(np.array(channel), levels(0.2 * light), atol=0.05)


def test_a_dot_brighter_than_the_coat_stays_bright_under_a_tone_curve() -> None:
    """Levels beyond white saturate; the curve, which is for levels up to white, does not turn them dark."""
    mi, _ = load_mitsuba("cpu")
    spec = like_a_mini()
    spec = replace(
        spec,
        response=replace(CURVE, black_level=(0.0,) * 3),
        coat=replace(spec.coat, reflectance=(0.5,) * 3, specular=0.0),
        markers=replace(spec.markers, reflectance=0.9),
    )
    levels = np.array([120.0, 200.0, 240.0, 255.0])
    for channel in darkened(spec, [mi.Float(levels)] * 3, mi.Float(1.0)):
        shown = np.minimum(np.array(channel), 255)
        assert (shown > levels - 0.01).all() and (np.diff(shown) >= 0).all()


def background() -> np.ndarray:
    """A smooth, coloured image with a texture, as a camera might see an untouched gel."""
    v, u = np.indices(RESOLUTION[::-1]) / 60
    texture = np.random.default_rng(3).integers(-4, 5, (*u.shape, 1))
    return np.clip(np.stack([90 + 60 * u, 120 - 30 * v, 60 + 50 * v], axis=-1) + texture, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("options", [{}, {"integrator": "reference", "spp": 64}], ids=["fast", "reference"])
def test_flat_field_gives_the_background_at_rest(options: dict) -> None:
    spec = like_a_mini()
    spec = replace(spec, response=replace(CURVE, black_level=(0.0, 0.0, 0.0)))
    real = background()
    mode = built(RayTraced, spec, resolution=RESOLUTION, device="cpu", flat_field=real, **options)
    grid = grid_of(spec)
    at_rest_rgb = mode.render(at_rest(grid)).rgb
    pressed = mode.render(surface(grid, ball(grid)[0]))
    assert at_rest_rgb is not None and pressed.rgb is not None
    assert np.abs(at_rest_rgb[0].astype(int) - real).max() <= 1
    assert np.abs(pressed.rgb[0].astype(int) - real).max() > 10


def test_a_flat_field_may_have_parts_of_levels() -> None:
    """A mean of photographs: the image at rest is it, rounded."""
    spec, real = like_a_mini(), background()
    for part in (0.25, 0.75):
        mode = built(RayTraced, spec, resolution=RESOLUTION, device="cpu", flat_field=np.minimum(real + part, 255.0))
        rgb = mode.render(at_rest(grid_of(spec))).rgb
        assert rgb is not None
        assert (rgb[0] == np.minimum(real.astype(int) + round(part), 255)).mean() > 0.99


def test_flat_field_scales_in_linear_light(tracer: Build) -> None:
    """image = background × rendered / rendered at rest, before the gamma."""

    spec = like_a_mini()
    grid = grid_of(spec)
    real = background()
    pressed = surface(grid, ball(grid)[0])
    plain = tracer(spec, outputs=("rgb", "layers"))
    ratio = total(plain.render_layers(pressed))[0] / total(plain.render_layers(at_rest(grid)))[0]
    expected = 255 * np.clip((real / 255) ** spec.response.gamma * ratio, 0, 1) ** (1 / spec.response.gamma)
    rgb = RayTraced(flat_field=real).build(spec, resolution=RESOLUTION, device="cpu").render(pressed).rgb
    assert rgb is not None
    assert np.abs(rgb[0] - expected).max() <= 1.0


def test_vignetting_darkens_the_corners(tracer: Build) -> None:
    plain = like_a_mini()
    dark: SensorSpec = replace(plain, response=replace(plain.response, vignetting=(-0.5, 0.0, 0.0)))
    rest = at_rest(grid_of(plain))
    a, b = tracer(plain, bounce=False).render(rest).rgb, tracer(dark, bounce=False).render(rest).rgb
    assert a is not None and b is not None
    loss = a[0].astype(int) - b[0]
    assert loss[30, 40].max() <= 1 and loss[0, 0].max() > 10
