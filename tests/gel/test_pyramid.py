"""The grid, the Gaussians and the elastic surround."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel import pyramid
from raytac.gel.gaussian import GaussianBlur, gaussian_matrix
from raytac.gel.pyramid import CONTACT_SCALE, ComposedGaussians, ElasticSurround, LocalField, WholeField
from raytac.gel.surface import GelSurface, make_grid, rest_height
from raytac.shapes.part import primitive
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

PAD = GelpadSpec((16e-3, 12e-3), 4e-3, (0.21, 0.135), 2e5, 0.48, 1000.0, 0.8)


def press_sphere(
    pitch: float,
    *,
    radius: float = 4e-3,
    depth: float = 0.6e-3,
    at: tuple[float, float] = (0.0, 0.0),
    rule: str = "unilateral",
) -> GelSurface:
    grid = make_grid(PAD, pitch)
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = *at, radius - depth
    surround = ElasticSurround(grid, contact_rule=rule)
    return surround.surface(object_height([primitive("sphere", (radius,))], pose, grid.x, grid.y), pose)


def test_grid_covers_the_pad_and_follows_the_dome() -> None:
    grid = make_grid(PAD, 0.0634e-3)
    assert grid.shape == (190, 253)
    np.testing.assert_allclose([grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]], [-8e-3, 8e-3, -6e-3, 6e-3])
    assert rest_height(PAD, np.zeros(1), np.zeros(1))[0] == 0.0
    assert (grid.rest <= 0.0).all()
    edge = rest_height(PAD, np.array([8e-3]), np.array([0.0]))[0]
    assert math.isclose(8e-3**2 + (0.21 + edge) ** 2, 0.21**2, rel_tol=1e-12)  # on the circle of radius 0.21 m
    flat = make_grid(GelpadSpec((16e-3, 12e-3), 4e-3, (math.inf, math.inf), 2e5, 0.48, 1000.0, 0.8), 1e-4)
    assert not flat.rest.any()


@pytest.mark.parametrize("pitch", [0.0, -1e-3, math.nan, math.inf, 9e-3])
def test_impossible_pitch_is_refused(pitch: float) -> None:
    with pytest.raises(InputError, match="pitch"):
        make_grid(PAD, pitch)


@pytest.mark.parametrize("width", [0.3, 0.7, 1.5, 3.7, 5.9, 8.0, 14.0])
def test_gaussian_has_its_variance_and_mirrors(width: float) -> None:
    nodes = 161
    matrix = gaussian_matrix(nodes, width)
    offset = np.arange(nodes) - 80.0
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-12)
    assert math.isclose(matrix[80] @ offset**2, width**2, rel_tol=1e-4)
    k = 7  # cosines mirrored about the end nodes are its eigenvectors, also at the border
    wave = np.cos(math.pi * k * np.arange(nodes) / (nodes - 1))
    np.testing.assert_allclose(matrix @ wave, math.exp(width**2 * (math.cos(math.pi * k / (nodes - 1)) - 1.0)) * wave, atol=1e-12)


@pytest.mark.parametrize("width", [0.3, 1.1, 3.7, 5.9, 6.1, 14.0])
def test_fast_products_equal_the_dense_matrix(width: float) -> None:
    field = np.random.default_rng(0).normal(size=(70, 91)).astype(np.float32)
    dense = gaussian_matrix(70, width) @ field @ gaussian_matrix(91, width).T
    np.testing.assert_allclose(GaussianBlur((70, 91), (1e-4, 1e-4), width * 1e-4)(field), dense, atol=3e-6)


def test_wide_gaussian_agrees_with_scipy() -> None:
    from scipy.ndimage import gaussian_filter

    field = np.random.default_rng(1).normal(size=(120, 150)).astype(np.float32)
    expected = gaussian_filter(field.astype(float), 12.0, mode="mirror", truncate=6.0)
    np.testing.assert_allclose(GaussianBlur((120, 150), (1.0, 1.0), 12.0)(field), expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("final", [True, False])
@pytest.mark.parametrize("corner", [(0, 0), (31, 40), (45, 70)])
def test_a_field_followed_locally_is_that_of_the_whole_grid(corner: tuple[int, int], final: bool) -> None:
    """Also where Gaussians are mirrored at the borders, and for any rule by which the field is set again."""
    shape, pitch, sigmas = (60, 84), (1e-4, 0.9e-4), (8e-4, 3e-4, 1e-4, 0.4e-4)
    touched = slice(corner[0], corner[0] + 13), slice(corner[1], corner[1] + 9)
    window = slice(0, 60), slice(0, 84)
    rng = np.random.default_rng(3)
    values = rng.uniform(0.0, 1.0, (13, 9)).astype(np.float32)
    blurs = [GaussianBlur(shape, pitch, s) for s in sigmas]
    whole = WholeField(values, touched, window, blurs[:3], blurs[3] if final else None)
    local = LocalField(values, touched, ComposedGaussians(shape, pitch, sigmas), 3, final, 4.8)
    for _ in range(3):
        one, other = whole.smooth(), local.smooth()
        np.testing.assert_allclose(other, one, atol=5e-6)
        laid = np.where(rng.uniform(size=one.shape) < 0.5, values, one)
        whole.impose(laid.copy())
        local.impose(laid)
    np.testing.assert_allclose(local.over(window), whole.over(window), atol=1e-5)
    assert whole.over(window).max() > 0.5


def test_small_and_large_contacts_are_smoothed_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    for rule in ("unilateral", "threshold"):
        for at in ((0.0, 0.0), (6e-3, -4.5e-3)):
            local = press_sphere(0.1e-3, at=at, rule=rule)
            with monkeypatch.context() as patch:
                patch.setattr(ComposedGaussians, "fits", False)
                whole = press_sphere(0.1e-3, at=at, rule=rule)
            assert not np.array_equal(local.height, whole.height)  # they went two ways
            np.testing.assert_allclose(local.height, whole.height, rtol=0.0, atol=1e-5 * 0.6e-3)
            np.testing.assert_array_equal(local.contact, whole.contact)
            np.testing.assert_allclose(local.contact_centre, whole.contact_centre, rtol=0.0, atol=1e-9)


def test_no_contact_is_exactly_rest() -> None:
    grid = make_grid(PAD, 0.2e-3)
    surface = ElasticSurround(grid).surface(np.full((2, *grid.shape), np.inf))
    np.testing.assert_array_equal(surface.height, np.broadcast_to(grid.rest.astype(np.float32), surface.height.shape))
    assert not surface.contact.any() and np.isnan(surface.contact_centre).all()
    assert np.array_equal(press_sphere(0.2e-3, depth=-1e-6).height[0], grid.rest.astype(np.float32))


def test_gel_never_reaches_into_the_object() -> None:
    radius, depth = 4e-3, 0.6e-3
    grid = make_grid(PAD, 0.1e-3)
    sphere = radius - depth - np.sqrt(np.maximum(radius**2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2, 0.0))
    sphere = np.where(np.hypot(grid.x[None, :], grid.y[:, None]) < radius, sphere, np.inf)
    surface = ElasticSurround(grid, final_sigma=0.0).surface(sphere[None])
    gap = sphere - surface.height[0].astype(float)
    contact = surface.contact[0]
    assert gap.min() > -1e-9, f"the gel reaches {-gap.min():.2e} m into the sphere"
    assert np.abs(gap[contact]).max() < 1.01e-5 * depth and gap[~contact & np.isfinite(gap)].min() > 1e-5 * depth - 1e-9
    area = contact.sum() * grid.pitch[0] * grid.pitch[1]
    overlap_area = math.pi * (radius**2 - (radius - depth) ** 2)
    # Hertz's contact has half the area of the overlap with the resting surface; the Gaussians' is between the two.
    assert 0.5 * overlap_area < area < overlap_area
    assert np.abs(np.diff(surface.height[0].astype(float), axis=1)).max() < 0.1e-3  # no step anywhere: slope below 1


@pytest.mark.parametrize("depth", [1e-7, 0.05e-3, 0.3e-3, 0.7e-3, 1.5e-3])
def test_flat_punch_on_a_flat_pad_is_all_contact(depth: float) -> None:
    """Constant overlap: every Gaussian keeps it in the middle, so rounding must not decide which nodes touch."""
    grid = make_grid(dataclasses.replace(PAD, dome_radius=(math.inf, math.inf)), 0.1e-3)
    off_axis = np.hypot(grid.x[None, :] - 1e-3, grid.y[:, None] + 0.5e-3)
    punch = off_axis <= 4e-3
    surface = ElasticSurround(grid).surface(np.where(punch, -depth, np.inf)[None])
    np.testing.assert_array_equal(surface.contact[0], punch)
    np.testing.assert_allclose(surface.contact_centre[0], (1e-3, -0.5e-3), atol=0.02e-3)


@pytest.mark.parametrize("depth", [1e-40, 1e-12, 0.7e-3])
def test_a_slab_over_the_whole_pad_has_a_centre(depth: float) -> None:
    grid = make_grid(dataclasses.replace(PAD, dome_radius=(math.inf, math.inf)), 0.2e-3)
    surface = ElasticSurround(grid).surface(np.full((1, *grid.shape), -depth))
    assert surface.contact.all()
    np.testing.assert_allclose(surface.contact_centre[0], 0.0, atol=1e-9)


def test_unknown_contact_rule_is_refused() -> None:
    with pytest.raises(InputError, match="unilateral"):
        ElasticSurround(make_grid(PAD, 0.5e-3), contact_rule="hard")


def test_threshold_rule_follows_the_object_and_the_surround_is_smooth() -> None:
    radius, depth = 4e-3, 0.6e-3
    surface = press_sphere(0.1e-3, radius=radius, depth=depth, rule="threshold")
    grid, found = surface.grid, surface.height[0]
    sphere = radius - depth - np.sqrt(np.maximum(radius**2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2, 0.0))
    overlap = grid.rest - sphere
    expected = (overlap > CONTACT_SCALE * overlap.max()) & (np.hypot(grid.x[None, :], grid.y[:, None]) < radius)
    np.testing.assert_array_equal(surface.contact[0], expected)
    unsmoothed = ElasticSurround(grid, final_sigma=0.0, contact_rule="threshold").surface(sphere[None].astype(float))
    np.testing.assert_allclose(unsmoothed.height[0][expected], sphere[expected], atol=1e-9)
    deep = overlap > 0.55 * overlap.max()
    # The last smoothing lifts a paraboloid of curvature 1/R by σ²/R.
    np.testing.assert_allclose(found[deep], sphere[deep] + 0.03245e-3**2 / radius, atol=0.05e-6)
    indentation = surface.indentation[0]
    ring = ~expected & (np.hypot(grid.x[None, :], grid.y[:, None]) < 3e-3)
    assert indentation[ring].min() > 1e-6  # the gel around the contact sinks with it
    assert indentation.max() < depth and indentation.min() > -1e-8
    assert np.abs(indentation[:, 0]).max() < 0.02 * depth


def test_symmetric_press_gives_symmetric_surface() -> None:
    surface = press_sphere(0.1e-3)
    height = surface.height[0]
    np.testing.assert_allclose(height, height[::-1], atol=1e-9)
    np.testing.assert_allclose(height, height[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(surface.contact_centre, 0.0, atol=1e-12)


def test_contact_centre_is_below_the_sphere() -> None:
    surface = press_sphere(0.1e-3, at=(2e-3, -1e-3))
    np.testing.assert_allclose(surface.contact_centre[0], (2e-3, -1e-3), atol=0.05e-3)


def test_finer_grid_converges_to_one_surface() -> None:
    coarse, middle, fine = (press_sphere(pitch).height[0].astype(float) for pitch in (0.2e-3, 0.1e-3, 0.05e-3))
    first, second = np.abs(coarse - middle[::2, ::2]), np.abs(middle - fine[::2, ::2])
    assert np.sqrt(np.mean(second**2)) < 0.8 * np.sqrt(np.mean(first**2))
    assert np.sqrt(np.mean(second**2)) < 3e-4 * 0.6e-3 and second.max() < 0.02 * 0.6e-3


def test_environments_pressed_together_are_as_each_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the whole pad in one call, on a coarse grid, or around each contact, on a fine one: the same to rounding."""
    grid = make_grid(PAD, 0.3e-3)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :2, 3] = [(0.0, 0.0), (6e-3, 4e-3), (-3e-3, 1e-3), (0.0, 0.0), (8e-3, -6e-3)]
    poses[:, 2, 3] = 3.5e-3, 3.2e-3, 3.9e-3, 5.0e-3, 3.5e-3
    heights = object_height([primitive("sphere", (4e-3,))], poses, grid.x, grid.y)
    heights[2] = np.minimum(heights[2], -0.2e-3)  # as wide as the pad
    for rule in ("unilateral", "threshold"):
        together = ElasticSurround(grid, contact_rule=rule, final_sigma=0.1e-3).surface(heights)
        with monkeypatch.context() as patch:
            patch.setattr(pyramid, "_TOGETHER", 0)
            each = ElasticSurround(grid, contact_rule=rule, final_sigma=0.1e-3).surface(heights)
        assert not together.contact[3].any() and together.contact[[0, 1, 2, 4]].any(axis=(1, 2)).all()
        np.testing.assert_allclose(together.height, each.height, atol=2e-9, rtol=0.0)
        np.testing.assert_array_equal(together.contact, each.contact)
        np.testing.assert_allclose(together.contact_centre, each.contact_centre, atol=1e-12, rtol=0.0)


@pytest.mark.parametrize("pitch", [0.15e-3, 0.4e-3])
def test_batch_equals_single_bit_for_bit_and_nan_stays_alone(pitch: float) -> None:
    grid = make_grid(PAD, pitch)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0.0, 1e-3, np.nan
    poses[:, 2, 3] = 3.5e-3, 3.2e-3, 3.5e-3
    heights = object_height([primitive("sphere", (4e-3,))], poses, grid.x, grid.y)
    surround = ElasticSurround(grid)
    together = surround.surface(heights, poses)
    for b in range(2):
        alone = surround.surface(heights[b : b + 1])
        np.testing.assert_array_equal(together.height[b], alone.height[0])
        np.testing.assert_array_equal(together.contact[b], alone.contact[0])
        np.testing.assert_array_equal(together.contact_centre[b], alone.contact_centre[0])
    assert np.isnan(together.height[2]).all() and not together.contact[2].any()
