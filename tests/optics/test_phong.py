"""Phong's model against a NumPy implementation of its formula, and what light must do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import convolve1d, gaussian_filter

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.optics import PHONG_LIGHTS, Phong, PhongLight
from raytac.specs.sensor import SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import RESOLUTION, at_rest, ball, grid_of, like_a_mini, lit_from_three_sides, relief, sensor, surface


@pytest.fixture(scope="module")
def spec() -> SensorSpec:
    return sensor(lit_from_three_sides())


@pytest.fixture(scope="module")
def grid(spec: SensorSpec) -> PadGrid:
    return grid_of(spec)


def background() -> np.ndarray:
    return np.random.default_rng(0).integers(40, 200, (RESOLUTION[1], RESOLUTION[0], 3)).astype(np.uint8)


def published(h: np.ndarray, moved: np.ndarray, rest: np.ndarray, lights: tuple[PhongLight, ...]) -> np.ndarray:
    """The paper's image of heights ``h`` [px] towards the camera and indentation ``moved`` [m], float64; slopes repeated on the rim."""
    sy, sx = (np.pad((a - b) / 2, 1, mode="edge") for a, b in ((h[2:, 1:-1], h[:-2, 1:-1]), (h[1:-1, 2:], h[1:-1, :-2])))
    n = np.stack([sx, sy, np.ones_like(sx)], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)

    def overlay(below: np.ndarray, alpha: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
        return (
            np.clip((1 - alpha[..., None]) * below + alpha[..., None] * np.array(colour), 0, 255).astype(np.uint8).astype(float)
        )

    out = overlay(0.8 * rest, np.clip(moved / 4e-3, 0, 1), (0, 0, 0))
    for light in lights:
        direction = np.array(light.direction)
        dot = n @ direction
        mirrored = (2 * dot[..., None] * n - direction)[..., 2]
        out = overlay(out, light.diffuse * np.maximum(dot, 0) + light.specular * mirrored**5, light.colour)
    delta = np.zeros((3, 3))
    delta[1, 1] = 1
    taps = gaussian_filter(delta, 1).sum(axis=0)
    for axis in (0, 1):
        out = convolve1d(out, taps, axis=axis, mode="mirror")
    return np.rint(out)


@pytest.mark.parametrize("lights", PHONG_LIGHTS)
def test_it_is_the_published_formula(spec: SensorSpec, grid: PadGrid, lights: str) -> None:
    mode = Phong(lights=lights, background=background()).build(spec, resolution=RESOLUTION, device="cpu")
    surfaces = surface(grid, ball(grid)[0], relief(grid))
    heights, moved = mode.image_heights(surfaces)
    rgb = mode.render(surfaces).rgb
    assert rgb is not None
    for b in range(2):
        expected = published(heights[b].astype(float), moved[b] * mode.pitch[0], background(), PHONG_LIGHTS[lights])
        difference = np.abs(rgb[b] - expected)
        # float32 may fall on the other side of a truncation or rounding.
        assert difference.max() <= 1 and (difference > 0).mean() < 0.01
        assert np.abs(expected - background()).max() > 30


def test_a_slope_shows_the_light_that_it_rises_towards(spec: SensorSpec, grid: PadGrid) -> None:
    """Two lights from left and right: the sides of an imprint take their colours, mirrored in a mirrored press."""
    lights = (PhongLight((-1, 0, 0.25), (255, 0, 0), 0.5, 0.0), PhongLight((1, 0, 0.25), (0, 0, 255), 0.5, 0.0))
    grey = np.full((RESOLUTION[1], RESOLUTION[0], 3), 100, np.uint8)
    mode = Phong(lights=lights, background=grey).build(spec, resolution=RESOLUTION, device="cpu")
    rgb = mode.render(surface(grid, ball(grid, centre=(0.0, 0.0))[0])).rgb
    assert rgb is not None
    row = rgb[0, RESOLUTION[1] // 2].astype(int)
    red = row[:, 0] - row[:, 2]
    # Their normal leans as that of the depth image: where the gel rises to the right, the light on the right shines.
    assert red[: RESOLUTION[0] // 2].min() < -20 and red[RESOLUTION[0] // 2 :].max() > 20


@pytest.mark.slow
def test_the_rest_image_of_the_ray_tracer_is_the_background(tracer: Build, grid: PadGrid, spec: SensorSpec) -> None:
    lit = replace(spec, response=replace(spec.response, exposure=12.0))
    dark = (PhongLight((0, 0, 1), (0, 0, 0), 0.0, 0.0),)
    image = Phong(lights=dark).build(lit, resolution=RESOLUTION, device="cpu").render(at_rest(grid)).rgb
    traced = tracer(lit).render(at_rest(grid)).rgb
    assert image is not None and traced is not None and traced.max() > 50
    inner = np.s_[0, 5:-5, 5:-5]
    assert np.abs(image[inner] - 0.8 * traced[inner].astype(float)).max() < 2


def test_a_batch_is_its_single_images() -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    mode = Phong(background=background()).build(spec, resolution=RESOLUTION, device="cpu")
    batch = mode.render(surface(grid, ball(grid)[0], grid.rest, relief(grid))).rgb
    assert batch is not None
    for b, height in enumerate((ball(grid)[0], grid.rest, relief(grid))):
        one = mode.render(surface(grid, height)).rgb
        assert one is not None
        np.testing.assert_array_equal(batch[b], one[0])
    assert (batch[0] != batch[1]).any() and (batch[1] != batch[2]).any()


def test_wrong_lights_and_backgrounds_are_refused(spec: SensorSpec) -> None:
    with pytest.raises(InputError, match=r"lights.*gelsight2014, gelsight2017, gazebo"):
        Phong(lights="gelsight").build(spec, resolution=RESOLUTION, device="cpu")
    with pytest.raises(InputError, match="finite"):
        Phong(lights=(PhongLight((0, 0, np.nan), (0, 0, 0), 1, 1),)).build(spec, resolution=RESOLUTION, device="cpu")
    with pytest.raises(InputError, match=r"background.*\(60, 80, 3\)"):
        Phong(background=np.zeros((3, 3, 3), np.uint8)).build(spec, resolution=RESOLUTION, device="cpu")
    with pytest.raises(InputError, match="background = 'list'"):
        Phong(background=[[0]]).build(spec, resolution=RESOLUTION, device="cpu")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"lights = 3.*gelsight2014"):
        Phong(lights=3).build(spec, resolution=RESOLUTION, device="cpu")  # type: ignore[arg-type]
