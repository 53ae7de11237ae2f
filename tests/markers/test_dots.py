"""Dots in images: ink on the pad, and what each optical mode makes of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.pattern import MarkerPattern, dot_ink
from raytac.optics import Phong, RayTraced
from raytac.optics.image.phong import PhongMode
from raytac.specs import SensorSpec

SIZE = (160, 120)


def test_ink_covers_the_area_of_the_dots(sensor: SensorSpec, grid: PadGrid) -> None:
    pattern = MarkerPattern.of(sensor)
    ink = dot_ink(grid, pattern.rest, pattern.radius)
    dx, dy = grid.pitch
    assert ink.shape == (1, *grid.shape) and ink.min() == 0 and ink.max() == 1
    assert ink.sum() * dx * dy == pytest.approx(99 * np.pi * pattern.radius**2, rel=0.02)


def test_ink_moves_with_its_dot(grid: PadGrid) -> None:
    at = np.array([[[1.234e-3, -2.345e-3]], [[-3.21e-3, 0.5e-3]], [[np.nan, 0.0]]])
    ink = dot_ink(grid, at, 0.4e-3)
    x, y = np.meshgrid(grid.x, grid.y)
    for b in range(2):
        weight = ink[b] / ink[b].sum()
        assert (weight * x).sum() == pytest.approx(at[b, 0, 0], abs=2e-6)
        assert (weight * y).sum() == pytest.approx(at[b, 0, 1], abs=2e-6)
    assert not ink[2].any()


def test_dots_over_one_another_leave_the_darkest(grid: PadGrid) -> None:
    at = 1e-3 * np.array([[0.0, 0.0], [0.35, 0.0], [0.1, 0.3], [0.05, 0.02], [5.0, 0.0]])
    alone = np.stack([dot_ink(grid, one[None, None], 0.4e-3)[0] for one in at])
    for order in (slice(None), slice(None, None, -1)):
        np.testing.assert_array_equal(dot_ink(grid, at[None, order], 0.4e-3)[0], alone.max(axis=0))
    assert (np.count_nonzero(alone, axis=0) > 2).any()


def test_a_dot_over_the_edge_is_cut_off(grid: PadGrid) -> None:
    half = dot_ink(grid, np.array([[[float(grid.x[-1]), 0.0]]]), 0.5e-3)
    whole = dot_ink(grid, np.array([[[0.0, 0.0]]]), 0.5e-3)
    assert half.sum() == pytest.approx(0.5 * whole.sum(), rel=0.15)


@pytest.fixture(scope="module")
def dotted(sensor: SensorSpec, grid: PadGrid) -> tuple[GelSurface, GelSurface, np.ndarray]:
    """The untouched pad plain and dotted, and the pixels at the dots' centres."""
    pattern = MarkerPattern.of(sensor, SIZE)
    plain = GelSurface.at_rest(grid)
    pixel = np.floor(pattern.pixel[0]).astype(int)
    return plain, replace(plain, ink=dot_ink(grid, pattern.rest, pattern.radius)), pixel


@pytest.mark.parametrize("integrator", ["fast", "reference", "path"])
def test_ray_traced_dots(integrator: Any, sensor: SensorSpec, dotted: tuple[GelSurface, GelSurface, np.ndarray]) -> None:
    """On a Lambertian coat under direct light a dot returns its share of albedo, and nothing changes beside it."""
    lambertian = replace(sensor, coat=replace(sensor.coat, specular=0.0))
    spp, depth = (None, -1) if integrator == "fast" else (16, 1 if integrator == "reference" else 2)
    tracer = RayTraced(integrator=integrator, spp=spp, max_depth=depth, bounce=False).build(
        lambertian, resolution=SIZE, outputs=("layers",), device="cpu"
    )
    plain, dots, (u, v) = dotted[0], dotted[1], dotted[2].T
    before, after = (sum(tracer.render_layers(surface).values())[0] for surface in (plain, dots))  # type: ignore[index]
    share = sensor.markers.reflectance / sensor.coat.reflectance[0]
    assert after[v, u].mean() / before[v, u].mean() == pytest.approx(share, rel=0.05 if integrator == "fast" else 0.15)
    beside = np.ones(before.shape[:2], bool)
    for du in range(-4, 5):
        for dv in range(-4, 5):
            beside[np.clip(v + dv, 0, SIZE[1] - 1), np.clip(u + du, 0, SIZE[0] - 1)] = False
    np.testing.assert_allclose(after[beside], before[beside], rtol=1e-4, atol=1e-6)


def test_a_batch_with_dots_is_single(sensor: SensorSpec, dotted: tuple[GelSurface, GelSurface, np.ndarray]) -> None:
    tracer = RayTraced(bounce=False).build(sensor, resolution=SIZE, device="cpu")
    plain, dots, _ = dotted
    assert dots.ink is not None
    both = replace(
        dots,
        height=np.repeat(dots.height, 2, axis=0),
        contact=np.repeat(dots.contact, 2, axis=0),
        contact_centre=np.repeat(dots.contact_centre, 2, axis=0),
        ink=np.concatenate([np.zeros_like(dots.ink), dots.ink]),
    )
    together = tracer.render(both).rgb
    alone = [tracer.render(surface).rgb for surface in (plain, dots)]
    assert together is not None and alone[0] is not None and alone[1] is not None
    np.testing.assert_array_equal(together[0], alone[0][0])
    np.testing.assert_array_equal(together[1], alone[1][0])
    assert np.abs(together[1].astype(int) - together[0]).max() > 20


@pytest.fixture(scope="module")
def mode(sensor: SensorSpec) -> PhongMode:
    return Phong().build(sensor, resolution=SIZE, device="cpu")


def test_dots_of_a_mode_that_knows_levels_only(
    mode: PhongMode, sensor: SensorSpec, dotted: tuple[GelSurface, GelSurface, np.ndarray]
) -> None:
    plain, dots, (u, v) = dotted[0], dotted[1], dotted[2].T
    before, after = (mode.render_levels(surface)[0] for surface in (plain, dots))
    s, q = sensor.coat.specular, 0.57
    share = ((1 - s) * sensor.markers.reflectance + s * q) / ((1 - s) * sensor.coat.reflectance[0] + s * q)
    gamma, black = sensor.response.gamma, np.array(sensor.response.black_level)
    light = (before[v, u] / 255) ** gamma - black  # light that no press changes does not come from the coat
    np.testing.assert_allclose(after[v, u], 255 * (black + share * light) ** (1 / gamma), rtol=0.01)
    assert (after <= before + 1e-3).all() and (after == before).mean() > 0.5
    rgb = mode.render(dots).rgb
    assert rgb is not None and np.abs(rgb[0] - np.clip(after, 0, 255)).max() <= 0.51


@pytest.mark.parametrize("ink", [np.zeros((1, 3, 3)), None], ids=["shape", "range"])
def test_ink_that_cannot_be(mode: PhongMode, ink: np.ndarray | None, grid: PadGrid) -> None:
    bad = np.full((1, *grid.shape), 1.5) if ink is None else ink
    with pytest.raises(InputError, match=r"surface\.ink"):
        mode.render(replace(GelSurface.at_rest(grid), ink=bad))
