"""The case's even glow: a closed form on a flat pad, Mitsuba's own integrator, and the fast integrator on an imprint."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from raytac.gel.surface import GelSurface
from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import ball, grid_of, like_a_mini, surface

GLOW = np.array([3e2, 0.0, 2e3])
"""By LED [1/m²]."""


def glowing(spec: SensorSpec, glow: np.ndarray = GLOW) -> SensorSpec:
    leds = tuple(
        dataclasses.replace(led, glow=float(g))
        for led, g in zip(spec.lights.leds, np.resize(glow, len(spec.lights.leds)), strict=True)
    )
    return dataclasses.replace(spec, lights=dataclasses.replace(spec.lights, leds=leds))


def binned(image: np.ndarray) -> np.ndarray:
    height, width, _ = image.shape
    return image.reshape(height // 4, 4, width // 4, 4, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("integrator", ["fast", "reference", "path"])
def test_a_flat_coat_shows_albedo_times_glow(tracer: Build, integrator: str) -> None:
    """A flat pad sees nothing but case, so E = π G and L = ρ G; LEDs look away and the case reflects nothing."""
    mini = glowing(like_a_mini())
    leds = tuple(
        dataclasses.replace(led, axis=(0.0, 0.0, -1.0), position=(*led.position[:2], -15e-3)) for led in mini.lights.leds
    )
    spec = dataclasses.replace(
        mini,
        lights=dataclasses.replace(mini.lights, leds=leds),
        coat=dataclasses.replace(mini.coat, specular=0.0, reflectance=(0.2, 0.5, 0.8)),
        case=dataclasses.replace(mini.case, reflectance=0.0),
        gelpad=dataclasses.replace(mini.gelpad, dome_radius=(np.inf, np.inf)),
    )
    light = total(
        tracer(spec, integrator=integrator, spp=256 if integrator != "fast" else None, resolution=(16, 12)).render_layers(
            GelSurface.at_rest(grid_of(spec))
        )
    )[0]
    expected = np.array(spec.coat.reflectance) * sum(led.glow * np.array(led.power) for led in leds)
    # LEDs hide a little of the case, the outermost pixels see its edge; the sampled images have noise.
    np.testing.assert_allclose(light.mean((0, 1)), expected, rtol=0.02)


def test_fast_agrees_with_reference_on_an_imprint(tracer: Build) -> None:
    spec = glowing(like_a_mini())
    grid = grid_of(spec)
    pressed = surface(grid, ball(grid)[0])
    sampled = tracer(spec, integrator="reference", spp=128)
    expected, actual = total(sampled.render_layers(pressed))[0], total(tracer(spec).render_layers(pressed))[0]
    dark = total(tracer(glowing(spec, np.zeros(3))).render_layers(pressed))[0]
    assert dark.mean() < 0.9 * actual.mean(), "the glow must matter"
    # A square of 4 × 4 pixels has a quarter of a pixel's noise.
    apart = np.abs(binned(actual) - binned(expected)).mean() / expected.mean()
    assert apart < 0.015, f"{apart:.2%} of the mean radiance apart"
