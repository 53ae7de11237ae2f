"""The fast integrator against the path tracer: equal without inter-reflection, and with it within a stated error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.gel.surface import GelSurface
from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree, errors, psnr_db
from tests.optics.scenes import ball, grid_of, led, like_a_mini, relief, sensor, surface

PITCH = 0.2e-3
SHAPES = ("ball", "relief", "step")
DOUBLE = (160, 120)


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return like_a_mini()


def shape(spec: SensorSpec, name: str) -> GelSurface:
    grid = grid_of(spec, PITCH)
    block = (np.abs(grid.x[None, :] - 1e-3) < 3e-3) & (np.abs(grid.y[:, None]) < 2e-3)
    heights = {"ball": ball(grid)[0], "relief": relief(grid), "step": grid.rest - 0.3e-3 * block}
    return surface(grid, heights[name])


def binned(image: np.ndarray, by: int = 2) -> np.ndarray:
    """Mean over squares of ``by`` pixels."""
    height, width, _ = image.shape
    return image.reshape(height // by, by, width // by, by, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("name", SHAPES)
def test_without_bounce_it_is_the_direct_light(tracer: Build, tmp_path: Path, spec: SensorSpec, name: str) -> None:
    pressed = shape(spec, name)
    expected = total(tracer(spec, integrator="reference", max_depth=1, spp=512, pitch=PITCH).render_layers(pressed))[0]
    # Four rays a pixel, by way of twice the resolution (a kernel with four rays compiles for longer).
    fine = tracer(spec, bounce=False, led_points=2, pitch=PITCH, resolution=DOUBLE)
    actual = binned(total(fine.render_layers(pressed))[0])
    assert_images_agree(actual, expected, tmp_path, mean=5e-3)
    assert actual.mean() == pytest.approx(expected.mean(), rel=2e-3)


def test_four_rays_a_pixel_are_the_mean_of_four_pixels(tracer: Build) -> None:
    spec = sensor([led("one", (-12e-3, 3e-3, -6e-3), size=(1e-3, 1e-3))], specular=0.1)
    pressed = surface(grid_of(spec), relief(grid_of(spec)))
    four = total(tracer(spec, bounce=False, spp=4).render_layers(pressed))[0]
    one = total(tracer(spec, bounce=False, resolution=DOUBLE).render_layers(pressed))[0]
    assert errors(four, binned(one))[1] < 1e-4


@pytest.mark.parametrize("name", ["ball", "relief"])
def test_with_bounce_it_is_close_to_all_light(tracer: Build, tmp_path: Path, spec: SensorSpec, name: str) -> None:
    pressed = shape(spec, name)
    sampled = tracer(spec, integrator="reference", spp=256, pitch=PITCH)
    expected = total(sampled.render_layers(pressed))[0]
    # The defaults: one ray a pixel, one point an LED.
    actual = total(tracer(spec, pitch=PITCH).render_layers(pressed))[0]
    direct = total(tracer(spec, pitch=PITCH, bounce=False).render_layers(pressed))[0]
    # A pixel's error is mostly the reference's noise at this number of samples; a square of 4 × 4 pixels has a quarter of it.
    assert_images_agree(actual, expected, tmp_path, mean=0.02)
    assert_images_agree(binned(actual, 4), binned(expected, 4), tmp_path, mean=0.01, name="binned")
    with_bounce, without = (errors(binned(image, 4), binned(expected, 4))[0] for image in (actual, direct))
    assert without > 3 * with_bounce, (without, with_bounce)
    encode = sampled.response.encode_numpy
    assert psnr_db(encode(actual), encode(expected)) >= 44.0
    assert psnr_db(encode(direct), encode(expected)) < 44.0
