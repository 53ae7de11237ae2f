"""Contact shows, release restores the image, a batch is its environments one by one, and a seed fixes what is sampled."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.gel.surface import GelSurface
from raytac.optics.trace.sampled_tracer import image_seed
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import at_rest, ball, grid_of, like_a_mini, surface

ALL = ("rgb", "layers", "normals", "depth")
FAST = {"outputs": ALL}
REFERENCE = {"outputs": ALL, "integrator": "reference", "spp": 4}
MODES = pytest.mark.parametrize("options", [FAST, REFERENCE], ids=["fast", "reference"])
BALLS: tuple[dict[str, Any], ...] = (
    {"depth": 0.8e-3},
    {"depth": 0.4e-3, "centre": (-3e-3, 2e-3)},
    {"depth": 1.2e-3, "centre": (0.0, 0.0)},
)


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return like_a_mini()


@MODES
def test_contact_changes_the_image_and_release_restores_it(tracer: Build, spec: SensorSpec, options: dict) -> None:
    grid = grid_of(spec)
    height, contact = ball(grid)
    mode = tracer(spec, **options)
    before = mode.render(at_rest(grid))
    pressed = mode.render(surface(grid, height, contact=contact))
    after = mode.render(at_rest(grid))
    assert before.rgb is not None and pressed.rgb is not None and after.rgb is not None
    assert pressed.contact is not None and before.contact is not None
    touched = pressed.contact[0]
    assert 0.005 < touched.mean() < 0.5 and not before.contact.any()
    change = np.abs(pressed.rgb[0].astype(int) - before.rgb[0]).mean(axis=-1)
    assert change[touched].mean() > 8, change[touched].mean()
    far = np.hypot(*np.indices(touched.shape) - np.argwhere(touched).mean(0)[:, None, None]) > 35
    assert change[far].mean() < (0.5 if options is FAST else 0.5 * change[touched].mean())
    assert after.layers is not None and before.layers is not None
    if options is FAST:
        np.testing.assert_array_equal(after.rgb, before.rgb)
    for name, layer in before.layers.items():
        # To the last bit, but for the last bit of the trees and normals that Mitsuba rebuilds with several threads.
        np.testing.assert_allclose(after.layers[name], layer, rtol=0 if options is FAST else 1e-6, err_msg=name)


@MODES
def test_a_batch_is_its_environments_one_by_one(tracer: Build, spec: SensorSpec, options: dict) -> None:
    grid = grid_of(spec)
    heights = [ball(grid, **options)[0] for options in BALLS]
    together = tracer(spec, **options).render(surface(grid, *heights))
    for b, height in enumerate(heights):
        # Environment b of a sampled integrator has its own stream.
        alone = tracer(spec, **options, **({} if options is FAST else {"seed": image_seed(0, b)})).render(surface(grid, height))
        for name in ("rgb", "normals", "position", "depth", "contact"):
            many, one = getattr(together, name), getattr(alone, name)
            assert many.shape == (3, *one.shape[1:])
            if options is FAST or name != "rgb":
                np.testing.assert_array_equal(many[b], one[0], err_msg=f"{name} of environment {b}")
            else:  # built as another kernel, which may round otherwise
                assert np.abs(many[b].astype(int) - one[0]).max() <= 1
        assert together.layers is not None and alone.layers is not None
        for name, layer in together.layers.items():
            if options is FAST:
                np.testing.assert_array_equal(layer[b], alone.layers[name][0], err_msg=f"layer {name} of environment {b}")
            else:
                np.testing.assert_allclose(layer[b], alone.layers[name][0], rtol=1e-5, atol=1e-9)


def test_the_size_of_a_batch_may_change(tracer: Build, spec: SensorSpec) -> None:
    grid = grid_of(spec)
    mode = tracer(spec, **FAST)
    heights = [ball(grid, **options)[0] for options in BALLS]
    images = [mode.render(surface(grid, *heights[:n])).rgb for n in (1, 3, 2, 1)]
    for image in images:
        assert image is not None
        np.testing.assert_array_equal(image[0], images[0][0])  # type: ignore[index]


def test_a_surface_may_come_in_any_layout(tracer: Build, spec: SensorSpec) -> None:
    grid = grid_of(spec)
    mode = tracer(spec, **FAST)
    plain = surface(grid, ball(grid)[0])
    odd = GelSurface(grid, np.asfortranarray(plain.height.astype(np.float64)), plain.contact, plain.contact_centre)
    np.testing.assert_array_equal(mode.render(odd).rgb, mode.render(plain).rgb)
