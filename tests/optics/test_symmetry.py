"""A sensor and a press mirrored at x = 0 (or y = 0) give the mirrored image."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.optics.trace.fast_tracer import total
from raytac.specs.sensor import LightsSpec, SensorSpec, Vec3
from tests.optics.conftest import Build
from tests.optics.images import assert_images_agree, errors
from tests.optics.scenes import ball, grid_of, like_a_mini, surface


def mirrored(spec: SensorSpec, axis: int) -> SensorSpec:
    def flip(v: Vec3) -> Vec3:
        return tuple(-c if i == axis else c for i, c in enumerate(v))  # type: ignore[return-value]

    leds = tuple(replace(led, position=flip(led.position), axis=flip(led.axis)) for led in spec.lights.leds)
    return replace(spec, lights=LightsSpec(leds))


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
@pytest.mark.parametrize("bounce", [False, True], ids=["direct", "bounce"])
def test_fast_is_symmetric(tracer: Build, tmp_path: Path, bounce: bool, axis: int) -> None:
    spec = like_a_mini()
    if bounce:
        # The light of the case is fitted to random paths, which are not symmetric: leave it only the coat's own bounce.
        flat = replace(spec.gelpad, dome_radius=(math.inf, math.inf))
        spec = replace(spec, gelpad=flat, case=replace(spec.case, reflectance=0.0))
    grid = grid_of(spec)
    height, _ = ball(grid)
    image = total(tracer(spec, bounce=bounce).render_layers(surface(grid, height)))[0]
    other = total(tracer(mirrored(spec, axis), bounce=bounce).render_layers(surface(grid, np.flip(height, 1 - axis))))[0]
    assert_images_agree(np.flip(other, 1 - axis), image, tmp_path, mean=1e-6, maximum=1e-4)
    assert errors(other, image)[0] > 0.05  # the press and the lights are off centre


def test_reference_is_symmetric_within_its_noise(tracer: Build) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    height, _ = ball(grid)
    options = {"integrator": "reference", "resolution": (40, 30), "spp": 64}
    mode = tracer(spec, **options)
    image = total(mode.render_layers(surface(grid, height)))[0]
    again = total(mode.render_layers(surface(grid, height, height)))[1]  # the second of a batch has the next seed
    other = total(tracer(mirrored(spec, 0), **options).render_layers(surface(grid, np.flip(height, 1))))[0][:, ::-1]
    noise, difference = errors(again, image)[0], errors(other, image)[0]
    assert difference < 1.2 * noise, (difference, noise)
    assert other.mean() == pytest.approx(image.mean(), rel=2e-3)
