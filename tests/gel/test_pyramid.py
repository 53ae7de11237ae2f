"""The grid, the Gaussians and the elastic surround."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel import pyramid
from raytac.gel.gaussian import CONTACT_SCALE, FINAL_SIGMA, LAYER_STEPS, PYRAMID_SIGMAS, gaussian_matrix
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid, make_grid, rest_height
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
    surround = ElasticSurround(grid, thickness=PAD.thickness, contact_rule=rule)
    return surround.surface(object_height([primitive("sphere", (radius,))], pose, grid.x, grid.y), pose)


def gaussian_by_cosines(nodes: int, width: float) -> np.ndarray:
    """exp(½ width² L), L the second difference with mirrored ends, by its eigenvectors: cosines along the line."""
    k = np.arange(nodes)
    cosines = np.cos(math.pi / (nodes - 1) * np.outer(k, k))
    weight = np.where((k == 0) | (k == nodes - 1), 0.5, 1.0)
    gain = np.exp(width**2 * (np.cos(math.pi * k / (nodes - 1)) - 1.0))
    return (cosines * gain) @ (2.0 / (nodes - 1) * weight[:, None] * cosines.T * weight)


def pyramid_by_definition(grid: PadGrid, under: np.ndarray, rule: str, final: float) -> tuple[np.ndarray, np.ndarray]:
    """Height and contact (Ny, Nx) of one pad: dense products in double precision on the whole grid."""
    finest, u = 0.2 * min(grid.pitch), grid.rest - under
    w, full = np.maximum(u, 0.0), u > CONTACT_SCALE * u.max()

    def smooth(field: np.ndarray, sigma: float) -> np.ndarray:
        along_y, along_x = (gaussian_by_cosines(n, sigma / d) for n, d in zip(grid.shape, reversed(grid.pitch), strict=True))
        return along_y @ field @ along_x.T

    taxim, layer = [(sigma, 1.0) for sigma in PYRAMID_SIGMAS], [(share * PAD.thickness, gain) for share, gain in LAYER_STEPS]
    for sigma, gain in layer if rule == "unilateral" else taxim:
        if rule == "unilateral" or sigma > finest:
            w = gain * smooth(w, sigma if sigma > finest else 0.0)
            w = np.maximum(w, u) if rule == "unilateral" else np.where(full, u, w)
    contact = (u > 0.0) & (w <= u + 1e-5 * u.max()) if rule == "unilateral" else full
    return grid.rest - (smooth(w, final) if final > finest else w), contact


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
    matrix, reach = gaussian_matrix(nodes, width, tail=1e-15)
    offset = np.arange(nodes) - 80.0
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-12)
    assert math.isclose(matrix[80] @ offset**2, width**2, rel_tol=1e-4)
    np.testing.assert_allclose(matrix, gaussian_by_cosines(nodes, width), atol=1e-12)
    narrow, less = gaussian_matrix(nodes, width)
    assert less < reach and np.abs(narrow - matrix).max() < 2e-6 * matrix.max() and not narrow[80, : 80 - less].any()


def test_a_gaussian_wider_than_its_line_is_mirrored_again_and_again() -> None:
    np.testing.assert_allclose(gaussian_matrix(9, 6.0, tail=1e-15)[0], gaussian_by_cosines(9, 6.0), atol=1e-12)


def test_wide_gaussian_agrees_with_scipy() -> None:
    from scipy.ndimage import gaussian_filter

    field = np.random.default_rng(1).normal(size=(120, 150))
    expected = gaussian_filter(field, 12.0, mode="mirror", truncate=6.0)
    smooth = gaussian_matrix(120, 12.0)[0] @ field @ gaussian_matrix(150, 12.0)[0].T
    np.testing.assert_allclose(smooth, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("rule", ["unilateral", "threshold"])
@pytest.mark.parametrize("pitch", [0.45e-3, 0.2e-3, 0.09e-3])
def test_surfaces_are_those_of_the_definition(pitch: float, rule: str) -> None:
    """Balls in the middle, on an edge and in a corner, a box that turns up late in the batch, and a plate wider than the pad."""
    grid, poses = make_grid(PAD, pitch), np.tile(np.eye(4), (4, 1, 1))
    poses[:, :2, 3] = [(0.0, 0.0), (7.9e-3, 1e-3), (-8e-3, 6e-3), (3e-3, -2e-3)]
    poses[:, 2, 3] = 3.5e-3, 3.2e-3, 3.3e-3, 0.6e-3
    heights = object_height([primitive("sphere", (4e-3,))], poses, grid.x, grid.y)
    heights[3] = object_height([primitive("box", (2e-3, 3e-3, 1e-3))], poses[3:], grid.x, grid.y)[0]
    heights = np.concatenate([heights, np.full((1, *grid.shape), -0.2e-3)])
    final = 2.0 * FINAL_SIGMA
    surface = ElasticSurround(grid, thickness=PAD.thickness, contact_rule=rule, final_sigma=final, num_envs=2).surface(heights)
    for b, under in enumerate(heights):
        height, contact = pyramid_by_definition(grid, under, rule, final)
        np.testing.assert_allclose(surface.height[b], height, rtol=0.0, atol=2e-9)
        assert (surface.contact[b] != contact).sum() <= 2 and contact.any()
        weight = np.where(surface.contact[b], grid.rest - under, 0.0)
        centre = [(weight.sum(axis=0) @ grid.x) / weight.sum(), (weight.sum(axis=1) @ grid.y) / weight.sum()]
        np.testing.assert_allclose(surface.contact_centre[b], centre, rtol=0.0, atol=1e-9)


def test_no_contact_is_exactly_rest() -> None:
    grid = make_grid(PAD, 0.2e-3)
    surface = ElasticSurround(grid, thickness=PAD.thickness).surface(np.full((2, *grid.shape), np.inf))
    np.testing.assert_array_equal(surface.height, np.broadcast_to(grid.rest.astype(np.float32), surface.height.shape))
    assert not surface.contact.any() and np.isnan(surface.contact_centre).all()
    assert np.array_equal(press_sphere(0.2e-3, depth=-1e-6).height[0], grid.rest.astype(np.float32))


def test_gel_never_reaches_into_the_object() -> None:
    radius, depth = 4e-3, 0.6e-3
    grid = make_grid(PAD, 0.1e-3)
    sphere = radius - depth - np.sqrt(np.maximum(radius**2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2, 0.0))
    sphere = np.where(np.hypot(grid.x[None, :], grid.y[:, None]) < radius, sphere, np.inf)
    surface = ElasticSurround(grid, thickness=PAD.thickness, final_sigma=0.0).surface(sphere[None])
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
    surface = ElasticSurround(grid, thickness=PAD.thickness).surface(np.where(punch, -depth, np.inf)[None])
    np.testing.assert_array_equal(surface.contact[0], punch)
    np.testing.assert_allclose(surface.contact_centre[0], (1e-3, -0.5e-3), atol=0.02e-3)


@pytest.mark.parametrize("depth", [1e-40, 1e-12, 0.7e-3])
def test_a_slab_over_the_whole_pad_has_a_centre(depth: float) -> None:
    grid = make_grid(dataclasses.replace(PAD, dome_radius=(math.inf, math.inf)), 0.2e-3)
    surface = ElasticSurround(grid, thickness=PAD.thickness).surface(np.full((1, *grid.shape), -depth))
    assert surface.contact.all()
    np.testing.assert_allclose(surface.contact_centre[0], 0.0, atol=1e-9)


@pytest.mark.parametrize("final", [0.0, 0.5e-3])
def test_without_gaussians_the_surface_is_the_objects(final: float) -> None:
    """Or with the last one alone; the contact is the overlap."""
    grid = make_grid(PAD, 0.25e-3)
    under = object_height([primitive("sphere", (4e-3,))], np.eye(4)[None], grid.x, grid.y) + 3.4e-3
    surface = ElasticSurround(grid, thickness=PAD.thickness, steps=(), final_sigma=final).surface(under)
    overlap = np.maximum(grid.rest - under[0], 0.0)
    along_y, along_x = (gaussian_by_cosines(n, final / d) for n, d in zip(grid.shape, reversed(grid.pitch), strict=True))
    np.testing.assert_allclose(surface.indentation[0], along_y @ overlap @ along_x.T, rtol=0.0, atol=2e-9)
    np.testing.assert_array_equal(surface.contact[0], overlap > 0.0)


def test_unknown_contact_rule_is_refused() -> None:
    with pytest.raises(InputError, match="unilateral"):
        ElasticSurround(make_grid(PAD, 0.5e-3), thickness=PAD.thickness, contact_rule="hard")


def test_threshold_rule_follows_the_object_and_the_surround_is_smooth() -> None:
    radius, depth = 4e-3, 0.6e-3
    surface = press_sphere(0.1e-3, radius=radius, depth=depth, rule="threshold")
    grid, found = surface.grid, surface.height[0]
    sphere = radius - depth - np.sqrt(np.maximum(radius**2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2, 0.0))
    overlap = grid.rest - sphere
    expected = (overlap > CONTACT_SCALE * overlap.max()) & (np.hypot(grid.x[None, :], grid.y[:, None]) < radius)
    np.testing.assert_array_equal(surface.contact[0], expected)
    unsmoothed = ElasticSurround(grid, thickness=PAD.thickness, final_sigma=0.0, contact_rule="threshold").surface(
        sphere[None].astype(float)
    )
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


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("pitch", [0.15e-3, 0.4e-3])
def test_batch_equals_single_bit_for_bit_and_nan_stays_alone(pitch: float, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = make_grid(PAD, pitch)
    monkeypatch.setattr(pyramid, "_STACK", 2 * grid.rest.size)  # two at a time
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :2, 3] = [(0.0, 0.0), (1e-3, 0.0), (0.0, 0.0), (6e-3, 4e-3), (8e-3, -6e-3)]
    poses[:, 2, 3] = 3.5e-3, 3.2e-3, np.nan, 5.0e-3, 3.5e-3
    heights = object_height([primitive("sphere", (4e-3,))], poses, grid.x, grid.y)
    single, batch = (ElasticSurround(grid, thickness=PAD.thickness, num_envs=count, device=device) for count in (1, 3))
    together = batch.surface(heights, poses)
    for b in range(5):
        alone = single.surface(heights[b : b + 1])
        np.testing.assert_array_equal(together.height[b], alone.height[0])
        np.testing.assert_array_equal(together.contact[b], alone.contact[0])
        np.testing.assert_array_equal(together.contact_centre[b], alone.contact_centre[0])
    assert np.isnan(together.height[2]).all() and not together.contact[2].any() and np.isnan(together.contact_centre[2]).all()
    assert not together.contact[3].any() and together.contact[[0, 1, 4]].any(axis=(1, 2)).all()
    assert batch.surface(heights[:0]).batch == 0


def test_a_gel_below_its_bonded_face_is_marked_in_its_environment_alone() -> None:
    grid = make_grid(PAD, 0.4e-3)
    ball = np.hypot(grid.x[None, :], grid.y[:, None]) < 2e-3
    under = np.stack([np.where(ball, grid.rest - depth, np.inf) for depth in (0.5e-3, PAD.thickness + 2e-4, 0.5e-3)])
    surface = ElasticSurround(grid, thickness=PAD.thickness, num_envs=3).surface(under)
    np.testing.assert_array_equal(np.isnan(surface.height).all(axis=(1, 2)), [False, True, False])
    np.testing.assert_array_equal(surface.contact.any(axis=(1, 2)), [True, False, True])
    np.testing.assert_array_equal(np.isnan(surface.contact_centre[:, 0]), [False, True, False])
    deep = ElasticSurround(grid, thickness=PAD.thickness + 3e-4, num_envs=3).surface(under)
    assert np.isfinite(deep.height).all() and deep.height[1].min() < -PAD.thickness
