"""Colour shading: the stated polynomial, the same at every resolution, found again by a fit, and in every integrator's image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytac.optics.response import fit_log_gain, shading_gain
from raytac.optics.trace.fast_tracer import total
from tests.optics.conftest import Build
from tests.optics.scenes import at_rest, ball, grid_of, like_a_mini, surface

THIRD_DEGREE = (0.1, -0.2, 0.05, 0.3, 0.15, -0.1, 0.02, 0.04, -0.06, 0.08)


def test_the_gain_is_the_stated_polynomial() -> None:
    gain = shading_gain((THIRD_DEGREE, (0.5,), ()), (40, 30))
    assert gain.shape == (30, 40, 3)
    for row, column in ((0, 0), (29, 0), (7, 31), (15, 20)):
        x, y = (column + 0.5) / 20 - 1, (row + 0.5) / 15 - 1
        t = [(1, 1), (x, y), (2 * x * x - 1, 2 * y * y - 1), (4 * x**3 - 3 * x, 4 * y**3 - 3 * y)]
        pairs = [(i, j) for i in range(4) for j in range(4 - i)]  # c_00, c_01, c_02, c_03, c_10, …
        log = sum(c * t[i][0] * t[j][1] for c, (i, j) in zip(THIRD_DEGREE, pairs, strict=True))
        np.testing.assert_allclose(gain[row, column], [np.exp(log), np.exp(0.5), 1.0], rtol=1e-12)


def test_shading_does_not_depend_on_resolution() -> None:
    """Pixels of a coarse image lie at the corners of four fine ones, so that a mean of four is theirs to second order."""
    fine = np.log(shading_gain((THIRD_DEGREE,), (320, 240)))[..., 0]
    coarse = np.log(shading_gain((THIRD_DEGREE,), (160, 120)))[..., 0]
    off = np.abs(fine.reshape(120, 2, 160, 2).mean((1, 3)) - coarse).max()
    assert 0 < off < 1e-3, off


@settings(max_examples=30, deadline=None)
@given(degree=st.integers(0, 6), seed=st.integers(0, 2**31))
def test_a_fit_finds_the_coefficients_again(degree: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    known = rng.normal(0, 0.3, (degree + 1) * (degree + 2) // 2).tolist()
    gain = shading_gain((known,), (48, 36))[..., 0]
    found = fit_log_gain(gain, rng.uniform(0.1, 10, gain.shape), degree)
    np.testing.assert_allclose(found, known, atol=1e-9)


def test_pixels_without_weight_do_not_count() -> None:
    gain = shading_gain((THIRD_DEGREE,), (48, 36))[..., 0]
    spoilt, weight = gain.copy(), np.ones_like(gain)
    spoilt[5:9, 10:14], weight[5:9, 10:14] = 100.0, 0.0
    np.testing.assert_allclose(fit_log_gain(spoilt, weight, 3), THIRD_DEGREE, atol=1e-9)
    assert np.abs(np.array(fit_log_gain(spoilt, np.ones_like(gain), 3)) - THIRD_DEGREE).max() > 0.01


def test_a_ridge_holds_what_no_pixel_tells() -> None:
    """A gain known in one corner alone: without it coefficients of a polynomial of degree six run away."""
    gain = shading_gain((THIRD_DEGREE,), (48, 36))[..., 0] * np.random.default_rng(0).uniform(0.98, 1.02, (36, 48))
    weight = np.zeros_like(gain)
    weight[:8, :8] = 1.0
    loose, held = (np.abs(fit_log_gain(gain, weight, 6, ridge=ridge)).max() for ridge in (0.0, 1e-5))
    assert held < 1 < 5 < loose, (held, loose)


@pytest.mark.parametrize("integrator", ["fast", "reference", "path"])
def test_shading_scales_linear_light_in_every_integrator(tracer: Build, integrator: str) -> None:
    """u8 = 255 (gain · even · L + black)^(1/γ) of the layers that the same tracer gives, at rest and pressed."""
    spec = like_a_mini()
    options = {} if integrator == "fast" else {"spp": 2, "resolution": (40, 30)}
    shaded = replace(spec, response=replace(spec.response, shading_red=THIRD_DEGREE, shading_blue=(-0.4,)))
    plain, mode = (tracer(one, integrator=integrator, outputs=("rgb", "layers"), **options) for one in (spec, shaded))
    grid = grid_of(spec)
    gain = shading_gain(shaded.response.shading, plain.camera.resolution)
    for press in (at_rest(grid), surface(grid, ball(grid)[0])):
        images = mode.render(press)
        assert images.layers is not None and images.rgb is not None
        linear = total(images.layers)[0]
        np.testing.assert_allclose(total(plain.render(press).layers or {})[0], linear, rtol=1e-5, atol=1e-7)
        value = plain.response.scale * gain * linear + np.array(spec.response.black_level)
        expected = 255 * np.clip(value, 0, 1) ** (1 / spec.response.gamma)
        assert np.abs(images.rgb[0] - expected).max() <= 1.0
    assert np.abs(mode.render(at_rest(grid)).rgb[0].astype(int) - plain.render(at_rest(grid)).rgb[0]).max() > 10  # type: ignore[index]
