"""Light is additive: layers sum to the image, and a layer holds the light of its LEDs alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import LightsSpec
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree
from tests.optics.scenes import at_rest, ball, grid_of, like_a_mini, surface

MODES = pytest.mark.parametrize("options", [{}, {"integrator": "reference", "spp": 4}], ids=["fast", "reference"])


@MODES
@pytest.mark.parametrize("layers", ["colour", "led"])
def test_sum_of_layers_is_the_image(tracer: Build, options: dict, layers: str) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = tracer(spec, outputs=("rgb", "layers"), layers=layers, **options)
    images = mode.render(surface(grid, ball(grid)[0]))
    assert images.rgb is not None and images.layers is not None
    names = [led.name for led in spec.lights.leds] if layers == "led" else ["red", "green", "blue"]
    assert list(images.layers) == names
    encoded = mode.response.encode_numpy(total(images.layers))
    assert np.abs(encoded.astype(int) - images.rgb).max() <= 1
    assert 30 < images.rgb.mean() < 220 and images.rgb.std() > 5


@pytest.mark.parametrize("layers", ["colour", "led"])
def test_image_alone_is_that_beside_its_layers(tracer: Build, layers: str) -> None:
    """Without layers indirect light is gathered for their sum."""
    spec = like_a_mini()
    pressed = surface(grid_of(spec), ball(grid_of(spec))[0])
    alone = tracer(spec, outputs=("rgb",), layers=layers).render(pressed).rgb
    direct = tracer(spec, outputs=("rgb",), layers=layers, bounce=False).render(pressed).rgb
    beside = tracer(spec, outputs=("rgb", "layers"), layers=layers).render(pressed).rgb
    assert alone is not None and direct is not None and beside is not None
    assert np.abs(alone.astype(int) - beside).max() <= 1
    assert np.abs(alone.astype(int) - direct).max() > 2


@MODES
def test_layers_of_leds_sum_to_the_layer_of_their_colour(tracer: Build, options: dict) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    pressed = surface(grid, ball(grid)[0])
    by_colour = tracer(spec, outputs=("rgb", "layers"), layers="colour", **options).render_layers(pressed)
    by_led = tracer(spec, outputs=("rgb", "layers"), layers="led", **options).render_layers(pressed)
    np.testing.assert_allclose(by_led["green_a"] + by_led["green_b"], by_colour["green"], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(by_led["blue"], by_colour["blue"], rtol=1e-4, atol=1e-6)


def test_a_layer_is_what_its_leds_give_alone(tracer: Build, tmp_path: Path) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    pressed = surface(grid, ball(grid)[0])
    red = tracer(spec, outputs=("rgb", "layers"), layers="colour").render_layers(pressed)["red"][0]
    alone = replace(spec, lights=LightsSpec(spec.lights.leds[:1]))
    # The case's light is fitted from other random paths, so the two differ by that fit's error.
    assert_images_agree(total(tracer(alone).render_layers(pressed))[0], red, tmp_path, mean=3e-3, maximum=0.02)


def test_twice_the_power_is_twice_the_light(tracer: Build) -> None:
    spec = like_a_mini()
    leds = tuple(replace(led, power=tuple(2 * p for p in led.power)) for led in spec.lights.leds)
    rest = at_rest(grid_of(spec))
    one = total(tracer(spec, bounce=False).render_layers(rest))
    two = total(tracer(replace(spec, lights=LightsSpec(leds)), bounce=False).render_layers(rest))
    np.testing.assert_allclose(two, 2 * one, rtol=1e-6)
